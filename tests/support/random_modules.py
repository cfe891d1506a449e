"""Random controllers and estimators: structs of all types, marks and names, and hooks that fit them, or do not."""

from random import Random

HEAD = """from typing import Annotated

from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.core.subset import F32s, I32s, Logged, Sensed, Struct, Tunable, f32, i32, kernel

"""
# What fits, and what does not.
KINDS = {
    "own": (
        ('f32, Tunable(0.5, "m", low=-1.0, high=2.0)', 'i32, Tunable(3, "", low=3, high=2147483647)',
         'f32, Tunable(2.0, "rad", low=1, high=2.0)'),
        ('f32, Tunable(2.5, "m", low=-1.0, high=2.0)', 'f32, Tunable(-2, "", low=-1, high=2)', "i32",
         'i32, Tunable(0.5, "", low=-1, high=2)', 'i32, Tunable(1, "", low=-0.5, high=2)',
         'i32, Tunable(1, "", low=0, high=3000000000)', 'f32, Tunable(1.0, "", low=-1e39, high=2.0)',
         'f32, Logged("m")', 'F32s, 3, Tunable(0.5, "m", low=-1.0, high=2.0)'),
    ),
    "memory": (
        ('f32, Logged("m")', 'I32s, 2, Logged("")', "F32s, 3, 2", "f32", 'F32s, 12, Logged("s")'),
        ('F32s, 2, 3, Logged("m")', 'f32, Sensed("m")', 'f32, Tunable(0.5, "m", low=-1.0, high=2.0)'),
    ),
    "sensed": (
        ('f32, Sensed("m")', 'F32s, 2, Sensed("rad")'),
        ("f32", 'i32, Sensed("m")', 'F32s, 2, 3, Sensed("m")', 'f32, Logged("m")', 'I32s, 2, Sensed("m")'),
    ),
}  # fmt: skip
HOOKS = {
    "controller": {"reset_law": "None", "control_law": "None"},
    "estimator": {"reset": "None", "file_pose": "i32", "estimate": "None"},
}
CORE = ("parameters: Parameters", "data: Input", "estimator: Estimator", "control: Control")
STRANGE = ("gains: Own", "own: Parameters", "data: Estimator", "memory: Sense", "sensed: Own", "count: i32")
WRITES = {
    "control: Control": "control.u[0] = f32(0.0)",
    "estimator: Estimator": "estimator.now[0] = f32(0.0)",
    "parameters: Parameters": "parameters.gain_z = f32(0.0)",
}
RESULTS = {"None": "return", "i32": "return i32(0)", "f32": "return f32(0.0)"}


def random_module(point: str, seed: int) -> str:
    """Return a module of a plug point; every third one fits."""
    random, text, fits = Random(f"{point} {seed}"), HEAD, seed % 3 == 0
    structs = [kind for kind in KINDS if random.random() < 0.7]
    for kind in structs:
        text += f"class {_struct(kind)}(Struct):\n"
        good, bad = KINDS[kind]
        forms = random.choices(good if fits else (*good * 2, *bad), k=random.randint(1, 8))
        for number, form in enumerate(forms):
            length = random.choice((3, 12) if fits else (3, 12, 12, 13, 18, 19, 19, 20))
            name = f"{kind[0]}{chr(97 + number)}".ljust(length, "x")
            name = name if fits or number % 3 != 1 else ("controller", "estimator")[number // 3 % 2]
            text += f"    {name}: {form if ',' not in form else f'Annotated[{form}]'}\n"
        text += "\n"
    text += "@kernel\ndef other(count: i32) -> i32:\n    return count\n\n"
    for hook, result in HOOKS[point].items():
        if not fits and random.random() < 0.2:
            continue
        arguments = random.sample(CORE, random.randrange(5)) + [
            f"{kind}: {_struct(kind)}" for kind in structs
        ]
        lines = []
        if not fits:
            arguments += [random.choice(STRANGE)] if random.random() < 0.3 else []
            result = random.choice((result, result, result, *RESULTS))
            lines = [line for one, line in WRITES.items() if one in arguments and random.random() < 0.3]
        body = "\n    ".join((*lines, RESULTS[result]))
        text += f"@kernel\ndef {hook}({', '.join(arguments)}) -> {result}:\n    {body}\n\n"
    return text


def _struct(kind: str) -> str:
    return {"own": "Own", "memory": "Memory", "sensed": "Sense"}[kind]
