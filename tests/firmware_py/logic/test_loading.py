"""What a module of the user's may hold, and what it is told when it does not: file, line, and what to write instead."""

import re
from pathlib import Path
from textwrap import indent

import pytest

from firmware_py.config import LogicConfig, parameters_of
from firmware_py.core_runner import CoreBlocks, PlainRunner, default_runner
from firmware_py.export import compilers
from firmware_py.export.errors import ExportError
from firmware_py.logic.loading import load_logic
from hil.config import load_config
from hil.errors import LabError
from support.command import Cli
from support.own_logic import AS_BUILT_IN, ESTIMATOR, HEAD, LAW, make_project, own_config


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


IN_LAW = "    memory.ticks = i32(memory.ticks + 1)\n"
GAIN = '    gain_iy: Annotated[f32, Tunable(-0.4, "rad/m/s", low=-2.0, high=2.0)]\n'
HOOK = "estimator: Estimator, control: Control, own: Gains, memory: Memory) -> None:"
IMPORTS = "from typing import Annotated\n"
CALLS_NUMPY = (IMPORTS, IMPORTS + "import numpy as np\n")


# A statement, the place of its line that the message points to, and what it says.
IN_THE_LAW = [
    ("control.u[1] = 0.5", 0, "float literal 0.5 without f32(..): write f32(0.5)"),
    ("control.u[1] = own.gain_iy ** 2", 0, "** of f32 and i32: write own.gain_iy * own.gain_iy"),
    ("control.u[1] = np.dot(own.gain_iy, ZERO)", 0,
     "call np.dot(..) is no plain call of a kernel: write a loop over range(..)"),
    ("control.u[1] = clamp(x=ZERO, low=ZERO, high=ZERO)", 0, "write the arguments in their order, without names"),
    ("control.u[1] = own.gain_iy * 2", 0, "* of f32 and i32: write f32(2)"),
    ("if 0 < own.gain_iy:\n    control.u[1] = ZERO", 0, "comparison of i32 and f32: write f32(0)"),
    ("if ZERO < own.gain_iy < ZERO:\n    control.u[1] = ZERO", 0, ": write ZERO < own.gain_iy and own.gain_iy < ZERO"),
    ("if own.gain_iy:\n    control.u[1] = ZERO", 0, "the condition is f32, not bool: write own.gain_iy != f32(0.0)"),
    ("first, second = ZERO, ZERO", 0, "several values in one assignment: write one assignment for each value"),
    ("control.u[0:2] = ZERO", 0, "slice: write a loop over range(..)"),
    ("control.u[POSITION + 4] = ZERO", 0, "index POSITION + 4, which is 4: f32 array of 4 has 0..3"),
    ("for flap in range(2, 5):\n    control.u[flap - 1] = control.u[flap]", 1,
     "index flap, which is 2..4: f32 array of 4 has 0..3"),
    ("for flap in range(4):\n    control.u[flap - 1] = ZERO", 1, "index flap - 1, which is -1..2: f32 array of 4 has 0..3"),
    ("control.u[memory.ticks] = ZERO", 0,
     "index memory.ticks: it may be outside 0..3 in flight: write memory.ticks % 4"),
    ("for flap in range(memory.ticks):\n    control.u[flap] = ZERO", 1, "index flap: it may be outside 0..3 in flight"),
    ("control.u[memory.ticks % 5] = ZERO", 0, "index memory.ticks % 5, which is 0..4: f32 array of 4 has 0..3"),
    ("a = i32(7 // memory.ticks)", 0, "7 // memory.ticks: the divisor must be a constant above 0"),
    ("a = i32(memory.ticks % 0)", 0, "memory.ticks % 0: the divisor must be a constant above 0"),
    ("a = i32(memory.ticks // -2)", 0, "memory.ticks // -2: the divisor must be a constant above 0"),
    ("control.u[1] = own.gain_jy", 0, "own.gain_jy is no field of a struct: write own.gain_iy"),
    ("a = [v * v for v in control.u]", 0, "list comprehension: write a loop over range(..)"),
    ("a = {v for v in control.u}", 0, "set comprehension: write a loop over range(..)"),
    ("a = {v: v for v in control.u}", 0, "dict comprehension: write a loop over range(..)"),
    ("a = sum(v for v in control.u)", 0, "generator expression: write a loop over range(..)"),
    ("twice = lambda v: v + v", 0, "lambda: write a @kernel of its own, above this one"),
    ("def twice(v: f32) -> f32:\n    return v + v", 0, "function inside a function: write a @kernel of its own"),
    ("class Inner:\n    v = 1", 0, "class inside a function: write a Struct at the top of the file"),
    ("import math\na = math.sin(ZERO)", 1, "write sin(x), from firmware_py.core.maths"),
    ("import numpy as np", 0, "import numpy as np is outside the subset, and not used: leave it out"),
    ("from math import sqrt as root\na = root(ZERO)", 1, "write sqrt(x), from firmware_py.core.subset"),
    ("from firmware_py.core.maths import cos", 0, "import inside a function: write it at the top of the file"),
    ("try:\n    a = ZERO\nexcept ValueError:\n    a = DT", 0, "try: write an if"),
    ("with control as c:\n    a = c", 0, "with: write its lines without it"),
    ("global DT", 0, "global: write a field of the memory struct"),
    ("nonlocal DT", 0, "nonlocal: write a field of the memory struct"),
    ('a = f"{DT}"', 0, "f-string: write a field of the memory struct marked Logged(unit)"),
    ("if (a := ZERO) < DT:\n    return", 0, "assignment with :=: write an assignment on a line of its own"),
    ("match memory.ticks:\n    case 1:\n        a = ZERO", 0, "match: write if and elif"),
    ("a = clamp(*control.u)", 0, "* before an argument: write the arguments one by one"),
    ("a = clamp(**control.u)", 0, "write the arguments in their order, without names"),
    ("a, *b = control.u", 0, "* before an argument: write the arguments one by one"),
    ("while True:\n    a = ZERO\nelse:\n    a = DT", 0, "while: write a loop over range(..)"),
    ("for i in range(3):\n    a = ZERO\nelse:\n    a = DT", 3, "else of a loop: write its lines behind the loop"),
    ("del control", 0, "del: write nothing"),
    ("yield ZERO", 0, "yield: write a field of the memory struct"),
    ("a = await control", 0, "await: write nothing"),
    ("a = ZERO if memory.ticks == 0 else DT", 0, "a if .. else b: write an if on lines of its own"),
    ("raise ValueError", 0, "raise: write an if"),
    ("assert memory.ticks == 0", 0, "assert: write an if"),
    ("a = memory.ticks in (1, 2)", 0, "comparison memory.ticks in (1, 2): write memory.ticks == 1 or memory.ticks == 2"),
    ("a = 3000000000", 0, "literal 3000000000: write a number of 32 bits"),
    ("a = 2j", 0, "literal 2j: write a number, as f32(0.5) or 3"),
    ("a = None", 0, "literal None: write a number, as f32(0.5) or 3"),
    ("a = 'text'", 0, "literal 'text': write a number, as f32(0.5) or 3"),
    ("a = memory is control", 0, "comparison memory is control: write memory == control"),
    ("a = memory.ticks is not 3", 0, "comparison memory.ticks is not 3: write memory.ticks != 3"),
]  # fmt: skip


def refused_in(folder: Path, text: str) -> dict[int, str]:
    """The reasons by their lines."""
    with pytest.raises(LabError) as error:
        own_config(folder, text)
    found: dict[int, str] = {}
    for one in str(error.value).splitlines():
        place = re.match(rf"{folder / 'controller.py'}:(\d+): ", one)
        assert place, one
        found[int(place[1])] = found.get(int(place[1]), "") + one.removeprefix(place[0])
    return found


def test_every_unsupported_statement_is_refused_in_its_line(tmp_path: Path) -> None:
    """Each in a kernel that the law calls."""
    kernels, calls = "", ""
    for row, (statement, *_) in enumerate(IN_THE_LAW):
        head = f"@kernel\ndef row_{row}(control: Control, own: Gains, memory: Memory) -> None:\n"
        kernels += head + indent(f"{statement}\n", "    ") + "\n\n"
        calls += f"    row_{row}(control, own, memory)\n"
    text = changed(changed(LAW, AT_LAW, kernels + AT_LAW), IN_LAW, IN_LAW + calls)
    found = refused_in(tmp_path, text)
    for row, (statement, line, told) in enumerate(IN_THE_LAW):
        assert told in found.get(line_of(text, f"def row_{row}(") + 1 + line, ""), statement


AT_LAW = "@kernel\ndef control_law"
DT = "DT = f32(0.01)"
GUARD = "from firmware_py.core.guard import allocate"


def hook(old: str, new: str) -> tuple[str, str, str]:
    return HOOK, HOOK.replace(old, new), AT_LAW


def line_more(line: str) -> tuple[str, str, str]:
    return IN_LAW, f"{IN_LAW}    {line}\n", AT_LAW


def gain(new: str, at: str = "    gain_iy") -> tuple[str, str, str]:
    return GAIN, new, at


# The text that is replaced, what by, where the message points to, and what it says.
MISTAKES = [
    (
        "def control_law",
        "def control_low",
        "",
        "no function control_law; functions there: reset_law, control_low",
    ),
    ("def reset_law", "def forget", "", "no function reset_law; functions there: forget, control_law"),
    (*hook("own: Gains", "gains: Gains"), "control_law: argument gains: expected any of"),
    (*hook("own: Gains", "own: Parameters"), "control_law: argument own: expected any of"),
    (*hook("-> None", "-> f32"), "control_law: expected -> None"),
    (*hook("estimator: Estimator", "estimator"), "argument estimator of control_law has no type"),
    (
        *line_more("parameters.gain_z = ZERO"),
        "control_law writes parameters: it may write control and memory",
    ),
    (*line_more("own.after = i32(1)"), "control_law writes own: it may write control and memory"),
    (*gain("    gain_iy: f32\n"), "gain_iy: a parameter is Annotated[f32, Tunable(default,"),
    (
        *gain("    gain_iy: Annotated[f32, Tunable(0.4)]\n"),
        'Tunable(0.4): expected Tunable(default, "unit", low=.., high=..)',
    ),
    (
        *gain('    gain_iy: Annotated[f32, Tunable(0.4, "rad")]\n'),
        "Tunable(0.4, 'rad'): expected Tunable(default,",
    ),
    (*gain("    gain_iy: Annotated[f32, Tunable(0.4, low=0.0, high=1.0)]\n"), "expected Tunable(default,"),
    (*gain(GAIN.replace("-0.4", "-2.4")), "gain_iy: default -2.4 is outside -2..2"),
    (*gain(GAIN.replace("high=2.0", "high=1e39")), "gain_iy: 1e+39: expected a finite number of 32 bits"),
    (*gain(GAIN.replace("high=2.0", "high=1e999")), "gain_iy: inf: expected a finite number of 32 bits"),
    (*gain(GAIN.replace("f32", "i32")), "gain_iy: -0.4: expected a whole number of 32 bits"),
    (*gain(GAIN.replace("gain_iy", "größe"), "    größe"), "größe: expected a name of a-z, 0-9 and _"),
    (
        "hidden: f32",
        "__hidden: f32",
        "    __hidden",
        "__hidden: expected a name of a-z, 0-9 and _ without __ in front",
    ),
    (
        *gain(GAIN.replace("gain_iy", "a_gain_of_mine"), "    a_gain"),
        "a_gain_of_mine: 14 characters; MAVLink leaves a parameter's name 12",
    ),
    (
        *gain(GAIN + GAIN.replace("-0.4", "0.4"), "    gain_iy: Annotated[f32, Tunable(0.4,"),
        "gain_iy: this name exists already",
    ),
    (
        *gain(GAIN.replace("gain_iy", "estimator"), "    estimator: Ann"),
        "estimator: this name exists already, as a key of [logic]",
    ),
    (DT, f"{DT}\nZERO = f32(0.0)", "ZERO = f32", "ZERO: this name exists already"),
    (
        *("integral: Annotated", "a_very_long_name_for_a_log: Annotated", "    a_very"),
        "26 characters; a log variable's name has at most 19",
    ),
    (
        *("hidden: f32", 'hidden: Annotated[f32, Tunable(0.0, "", low=0.0, high=1.0)]', "    hidden"),
        "hidden: in the memory",
    ),
    (
        *(
            IMPORTS,
            f"{IMPORTS}from firmware_py.core.maths import tan\n",
            "from firmware_py.core.maths import tan",
        ),
        "firmware_py.core.maths has no tan: there is none: put it together",
    ),
    (*("hidden: f32", 'hidden: Annotated[f32, Sensed("m")]', "    hidden", "hidden: in the memory"),),
    (IMPORTS, f"{IMPORTS}from os import path\n", "from os", "import from os"),
    (
        *(GUARD, GUARD.replace("guard", "controller"), GUARD.replace("guard", "controller")),
        ": write allocate, from firmware_py.core.guard: it does not make a number of NaN",
    ),
    (
        *(DT, f"from firmware_py.core import controller\n_mix = controller.allocate\n{DT}", "_mix"),
        ": write allocate, from firmware_py.core.guard: it does not make a number of NaN",
    ),
    (DT, "DT = f32(0.01", "DT", "'(' was never closed"),
    (DT, f"{DT}\0", "", "source code string cannot contain null bytes"),
]


@pytest.mark.parametrize(("old", "new", "at", "told"), MISTAKES)
def test_a_mistake_is_reported_with_its_place(tmp_path: Path, old: str, new: str, at: str, told: str) -> None:
    text = changed(LAW, old, new)
    assert told in refused_in(tmp_path, text)[line_of(text, at) + at.count("\n") if at else 1]


NUMPY = {
    "np.sin(own.gain_iy)": "write sin(x), from firmware_py.core.maths",
    "np.clip(own.gain_iy, ZERO, ZERO)": "write clamp(x, low, high), from",
    "np.zeros(3)": "write a field Annotated[F32s, n] of the memory struct",
    "np.exp(own.gain_iy)": "there is none",
    "np.tanh(own.gain_iy)": "write tanh(x), from firmware_py.core.maths",
    "np.i0(own.gain_iy)": "",
}


def test_every_numpy_call_is_refused_in_its_line_with_a_replacement(tmp_path: Path) -> None:
    calls = "".join(f"    control.u[1] = {call}\n" for call in NUMPY)
    text = changed(changed(LAW, *CALLS_NUMPY), IN_LAW, IN_LAW + calls)
    found = refused_in(tmp_path, text)
    for call, told in NUMPY.items():
        reason = f"{call.partition('(')[0]} is outside the subset" + (f": {told}" if told else "")
        assert reason in found[line_of(text, call)]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder: the same module in it is loaded once."""
    return tmp_path_factory.mktemp("project")


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ("gain_iz = 1.0", "logic.gain_iz: no parameter of that name; did you mean gain_iy?"),
        ("gain_iy = 2.5", "logic.gain_iy = 2.5: outside -2..2 rad/m/s"),
        ("after = 1.5", "logic.after = 1.5: expected a whole number"),
        ('gain_iy = "much"', "logic.gain_iy = 'much'"),
        ("gain_iy = nan", "logic.gain_iy = nan"),
    ],
)
def test_a_wrong_profile_value_is_refused_with_the_range(project: Path, values: str, told: str) -> None:
    with pytest.raises(LabError) as error:
        own_config(project, values=values)
    assert str(error.value).startswith(told)


@pytest.mark.long
def test_names_of_two_modules_that_clients_could_not_tell_apart_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        LabError, match=r"estimator.py: GAIN_IY: this name exists already: gain_iy in .*controller.py"
    ):
        own_config(tmp_path, LAW, ESTIMATOR.replace("until", "GAIN_IY"))


def test_a_value_without_own_logic_is_refused() -> None:
    with pytest.raises(LabError, match=r"logic.gain_y: neither a controller nor an estimator"):
        load_config(overrides=["logic.gain_y=1.0"])


def test_a_file_that_is_not_there_is_one_line_and_exit_code_two(cli: Cli, tmp_path: Path) -> None:
    profile = make_project(tmp_path)
    (tmp_path / "controller.py").unlink()
    assert cli("fly", "hover", "--profile", profile) == 2
    said = cli.err
    assert said == f"floaty: logic.controller = {tmp_path / 'controller.py'}: No such file or directory\n"
    assert cli("fly", "hover", "--set", "logic.controller=lqrr") == 2
    assert cli.err.endswith("lqrr: No such file or directory; laws that ship: lqr, original\n")


@pytest.mark.long
def test_a_wrong_module_is_one_line_always(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    make_project(tmp_path, changed(LAW, "f32(0.01)", "0.01"))
    for command in (("fly", "hover"), ("deploy", "check"), ("deploy", "write", "app")):
        assert cli(*command, "--profile", "profile.toml") == 2
        said = cli.err
        at = f"controller.py:{line_of(LAW, 'DT =')}"
        assert (
            said
            == f"floaty: {at}: constant DT is none of f32(number), a 32-bit integer and constant(numbers): "
            "write DT = f32(0.01)\n"
        )


@pytest.mark.long
def test_paths_begin_at_the_profile_that_names_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    project, child = tmp_path / "project", tmp_path / "child"
    project.mkdir()
    child.mkdir()
    make_project(project, AS_BUILT_IN)
    (child / "mine.toml").write_text('base = "../project/profile.toml"\n', encoding="utf-8")
    config = load_config(str(child / "mine.toml"))
    assert config.logic.controller == str(project / "controller.py")
    monkeypatch.chdir(project)
    assert load_config(overrides=["logic.controller=controller.py"]).logic == config.logic
    assert load_config("profile.toml", ["logic.controller=''"]).logic.controller == ""
    assert load_config("profile.toml", ["logic.controller=lqr"]).logic == load_config("lqr").logic


@pytest.mark.long
def test_an_edited_module_is_never_mistaken_for_what_it_was(tmp_path: Path) -> None:
    def after_one_tick(factor: str) -> float:
        law = AS_BUILT_IN + f"    control.u[0] = f32({factor})\n"
        config = own_config(tmp_path, law)
        blocks = CoreBlocks(parameters_of(config), default_runner, load_logic(config.logic))
        blocks.data.fields.mode = 1
        blocks.run.call("control")
        return float(blocks.control.fields.u[0])

    assert [after_one_tick(factor) for factor in ("0.25", "0.5", "0.25")] == [0.25, 0.5, 0.25]
    assert {path.suffix for path in tmp_path.rglob("*")} == {".py", ".toml"}, "compiled code in a project"


@pytest.mark.long
def test_a_project_gets_no_compiled_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project, cache = tmp_path / "project", tmp_path / "cache"
    project.mkdir()
    monkeypatch.setenv("FLOATY_CACHE_DIR", str(cache))
    config = own_config(project, AS_BUILT_IN)
    for _ in range(2):
        CoreBlocks(parameters_of(config), default_runner, load_logic(config.logic))
    assert [path.stat().st_mode & 0o777 for path in cache.rglob("core.so")] == [0o600]
    assert capsys.readouterr().err == f"floaty: compiling {Path(config.logic.controller).name}\n"
    assert {path.suffix for path in project.rglob("*")} == {".py", ".toml"}


@pytest.mark.long
def test_without_a_compiler_own_logic_flies_as_python_and_one_line_names_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FLOATY_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compilers, "compilers", lambda: iter(()))
    config = own_config(tmp_path, AS_BUILT_IN + "    control.u[0] = f32(0.25)\n")
    for _ in range(2):
        blocks = CoreBlocks(parameters_of(config), default_runner, load_logic(config.logic))
        assert isinstance(blocks.run, PlainRunner)
    blocks.data.fields.mode = 1
    blocks.run.call("control")
    assert blocks.control.fields.u[0] == 0.25
    assert re.fullmatch(
        r"floaty: flies as plain Python, far slower: no C compiler on this "
        r"machine: .*pip install .*ziglang.*\n",
        capsys.readouterr().err,
    )


def test_text_outside_the_subset_is_an_export_error(tmp_path: Path) -> None:
    (tmp_path / "law.py").write_text(changed(LAW, IN_LAW, "    print(own.after)\n"), encoding="utf-8")
    with pytest.raises(
        ExportError, match=r"call of print, which is no kernel: write a field of the memory struct"
    ):
        load_logic(LogicConfig(controller=str(tmp_path / "law.py")))


PATHS = (
    HEAD
    + """
class Memory(Struct):
    n: i32


@kernel
def reset_law(memory: Memory) -> None:
    memory.n = i32(0)


@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control, memory: Memory) -> None:
    feedback(parameters, estimator, control)
    k = memory.n
    if memory.n > 5:
        k = i32(1)
    OTHERWISE
    control.u[0] = control.u[k]
    allocate(parameters, control)
"""
)


@pytest.mark.long
@pytest.mark.parametrize(
    ("otherwise", "known"),
    [
        ("else:\n        k = i32(2)", True), ("", False), ("else:\n        k = i32(k + 1)", False),
        ("elif memory.n < 2:\n        k = i32(2)\n    else:\n        k = i32(3)", True),
        ("elif memory.n < 2:\n        k = i32(2)", False),
        ("else:\n        allocate(parameters, control)\n        return", True),
    ],
)  # fmt: skip
def test_an_index_is_bounded_where_each_path_bounds_it(tmp_path: Path, otherwise: str, known: bool) -> None:
    law = PATHS.replace("OTHERWISE", otherwise)
    if known:
        own_config(tmp_path, law)
    else:
        with pytest.raises(LabError, match=r"index k: it may be outside 0\.\.3 in flight"):
            own_config(tmp_path, law)
