"""The entry module of a core with the user's own logic, as text: it replaces `firmware_py/core/entry.py` of the default
core.

Each call takes only the memory that it needs; `EntryText.calls` names it, in the order of the arguments.
"""

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import dedent

from firmware_py.core import entry
from firmware_py.export.syntax import OWN
from firmware_py.logic.budget import ARGUMENT, STRUCT
from firmware_py.logic.plugs import ANSWERING, BLOCKS, CALLS, CONTROLLER, ESTIMATOR, Plug

GUARD = "guard"
HEAD = """
from firmware_py.core import guard
from firmware_py.core.guard import Guard
from {package} import {modules}

_closed = guard.closed
_guard_control = guard.guard_control
_guard_estimate = guard.guard_estimate
_note_faults = guard.note_faults
"""
BUDGET = f"""
from firmware_py.core import budget
from firmware_py.core.budget import {STRUCT}

_begin_call = budget.begin_call
_spoil_control = budget.spoil_control
_spoil_estimate = budget.spoil_estimate
"""
TEXT = Path(entry.__file__).read_text(encoding="utf-8")
PARTS = {node.name: node for node in ast.parse(TEXT).body if isinstance(node, ast.FunctionDef)}
DRIVE = "    _drive_servos(parameters, control)\n    _average_inputs(control)\n"


@dataclass(frozen=True, slots=True)
class EntryText:
    """The text, and the names of the blocks that each call takes."""

    text: str
    calls: Mapping[str, tuple[str, ...]]


def compose(plugs: Sequence[Plug]) -> EntryText:
    """Return the entry module that calls the user's modules: the core's, with some calls replaced."""
    by_name = {plug.point.name: plug for plug in plugs}
    bodies = {"supervise": f"    _note_faults(supervisor, {GUARD})\n{_body('supervise')}"}
    if ESTIMATOR.name in by_name:
        bodies |= {hook: _estimator_body(by_name[ESTIMATOR.name], hook) for hook in ESTIMATOR.hooks}
    if CONTROLLER.name in by_name:
        bodies["control"] = _control_body(by_name[CONTROLLER.name], _body("control").removesuffix(DRIVE))
    first = min(node.decorator_list[0].lineno for node in PARTS.values())
    head = "".join(TEXT.splitlines(keepends=True)[: first - 1]).rstrip() + "\n"
    lines = [re.sub(rf"^({'|'.join(bodies)}) = ", r"_\1 = ", head, flags=re.MULTILINE)]
    modules = {plug.point.name: f"own_{plug.point.name}" for plug in plugs}
    lines.append(HEAD.format(package=OWN, modules=", ".join(modules.values())))
    lines += [BUDGET] if any(plug.charged for plug in plugs) else []
    types = {**BLOCKS, GUARD: "Guard"}
    for plug in plugs:
        for argument, struct in sorted(plug.structs.items(), reverse=True):  # own, memory
            alias = types[plug.block(argument)] = f"{plug.point.name.capitalize()}{argument.capitalize()}"
            own_name = struct.name.removeprefix(plug.point.name.capitalize())
            lines.append(f"{alias} = {modules[plug.point.name]}.{own_name}\n")
        lines += [f"_own_{hook} = {modules[plug.point.name]}.{hook}\n" for hook in plug.hooks]
        if plug.charged:
            types[plug.block(ARGUMENT)] = STRUCT
    calls = dict(CALLS)
    for name, body in bodies.items():
        used = {node.id for node in ast.walk(ast.parse(dedent(body))) if isinstance(node, ast.Name)}
        calls[name] = tuple(block for block in types if block in used)
        listed = "".join(f"    {block}: {types[block]},\n" for block in calls[name])
        result = "i32" if name in ANSWERING else "None"
        lines.append(
            f'\n\n@kernel\ndef {name}(\n{listed}) -> {result}:\n    """{getattr(entry, name).__doc__}"""\n{body}'
        )
    kept = (ast.get_source_segment(TEXT, node) for name, node in PARTS.items() if name not in bodies)
    lines += [f"\n\n@kernel\n{text}\n" for text in kept]
    return EntryText("".join(lines), calls)


def _body(name: str) -> str:
    """Return the statements of an entry point behind its docstring; of another kernel's, its call."""
    if name not in PARTS:
        returns = "return " if name in ANSWERING else ""
        return f"    {returns}_{name}({', '.join(CALLS[name])})\n"
    node = PARTS[name]
    return "".join(f"{line}\n" for line in TEXT.splitlines()[node.body[1].lineno - 1 : node.end_lineno])


def _begin(plug: Plug, hook: str, indent: str) -> str:
    """Return the line that begins a call whose loops are charged; empty for another."""
    if hook not in plug.charged:
        return ""
    return f"{indent}_begin_call({plug.block(ARGUMENT)}, {plug.charged[hook]})\n"


def _spoil(plug: Plug, result: str, block: str, indent: str) -> str:
    """Return the line that spoils the result of calls over their budget; empty when no loop is charged."""
    return f"{indent}_spoil_{result}({plug.block(ARGUMENT)}, {block})\n" if plug.charged else ""


def _call(plug: Plug, hook: str) -> str:
    return f"_own_{hook}({', '.join(map(plug.block, plug.hooks[hook]))})"


def _estimator_body(plug: Plug, hook: str) -> str:
    """Return an entry point with the user's hook in place of the core's."""
    body = _body(hook)
    line = next(line for line in body.splitlines(keepends=True) if f"_{hook}(" in line)
    before = line.partition(f"_{hook}(")[0]
    own = f"{_begin(plug, hook, '    ')}{before}{_call(plug, hook)}\n"
    if hook == "estimate":
        own += _spoil(plug, "estimate", "estimator", "    ") + f"    _guard_estimate(estimator, {GUARD})\n"
    return body.replace(line, own)


def _control_body(plug: Plug, default: str) -> str:
    """Return the controller's entry point: the user's law while the loop is closed, otherwise the core's flaps."""
    indent = " " * 8
    reset = f"        {_call(plug, 'reset_law')}\n" if "reset_law" in plug.hooks else ""
    return (
        f"    if _closed(data):\n{_begin(plug, 'control_law', indent)}        {_call(plug, 'control_law')}\n"
        f"{_spoil(plug, 'control', 'control', indent)}"
        f"        _guard_control(parameters, control, {GUARD})\n"
        f"    else:\n{_begin(plug, 'reset_law', indent)}{reset}    {default}{DRIVE}"
    )
