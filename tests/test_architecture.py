"""Who may import whom, and which files alone may touch clocks, threads, randomness and heavy libraries."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("firmware_py", "ground_station", "hil")

# What a package may import of ours, longest prefix of the importing module first. A name allows what is below it.
LAYERS: dict[str, tuple[str, ...]] = {
    "firmware_py.core.subset": ("firmware_py.compiling",),
    "firmware_py.core": ("firmware_py.core",),
    "firmware_py.wire": ("firmware_py.wire", "firmware_py.geometry", "firmware_py.elementary"),
    "firmware_py.crazyflie": (
        "firmware_py.crazyflie", "firmware_py.wire", "firmware_py.geometry", "firmware_py.elementary",
    ),
    "firmware_py.geometry": ("firmware_py.elementary",),
    "firmware_py.elementary": (),
    "firmware_py.compiling": ("firmware_py.kept_code", "firmware_py.core.subset", "firmware_py.export"),
    "firmware_py.kept_code": (),
    "firmware_py.extras": (),
    "firmware_py.section": (),
    "firmware_py": ("firmware_py",),
    "ground_station": (
        "ground_station", "firmware_py.wire", "firmware_py.geometry", "firmware_py.elementary", "firmware_py.extras",
        "firmware_py.section", "firmware_py.table",
        "firmware_py.core.structs",  # the oldest pose that the board can use
    ),
    "hil.errors": ("firmware_py.extras",),
    "hil.emulator.events": ("firmware_py.rtos.memory",),
    "hil.emulator.stm32f405": ("hil.emulator", "hil.errors", "firmware_py.export", "firmware_py.extras"),
    "hil.emulator": (
        "hil.emulator", "hil.errors", "hil.world", "firmware_py.wire.scalars", "firmware_py.wire.memories",
        "firmware_py.elementary", "firmware_py.section",
    ),
    "hil.research.learn": ("hil", "ground_station", "firmware_py"),
    "hil.pictures.exports.demonstrations": ("hil", "firmware_py"),
    "hil": (
        "hil", "ground_station",
        "firmware_py.firmware", "firmware_py.core_runner", "firmware_py.export", "firmware_py.board",
        "firmware_py.config", "firmware_py.signals", "firmware_py.rtos",
        "firmware_py.wire", "firmware_py.geometry", "firmware_py.elementary", "firmware_py.compiling",
        "firmware_py.errors", "firmware_py.extras", "firmware_py.logic", "firmware_py.policy",
        "firmware_py.section", "firmware_py.table", "firmware_py.kept_code",
        "firmware_py.core.subset",  # the language of the world's kernels
        "firmware_py.tasks",
    ),
}  # fmt: skip

# The wings of hil from the ground up: one imports from itself and from floors below, a `config` also from other configs.
# All import from `errors`.
FLOORS = (
    ("world",),
    ("emulator",),
    ("board",),
    ("config",),
    ("laboratory",),
    ("pictures", "servers"),
    ("live", "api"),
    ("research", "deploy", "testing"),
    ("commands",),
)
FLOOR = {wing: floor for floor, wings in enumerate(FLOORS) for wing in wings}
# The rooms of a wing that its other rooms do not import from; the later ones import from the earlier ones.
UPSTAIRS = {
    "emulator": ("crazyflie",),
    "laboratory": ("experiments",),
    "research": ("identify", "studies", "learn"),
}

# All others work with any body, which hil/laboratory/bodies.py makes for them.
KNOW_FLOATY = (
    "hil.world.floaty", "hil.config", "hil.laboratory.bodies", "hil.laboratory.experiments", "hil.research.design",
    "hil.research.identify", "hil.research.studies", "hil.research.learn",
)  # fmt: skip

# Outside libraries that the core may use at all.
CORE_LIBRARIES = {"numpy", "typing"}

# Module or attribute -> the files that alone may use it.
CONFINED: dict[str, tuple[str, ...]] = {
    "rerun": ("hil/pictures/viewer/",),
    "foxglove": ("hil/pictures/exports/mcap.py", "hil/live/foxglove_server.py"),
    "gymnasium": ("hil/research/learn/",),
    "av": ("hil/pictures/video.py",),
    "tornado": ("hil/live/panel.py", "hil/live/local_server.py", "hil/live/foxglove_server.py"),
    "youplot": ("hil/pictures/pages.py",),
    "time": (
        "hil/board/clock.py", "hil/commands/listing.py",
        "hil/research/campaigns/jobs.py", "ground_station/clock.py", "hil/servers/usb_dongle.py",
        "hil/servers/dongle_plugin.py",
    ),
    "datetime": (),
    "asyncio": (),
    "threading": (
        "hil/live/feed.py", "hil/live/local_server.py", "hil/research/campaigns/workers.py",
        "ground_station/links/live_link.py", "ground_station/links/crazyradio.py", "ground_station/links/mavlink_serial.py",
        "ground_station/terminal.py", "hil/servers/dongle_plugin.py", "hil/emulator/stm32f405/checkpoints.py",
        "firmware_py/export/syntax.py",
    ),
    "prompt_toolkit": ("ground_station/terminal.py",),
    "multiprocessing": ("hil/research/campaigns/workers.py", "hil/servers/swarm.py"),
    "concurrent": ("hil/research/campaigns/workers.py",),
    "unicorn": ("hil/emulator/stm32f405/chip.py",),
    "onnx": ("firmware_py/policy/reading.py",),
    "safetensors": ("firmware_py/policy/reading.py",),
    "elftools": ("firmware_py/export/elf.py",),
    "ctypes": (
        "firmware_py/compiling.py", "firmware_py/core/subset.py", "hil/board/cores/cortex_m4.py",
        "hil/emulator/stm32f405/checkpoints.py",
    ),
    "cffi": ("hil/emulator/stm32f405/chip.py",),
    "subprocess": (
        "hil/laboratory/files/installation.py", "hil/live/", "hil/servers/linked.py", "hil/servers/usb_dongle.py",
        "ground_station/sources/motioncapture_client.py",
        "firmware_py/export/compilers.py",
    ),
    "socket": (
        "hil/board/clock.py", "hil/emulator/stm32f405/checkpoints.py", "hil/emulator/stm32f405/gdb.py",
        "hil/live/window.py", "hil/servers/dongle_plugin.py", "hil/servers/tcp_port.py",
        "hil/servers/udp_server.py", "hil/servers/serial_server.py", "hil/servers/motive.py", "hil/servers/usb_dongle.py",
        "ground_station/sources/optitrack.py", "ground_station/sources/motioncapture_process.py",
    ),
    "select": (
        "ground_station/clock.py", "hil/emulator/stm32f405/checkpoints.py", "hil/emulator/stm32f405/gdb.py",
    ),
    "selectors": ("ground_station/clock.py", "hil/servers/usb_dongle.py"),
    "platformdirs": ("firmware_py/kept_code.py",),
    "jinja2.FileSystemBytecodeCache": ("hil/pictures/pages.py",),
    "pickle": (),  # loading one executes what it names
    "marshal": (),
    "shelve": (),
    "random": (),
    "secrets": (),
    "numpy.random.default_rng": ("hil/laboratory/robot.py", "hil/research/campaigns/sampling.py"),
    "numpy.random.seed": (),
    "cflib": ("ground_station/links/crazyradio.py", "ground_station/links/packets.py", "ground_station/flashing.py"),
    "serial": ("ground_station/links/mavlink_serial.py",),
    "pymavlink": (
        "firmware_py/wire/mavlink.py", "firmware_py/wire/mavlink_dialect.py", "firmware_py/wire/mavlink_frames.py",
        "firmware_py/wire/mavlink_services.py",
    ),
    "filterpy": (),
    "motioncapture": ("ground_station/sources/motioncapture_process.py",),
    "scipy": ("hil/research/",),
    "control.dlqr": ("hil/research/design/",),
    "control.stability_margins": ("hil/research/design/",),  # `control` alone is also a name of ours
    "SALib": ("hil/research/campaigns/",),
    "dask": (),
    "distributed": ("hil/research/campaigns/workers.py",),
    "pytest": ("hil/testing/",),
    "hypothesis": ("hil/testing/strategies.py",),
    "perfetto": ("hil/pictures/exports/perfetto.py",),
    "matplotlib": ("hil/pictures/", "hil/research/"),
    "pyarrow": ("hil/api.py", "hil/laboratory/", "hil/pictures/", "hil/live/", "hil/research/"),
}  # fmt: skip
# BLAS, LAPACK, the C library's functions and numpy's vector code have other last bits on other processors, so they
# stay out of all that flies; these files look at what was flown, or are done before.
AFTER_THE_FLIGHT = (
    "hil/laboratory/metrics.py", "hil/pictures/", "hil/laboratory/experiments/measures.py",
    "hil/laboratory/experiments/take_off.py", "hil/research/design/", "hil/research/identify/",
    "hil/research/campaigns/findings.py", "hil/research/studies/paper_identification.py",
)  # fmt: skip
BY_PROCESSOR = """
    math.sin math.cos math.tan math.asin math.acos math.atan math.atan2 math.exp math.expm1 math.log math.log1p math.log2
    math.log10 math.pow numpy.sin numpy.cos numpy.tan numpy.arcsin numpy.arccos numpy.arctan numpy.arctan2 numpy.exp
    numpy.expm1 numpy.log numpy.log1p numpy.log2 numpy.log10 numpy.power numpy.hypot numpy.linalg numpy.dot numpy.inner
    numpy.matmul numpy.einsum numpy.convolve numpy.polyfit numpy.polynomial
""".split()  # noqa: SIM905
CONFINED |= dict.fromkeys(BY_PROCESSOR, AFTER_THE_FLIGHT)
CONFINED["click"] = CONFINED["rich"] = (
    "hil/commands/", "hil/research/campaigns/run.py",
)  # fmt: skip
# Of a whole flight.
CONFINED |= dict.fromkeys(("numpy.arctan2", "numpy.arcsin"), ("firmware_py/geometry.py",))
NORMAL_NOISE = "hil/world/fixed_order.py"
DRAWS = (
    "standard_normal", "exponential", "standard_exponential", "geometric", "poisson", "multivariate_normal",
)  # fmt: skip
# Only the first prints texts of others; the next prints to a pipe, the third its own progress, the fourth paths in
# ASCII, the last what its own command refuses.
PRINTERS = (
    "ground_station/lines.py", "hil/live/picture.py", "hil/api.py", "firmware_py/kept_code.py", "hil/servers/usb_dongle.py",
)  # fmt: skip
SUBSET = "firmware_py/core/subset.py"  # the border of the subset: it may use the standard library


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """Every node of a source, which is parsed once for all tests."""
    return tuple(ast.walk(ast.parse(source)))


def imported(source: str) -> list[tuple[int, str]]:
    """Line and full name of everything imported; `from a import b` counts as a.b."""
    found = []
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layer"
            found += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
    return found


def dotted(node: ast.AST) -> str:
    """The name of a chain of attributes on a name, with `np` written out; empty for any other expression."""
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        return ""
    return ".".join(("numpy" if node.id == "np" else node.id, *reversed(parts)))


def used_attributes(source: str) -> list[tuple[int, str]]:
    """Line and dotted name of attribute chains on names."""
    return [(node.lineno, dotted(node)) for node in nodes_of(source) if isinstance(node, ast.Attribute)]


def beginnings(name: str) -> Iterator[str]:
    """The name of an attribute, that of what has it, and so on."""
    while name:
        yield name
        name = name.rpartition(".")[0]


def below(name: str, prefix: str) -> bool:
    return name == prefix or name.startswith(prefix + ".")


def wing_of(name: str) -> str:
    return name.split(".")[1] if name.startswith("hil.") else "hil"


def knows_floaty(module: str, name: str) -> bool:
    """Whether a module that works with any body imports from Floaty's."""
    return below(name, "hil.world.floaty") and not any(below(module, known) for known in KNOW_FLOATY)


def stair(name: str) -> int:
    """How far up in its wing a module is."""
    rooms = UPSTAIRS.get(wing_of(name), ())
    return next((step for step, room in enumerate(rooms, 1) if name.split(".")[2:3] == [room]), 0)


def climbs(module: str, name: str) -> bool:
    """Whether a module of hil imports from a floor that is not below its own, or from upstairs in its wing."""
    here, there = wing_of(module), wing_of(name)
    if there not in FLOOR or here not in FLOOR or name.split(".")[2:3] == ["config"]:
        return False
    return stair(name) > stair(module) if here == there else FLOOR[there] >= FLOOR[here]


def violations(path: str, source: str) -> list[str]:
    """What in a source file breaks the architecture; path is relative to the root, with slashes."""
    module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    layer = next(layer for layer in LAYERS if below(module, layer))
    found = []
    for line, name in imported(source):
        if any(below(name, package) for package in PACKAGES):
            if not any(below(name, allowed) for allowed in LAYERS[layer]):
                found.append(f"{path}:{line}: {layer} must not import {name}")
            if knows_floaty(module, name):
                found.append(f"{path}:{line}: works with any body, not with {name}")
            if climbs(module, name):
                found.append(f"{path}:{line}: {name} is not below {module}")
        elif layer == "firmware_py.core" and path != SUBSET and name.split(".")[0] not in CORE_LIBRARIES:
            found.append(f"{path}:{line}: the core must not import {name}")
    for line, name in imported(source) + used_attributes(source):
        for confined in CONFINED.keys() & set(beginnings(name)):
            if not path.startswith(CONFINED[confined] or "-"):
                found.append(
                    f"{path}:{line}: {confined} belongs to {', '.join(CONFINED[confined]) or 'no file'}"
                )
    for node in nodes_of(source):
        if isinstance(node, ast.Call) and dotted(node.func) == "print" and path not in PRINTERS:
            found.append(f"{path}:{node.lineno}: {PRINTERS[0]} prints, without control characters")
        if (
            isinstance(node, ast.BinOp)
            and isinstance(node.op, ast.MatMult)
            and not path.startswith(AFTER_THE_FLIGHT)
        ):
            found.append(
                f"{path}:{node.lineno}: @ is BLAS; hil.world.fixed_order.product has the same bits everywhere"
            )
        if isinstance(node, ast.Attribute) and node.attr in DRAWS and path != NORMAL_NOISE:
            found.append(
                f"{path}:{node.lineno}: {node.attr} takes logarithms of the C library; see {NORMAL_NOISE}"
            )
    return found


@cache
def sources(*folders: str) -> dict[str, str]:
    """The text of every file in some folders by its path from the root."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(paths)}


OURS = sources(*PACKAGES)


def test_every_file_keeps_to_its_room() -> None:
    assert len(OURS) > 400
    assert [found for path, source in OURS.items() for found in violations(path, source)] == []


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("firmware_py/core/model.py", "import math"),
        ("firmware_py/core/model.py", "from firmware_py.geometry import multiply"),
        ("firmware_py/core/model.py", "import scipy"),
        ("firmware_py/wire/crtp.py", "from firmware_py.board import Board"),
        ("firmware_py/tasks.py", "from hil.emulator.events import EventQueue"),
        ("firmware_py/tasks.py", "import time"),
        ("ground_station/station.py", "from firmware_py.firmware import Firmware"),
        ("ground_station/tracker.py", "from firmware_py.core import maths"),
        ("hil/laboratory/robot.py", "from firmware_py.core import entry"),
        ("hil/world/floaty/plant.py", "from hil.board.imu import VirtualImu"),
        ("hil/laboratory/flight.py", "from hil.laboratory.experiments import EXPERIMENTS"),
        ("hil/pictures/report.py", "import hil.servers.server"),
        ("hil/laboratory/robot.py", "from hil.world.floaty.plant import Plant"),
        ("hil/pictures/viewer/scene.py", "from hil.world.floaty.geometry import weigh"),
        ("hil/research/campaigns/run.py", "from distributed import Client"),
        ("hil/research/campaigns/run.py", "from hil.research.studies.paper import fly_paper"),
        ("hil/board/clock.py", "from hil.config import LabConfig"),
        ("hil/emulator/stm32f405/processor.py", "from firmware_py.rtos import Kernel"),
        ("hil/emulator/crazyflie/nrf51.py", "from hil.board.clock import Paced"),
        ("hil/deploy/check.py", "from hil.research.design.trim import find_trim"),
        ("hil/emulator/stm32f405/chip.py", "from hil.emulator.crazyflie import syslink"),
        ("hil/emulator/crazyflie/crazyflie.py", "from firmware_py.board import Board"),
        ("hil/board/imu.py", "from firmware_py.drivers.imu import body_of"),
        ("hil/pictures/report.py", "import rerun as rr"),
        ("hil/board/imu.py", "import numpy as np\nrng = np.random.default_rng()"),
        ("hil/board/imu.py", "from numpy.random import default_rng"),
        ("hil/board/markers.py", "import numpy as np\nx = np.cos(1.0)"),
        ("ground_station/trajectory.py", "from math import sin"),
        ("hil/world/floaty/shape.py", "x = AXIS @ vector"),
        (
            "hil/world/floaty/correction.py",
            "import numpy as np\nx = np.polynomial.polynomial.polyfit(a, b, 3)",
        ),
        ("hil/board/cameras.py", "x = rng.standard_normal(3)"),
        ("hil/commands/param.py", "print(name)"),
    ],
)
def test_a_planted_violation_is_caught(path: str, source: str) -> None:
    assert violations(path, source) != []


def test_a_legal_file_is_not_accused() -> None:
    source = "import numpy as np\nfrom ground_station.station import GroundStation\nfrom firmware_py.wire import crtp\n"
    assert violations("hil/laboratory/robot.py", source) == []


def test_every_confined_file_exists() -> None:
    files = {file for files in CONFINED.values() for file in files} | {SUBSET}
    assert {file for file in files if not (ROOT / file).exists()} == set()


ARCHITECTURE = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")


def test_every_file_that_the_architecture_names_exists() -> None:
    named = set(re.findall(r"`([\w./]+(?:\.py|/\w*))`", ARCHITECTURE))
    assert len(named) > 20
    assert {name for name in named if not (ROOT / name).exists()} == set()


def test_the_architecture_s_floors_are_those_that_are_enforced() -> None:
    section = ARCHITECTURE.split("## The floors")[1].split("## ")[0]
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", section, re.MULTILINE)
    told = {int(floor): set(re.findall(r"`(\w+)`", rooms)) for floor, rooms in rows}
    assert told == dict(enumerate(map(set, FLOORS)))


def test_hil_has_few_wings_and_each_its_floor_and_sentence() -> None:
    wings = {path.split("/")[1].removesuffix(".py") for path in OURS if path.startswith("hil/")}
    assert wings - {"__init__", "errors"} == set(FLOOR)
    assert len(wings) <= 15  # 14 beside `__init__`
    for wing in sorted(wings - {"__init__"}):
        path = ROOT / "hil" / wing
        text = ast.get_docstring(
            ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text("utf-8"))
        )
        assert text
        assert text.splitlines()[0].endswith("."), wing


def test_no_room_has_more_than_eighteen_files() -> None:
    sizes = Counter(path.rpartition("/")[0] for path in OURS)
    assert {room: size for room, size in sizes.items() if size > 18 and room.startswith("hil/")} == {}


def circles(imports: dict[str, set[str]]) -> list[set[str]]:
    """The sets of modules that import one another, directly or not."""

    def reach(module: str) -> set[str]:
        seen: set[str] = set()
        waiting = [module]
        while waiting:
            for name in imports[waiting.pop()] - seen:
                seen.add(name)
                waiting.append(name)
        return seen

    reached = {module: reach(module) for module in imports}
    found = {frozenset(n for n in reached[m] if m in reached[n]) for m in imports if m in reached[m]}
    return sorted(map(set, found), key=sorted)


def imports_of_ours() -> dict[str, set[str]]:
    """Every module and the modules of ours that it imports, also only for types."""
    modules = {
        path.removesuffix(".py").removesuffix("/__init__").replace("/", "."): source
        for path, source in OURS.items()
    }

    def target(name: str) -> str | None:
        return name if name in modules else next((n for n in [name.rpartition(".")[0]] if n in modules), None)

    return {
        module: {
            found for _, name in imported(source) if (found := target(name)) is not None and found != module
        }
        for module, source in modules.items()
    }


def test_no_modules_import_one_another() -> None:
    assert circles(imports_of_ours()) == []


def test_a_planted_circle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [{"b", "c"}]


def test_a_pose_has_the_shapes_that_the_architecture_names() -> None:
    """A class that holds a pose has a rotation, a frame or a correction among its fields."""
    shapes = {
        node.name
        for path, source in OURS.items()
        if not path.startswith("hil/")
        for node in nodes_of(source)
        if isinstance(node, ast.ClassDef)
        for field in node.body
        if isinstance(field, ast.AnnAssign)
        and re.match(r"(q_\w\w|pose_quaternion): |\w+: (MocapFrame|Correction|Pose)$", ast.unparse(field))
    }
    assert shapes == {"MocapFrame", "Track", "Correction", "Pose", "Input"}
    assert {shape for shape in shapes if f"`{shape}`" not in ARCHITECTURE} == set()


def asks_which_board(source: str) -> list[str]:
    """The places that choose by the class of a firmware; what a board cannot report is None instead."""
    return [
        ast.unparse(node)
        for node in nodes_of(source)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "isinstance"
        and re.search(r"Firmware|PythonBoard|ChipImage|RealBoard", ast.unparse(node.args[1]))
    ]


def test_nobody_asks_which_board_it_has() -> None:
    assert [found for source in OURS.values() for found in asks_which_board(source)] == []


def test_a_planted_question_is_found() -> None:
    assert asks_which_board("x = isinstance(robot.firmware, Firmware | ImageFirmware)") != []


# What is made whole: nobody but its own class assigns to its attributes.
WHOLE = (
    "robot", "flight", "board", "line", "served", "lab", "recorder", "link", "radio", "nrf51", "firmware",
    "uart",
)  # fmt: skip


def completes_another(source: str) -> list[str]:
    """The assignments to attributes of a robot, a flight, a board, a line … from outside their class."""
    targets: list[ast.expr] = []
    for node in nodes_of(source):
        if isinstance(node, ast.Assign):
            targets += [
                one for target in node.targets for one in ast.walk(target) if isinstance(one, ast.expr)
            ]
        elif isinstance(node, ast.AugAssign | ast.AnnAssign):
            targets.append(node.target)
        elif isinstance(node, ast.Call) and dotted(node.func) == "setattr":
            targets.append(ast.Attribute(node.args[0], "anything", ast.Store()))
    return [
        ast.unparse(target)
        for target in targets
        if isinstance(target, ast.Attribute)
        and isinstance(target.ctx, ast.Store)
        and ast.unparse(target.value).split(".")[-1].lstrip("_") in WHOLE
    ]


def test_nothing_is_assigned_to_a_robot_a_flight_a_board_or_a_line_from_outside() -> None:
    assert {path: found for path, source in OURS.items() if (found := completes_another(source))} == {}


@pytest.mark.parametrize(
    "source",
    [
        "robot.send_packet = self._send",
        "self._robot.free = False",
        "flight.line, flight.recorder = line, recorder",
        "recorder = flight.recorder = Recorder()",
        "served.robot.board.on_failure = inject",
        "lab.end_us += 1",
        "setattr(robot.board, 'imu', counts)",
    ],
)
def test_a_planted_completion_is_found(source: str) -> None:
    assert completes_another(source) != []


def test_an_objects_own_attributes_and_numbers_of_the_world_may_be_set() -> None:
    assert (
        completes_another("self.robot = robot\nself.line: Line = line\nrobot.body.x = 1\nself._link = link")
        == []
    )


def watches_the_clock(source: str) -> list[str]:
    """The tests and helpers in `source` that sleep or read the wall clock, and are not marked as real-time tests."""
    return [
        function.name
        for function in nodes_of(source)
        if isinstance(function, ast.FunctionDef)
        and "pytest.mark.realtime" not in map(ast.unparse, function.decorator_list)
        and any(dotted(node) in ("time.sleep", "time.monotonic") for node in ast.walk(function))
    ]


TESTS = sources("tests")


def test_only_real_time_tests_look_at_the_wall_clock() -> None:
    simulated = {
        path: source
        for path, source in TESTS.items()
        if "/test_" in path and not path.startswith("tests/realtime/")
    }
    assert len(simulated) > 200
    assert {
        path: found
        for path, source in simulated.items()
        if "time." in source and (found := watches_the_clock(source))
    } == {}


def test_a_planted_sleep_is_caught() -> None:
    assert watches_the_clock("def test_x():\n    for _ in range(3):\n        time.sleep(1)") == ["test_x"]
    assert watches_the_clock("@pytest.mark.realtime\ndef test_x():\n    time.sleep(1)") == []


SUSPECT = re.compile(r"^\s*(?:from|import) .*(?:test_|conftest)", re.MULTILINE)


def borrows(source: str) -> list[str]:
    """What a file of the tests imports from a test file; what is shared stands in `support`."""
    return [name for _, name in imported(source) if re.search(r"(^|\.)(test_|conftest\b)", name)]


def test_no_test_file_imports_from_another() -> None:
    found = {
        path: names for path, source in TESTS.items() if SUSPECT.search(source) and (names := borrows(source))
    }
    assert found == {}


def test_a_planted_loan_is_caught() -> None:
    assert borrows("from test_firmware import Bench") == ["test_firmware.Bench"]
    assert borrows("import tests.hil.world.test_plant as plant") == ["tests.hil.world.test_plant"]
    assert borrows("from support.firmware_bench import FirmwareBench") == []


LISTENERS = re.compile(r"create_server\(|bind_sockets\(|HTTPServer\b|\.Server\(|openpty\(|\"--bind\"")
PORTS = re.compile(r"^(?:\w+, )?(?:\w+_)?PORT = .*?\b(\d{4,5})\b", re.MULTILINE)


def listens(source: str) -> bool:
    """Whether a file opens what others can connect to."""
    return LISTENERS.search(source) is not None or ("import socket" in source and ".bind(" in source)


def test_every_file_that_listens_and_every_port_is_in_the_table_of_who_can_connect() -> None:
    page = (ROOT / "docs" / "explanation" / "security.md").read_text(encoding="utf-8")
    rows = [
        line for line in page.split("## Who can connect")[1].split("## ")[0].splitlines() if line[:1] == "|"
    ]
    named = set(re.findall(r"`([\w/]+\.py)`", "".join(rows)))
    assert named == {name for name, source in OURS.items() if listens(source)}
    ports = {port for name, source in OURS.items() for port in PORTS.findall(source)}
    assert len(ports) == 10
    assert {port for port in ports if port not in "".join(rows)} == set()


@pytest.mark.parametrize("source", ["import socket\nsocket.create_server(at)", "import socket\nown.bind(at)"])
def test_a_planted_listener_is_found(source: str) -> None:
    assert listens(source)
