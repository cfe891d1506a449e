"""The Crazyflie app: the same flight as the laboratory's board, on a board of memory and through Debian's ARM compiler."""

import math
import os
import re
import shutil
import struct
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from cflib.utils.encoding import compress_quaternion
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from firmware_py import supervisor as reference
from firmware_py.core.structs import MANUAL_ANGLES, Estimator
from firmware_py.export.crazyflie import write_app
from firmware_py.export.errors import ExportError
from firmware_py.export.profile_c import profile_hash
from firmware_py.firmware import Firmware
from firmware_py.geometry import Quaternion, Vector, from_euler_zyx, in_goal_frame, yaw_quaternion
from firmware_py.wire import crtp, telemetry
from firmware_py.wire.localisation import EXT_POSE_PACKED
from hil.board.pins import VirtualBoard
from hil.config import LabConfig, load_config
from support.crazyflie_app import LOCALISATION, STUBS, App, Setpoint, build_app
from support.own_logic import ESTIMATOR, LAW, own_config

ARM = "arm-none-eabi-gcc"
ARM_FLAGS = (  # of the Crazyflie firmware
    "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-std=gnu11", "-Os", "-g3", "-Wall",
    "-Wmissing-braces", "-fno-strict-aliasing", "-ffunction-sections", "-fdata-sections", "-Wdouble-promotion",
    "-Werror", "-fno-math-errno", "-fno-delete-null-pointer-checks",
)  # fmt: skip
BIAS = np.array((12, -7, 3))  # [counts]
STABILIZER_STACK = 3 * 150 * 4  # [B] of the task that calls the hooks, in an unmodified firmware


@pytest.fixture
def app(library: Path, tmp_path: Path) -> App:
    return App(library, tmp_path / "copy.so")


@pytest.fixture(scope="module")
def functions(library: Path) -> App:
    """An app that no step runs on: for its parameters."""
    functions = App(library, library.with_name("functions.so"))
    functions.boot()
    return functions


class Laboratory(VirtualBoard):
    """The laboratory's firmware on plain numbers, without computing time, as the app's stabilizer has none."""

    def __init__(self, config: LabConfig | None = None) -> None:
        self.counts: list[int] = []
        self.console: list[str] = []
        super().__init__(
            self._set_counts, lambda now_us, data: True, lambda now_us, text: self.console.append(text)
        )
        config = config or load_config()
        costs = dict.fromkeys(type(config.cpu).model_fields, 0)
        self.firmware = Firmware(config.model_copy(update={"cpu": config.cpu.model_copy(update=costs)}), self)
        self.parameters = {parameter.name: parameter for parameter in self.firmware.parameters}

    def _set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        self.counts = list(counts)

    def advance(self, now_us: int) -> None:
        while (wake_us := self.firmware.next_wake_us) is not None and wake_us <= now_us:
            self.firmware.run(wake_us)
        self.firmware.run(now_us)


Event = Callable[[App, Laboratory], None]


def pose(data: bytes) -> Event:
    """A packet with a pose: the whole CRTP packet for the laboratory, its data for the app."""

    def arrive(app: App, laboratory: Laboratory) -> None:
        app.radio(data[1:])
        laboratory.firmware.radio_received(data)

    return arrive


def write(name: str, value: float) -> Event:

    def act(app: App, laboratory: Laboratory) -> None:
        app.set(name, value)
        laboratory.parameters[name].set(value)

    return act


def packed_poses(header: bytes, p: NDArray[np.float64], q: Quaternion) -> bytes:
    """Return a packet with the pose of another robot and ours."""
    w, *xyz = q
    items = (
        struct.pack(
            "<B3hI", address, *(round(1000 * part) + away for part in p), compress_quaternion((*xyz, w))
        )
        for address, away in ((0x01, 500), (0xE7, 0))
    )
    return header + bytes((EXT_POSE_PACKED,)) + b"".join(items)


def scenario(rng: np.random.Generator, steps: int) -> dict[int, list[Event]]:
    """Poses at 50 Hz along a walk: with ages, without, too old, garbage, jumps, too far, out of bounds, frozen; pauses."""
    events: dict[int, list[Event]] = defaultdict(list)
    frozen = b""
    p = np.zeros(3)
    for step in range(600, steps, 20):
        if 3000 <= step < 3800:  # silence
            continue
        p += rng.normal(0, 0.004, 3)
        p += {1600: (0.0, 0.0, -1.9), 2200: (0.0, 0.0, 1.9), 4500: (0.6, 0.0, 0.2)}.get(step, (0.0, 0.0, 0.0))
        roll, yaw = rng.normal(0, 0.03, 2)
        q = (math.sqrt(1 - 0.25 * (roll**2 + yaw**2)), roll / 2, 0.0, yaw / 2)
        age_us = int(rng.choice([25_000, 40_000, 41_500, 60_000, 126_000]))
        data = crtp.encode_ext_pose(tuple(p), q, None if rng.random() < 0.1 else age_us)
        if step % 260 == 0:
            data = packed_poses(data[:1], p, q)
        if rng.random() < 0.03:
            data = data[:1] + bytes(30)
        if step == 6000:
            frozen = crtp.encode_ext_pose(tuple(p), q, 25_000)
        data = frozen if 6000 <= step < 6400 else data
        just_before_control = step in (600, 3800)  # the first one, and the one that ends the silence
        events[step + (0 if just_before_control else int(rng.integers(0, 20)))].append(pose(data))
    for step, name, value in (
        (2505, "extCtrl.x_P", 3.5), (2505, "extCtrl.y_P", 99.0), (2505, "setpoint.Z", 0.2), (2505, "motorShifts.m2", -4000),
        (5207, "floaty.stop", 1), (5603, "floaty.stop", 0), (6503, "floaty.armed", 0), (6603, "floaty.armed", 1),
        (7301, "floaty.stop", 0),  # this one leaves the empty battery
    ):  # fmt: skip
        events[step].append(write(name, value))
    events[8205].append(pose(crtp.encode_ext_pose((12.346, -2.3, 0.0), (1.0, 0.0, 0.0, 0.0), 40_000)))
    return events


@pytest.mark.long
def test_app_and_laboratory_turn_the_same_samples_into_the_same_bits(app: App) -> None:
    rng = np.random.default_rng(7)
    laboratory, steps = Laboratory(), 9000
    events = scenario(rng, steps)
    app.first_tick.value = 2**32 - 3200  # the tick count wraps in the silence
    app.boot()
    assert app.counts() == laboratory.counts
    counts, states, compared, printed, rates, sample = set(), set(), 0, 0, np.zeros(3), [0, 0, 0]
    for step in range(1, steps):
        before_us = (step - 1) * 1000
        if step > 700:
            rates = 0.98 * rates + rng.normal(0, 30, 3)
        fresh = [int(v) for v in np.rint(rates + BIAS + rng.normal(0, 2, 3))]
        sample = sample if 5900 < step < 5950 else fresh  # a frozen gyro
        app.gyro_noise = 0
        laboratory.measure((*sample, 0, 0, 1365))
        app.gyro[:] = sample
        laboratory.battery_mv = 3000 if step > 3500 else 3900
        app.battery.value = laboratory.battery_mv * 1e-3
        laboratory.advance(before_us + 100)
        laboratory.firmware.imu_ready()
        laboratory.advance(before_us + 100)
        laboratory.advance(before_us + 200)
        app.now.value = before_us + 200
        for event in events[step]:
            event(app, laboratory)
        laboratory.advance(before_us + 200)
        laboratory.advance(step * 1000)
        app.step(step)
        if len(laboratory.console) > printed:
            app.c.stub_run_app(1)
            printed = len(laboratory.console)
        assert app.counts() == laboratory.counts, f"step {step}"
        if step % 10 == 9:
            assert app.estimator() == laboratory.firmware._core.estimator.bytes(), f"step {step}"
            compared += 1
        assert (app.supervisor.state, app.supervisor.cause) == (
            laboratory.firmware._supervisor.state, laboratory.firmware._supervisor.cause,
        ), f"step {step}"  # fmt: skip
        counts.add(tuple(app.counts()))
        states.add((app.supervisor.state, app.supervisor.cause))
    assert compared > 890
    assert len(counts) > 300
    assert states == {(0, 0), (1, 0), (2, 0), (3, 1), (3, 2), (3, 3), (3, 4), (3, 5), (3, 9)}
    announced = re.findall(r"^(?:FLOATY: )?((?:supervisor: |poses? ).*)$", app.console(), re.MULTILINE)
    assert announced == [line for line in laboratory.console if line.startswith(("supervisor: ", "pose"))]
    assert "pose refused: it is too far from the estimate" in announced
    assert any(re.fullmatch(r"poses 1[2-4]\d ms old: at most 120 ms", line) for line in announced)
    assert "poses frozen: they stay the same although the robot turns" in announced
    assert any("1235 -230 0 cm is no correction" in line for line in announced)
    assert "restarted" not in app.console()
    assert "EEPROM" not in app.console()
    for name in ("fused", "refused", "jumps", "too_old", "bounded", "frozen"):
        value = getattr(laboratory.firmware._core.estimator.fields, name)
        assert app.log(f"kalman.{name}") == value > 0, name
    shown = {variable.name: variable.read() for variable in laboratory.firmware.variables}
    state = app.state()
    assert state == pytest.approx({name: shown[name] for name in state}, rel=1e-6)
    logs = {name: app.log(name) for name in app.logs.keys() & shown.keys()}
    assert logs == pytest.approx({name: shown[name] for name in logs}, rel=1e-5, abs=1e-6)
    assert abs(state["stateEstimate.pitch"]) > 0.5  # [deg]


STEP = "    memory.ticks = i32(memory.ticks + 1)\n"
ENDLESS = LAW.replace(
    STEP,
    f"""{STEP}    if memory.ticks > own.after:
        for i in range(memory.ticks + 2000000000):
            memory.hidden = memory.hidden + DT
""",
)


@pytest.mark.long
@pytest.mark.parametrize("law", [LAW, ENDLESS], ids=["not a number", "an endless loop"])
def test_own_logic_flies_and_fails_in_the_app_as_in_the_laboratory(tmp_path: Path, law: str) -> None:
    config = own_config(tmp_path, law, ESTIMATOR, "gain_iy = 0.5")
    app, laboratory = App(build_app(tmp_path / "app", config), tmp_path / "copy.so"), Laboratory(config)
    rng, states, integrals = np.random.default_rng(3), set(), set()
    names = ("logic.gain_iy", "logic.twelve_chars", "logic.after", "logic.until")
    read = {variable.name: variable.read for variable in laboratory.firmware.variables}
    logged = sorted(name for name in read if name.startswith("logic."))
    app.boot()
    assert {name for name in app.params if name.startswith("logic.")} == set(names)
    assert {name for name in app.logs if name.startswith("logic.")} == set(logged)
    for name in names:
        twin = laboratory.parameters[name]
        assert app.get(name) == twin.read(), name
        assert app.c.stub_param_type(app.params[name]) == twin.scalar.parameter_number, name
        assert app.c.stub_param_persistent(app.params[name]) == twin.persistent is True, name
    for step in range(1, 1500):
        sample = [int(v) for v in np.rint(BIAS + rng.normal(0, 2, 3))]
        laboratory.measure((*sample, 0, 0, 1365))
        app.gyro[:] = sample
        laboratory.advance(step * 1000 - 900)
        laboratory.firmware.imu_ready()
        laboratory.advance(step * 1000 - 800)
        app.now.value = step * 1000 - 800
        if step > 600 and step % 20 == 3:
            pose(crtp.encode_ext_pose((0.01, -0.03, 0.02), (1.0, 0.0, 0.0, 0.0), 40_000))(app, laboratory)
        for at, name, value in (
            (900, "logic.twelve_chars", 9.0),
            (1000, "logic.gain_iy", -1.5),
            (1200, "logic.after", 50),
        ):
            if step == at:
                write(name, value)(app, laboratory)
        laboratory.advance(step * 1000 - 800)
        laboratory.advance(step * 1000)
        app.step(step)
        assert app.counts() == laboratory.counts, f"step {step}"
        assert (app.supervisor.state, app.supervisor.cause) == (
            laboratory.firmware._supervisor.state, laboratory.firmware._supervisor.cause,
        ), f"step {step}"  # fmt: skip
        assert [app.log(name) for name in logged] == [read[name]() for name in logged], f"step {step}"
        states.add((app.supervisor.state, app.supervisor.cause))
        integrals.add(app.log("logic.integral"))
    assert len(integrals) > 50
    assert states == {(0, 0), (1, 0), (2, 0), (3, reference.Cause.CONTROLLER_NOT_FINITE)}
    app.c.stub_run_app(1)
    assert "supervisor: failsafe, controller not finite\n" in app.console()


@pytest.mark.long
def test_an_app_with_own_logic_compiles_as_the_default_does(tmp_path: Path) -> None:
    if shutil.which(ARM) is None:
        pytest.skip(f"no {ARM} here: apt-get install gcc-arm-none-eabi")
    write_app(own_config(tmp_path, ENDLESS, ESTIMATOR, "after = 7"), "floaty", tmp_path / "app")
    source = compile_for_arm(tmp_path / "app")
    assert (source / "floaty_core.o").is_file()
    assert ".after = 7," in (source / "floaty_profile.c").read_text()
    assert (
        profile_hash(own_config(tmp_path, ENDLESS, ESTIMATOR, "after = 8"))
        not in (source / "floaty_profile.c").read_text()
    )


def test_servos_hang_on_the_originals_pins_at_400_hz(app: App) -> None:
    app.boot()
    tim3, tim5 = app.timers
    for timer in (tim3, tim5):
        assert 84e6 / (timer.PSC + 1) == 21e6
        assert timer.ARR == 52500
        assert timer.CR1 == 0x81  # counting, reload preloaded
    assert (tim3.CCMR1, tim5.CCMR2) == (0x6868, 0x6868)  # PWM mode 1 with preload
    assert (tim3.CCER, tim5.CCER) == (0x0011, 0x1100)  # active high
    a, b = app.pins
    for port, pin in ((a, 2), (a, 3), (b, 4), (b, 5)):
        assert port.MODER >> 2 * pin & 3 == 2  # alternate function
        assert port.OTYPER >> pin & 1 == 1  # open drain
        assert port.AFR[0] >> 4 * pin & 15 == 2  # TIM3..5
    assert a.MODER == 0b10100000  # no other pin


STANDING = crtp.encode_ext_pose((0.01, -0.02, 0.05), (1.0, 0.0, 0.0, 0.0), 40_000)[1:]
SUPERVISOR = 9


def flying(app: App, until: int = 1200) -> None:
    app.boot()
    for step in range(1, until):
        if step % 20 == 1:
            app.radio(STANDING)
        app.step(step)
    assert app.supervisor.state == reference.State.FLYING


def hover_of(app: App) -> list[int]:
    before = app.counts()
    app.c.floaty_hover()
    hover = app.counts()
    tim3, tim5 = app.timers
    tim5.CCR3, tim3.CCR1, tim3.CCR2, tim5.CCR4 = before
    return hover


def test_a_stopped_loop_moves_the_servos_to_hover(app: App) -> None:
    flying(app)
    hover = hover_of(app)
    for stop in (1, 2):
        assert app.counts() != hover
        app.now.value += 30_000
        app.c.stub_run_app(1)
        assert app.counts() != hover
        app.now.value += 30_000
        app.c.stub_run_app(3)
        assert app.counts() == hover
        assert app.log("floaty.staleHovers") == stop
        fly_on(app, 1200 + 100 * stop, 100)


@pytest.mark.parametrize("silent_steps", [0, 600])
def test_the_firmwares_own_emergency_stop_stops_floaty_with_a_line_of_its_own(
    app: App, silent_steps: int
) -> None:
    flying(app)
    stop_at = 1200 + silent_steps
    for step in range(1200, stop_at):
        app.step(step)
    app.c.stub_run_app(1)
    assert app.console().endswith("supervisor: failsafe, silence\n") == bool(silent_steps)
    app.locked.value = 1
    for step in range(stop_at, stop_at + 11):
        app.step(step)
    app.c.stub_run_app(1)
    assert app.counts() == hover_of(app)
    assert app.console().endswith("supervisor: failsafe, emergency stop\n")


def test_poses_come_through_the_app_channel_too(app: App) -> None:
    app.boot()
    for step in range(1, 100):
        if step == 53:
            app.app_channel(crtp.encode_ext_pose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0), 20_000)[1:])
        app.step(step)
    assert app.log("kalman.fused") == 1
    assert app.log("locSrv.age") == pytest.approx(270)  # 20 ms, and 7 to the next step


@pytest.mark.parametrize("lacking", ["gyro_known", "sensors"])
def test_a_board_without_bmi088_reports_it_and_holds_hover(app: App, lacking: str) -> None:
    getattr(app, lacking).value = 1 - getattr(app, lacking).value
    app.boot()
    assert "no raw counts of a BMI088: flaps stay at hover" in app.console()
    hover = app.counts()
    for step in range(1, 700):
        app.step(step)
    assert app.counts() == hover


def fly_on(app: App, first: int, steps: int, **step: bool) -> set[tuple[int, ...]]:
    """Go on with poses at 50 Hz; return the servo counts that were seen."""
    seen = set()
    for i in range(first, first + steps):
        if i % 20 == 1:
            app.radio(STANDING)
        app.step(i, **step)
        seen.add(tuple(app.counts()))
    return seen


def test_a_client_that_writes_the_estimators_parameter_does_not_disturb_the_flight(app: App) -> None:
    flying(app)
    hover, fused = hover_of(app), app.log("kalman.fused")
    app.c.estimatorOutOfTreeInit()  # what a write of 1 or 2 leads to: the build forces this estimator
    assert tuple(hover) not in fly_on(app, 1200, 200)
    assert app.log("kalman.fused") == fused + 10
    assert np.frombuffer(app.estimator(), Estimator.dtype)[0]["started"] == 1
    app.estimator_type.value = 2
    app.c.estimatorOutOfTreeInit()  # a switch that is one starts afresh
    app.step(1400)
    assert np.frombuffer(app.estimator(), Estimator.dtype)[0]["started"] == 0


@pytest.mark.parametrize("reset_us", [1_190_000, 1_195_000])
def test_resetting_the_microsecond_clock_ends_neither_flight_nor_failsafe(app: App, reset_us: int) -> None:
    flying(app)
    app.usec_reset.value = reset_us
    for step in range(1200, 1680):
        app.step(step)
    assert app.supervisor.state == reference.State.FLYING
    for step in range(1680, 1710):
        app.step(step)
    assert (app.supervisor.state, app.supervisor.cause) == (
        reference.State.FAILSAFE, reference.Cause.SILENCE,
    )  # fmt: skip
    assert app.counts() == hover_of(app)


def test_a_pose_from_before_the_clock_was_set_counts_as_if_it_came_with_the_step(app: App) -> None:
    flying(app, until=1201)
    app.radio(STANDING)
    app.usec_reset.value = app.now.value
    app.step(1201)
    for step in range(1202, 1210):
        app.step(step)
    assert app.log("locSrv.age") == pytest.approx(480)  # 40 ms, and 8 to the estimator's step


def test_an_age_beyond_what_is_logged_is_the_greatest_value(app: App) -> None:
    flying(app)
    estimator = np.frombuffer(app._estimator, Estimator.dtype)
    estimator["pose_age_us"] = 8_000_000
    for step in range(1200, 1210):
        app.step(step)
    assert app.log("locSrv.age") == 65535


@pytest.mark.parametrize("reason", ["watchdog", "assert"])
def test_after_a_watchdog_or_assert_reset_floaty_reports_it_and_flies_on(app: App, reason: str) -> None:
    getattr(app, f"after_{reason}").value = 1
    flying(app)
    assert f"SYS: after {reason}\n" in app.console()
    assert "restarted by watchdog or assert" in app.console()


def test_a_failed_self_test_is_reported_once(app: App) -> None:
    app.c.appInit()
    app.c.stub_run_app(48)
    assert app.console() == ""
    app.c.stub_run_app(200)
    assert app.console() == "FLOATY: self-test has not passed: flaps stay at hover, see above\n"


def test_servos_pulse_from_the_first_hook_and_take_the_trims_of_the_eeprom(app: App) -> None:
    app.c.appInit()
    profile = app.counts()
    assert all(21_000 <= count <= 42_000 for count in profile)
    assert all(timer.CR1 & 1 for timer in app.timers)
    for name in ("m1", "m3"):
        app.c.stub_param_load(app.params[f"motorShifts.{name}"], app.get(f"motorShifts.{name}") + 1000)
    app.c.estimatorOutOfTreeInit()
    moved = [after - before for after, before in zip(app.counts(), profile, strict=True)]
    assert moved == [pytest.approx(1000 * 21_000 / 65_535, abs=1), 0] * 2


def test_parameters_from_the_eeprom_are_named_on_the_console(app: App) -> None:
    app.boot(
        {
            "extCtrl.x_P": 3.25,
            "motorShifts.m2": -123,
            "extCtrl.y_P": 99.0,
            "extCtrl.z_P": app.get("extCtrl.z_P"),
        }
    )
    # 99 is out of its limits, and z_P as in the profile.
    assert (
        "FLOATY: 2 parameters from the EEPROM, not from profile floaty: extCtrl.x_P motorShifts.m2\n"
        in app.console()
    )


def test_a_default_of_another_profile_is_not_taken_for_one_of_the_eeprom(tmp_path: Path) -> None:
    plant = ("floaty_profile.c", "parameters->gain_z = ", "parameters->gain_z = 0.1f + ")
    app = App(build_app(tmp_path / "app", plant=plant), tmp_path / "copy.so")
    app.boot({"motorShifts.m1": 60.0})
    assert "1 parameters from the EEPROM, not from profile floaty: motorShifts.m1\n" in app.console()
    named = re.findall(
        r"(\d) parameters from floaty_profile.c, not from profile floaty: (.+)\n", app.console()
    )
    assert [(count, "extCtrl.z_P" in names.split()) for count, names in named] == [("1", True)]


@pytest.mark.parametrize(("name", "before"), [("floaty.stop", 0), ("floaty.armed", 1)])
def test_a_switch_that_is_written_2_is_put_back_and_does_nothing(app: App, name: str, before: int) -> None:
    flying(app)
    app.set(name, 2)
    assert app.get(name) == before
    for step in range(1200, 1221):
        app.step(step)
    assert app.supervisor.state == reference.State.FLYING


def test_under_another_controller_the_state_is_failsafe(app: App) -> None:
    flying(app)
    fly_on(app, 1200, 60, controlled=False)
    app.c.stub_run_app(1)
    assert app.counts() == hover_of(app)
    assert (app.supervisor.state, app.supervisor.cause) == (
        reference.State.FAILSAFE, reference.Cause.NO_CONTROL,
    )  # fmt: skip
    assert app.console().endswith("supervisor: failsafe, no control\n")
    fly_on(app, 1260, 20)
    app.c.stub_run_app(1)
    assert app.console().endswith("supervisor: flying\n")


def test_manual_angles_last_as_long_as_a_client_is_there(app: App) -> None:
    app.boot()
    hover = hover_of(app)
    app.set("extCtrl.manual", MANUAL_ANGLES)
    for connected in (1, 0, 1):
        app.connected.value = connected
        for step in range(1, 21):
            app.step(step)
        assert (app.counts() == hover) == (not connected)


@pytest.mark.parametrize("port", [LOCALISATION, SUPERVISOR])
def test_a_stop_by_either_port_lasts_until_a_reboot(app: App, port: int) -> None:
    flying(app)
    if port == LOCALISATION:
        app.radio(b"\x03")
    else:
        app.stop_requested.value = 1  # the firmware's own service of that port
    fly_on(app, 1200, 20)
    assert app.supervisor.cause == reference.Cause.EMERGENCY_STOP
    app.set("floaty.stop", 0)
    fly_on(app, 1220, 20)
    assert app.supervisor.cause == reference.Cause.EMERGENCY_STOP
    assert app.counts() == hover_of(app)
    assert app.stop_requested.value == 1  # the firmware locks itself


def test_core_and_firmware_arm_and_disarm_each_other_each_time(app: App) -> None:
    flying(app)
    step = 1200

    def go_on(core: int | None = None, client: int | None = None) -> tuple[bool, bool]:
        """Let one of them act; return whether core and firmware are armed soon after."""
        nonlocal step
        if core is not None:
            app.set("floaty.armed", core)
        if client is not None:
            app.armed.value = client
        app.can_fly.value = app.armed.value
        fly_on(app, step, 40)
        step += 40
        return bool(app.supervisor.armed), bool(app.armed.value)

    for _ in range(2):
        app.can_arm.value = 1  # the firmware's checks have passed
        assert go_on(client=0) == (False, False)
        assert go_on(client=1) == (True, True)
        assert go_on(core=0) == (False, False)
        assert go_on(core=1) == (True, True)
        assert go_on(core=0) == (False, False)
        app.can_arm.value = 0
        assert go_on(client=1) == (True, True), "it was ready to be armed"
        assert go_on(core=0) == (False, False)
        assert go_on(client=1) == (False, False), "it armed itself after its checks"
        app.can_arm.value = 1
        assert go_on(core=1) == (True, True)


@pytest.mark.parametrize("requests", [("armed", 0, 1), ("armed", 1, 0), ("stop", 0, 1), ("stop", 1, 0)])
def test_of_two_requests_between_two_steps_the_one_to_stop_lasts(
    app: App, requests: tuple[str, int, int]
) -> None:
    flying(app)
    name, *values = requests
    for value in values:
        app.set(f"floaty.{name}", value)
    app.step(1200)
    assert (app.supervisor.armed, app.supervisor.stopped) == ((0, 0) if name == "armed" else (1, 1))


def test_the_watchdog_of_the_stop_is_the_firmwares(app: App) -> None:
    app.boot()
    app.radio(b"\x04")
    assert app.watchdog_fed.value == 1


def test_a_full_pose_queue_keeps_the_newest_poses(app: App) -> None:
    app.boot()
    for step in range(1, 100):
        app.step(step)
    for i in range(20):
        app.radio(crtp.encode_ext_pose((0.01 * i, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0)[1:])
    for step in range(100, 140):
        app.step(step)
    assert app.log("floaty.overflows") == 12
    assert app.state()["stateEstimate.x"] == pytest.approx(0.19, abs=0.01)


# Absolute poses: the stock commander says where to fly


def commanded(app: App, **fields: float) -> None:
    """Let the stock commander command this."""
    app.setpoint = Setpoint(**fields)


def position(x: float, y: float, z: float, yaw_deg: float = 0.0) -> dict[str, float]:
    return {"x": x, "y": y, "z": z, "yaw": yaw_deg, "x_mode": 1, "y_mode": 1, "z_mode": 1, "yaw_mode": 1}


def absolute(app: App, first: int, steps: int, p_WB: Vector, q_WB: Quaternion) -> None:
    data = crtp.encode_ext_pose(p_WB, q_WB, 0)[1:]
    for step in range(first, first + steps):
        if step % 20 == 1:
            app.radio(data)
        app.step(step)


def estimate(app: App) -> list[float]:
    return np.frombuffer(app.estimator(), Estimator.dtype)[0]["now"][:9].tolist()  # type: ignore[no-any-return]


HOME = (0.0, 0.0, 1.15)
P_WB, Q_WB = (1.0, 2.0, 3.0), from_euler_zyx(0.1, -0.2, 1.3)


@pytest.mark.long
@pytest.mark.parametrize("how", ["attitude", "quaternion"])
def test_absolute_poses_become_corrections(app: App, library: Path, tmp_path: Path, how: str) -> None:
    rng = np.random.default_rng(5)
    twin = App(library, tmp_path / "twin.so")
    app.boot(absolute=True)
    twin.boot()
    p, yaw = np.array(P_WB), 1.3
    for step in range(1, 2000):
        if step % 10 == 1:  # the high-level commander's rate
            goal = (1.0 + 0.1 * math.sin(0.002 * step), 2.0, 3.05)
            goal_yaw = 1.3 + 2.0 * math.sin(0.001 * step)  # through half a turn
            commanded(app, **position(*goal, math.degrees(goal_yaw)))
            if how == "quaternion":  # a full-state set-point
                app.setpoint.yaw_mode, app.setpoint.quat_mode, app.setpoint.yaw = 0, 1, 0.0
                s = app.setpoint
                s.qw, s.qx, s.qy, s.qz = from_euler_zyx(0.3, -0.4, goal_yaw)
        if step % 20 == 5:
            p += rng.normal(0, 0.002, 3)
            p_WB = (p[0].item(), p[1].item(), p[2].item())
            yaw += rng.normal(0, 0.01)
            q_WB = from_euler_zyx(0.1, -0.05, yaw)
            app.radio(crtp.encode_ext_pose(p_WB, q_WB, 40_000)[1:])
            twin.radio(crtp.encode_ext_pose(*in_goal_frame(p_WB, q_WB, goal, goal_yaw), 40_000)[1:])
        for board in (app, twin):
            board.step(step)
        assert estimate(app) == pytest.approx(estimate(twin), abs=1e-4), step
    assert app.supervisor.state == reference.State.FLYING
    assert max(map(abs, estimate(app))) > 0.1


def test_the_firmwares_commander_gets_the_state_in_the_world(app: App) -> None:
    app.boot(absolute=True)
    commanded(app, **position(0.0, 0.0, 1.0, 170.0))
    app.setpoint.derivatives[1:4] = 0.5, -0.25, 0.125  # its velocity, behind a time
    app.step(0)
    assert list(app.data.setpoint_velocity) == [0.5, -0.25, 0.125]
    commanded(app, **position(0.0, 0.0, 1.0, 170.0))
    q_WB = from_euler_zyx(0.02, -0.01, 3.2)
    for step in range(1, 1000):
        if step % 20 == 1:
            p_WB = (-0.5 + 0.3e-3 * step, 0.1, 1.0)
            app.radio(crtp.encode_ext_pose(p_WB, q_WB, 0)[1:])
        app.step(step)
    state = app.state()
    assert [state[f"stateEstimate.{name}"] for name in "xyz"] == pytest.approx(p_WB, abs=0.02)
    assert [state[f"stateEstimate.v{name}"] for name in "xyz"] == pytest.approx((0.3, 0.0, 0.0), abs=0.05)
    told = np.array([state[f"stateEstimate.q{name}"] for name in "wxyz"])
    assert abs(told @ np.array(q_WB)) == pytest.approx(1.0, abs=1e-3)
    assert state["stateEstimate.yaw"] == pytest.approx(math.degrees(3.2 - 2 * math.pi), abs=2.0)
    assert [struct.unpack_from("<I", app._state, at)[0] for at in (0, 32, 48)] == [step] * 3


def test_until_something_is_commanded_floaty_holds_where_it_is(app: App) -> None:
    app.boot(absolute=True)
    absolute(app, 1, 1000, P_WB, yaw_quaternion(1.3))
    assert max(map(abs, estimate(app))) < 1e-3
    assert app.supervisor.state == reference.State.FLYING


def test_a_nan_yaw_leaves_the_goals_yaw(app: App) -> None:
    app.boot(absolute=True)
    commanded(app, **position(1.0, 2.0, 2.9, 40.0))
    absolute(app, 1, 300, P_WB, yaw_quaternion(1.0))
    before = estimate(app)
    commanded(app, **position(1.0, 2.0, 2.9, math.nan))
    absolute(app, 300, 300, P_WB, yaw_quaternion(1.0))
    assert estimate(app)[8] == pytest.approx(before[8], abs=0.02)
    assert app.log("kalman.invalid") == 0


def test_corrections_forget_the_goal_of_absolute_poses(app: App) -> None:
    app.boot(absolute=True)
    commanded(app, **position(1.0, 2.0, 2.9, 0.0))
    absolute(app, 1, 600, P_WB, Q_WB)
    app.set("extPose.absolute", 0)
    commanded(app)
    fly_on(app, 600, 400)
    assert app.state()["stateEstimate.z"] == pytest.approx(0.05, abs=5e-3)
    app.set("extPose.absolute", 1)
    absolute(app, 1000, 400, P_WB, Q_WB)
    assert estimate(app)[2] == pytest.approx(0.0, abs=5e-3)


ONLY_POSITIONS, OUTSIDE = "only positions are\n", "it leaves the box, see box.radius"


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"roll_mode": 1, "pitch_mode": 1, "yaw_mode": 2, "thrust": 30000.0}, ONLY_POSITIONS),  # port 3
        ({"x_mode": 2, "y_mode": 2, "z_mode": 1, "yaw_mode": 2, "z": 1.0}, ONLY_POSITIONS),  # hover
        ({"x_mode": 1, "y_mode": 1, "z_mode": 1, "x": math.nan}, ONLY_POSITIONS),
        ({"x_mode": 1, "y_mode": 1, "z_mode": 2, "z": 1.0}, ONLY_POSITIONS),  # a velocity upwards
        ({"x_mode": 1, "y_mode": 2, "z_mode": 1, "z": 1.0}, ONLY_POSITIONS),
        (position(0.16, 0.0, 1.15), OUTSIDE),
        (position(0.0, 0.0, 0.4), OUTSIDE),
        (position(0.0, 0.0, 1.9), OUTSIDE),
    ],
)
def test_a_bad_set_point_keeps_the_goal_in_one_line(app: App, other: dict[str, float], reason: str) -> None:
    app.boot(absolute=True)
    for size, value in (("radius", 0.15), ("below", 0.65), ("above", 0.65)):
        app.set(f"box.{size}", value)
    commanded(app, **position(0.1, 0.0, 1.2))
    absolute(app, 1, 600, HOME, yaw_quaternion(0.0))
    for first, fields in ((600, other), (620, other), (640, {}), (660, other)):
        commanded(app, **fields)
        absolute(app, first, 20, HOME, yaw_quaternion(0.0))
        app.c.stub_run_app(1)
        assert app.console().count(f"set-point not followed: {reason}") == (2 if first == 660 else 1)
    absolute(app, 680, 120, HOME, yaw_quaternion(0.0))
    assert estimate(app)[:3] == pytest.approx([-0.1, 0.0, -0.05], abs=5e-3)
    commanded(app, **position(0.15, 0.0, 1.15))
    absolute(app, 800, 400, HOME, yaw_quaternion(0.0))
    assert estimate(app)[0] == pytest.approx(-0.15, abs=0.02)


def test_an_app_that_has_booted_takes_absolute_poses(app: App) -> None:
    assert app.get("extPose.absolute") == 1


@pytest.mark.long
@pytest.mark.parametrize("place", [(0.0, 0.0, 1.1), (0.7, 0.7, 0.0), (0.0, 0.0, -2.1)])
def test_impossible_corrections_are_counted_and_reported_every_ten_seconds(
    app: App, place: tuple[float, float, float]
) -> None:
    flying(app)
    before, invalid = estimate(app), app.log("kalman.invalid")
    reported = []
    for step in range(1200, 21_300):
        if step % 20 == 1:
            app.radio(crtp.encode_ext_pose(place, yaw_quaternion(0.0), 40_000)[1:])
        app.step(step)
        if step % 500 == 205:  # the console takes few of the lines with which the app begins
            app.c.stub_run_app(1)
            if app.console().count("for absolute poses set extPose.absolute 1") > len(reported):
                reported.append(step)
        if step == 1259:
            assert estimate(app) == pytest.approx(before, abs=0.02)
            assert app.log("kalman.invalid") - invalid == 3
    assert np.diff(reported).tolist() == [10_000, 10_000]


def test_a_pose_refused_soon_after_a_line_is_in_no_later_line(app: App) -> None:
    flying(app)
    for first, length in ((1200, 1000), (2200, 1000), (3200, 10_000)):
        if first < 3000:
            app.radio(crtp.encode_ext_pose((0.0, 0.0, 1.1), yaw_quaternion(0.0), 40_000)[1:])
        fly_on(app, first, length)
        app.c.stub_run_app(1)
    assert app.console().count("for absolute poses set extPose.absolute 1") == 1


@pytest.mark.parametrize(
    ("sent_us", "lines"), [(110_000, []), (110_500, ["poses 121 ms old: at most 120 ms"])]
)
def test_poses_are_named_too_old_above_the_limit(app: App, sent_us: int, lines: list[str]) -> None:
    flying(app)
    before = app.log("kalman.too_old")
    app.radio(crtp.encode_ext_pose((0.01, -0.02, 0.05), yaw_quaternion(0.0), sent_us)[1:])  # waits 10 ms
    for step in (1201, 1202):
        app.step(step)
    app.c.stub_run_app(1)
    assert app.log("kalman.too_old") == before + 1  # for a horizon that is short so far
    assert re.findall(r"poses .* old: .*", app.console()) == lines


def test_a_packet_of_packed_poses_without_any_is_malformed(app: App) -> None:
    app.boot()
    before = app.log("floaty.malformed")
    app.radio(b"\x09")
    assert app.log("floaty.malformed") == before + 1


@pytest.mark.parametrize(("channel", "size"), [(1, 2), (0, 1), (2, 1)])
@pytest.mark.parametrize("kind", [3, 4])
def test_an_emergency_packet_of_another_size_or_channel_changes_nothing(
    app: App, kind: int, channel: int, size: int
) -> None:
    flying(app)
    app.radio(bytes((kind, 0))[:size], channel=channel)
    assert (app.stop_requested.value, app.watchdog_fed.value) == (0, 0)
    fly_on(app, 1200, 20)
    assert app.supervisor.state == reference.State.FLYING


def test_with_corrections_a_commanded_position_is_refused_in_one_line(app: App) -> None:
    flying(app)
    before = app.state()
    commanded(app, **position(1.0, 2.0, 3.0))
    for first in (1200, 1300):
        fly_on(app, first, 100)
        app.c.stub_run_app(1)
    assert app.console().count("set-point not followed: poses are corrections, see extPose.absolute\n") == 1
    assert app.state() == pytest.approx(before, abs=1e-2)


def test_the_firmware_sees_a_flight_only_while_its_commander_leads_one(app: App) -> None:
    flying(app)
    assert list(app.ratios) == [0, 0, 0, 0]
    app.set("extPose.absolute", 1)
    absolute(app, 1200, 100, P_WB, Q_WB)
    assert app.supervisor.state == reference.State.FLYING
    assert list(app.ratios) == [0, 0, 0, 1]  # of 65535: the motors' PWM has 255 steps
    app.idle_thrust.value = 3000  # the firmware takes more than that for a flight
    app.step(1201)
    assert list(app.ratios) == [0, 0, 0, 3001]
    app.ratios[3] = 0  # the firmware's own, after each step of the controller
    for step in range(1300, 1900):
        app.step(step)
    app.ratios[3] = 0
    app.step(1900)
    assert app.supervisor.cause == reference.Cause.SILENCE
    assert list(app.ratios) == [0, 0, 0, 0]


RENAMED = {"floaty.reset": "FloatyKalm.resetKalman"}


def test_parameters_have_the_names_types_and_defaults_of_the_laboratory(app: App) -> None:
    laboratory = Laboratory()
    app.boot()
    for name, index in app.params.items():
        twin = laboratory.parameters[RENAMED.get(name, name)]
        assert app.c.stub_param_type(index) == twin.scalar.parameter_number, name
        assert app.get(name) == twin.read(), name
        if name != "floaty.reset":
            assert app.c.stub_param_persistent(index) == twin.persistent, name


@pytest.mark.long
@given(data=st.data())
def test_the_board_accepts_the_laboratory_s_parameters_only(functions: App, data: st.DataObject) -> None:
    laboratory = LABORATORY
    names = sorted(name for name in functions.params if name in laboratory.parameters)
    name = data.draw(st.sampled_from(names))
    twin = laboratory.parameters[name]
    if twin.scalar.parameter_number == 6:
        value = data.draw(st.floats(width=32) | st.sampled_from([twin.minimum, twin.maximum]))
        value = float(np.float32(value))
    else:
        value = data.draw(st.integers(0, 255) if twin.scalar.size == 1 else st.integers(0, 32767))
    assume(not (twin.minimum != value and abs(value - twin.minimum) < 1e-6))
    assume(not (twin.maximum != value and abs(value - twin.maximum) < 1e-6))
    before = functions.get(name)
    functions.set(name, value)
    accepted = twin.minimum <= value <= twin.maximum
    assert functions.get(name) == (value if accepted else before)


def test_two_names_of_one_parameter_follow_each_other(app: App) -> None:
    app.boot()
    app.set("setpoint.Yaw", 0.5)
    assert app.get("extCtrl.target_yaw") == 0.5
    app.set("extCtrl.target_yaw", -1.0)
    assert app.get("setpoint.Yaw") == -1.0
    app.set("setpoint.Yaw", math.nan)
    assert app.get("setpoint.Yaw") == -1.0


def test_log_variables_have_names_of_the_laboratory(app: App) -> None:
    known = {variable.name for variable in Laboratory().firmware.variables}
    assert {name for name in app.logs if not name.startswith("floaty.")} <= known
    stock = "stateEstimate.x y z vx vy vz roll pitch yaw".replace(" ", " stateEstimate.").split()
    of_the_firmware = {*stock, "motor.m1", "motor.m2", "motor.m3", "motor.m4"}
    wanted = {variable.name for block in telemetry.BLOCKS for variable in block.variables}
    assert wanted - of_the_firmware <= set(app.logs)
    assert not of_the_firmware & set(app.logs)  # no name twice


# What is read from packets, against its Python original

FLOATS = st.floats(width=32) | st.floats(-1.25, 1.25, width=32)


@pytest.mark.long
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.binary(max_size=31)
    | st.builds(
        lambda floats, rest: struct.pack("<B7f", 8, *floats) + rest,
        st.lists(FLOATS, min_size=7, max_size=7),
        st.binary(max_size=2),
    )
)
def test_poses_are_read_as_the_laboratory_reads_them(app: App, data: bytes) -> None:
    assume(len(data) > 1)
    app.boot()
    app.data.absolute = 0  # it has booted before
    malformed = app.log("floaty.malformed")
    app.radio(data)
    app.step(11)
    app.step(12)
    is_pose = data[:1] == b"\x08" and len(data) in (29, 30)
    assert app.log("floaty.malformed") == malformed + (not is_pose)
    if is_pose:
        x, y, z, qx, qy, qz, qw = np.frombuffer(data[1:29], np.float32)
        fields = (*app.data.pose_position, *app.data.pose_quaternion)
        assert fields == pytest.approx((x, y, z, qw, qx, qy, qz), abs=0, rel=0, nan_ok=True)


# The folder and its build for the board


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an app."""
    folder = tmp_path_factory.mktemp("written")
    write_app(load_config(), "floaty", folder)
    return folder


@pytest.mark.long
def test_only_an_empty_folder_or_an_app_is_written_to(written: Path, tmp_path: Path) -> None:
    config = load_config()
    before = {path: path.read_bytes() for path in (written / "src").glob("*.[ch]")}
    write_app(config, "floaty", written)
    assert {path: path.read_bytes() for path in (written / "src").glob("*.[ch]")} == before
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    with pytest.raises(ExportError, match="neither empty nor an app"):
        write_app(config, "floaty", tmp_path / "full")
    with pytest.raises(ExportError, match=r"thesis\.tex"):
        write_app(config, "floaty", tmp_path / "full" / "thesis.tex")


@pytest.mark.long
def test_every_source_is_built_and_every_include_is_there(written: Path) -> None:
    source = written / "src"
    kbuild = (source / "Kbuild").read_text()
    objects = {name.removesuffix(".o") for name in re.findall(r"^obj-y \+= (\S+)$", kbuild, re.M)}
    assert objects == {path.stem for path in source.glob("*.c")}
    for path in source.glob("*.[ch]"):
        for name in re.findall(r'#include "(\S+)"', path.read_text()):
            assert (source / name).is_file() or (STUBS / name).is_file(), name


def test_the_stubs_are_as_the_firmwares_headers(tmp_path: Path) -> None:
    zig = (sys.executable, "-m", "ziglang", "cc", "-target", "thumb-freestanding-eabihf", "-fshort-enums")
    caches = dict.fromkeys(("ZIG_LOCAL_CACHE_DIR", "ZIG_GLOBAL_CACHE_DIR"), str(tmp_path))
    built = subprocess.run(
        (*zig, "-std=gnu11", "-Wall", "-Werror", "-c", STUBS / "facts.c", "-o", tmp_path / "facts.o"),
        env=os.environ | caches, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr


@pytest.mark.long
@pytest.mark.parametrize("header", sorted(STUBS.glob("*.h")), ids=lambda header: header.name)
def test_the_stubs_declare_nothing_that_the_facts_do_not_state(header: Path) -> None:
    words_of_c = (
        "volatile typedef enum union extern inline return packed section used aligned format printf opaque"
    )
    only_in_stubs = (
        r"stub_\w+|\w+_PLACE|(LOG|PARAM)_ADD_(GROUP|FULL)|(sensorData|setpoint)_s|__(logs|params)_|stop_"
    )
    declared = {
        name
        for name in names_in(header.read_text()) - names_in((STUBS / "facts.c").read_text())
        if not re.fullmatch(only_in_stubs, name)
    }
    assert declared - set(words_of_c.split()) == set()


def names_in(c: str) -> set[str]:
    """The identifiers of a C source, without those of comments, texts, directives and macros' parameters."""
    c = re.sub(r'/\*(.|\n)*?\*/|"[^"\n]*"|#(pragma|include|if|else|endif).*', "", c)
    parameters = {
        name for listed in re.findall(r"#define \w+\(([^)]*)\)", c) for name in re.findall(r"\w+", listed)
    }
    return set(re.findall(r"(?<!\w)[A-Za-z_]\w*", c)) - parameters


@pytest.fixture(scope="module")
def arm_build(written: Path) -> Path:
    if shutil.which(ARM) is None:
        pytest.skip(f"no {ARM} here: apt-get install gcc-arm-none-eabi")
    return compile_for_arm(written)


def compile_for_arm(folder: Path) -> Path:
    """Compile an app's files as the Crazyflie's firmware is; returns their folder."""
    kbuild = (folder / "src" / "Kbuild").read_text()
    for name in re.findall(r"^obj-y \+= (\S+)$", kbuild, re.M):
        own = re.findall(rf"^CFLAGS_{re.escape(name)} := (.*)$", kbuild, re.M)
        flags = (*ARM_FLAGS, *" ".join(own).split(), "-fcallgraph-info=su", f"-I{STUBS}")
        subprocess.run((ARM, *flags, "-c", name.replace(".o", ".c")), cwd=folder / "src", check=True)
    return folder / "src"


@pytest.mark.long
def test_the_app_compiles_with_the_crazyflies_flags_and_fits(arm_build: Path) -> None:
    objects = sorted(map(str, arm_build.glob("*.o")))
    lines = subprocess.run(
        ("arm-none-eabi-size", "-t", *objects), capture_output=True, text=True, check=True
    ).stdout
    text, data, bss = map(int, lines.splitlines()[-1].split()[:3])
    sections = subprocess.run(
        ("arm-none-eabi-objdump", "-h", *objects), capture_output=True, text=True, check=True
    ).stdout
    stack = {
        name: deepest_stack(arm_build)[name]
        for name in ("estimatorOutOfTree", "controllerOutOfTree", "app_task", "appInit", "receive")
    }
    print(f"flash {text + data} B, RAM {data + bss} B, stack {stack} B")
    assert text + data < 30_000
    assert data + bss < 16_500  # a core that flies, one for the port
    assert "ccm" not in sections.lower()
    assert max(stack.values()) < STABILIZER_STACK // 2


@pytest.mark.long
def test_the_core_on_arm_neither_fuses_nor_computes_in_double(arm_build: Path) -> None:
    code = subprocess.run(
        ("arm-none-eabi-objdump", "-d", str(arm_build / "floaty_core.o")), capture_output=True, text=True, check=True
    ).stdout  # fmt: skip
    assert "vsqrt.f32" in code
    assert not re.findall(r"vfn?m[as]\.", code)
    everything = sorted(map(str, arm_build.glob("*.o")))
    symbols = subprocess.run(
        ("arm-none-eabi-nm", "-u", *everything), capture_output=True, text=True, check=True
    ).stdout
    assert not re.findall(
        r"__aeabi_[dfl]?2?d\w*", symbols.replace("__aeabi_ldivmod", "").replace("__aeabi_idiv", "")
    )


def deepest_stack(folder: Path) -> dict[str, int]:
    """Bytes of stack from each function of the app down, from gcc's call graphs; unknown functions count nothing."""
    frames: dict[str, int] = {}
    calls: dict[str, set[str]] = defaultdict(set)
    for path in folder.glob("*.ci"):
        text = path.read_text()
        for title, label in re.findall(r'node: \{ title: "([^"]+)" label: "([^"]+)"', text):
            size = re.search(r"(\d+) bytes", label)
            if size:
                frames[title] = int(size[1])
        for caller, callee in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', text):
            calls[caller].add(callee)

    def depth(name: str) -> int:
        return frames.get(name, 0) + max(
            (depth(callee) for callee in calls[name] if callee in frames), default=0
        )

    return {name.split(":")[-1]: depth(name) for name in frames}


LABORATORY = Laboratory()
assert Estimator.dtype.itemsize % 4 == 0
