"""Own logic on the running board: its parameters and log variables, and what happens when it puts out no number."""

import math
from pathlib import Path
from typing import Any

import pytest

from firmware_py.config import parameters_of
from firmware_py.core.guard import Guard, note_faults
from firmware_py.core.structs import MODE_FLY, Supervisor
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks
from firmware_py.firmware import Firmware
from firmware_py.links.parameters import Parameter
from firmware_py.logic.loading import load_logic
from firmware_py.wire.parameters import EINVAL, OK
from firmware_py.wire.supervisor import Cause, State
from hil.board.cores.boards import BOARDS, runner_of
from hil.config import LabConfig
from support.firmware_bench import HOVER_COUNTS, FirmwareBench
from support.mavlink_client import GYRO_ZERO_US, MavlinkClient
from support.own_logic import AS_BUILT_IN, ESTIMATOR, LAW, own_config


class Bench(FirmwareBench):
    """A board with own logic that gets poses all the time."""

    def __init__(self, config: LabConfig) -> None:
        super().__init__()
        self.firmware = Firmware(config, self)
        self.core = self.firmware._core
        self.supervisor = self.firmware.signals.supervisor
        self.poses(GYRO_ZERO_US, 4_000_000, (0.0, 0.05, 0.0))

    def parameter(self, name: str) -> Parameter:
        return next(parameter for parameter in self.firmware.parameters if parameter.name == name)

    def read(self, name: str) -> float:
        return next(variable for variable in self.firmware.variables if variable.name == name).read()


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> LabConfig:
    return own_config(tmp_path_factory.mktemp("law"))


@pytest.fixture(scope="module")
def bench(config: LabConfig) -> Bench:
    bench = Bench(config)
    bench.run(GYRO_ZERO_US + 500_000)
    return bench


@pytest.mark.long
def test_parameters_are_taken_inside_their_bounds_and_can_be_stored(bench: Bench) -> None:
    gain = bench.parameter("logic.gain_iy")
    assert (gain.unit, gain.minimum, gain.maximum, gain.persistent) == ("rad/m/s", -2.0, 2.0, True)
    assert gain.set(1.5) == OK
    assert bench.core.named["controller_own"].fields.gain_iy == 1.5  # type: ignore[attr-defined]
    assert [gain.set(value) for value in (2.5, -2.5, math.nan)] == [EINVAL] * 3
    assert gain.read() == 1.5
    after = bench.parameter("logic.after")
    assert after.set(70_000) == OK
    assert after.value() == (70_000).to_bytes(4, "little")
    assert after.set(1_000_000) == OK


@pytest.mark.long
def test_only_marked_memory_is_logged(bench: Bench) -> None:
    names = [variable.name for variable in bench.firmware.variables if variable.name.startswith("logic.")]
    assert names == ["logic.integral", "logic.errors1", "logic.errors2", "logic.errors3", "logic.ticks"]
    y = bench.read("stateEstimate.y")
    assert bench.read("logic.errors2") == pytest.approx(-y, abs=2e-3)  # of the last step
    assert y == pytest.approx(0.05, abs=5e-3)
    assert bench.read("logic.integral") < 0.0
    before = bench.read("logic.ticks")
    bench.run(bench.now_us + 100_000)
    assert bench.read("logic.ticks") == before + 10


@pytest.mark.long
def test_mavlink_has_room_for_the_longest_name(config: LabConfig) -> None:
    client = MavlinkClient(f"logic.controller={config.logic.controller!r}")
    client.run(20_000)
    client.send("param_request_read", 1, 1, b"OWN_TWELVE_CHARS", -1)
    client.run(client.now_us + 20_000)
    [found] = [message for _, message in client.messages if message.get_type() == "PARAM_VALUE"]
    assert (found.param_id, found.param_value) == ("OWN_TWELVE_CHARS", pytest.approx(0.1))


def test_a_failing_law_holds_the_hover_angles_until_recovery(config: LabConfig) -> None:
    bench = Bench(config)
    bench.run(GYRO_ZERO_US + 300_000)
    assert bench.supervisor.state is State.FLYING
    assert bench.writes[-1][1] != HOVER_COUNTS
    bench.parameter("logic.after").set(bench.read("logic.ticks"))
    bench.run(bench.now_us + 10_000)
    assert bench.writes[-1][1] == HOVER_COUNTS
    bench.run(bench.now_us + 10_000)
    assert (bench.supervisor.state, bench.supervisor.cause) == (State.FAILSAFE, Cause.CONTROLLER_NOT_FINITE)
    assert bench.console[-1] == "supervisor: failsafe, controller not finite"
    assert not bench.supervisor.arm(True)
    bench.parameter("logic.after").set(1_000_000)
    bench.run(bench.now_us + 500_000)
    assert bench.supervisor.state is State.FAILSAFE
    assert all(counts == HOVER_COUNTS for _, counts in bench.writes[-50:])
    bench.parameter("floaty.stop").set(0)
    bench.run(bench.now_us + 100_000)
    assert bench.supervisor.state is State.FLYING
    assert bench.writes[-1][1] != HOVER_COUNTS


@pytest.mark.long
def test_an_estimator_that_fails_is_named(tmp_path: Path) -> None:
    bench = Bench(own_config(tmp_path, LAW, ESTIMATOR))
    bench.run(GYRO_ZERO_US + 300_000)
    assert bench.supervisor.state is State.FLYING
    bench.parameter("logic.until").set(10)
    bench.run(bench.now_us + 30_000)
    assert (bench.supervisor.state, bench.supervisor.cause) == (State.FAILSAFE, Cause.ESTIMATOR_NOT_FINITE)
    assert bench.console[-1] == "supervisor: failsafe, estimator not finite"
    assert bench.writes[-1][1] == HOVER_COUNTS
    assert all(math.isfinite(value) for value in bench.firmware.signals.estimate)


WHATEVER = """
    for i in range(4):
        control.u[i] = data.manual[i]
        control.flap[i] = data.pose_quaternion[i]
"""
SLOW = {"cortex-m4": pytest.mark.long}


@pytest.fixture(scope="module", params=[pytest.param(board, marks=SLOW.get(board, ())) for board in BOARDS])
def loop(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> CoreBlocks:
    """A law that puts out what the test writes into the input."""
    law = AS_BUILT_IN.replace("(parameters: Parameters,", "(data: Input, parameters: Parameters,") + WHATEVER
    config = own_config(tmp_path_factory.mktemp("loop"), law)
    runner = runner_of(request.param, config.logic)
    blocks = CoreBlocks(parameters_of(config), runner, load_logic(config.logic))
    blocks.data.fields.mode = MODE_FLY
    return blocks


@pytest.mark.long
@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", ["u", "flap"])
@pytest.mark.parametrize("index", range(4))
def test_not_a_number_is_stopped_everywhere(loop: CoreBlocks, wrong: float, place: str, index: int) -> None:
    data: Any = loop.data.fields
    data.manual[:], data.pose_quaternion[:] = (0.1, 0.2, 0.3, 0.4), (0.5, -0.4, 3.0, -3.0)
    loop.run.call("control")
    assert loop.control.fields.flap.tolist() == pytest.approx([0.5, -0.4, math.pi / 2, -math.pi / 2])
    guard = loop.named["guard"].fields
    before = int(guard.controller_faults)
    (data.manual if place == "u" else data.pose_quaternion)[index] = wrong
    loop.run.call("control")
    assert guard.controller_faults == before + 1
    hover = float(loop.parameters.fields.hover_angle)
    assert loop.control.fields.flap.tolist() == pytest.approx([hover, -hover, hover, -hover])
    assert loop.control.fields.u.tolist() == loop.control.fields.command.tolist() == [0.0] * 4


def test_the_failures_of_each_module_are_noted_once_each_time() -> None:
    supervisor, guarded = Supervisor.allocate().fields, Guard.allocate().fields
    for estimator, controller, cause in (
        (1, 0, Cause.ESTIMATOR_NOT_FINITE), (0, 0, Cause.NONE), (0, 2, Cause.CONTROLLER_NOT_FINITE), (0, 0, Cause.NONE),
        (1, 1, Cause.ESTIMATOR_NOT_FINITE), (0, 0, Cause.NONE), (0, 1, Cause.CONTROLLER_NOT_FINITE),
    ):  # fmt: skip
        guarded.estimator_faults = i32(guarded.estimator_faults + estimator)
        guarded.controller_faults = i32(guarded.controller_faults + controller)
        supervisor.not_finite = i32(Cause.NONE)
        note_faults(supervisor, guarded)
        assert supervisor.not_finite == cause
