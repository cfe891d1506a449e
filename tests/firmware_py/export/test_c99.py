"""The exporter: C that strict compilers accept, laid out as numpy does, and refusals with file, line and reason."""

import ctypes
import gc
import os
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core import structs
from firmware_py.export.c99 import ExportError, Translation, core_texts, translate
from firmware_py.export.compilers import Compiler, compilers
from firmware_py.export.literals import float_literal
from firmware_py.export.native import STRICT, build
from firmware_py.export.profile_c import profile_hash, profile_source
from firmware_py.export.syntax import parsed
from firmware_py.logic.plugs import ANSWERING, CALLS
from hil.config import load_config

COMPILERS = [compiler for compiler in compilers() if compiler.name != "cc"]
IDS = [compiler.name for compiler in COMPILERS]
C = translate()

PROBE = """\
from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import F32s, F64s, I32s, Integer, f32, f64, i32, kernel, sqrt

LIMIT = f32(2.0)
COUNT = 3


@kernel
def written(control: Control) -> bool:
    \"\"\"Write.\"\"\"
    control.integral_z = LIMIT
    return True


@kernel
def probe(x: f32, n: Integer, control: Control) -> f32:
    \"\"\"Probe.\"\"\"
    y = x * control.integral_z * f32(n)
    {body}
    return y
"""


def translated(body: str, kernel: str = "") -> Translation:
    """Translate a probe with that body, or with that kernel behind it."""
    text = PROBE.replace("{body}", body.replace("\n", "\n    ")) + kernel
    return translate(core_texts() | {"entry": text})


def test_the_probe_itself_is_inside_the_subset() -> None:
    assert (
        "float floaty_core_probe(float x, int32_t n, const FloatyControl *control)"
        in translated("y = -y").source
    )


# Statements beside those of tests/firmware_py/logic/test_loading.py.
REFUSED = [
    ("a = [x, y]", "list [..]: write a field"),
    ("a = (x, y)", "tuple (.., ..): write"),
    ("a = {}", "dict {..}: write"),
    ('a = "text"', "literal 'text'"),
    ("y = x + n", "+ of f32 and i32"),
    ("y = x // y", "// of f32: write i32(x / y)"),
    ("y = x % y", "% of f32: write x - y * f32(i32(x / y))"),
    ("a = n / 2", "/ of i32: write f32(n) / f32(2), or n // 2"),
    ("a = n << 2", "<< of i32: write n * 2 for each bit"),
    ("a = n & 1", "& of i32: write n % 2"),
    ("a = ~n", "~ of i32: write -n - 1"),
    ("a = not n", "not of i32: write n == 0"),
    ("z: f32 = x", "type of a local: write x = value"),
    ("a = b = x", "several values in one assignment"),
    ("if n:\n    y = x", "the condition is i32, not bool"),
    ("if x > y and n:\n    y = x", "an operand of and/or is i32, not bool"),
    ("y = n", "y changes its type to i32"),
    ("if n > 0:\n    z = x\ny = z", "z is read before it has a value: write z = f32(0.0) before line 19"),
    ("y = z\nz = x", "z is read before it has a value"),
    ("z = z + x\ny = z", "z is read before it has a value"),
    (
        "if n > 0:\n    return z\nz = x\ny = z",
        "z is read before it has a value: write z = f32(0.0) before line 19",
    ),
    ("x = y", "x is an argument or a loop variable and is assigned"),
    ("for i in range(4):\n    i = 2", "i is an argument or a loop variable and is assigned"),
    ("for i in range(4):\n    y = x\ny = f32(i)", "i is no value here"),
    ("for i in range(4):\n    for i in range(2):\n        y = x", "loop variable i is in use"),
    ("for i in range(0, n, 2):\n    y = x", "the numbers of a range with a step are constants"),
    ("for i in control.u:\n    y = x", "a loop runs over range"),
    ("import math", "import math is outside the subset"),
    ("y = math.sin(x)", "call math.sin(..) is no plain call of a kernel"),
    ("y = sin(x)", "call of sin, which is no kernel"),
    ("y = float(x)", "call of float, which is no kernel"),
    ("y = f64(x)", "call of f64, which is no kernel"),
    ("y = abs(n)", "the argument of abs is i32, not f32"),
    ("y = sqrt(n)", "the argument of sqrt is i32, not f32"),
    ("y = f32(x > y)", "f32(..) of bool"),
    ("a = bool(n)", "bool(..) of i32"),
    ("y = f32(1e39)", "f32(1e+39) is no finite 32-bit number"),
    ("a = i32(3000000000)", "i32(3000000000) is no finite 32-bit number"),
    ("a = n + 3000000000", "literal 3000000000"),
    ("y = control.u[-1]", "index -1: f32 array of 4 has 0..3"),
    ("y = control.u[4]", "index 4: f32 array of 4 has 0..3"),
    ("y = control.u[x]", "an index is f32, not i32"),
    ("y = control.u[0, 1]", "2 indices on f32 array"),
    ("y = control.integral_z[0]", "1 index on f32"),
    ("y = control.u", "y changes its type to f32 array"),
    ("control.u[0] = n", "f32 = i32"),
    ("control.u = control.flap", "f32 array = f32 array"),
    ("a = control", "local a of type Control"),
    ("a = written(control) and x > y", "written writes through its arguments"),
    ("a = written(x)", "control of written gets f32"),
    ("a = written(control, x)", "written takes 1 arguments"),
    ("a = written(control=control)", "is no plain call of a kernel"),
    ("y = probe(x, n, control)", "probe calls itself: recursion"),
    ("return", "return without f32"),
    ("return n", "returns i32, not f32"),
    ("if n > 0:\n    double = x\n    y = double", "double is a word of C"),
    ("for short in range(4):\n    y = x", "short is a word of C"),
    ("i_end = n\nfor i in range(i_end):\n    i_end = n + 1", "i_end is a word of C or the end of a loop"),
]


@pytest.mark.parametrize(("body", "reason"), REFUSED, ids=[body for body, _ in REFUSED])
def test_code_outside_the_subset_is_refused_with_file_line_and_reason(body: str, reason: str) -> None:
    with pytest.raises(ExportError) as refusal:
        translated(body)
    match = re.fullmatch(r"firmware_py/core/entry\.py:(\d+): (.*)", str(refusal.value))
    assert match, refusal.value
    assert reason in match[2]
    assert 19 <= int(match[1]) <= 19 + body.count("\n")


@pytest.mark.long
@pytest.mark.parametrize(
    ("body", "at_head", "inside"),
    [
        ("if n > 0:\n    z = x\n    y = z\nelse:\n    z = y\n    y = z + x", True, False),
        ("if n > 0:\n    z = x\n    y = z", False, True),
        ("if n > 0:\n    y = x\nelse:\n    z = y\n    y = z + x", False, True),
        ("if n > 0:\n    y = x\nelif n > -3:\n    z = y\n    y = z\nelse:\n    z = x\n    y = -z", True, False),
        ("if n > 0:\n    z = x\nelse:\n    z = y\ny = z", True, False),
        ("for i in range(4):\n    z = x\n    y = z\nfor j in range(4):\n    z = y\n    y = z", True, False),
        ("for i in range(4):\n    z = x\n    y = y + z", False, True),
        ("z = x\nif n > 0:\n    y = z", False, False),
    ],
)  # fmt: skip
def test_a_local_is_declared_in_the_block_that_has_all_its_uses(
    body: str, at_head: bool, inside: bool
) -> None:
    _, _, text = translated(body).source.partition("float floaty_core_probe(")
    lines = text.split("\n}\n")[0].splitlines()[1:]
    assert ("    float z = 0.0f;" in lines[:1]) == at_head
    assert any(re.match(r" {8}(const )?float z = ", line) for line in lines) == inside


REFUSED_KERNELS = [
    ("@kernel\ndef f(x) -> None:\n    '''Do.'''\n", 1, "argument x of f has no type of the subset"),
    ("@kernel\ndef f(x: float) -> None:\n    '''Do.'''\n", 1, "argument x of f has no type of the subset"),
    ("@kernel\ndef f(x: f32):\n    '''Do.'''\n", 1, "f has no result type"),
    ("@kernel\ndef f(x: f32) -> float:\n    '''Do.'''\n", 1, "f has no result type"),
    ("@kernel\ndef f(x: f32 = LIMIT) -> None:\n    '''Do.'''\n", 1, "f: only plain arguments without defaults"),
    *(
        (f"@kernel\ndef f({one}) -> None:\n    '''Do.'''\n", 1, "f: only plain arguments without defaults")
        for one in ("*x: f32", "**x: f32", "*, x: f32", "x: f32, /")
    ),
    ("@kernel\ndef f(register: f32) -> None:\n    '''Do.'''\n", 1, "register is a word of C"),
    ("@kernel\ndef f(x: f32) -> None:\n    y = x\n", 1, "no docstring"),
    ("@kernel\ndef f(x: f32) -> None:\n    '''Do.'''\n    return\n", 1, "argument x is not used"),
    ("@kernel\ndef f(x: f32) -> f32:\n    '''Do.'''\n    if x > LIMIT:\n        return x\n", 1, "may end without a result"),
    ("@kernel\ndef f(a: Parameters[f32]) -> None:\n    '''Do.'''\n", 1, "argument a of f has no type of the subset"),
    ("def f(x: f32) -> f32:\n    '''Do.'''\n    return x\n", 0, "function f is not marked @kernel alone"),
    ("@kernel\nasync def f(x: f32) -> f32:\n    '''Do.'''\n", 1, "async def f at the top of a module"),
    ("@kernel\ndef f(x: f32) -> f32:\n    '''Do.'''\n    return g(x)\n\n@kernel\ndef g(x: f32) -> f32:\n    '''Do.'''\n"
     "    return f(x)\n", 3, "g is defined below its caller"),
    ("HALF = 0.5\n", 0, "constant HALF is none of f32(number), a 32-bit integer and constant(numbers)"),
    ("HALF = f32(1e39)\n", 0, "constant HALF is none of f32(number), a 32-bit integer and constant(numbers)"),
    ("class Thing:\n    pass\n", 0, "class Thing is not a Struct"),
    ("class Thing(Struct, Other):\n    pass\n", 0, "class Thing is not a Struct"),
    ("class Thing(Struct):\n    x: float\n", 1, "field type float"),
    ("class Thing(Struct):\n    x: f64\n", 1, "field type f64"),
    ("class Thing(Struct):\n    x: Annotated[F64s, 3]\n", 1, "field type Annotated[F64s, 3]"),
    ("@kernel\ndef f(x: f64) -> None:\n    '''Do.'''\n", 1, "argument x of f has no type of the subset"),
    ("@kernel\ndef f(x: F64s) -> None:\n    '''Do.'''\n", 1, "argument x of f has no type of the subset"),
    ("class Thing(Struct):\n    x: f32 = 0\n", 1, "a struct has nothing but fields"),
    ("import math\n", 0, "import math is outside the subset, and not used: leave it out"),
    ("from math import pi\n", 0, "from math import pi is outside the subset, and not used: leave it out"),
    ("from firmware_py.core import entry\n", 0, "cannot import entry"),
    ("from firmware_py.core.maths import sin as sine\n", 0, "import under another name"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "line", "reason"), REFUSED_KERNELS, ids=[case[2] for case in REFUSED_KERNELS]
)
def test_unknown_objects_are_refused(text: str, line: int, reason: str) -> None:
    with pytest.raises(ExportError) as refusal:
        translated("y = x", text)
    first = PROBE.count("\n") + 1
    assert str(refusal.value).startswith(f"firmware_py/core/entry.py:{first + line}: {reason}")


ARRAYS = """

@kernel
def element(values: F32s) -> f32:
    '''Return an element.'''
    return values[{index}]


@kernel
def elements(control: Control, estimator: Estimator) -> f32:
    '''Return the sum of two elements.'''
    return element({first}) + element({second})
"""


@pytest.mark.parametrize("arrays", [("control.u", "estimator.now"), ("estimator.now", "control.u")])
def test_the_shortest_of_two_arrays_bounds_an_index(arrays: tuple[str, str]) -> None:
    def of_index(index: int) -> Translation:
        return translated("y = x", ARRAYS.format(index=index, first=arrays[0], second=arrays[1]))

    of_index(3)
    with pytest.raises(ExportError, match=r"index 4: f32 array of 4 has 0\.\.3"):
        of_index(4)


@pytest.mark.long
@pytest.mark.parametrize("standard", ["-std=c99", "-std=gnu11"])
@pytest.mark.parametrize("compiler", COMPILERS, ids=IDS)
def test_strict_compilers_accept_the_core_without_a_warning(compiler: Compiler, standard: str) -> None:
    build(C, compiler, "-Os", (*STRICT, standard))
    warned = C.source + "\nstatic int32_t never(void) { return 1; }\n"
    with pytest.raises(ExportError, match="never"):
        build(Translation(C.header, warned), compiler, "-Os", (*STRICT, standard))


def test_the_c_has_no_double_no_library_and_no_memory_of_its_own() -> None:
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", C.header + C.source, flags=re.S)
    assert not re.search(r"\bdouble\b|\bmalloc\b|\bmath\.h|\bsqrtf?\(|\d\.\d+(e-?\d+)?(?![\de.f])", code)
    assert not re.search(r"^(static (?!const)|(?!typedef|extern|static|#|\}|enum)\w)[^(\n]*;", code, re.M)


@pytest.mark.long
@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_a_struct_of_another_layout_does_not_compile() -> None:
    swapped = C.header.replace("int32_t quiet_ticks;", "int32_t spare;\n    int32_t quiet_ticks;")
    with pytest.raises(ExportError, match="layout_FloatyEstimator"):
        build(Translation(swapped, C.source))
    for struct in (structs.Parameters, structs.Input, structs.Estimator, structs.Control):
        assert f"sizeof(Floaty{struct.__name__}) == {struct.dtype.itemsize})" in C.source


def test_units_comments_and_docstrings_come_along() -> None:
    assert "float opening_min;  // [rad]" in C.header
    assert "counters are kept. */\nvoid floaty_core_reset(" in C.header
    assert "// eq. (input_signals) inverted: its columns are orthogonal and of length 2" in C.source
    assert "} else {  // the sensor is silent: the last rates are the best guess" in C.source
    assert "#define FLOATY_HORIZON_LIMIT 12  // ticks, 120 ms" in C.header


def test_arguments_that_are_only_read_are_const_and_private_functions_static() -> None:
    assert (
        "void floaty_core_reset(const FloatyParameters *parameters, FloatyEstimator *estimator);" in C.header
    )
    assert (
        "int32_t floaty_core_file_pose(const FloatyParameters *parameters, FloatyInput *data,\n" in C.header
    )
    assert "const FloatyControl *control," in C.header
    assert (
        "static void controller_allocate(const FloatyParameters *parameters, FloatyControl *control) {"
        in C.source
    )
    assert set(re.findall(r"^\w+ floaty_core_\w+\(|^(?!static)\w+ \w+\(", C.source, re.M)) == {
        f"{'int32_t' if name in ANSWERING else 'void'} floaty_core_{name}(" for name in CALLS
    }


def test_unreachable_code_is_left_out_and_the_version_follows_the_sources() -> None:
    texts = core_texts()
    texts["servo"] += (
        '\nSPARE = f32(7.0)\n\n\n@kernel\ndef spare(x: f32) -> f32:\n    """Spare."""\n    return x * SPARE\n'
    )
    changed = translate(texts)
    assert changed.source == C.source
    assert changed.header != C.header


def test_the_end_of_a_range_is_looked_at_once_as_in_python() -> None:
    source = translated("end = n\nfor i in range(end):\n    end = end - 1\n    y = y + f32(i)").source
    assert "for (int32_t i = 0, i_end = end; i < i_end; i++) {" in source


def test_constants_that_two_modules_define_get_the_modules_name() -> None:
    assert "static const float MODEL_DT = 0.01f;" in C.source
    assert "static const float CONTROLLER_DT = 0.01f;" in C.source


@pytest.mark.long
@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_every_float_literal_is_read_by_the_compiler_as_that_float() -> None:
    bits = np.random.default_rng(4).integers(0, 2**32, 20_000, np.uint32)
    values = bits.view(np.float32)[np.isfinite(bits.view(np.float32))]
    values = np.concatenate([values, np.array([0.0, -0.0, 1e-45, 3.4028235e38, 16777216.0], np.float32)])
    table = ",\n".join(map(float_literal, values))
    source = f"extern const float table[];\nconst float table[] = {{\n{table}}};\n"
    library = ctypes.CDLL(str(build(Translation("", source), optimisation="-O0")))
    got = np.ctypeslib.as_array((ctypes.c_float * values.size).in_dll(library, "table"))
    assert got.tobytes() == values.tobytes()


@pytest.mark.parametrize("overrides", [[], ["servo.trim=[1.5, -0.1, 0.3333, 1e-7]", "predictor.age=fixed"]])
@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_a_profile_in_c_has_the_bits_of_the_emulators_parameters(overrides: list[str]) -> None:
    config = load_config(overrides=overrides)
    library = ctypes.CDLL(str(build(Translation(C.header, profile_source(config)))))
    expected, got = parameters_of(config), structs.Parameters.allocate()
    got.memory.view(np.uint8)[:] = 0xAA
    library.floaty_core_init(ctypes.c_void_p(got.memory.ctypes.data))
    assert got.bytes() == expected.bytes()
    text = profile_hash(config).encode()
    assert ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(library, "floaty_profile_hash"))) == text
    assert profile_hash(config) != profile_hash(load_config(overrides=["servo.trim=[9, 9, 9, 9]"]))


def test_threads_read_modules_side_by_side() -> None:
    """A system call in the collector changes threads in the midst of a tree."""
    text, threshold = core_texts()["estimator"], gc.get_threshold()
    gc.callbacks.append(give_way := lambda *_: os.stat("/"))
    gc.set_threshold(50)
    try:
        with ThreadPoolExecutor(2) as threads:
            trees = [*threads.map(parsed, [text] * 40)]
    finally:
        gc.set_threshold(*threshold)
        gc.callbacks.remove(give_way)
    assert {len(tree.body) for tree in trees} == {len(parsed(text).body)}
