"""The entry module of a core with the user's own logic: that of the default core, whose plug points call the user's hooks.

`POINTS` lists the statements of `firmware_py/core/entry.py` that call the core's own law and estimator, with those that
take their place. Each call takes only the memory that it needs; `EntryText.calls` names it, in the order of the arguments.
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware_py.core import entry
from firmware_py.export.syntax import OWN, VOID, parsed
from firmware_py.logic.budget import ARGUMENT, STRUCT
from firmware_py.logic.plugs import BLOCKS, CALLS, CONTROLLER, ESTIMATOR, Plug

IMPORTS = "from firmware_py.core.subset import i32, kernel"
HEAD = f"""{IMPORTS}
from firmware_py.core import guard
from firmware_py.core.guard import Guard
from {OWN} import {{modules}}

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
SUPERVISE = """
_supervise = supervisor.supervise
@kernel
def supervise() -> i32:
    _note_faults(supervisor, guard)
    return _supervise(parameters, data, estimator, sampling, supervisor)
"""
CONTROL = """
if _closed(data):
    {control_law}
    {spoil_control}
    _guard_control(parameters, control, guard)
else:
    {reset_law}
    _control_flaps(parameters, data, estimator, control)
"""
RESET = """
@kernel
def reset() -> None:
    {reset}
"""
ESTIMATE = """
{estimate}
{spoil_estimate}
_guard_estimate(estimator, guard)
"""
# By plug point: statements of the core's entry module, and the user's.
POINTS = {
    CONTROLLER.name: {"_control_flaps(parameters, data, estimator, control)": CONTROL},
    ESTIMATOR.name: {
        "reset = predictor.reset": RESET,
        "answer = _file_pose(parameters, data, estimator)": "{file_pose}",
        "_estimate(parameters, data, estimator, control)": ESTIMATE,
    },
}
TEXT = Path(entry.__file__).read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class EntryText:
    """The text, and the names of the blocks that each call takes."""

    text: str
    calls: Mapping[str, tuple[str, ...]]


def own_blocks(plugs: Sequence[Plug]) -> dict[str, str]:
    """Return the structs of the blocks that own logic adds to the core's, by the blocks' names."""
    blocks = {"guard": "Guard"}
    for plug in plugs:
        blocks |= {plug.block(argument): struct.name for argument, struct in plug.structs.items()}
        blocks |= {plug.block(ARGUMENT): STRUCT} if plug.charged else {}
    return blocks


def compose(plugs: Sequence[Plug]) -> EntryText:
    """Return the entry module that calls the user's modules."""
    head = HEAD.format(modules=", ".join(f"own_{plug.point.name}" for plug in plugs))
    head += BUDGET if any(plug.charged for plug in plugs) else ""
    points = {"supervise = supervisor.supervise": SUPERVISE}
    for plug in plugs:
        module = f"own_{plug.point.name}"
        head += "".join(f"{struct.name} = {module}.{struct.shown}\n" for struct in plug.structs.values())
        head += "".join(f"_own_{hook} = {module}.{hook}\n" for hook in plug.hooks)
        calls = _hook_calls(plug)
        points |= {core: own.format(**calls) for core, own in POINTS[plug.point.name].items()}
    types = {**BLOCKS, **own_blocks(plugs)}
    points[IMPORTS] = head
    body = _exchanged(parsed(TEXT).body, points)
    taken = dict(CALLS)
    for node in body:
        if isinstance(node, ast.FunctionDef):
            if ast.get_docstring(node) is None:
                node.body.insert(0, ast.Expr(ast.Constant(getattr(entry, node.name).__doc__)))
            node.body = _exchanged(node.body, points)
            used = {part.id for line in node.body for part in ast.walk(line) if isinstance(part, ast.Name)}
            taken[node.name] = tuple(block for block in types if block in used)
            node.args.args = [ast.arg(block, ast.Name(types[block])) for block in taken[node.name]]
    assert not points, f"not in core/entry.py: {', '.join(points)}"
    return EntryText(ast.unparse(ast.Module(body, [])), taken)


def _exchanged(body: Sequence[ast.stmt], points: dict[str, str]) -> list[ast.stmt]:
    """Return statements; at a plug point, those that take its place out of `points`."""
    return [new for line in map(ast.unparse, body) for new in parsed(points.pop(line, line)).body]


def _hook_calls(plug: Plug) -> dict[str, str]:
    """Return the calls of a plug's hooks and of what spoils a result over the loop budget; "" for what it lacks."""
    budget = plug.block(ARGUMENT)
    calls = {"reset_law": "", "spoil_control": "", "spoil_estimate": ""}
    for hook, arguments in plug.hooks.items():
        begin = f"_begin_call({budget}, {plug.charged[hook]}); " if hook in plug.charged else ""
        answer = "" if plug.point.hooks[hook] == VOID else "answer = "
        calls[hook] = f"{begin}{answer}_own_{hook}({', '.join(map(plug.block, arguments))})"
    if plug.charged:
        calls["spoil_control"] = f"_spoil_control({budget}, control)"
        calls["spoil_estimate"] = f"_spoil_estimate({budget}, estimator)"
    return calls
