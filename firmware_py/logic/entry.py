"""The entry module of a core with the user's own logic, as text: it replaces `firmware_py/core/entry.py` of the default
core.

Each call takes the memory that it needs and no more; `Entry.calls` names it, in the order of the arguments.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from firmware_py.logic.plugs import CALLS, CONTROLLER, CORE_STRUCTS, ESTIMATOR, Plug

GUARD = "guard"
HEAD = '''"""The calls by which the firmware enters the core with {which}; every argument is the memory of one struct."""

from firmware_py.core import controller, guard, predictor, servo
from firmware_py.core.guard import Guard
from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.core.subset import Memory, i32, kernel
from {package} import {modules}

_control_flaps = controller.control_flaps
_drive_servos = servo.drive_servos
_closed = guard.closed
_guard_control = guard.guard_control
_guard_estimate = guard.guard_estimate
'''
# The predictor's kernels that are called by default.
PREDICTOR = {"reset": "reset", "file_pose": "pose_into_history", "estimate": "estimate"}
DOCS = {
    "reset": "Start the estimator.",
    "file_pose": "File the pose in the input under the instant at which it was true.",
    "estimate": "Run one tick of the estimator.",
    "control": "Run one tick of the controller, down to the timer counts.",
}


@dataclass(frozen=True, slots=True)
class Entry:
    """The text, and by call the names of the blocks that it takes."""

    text: str
    calls: Mapping[str, tuple[str, ...]]


def compose(plugs: Sequence[Plug], package: str) -> Entry:
    """Return the entry module that finds the user's modules in a package."""
    by_name = {plug.point.name: plug for plug in plugs}
    modules = {plug.point.name: f"own_{plug.point.name}" for plug in plugs}
    lines = [HEAD.format(
        which=" and ".join(f"{plug.point.name} of one's own" for plug in plugs),
        package=package, modules=", ".join(modules.values()),
    )]  # fmt: skip
    types = {**CORE_STRUCTS, GUARD: "Guard"}
    for plug in plugs:
        for argument, struct in sorted(plug.structs.items(), reverse=True):  # own, memory
            alias = types[plug.block(argument)] = f"{plug.point.name.capitalize()}{argument.capitalize()}"
            own_name = struct.name.removeprefix(plug.point.name.capitalize())
            lines.append(f"{alias} = {modules[plug.point.name]}.{own_name}\n")
        lines += [f"_{hook} = {modules[plug.point.name]}.{hook}\n" for hook in plug.hooks]
    bodies = _estimator_bodies(by_name.get(ESTIMATOR.name)) | {
        "control": _control_body(by_name.get(CONTROLLER.name))
    }
    if ESTIMATOR.name not in by_name:
        lines += [f"_{hook} = predictor.{kernel}\n" for hook, kernel in PREDICTOR.items()]
    calls = {}
    for name, body in bodies.items():
        calls[name] = tuple(block for block in types if f"{block}[0]" in body)
        listed = "".join(f"    {block}: Memory[{types[block]}],\n" for block in calls[name])
        result = "i32" if name == "file_pose" else "None"
        lines.append(f'\n\n@kernel\ndef {name}(\n{listed}) -> {result}:\n    """{DOCS[name]}"""\n{body}')
    return Entry("".join(lines), calls)


def _call(plug: Plug, hook: str) -> str:
    return f"_{hook}({', '.join(f'{plug.block(argument)}[0]' for argument in plug.hooks[hook])})"


def _estimator_bodies(plug: Plug | None) -> dict[str, str]:
    hooks = dict.fromkeys(ESTIMATOR.hooks, "")
    for hook in hooks:
        default = f"_{hook}({', '.join(f'{block}[0]' for block in CALLS[hook])})"
        hooks[hook] = (
            f"    {'return ' if hook == 'file_pose' else ''}{_call(plug, hook) if plug else default}\n"
        )
    if plug:
        hooks["estimate"] += f"    _guard_estimate(estimator[0], {GUARD}[0])\n"
    return hooks


def _control_body(plug: Plug | None) -> str:
    default = "_control_flaps(parameters[0], data[0], estimator[0], control[0])\n"
    drive = "    _drive_servos(parameters[0], control[0])\n"
    if plug is None:
        return f"    {default}{drive}"
    reset = f"        {_call(plug, 'reset_law')}\n" if "reset_law" in plug.hooks else ""
    return (
        f"    if _closed(data[0]):\n        {_call(plug, 'control_law')}\n"
        f"        _guard_control(parameters[0], control[0], {GUARD}[0])\n"
        f"    else:\n{reset}        {default}{drive}"
    )
