"""What is read from and written into the memory of an image with the exported app: the tests' firmware, with its symbols."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from firmware_py.config import LogicConfig, parameters_of
from firmware_py.logic.loading import load_logic, sensed_by
from firmware_py.signals import CONTROL, COUNTERS, ESTIMATOR, INPUT
from firmware_py.wire.supervisor import Cause, State
from hil.board import image_firmware
from hil.board.image_firmware import ChipImage, ChipSupervisor, ImageFirmware, differences
from hil.board.pins import Requests, VirtualBoard
from hil.config import load_config
from hil.emulator.stm32f405.chip import SOFTWARE, WATCHDOG, build_machine
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError
from support.stm32_firmware import PLACE, build, image_with

APP = {"floaty_estimator": ESTIMATOR, "floaty_control": CONTROL, "floaty_input": INPUT}


@cache
def plain() -> Image:
    return Image(build())


def booted(image: Image, logic: Any = None, rest: Any = None) -> ImageFirmware:
    requests = Requests(radio_command=lambda *_: None)
    board = VirtualBoard(lambda *_: None, lambda *_: True, lambda *_: None, requests=requests)
    return ImageFirmware(ChipImage(image, build_machine()), board, rest, logic=logic)


def put(firmware: ImageFirmware, name: str, content: np.ndarray[Any, Any]) -> None:
    firmware.chip.write(firmware.image.symbol(name).address, content.tobytes())


@pytest.mark.long
def test_an_image_rests_a_while_before_the_laboratorys_time_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_firmware, "WARM_UP_US", 5_000)
    rested = list[int]()
    firmware = booted(plain(), rest=lambda: rested.append(1) or (0,) * 6)
    assert (firmware.kernel.now_us, firmware.chip.now_us // 1_000, len(rested)) == (0, 5, 5)
    firmware.kernel.run(2_000)
    assert (firmware.kernel.now_us, firmware.chip.now_us // 1_000) == (2_000, 7)
    assert booted(plain()).kernel.now_us == 0


def test_another_image_in_flash_keeps_the_debugger_and_loses_what_watched_the_first() -> None:
    debugger: Any = Made()
    first = replace(ChipImage.flashed(plain(), Path("machine.so")), debugger=debugger, observers=(Made(),))
    assert first.flashed_with(first.in_flash + b"\xff\xff") is first
    padded = ChipImage.flashed(Image(Path("cf2.bin"), None, plain().code + b"\xff" * 8), first.library)
    assert padded.flashed_with(padded.in_flash[:-8]) is padded
    flash = first.in_flash[:-1] + bytes((first.in_flash[-1] ^ 1,))
    second = first.flashed_with(flash)
    assert (second.in_flash, second.debugger, second.library) == (flash, debugger, first.library)
    assert (second.observers, second.image.named, len(second.notes)) == ((), False, 1)


def test_the_app_s_signals_are_views_on_its_memory() -> None:
    firmware = booted(image_with(**{name: layout.itemsize for name, layout in APP.items()}))
    for turn in (1, 2):
        estimator, control, given = (np.zeros(1, layout) for layout in APP.values())
        estimator["now"] = turn + np.arange(16)
        for index, name in enumerate(COUNTERS):
            estimator[name] = 10 * turn + index
        for index, name in enumerate(("u", "flap", "count")):
            control[name] = 100 * turn + 4 * index + np.arange(4)
        given.view(np.uint8)[:] = turn
        for name, content in zip(APP, (estimator, control, given), strict=True):
            put(firmware, name, content)
        signals = firmware.signals
        assert signals.estimate.tolist() == estimator["now"][0].tolist()
        assert signals.counters.tolist() == [10 * turn + index for index in range(len(COUNTERS))]
        for name in ("u", "flap", "count"):
            assert getattr(signals, name).tolist() == control[name][0].tolist()
        assert firmware.inputs is not None
        assert firmware.inputs.tobytes() == given.tobytes()
        assert signals.supervisor.state is State.CALIBRATING


def test_an_image_without_the_app_has_no_input_and_signals_of_the_stock_firmware() -> None:
    firmware = booted(plain())
    assert firmware.inputs is None
    assert np.isnan(firmware.signals.estimate).all()
    assert firmware.differences(load_config()) == ""
    assert firmware.parameter_numbers == {"test.gain": 0, "test.revision": 1, "wait.timeout": 3}


@pytest.mark.parametrize("law", ["", "controller", "estimator", "both"])
@pytest.mark.parametrize("in_image", [False, True])
def test_an_image_has_a_user_s_logic_where_the_profile_has_any(
    monkeypatch: pytest.MonkeyPatch, law: str, in_image: bool
) -> None:
    config, without = load_config(), load_logic(LogicConfig())
    monkeypatch.setattr(image_firmware, "load_logic", lambda logic: without)
    chosen = [name for name in ("controller", "estimator") if law in (name, "both")]
    own = config.model_copy(update={"logic": LogicConfig(**dict.fromkeys(chosen, "own.py"))})
    told = differences(parameters_of(config).memory, own, lambda name: in_image)
    wanted = "one of the user's" if law else "the core's"
    assert told == ("" if bool(law) == in_image else f"control law, the profile has {wanted}")


def test_an_image_of_another_version_is_named_with_both_sizes() -> None:
    size = ESTIMATOR.itemsize
    for wrong in (size - 4, size + 4):
        with pytest.raises(
            LabError, match=f"floaty_estimator has {wrong} bytes where this laboratory's core has {size}:"
        ):
            booted(image_with(floaty_estimator=wrong, floaty_control=CONTROL.itemsize))


@pytest.mark.parametrize(("values", "state", "cause"), [
    ({}, State.CALIBRATING, Cause.NONE),
    ({"supervisor.state": State.FLYING, "supervisor.cause": Cause.SILENCE}, State.FLYING, Cause.SILENCE),
    ({"supervisor.state": State.FAILSAFE}, State.FAILSAFE, Cause.NONE),
    ({"supervisor.state": 200, "supervisor.cause": 200}, State.CALIBRATING, Cause.NONE),  # overwritten in a crash
])  # fmt: skip
def test_the_app_s_supervisor_is_read_by_its_log_variables(
    values: dict[str, int], state: State, cause: Cause
) -> None:
    variables: Any = {name: Made(read=lambda value=value: float(value)) for name, value in values.items()}
    supervisor = ChipSupervisor(variables)
    assert (supervisor.state, supervisor.cause) == (state, cause)


def test_an_image_s_constants_law_and_sensors_are_compared_with_the_profile_s() -> None:
    config = load_config()
    built = parameters_of(config).memory
    firmware = booted(image_with(floaty_parameters=built.dtype.itemsize))
    put(firmware, "floaty_parameters", built)
    assert firmware.differences(config) == ""
    name = built.dtype.names[0]
    other = built.copy()
    other[name] += 1
    put(firmware, "floaty_parameters", other)
    expected = f"{name} = {other[name][0].tolist()}, in the profile {built[name][0].tolist()}"
    assert firmware.differences(config) == expected
    assert (
        differences(built, config, lambda name: name == "floaty_guard")
        == "control law, the profile has the core's"
    )


@pytest.fixture
def own(tmp_path: Path) -> LogicConfig:
    """A law that reads a sensor of the robot's own."""
    from support.own_logic import HEAD

    (tmp_path / "law.py").write_text(
        HEAD.replace("POSITION, Control, Estimator, Input, Parameters", "Control, Estimator, Parameters")
        + '''
class Ranges(Struct):
    """What it sees."""

    down: Annotated[F32s, 2, Sensed("m")]


@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control, sensed: Ranges) -> None:
    """As built in, and a little more u with the distance."""
    feedback(parameters, estimator, control)
    control.u[0] = control.u[0] + sensed.down[1]
    allocate(parameters, control)
'''
    )
    return LogicConfig(controller=str(tmp_path / "law.py"))


def test_what_the_robot_s_own_sensors_measure_is_in_the_app_s_memory_with_each_sample(
    own: LogicConfig,
) -> None:
    logic = load_logic(own)
    (field,) = sensed_by(logic)
    assert logic is not None
    layout = logic.loaded.structs[field.block].dtype
    firmware = booted(image_with(**{f"floaty_{field.block}": layout.itemsize}), logic)
    for measured in ((1.0, 2.0), (3.0, 4.0)):
        firmware._board.sensors = {field.name: np.array(measured, np.float32)}
        firmware.imu_ready()
        there = firmware.chip.read(PLACE, layout.itemsize)
        assert np.frombuffer(there, layout)[field.name][0].tolist() == list(measured)
    config = load_config(overrides=(f'logic.controller="{own.controller}"',))
    built = parameters_of(config).memory
    said = f"own sensors, the image has no floaty_{field.block}"
    assert differences(built, config, lambda name: name == "floaty_guard") == said
    assert (
        differences(built, config, lambda name: False)
        == f"control law, the profile has one of the user's; {said}"
    )
    assert differences(built, config, lambda name: True) == ""


def test_the_report_counts_restarts_by_their_cause_and_free_stacks() -> None:
    firmware = booted(plain())
    assert firmware.report().stack_free_bytes == {}
    firmware.kernel.run(30_000)
    firmware._crazyflie.resets |= {WATCHDOG: 2, SOFTWARE: 3}
    report = firmware.report()
    assert (report.watchdog_resets, report.software_resets, firmware.resets) == (2, 3, 5)
    assert list(report.stack_free_bytes) == ["FILTER", "FROZEN", "REPORT", "SPIN-0", "SPIN-1", "IDLE"]
    assert (report.heap_free_bytes, report.sha256) == (None, plain().sha256)
