"""Settings reach a board over the radio: told a profile's values, it is as if it was flashed with that profile."""

import random
import struct
from collections.abc import Callable

import pytest

from firmware_py.config import parameters_of
from firmware_py.links.parameters import TYPE_READ_ONLY
from firmware_py.wire.scalars import PARAMETER_SCALARS, Scalar
from ground_station.config import PilotConfig
from hil.board.image_firmware import differences
from hil.board.image_settings import ImageSettings, stock_contents
from hil.config import LabConfig, load_config
from hil.emulator.crazyflie.log_table import ImageParameter
from hil.errors import LabError
from support.crtp_client import CrtpClient

OTHER = (
    "allocation.opening_min=-0.192", "controller.limit_u3=0.6", "controller.gain_yaw=1.0", "model.yaw_u3=90.5",
    "estimator.gate_sigma=7", "predictor.default_age_us=41500", "servo.trim=[10,-20,30,-40]",
    "supervisor.pose_timeout_us=700000",
)  # fmt: skip


ENTRIES = {
    "stabilizer.controller": ImageParameter(7, Scalar.U8, True, lambda: 0.0),
    "firmware.revision0": ImageParameter(8, Scalar.U32, False, lambda: 0.0),
    "posCtlPid.xKp": ImageParameter(9, Scalar.F32, True, lambda: 0.0),
}


LOG = {"supervisor.info": 3, "stateEstimate.x": 4}


def pilot(**parameters: dict[str, float]) -> PilotConfig:
    return PilotConfig(enabled=True, parameters=parameters)


@pytest.mark.parametrize(("parameters", "text"), [
    ({"stabilizer": {"controler": 1}}, "stabilizer.controler: the image has no such parameter; did you mean"),
    ({"stabilizer": {"controller": 300}}, "stabilizer.controller = 300: not a value of type U8"),
    ({"stabilizer": {"controller": 1.5}}, "stabilizer.controller = 1.5: not a value of type U8"),
    ({"firmware": {"revision0": 1}}, "firmware.revision0: can only be read"),
])  # fmt: skip
def test_a_parameter_that_the_image_cannot_take_is_refused(
    parameters: dict[str, dict[str, float]], text: str
) -> None:
    with pytest.raises(LabError, match=f"^pilot.parameters.{text}"):
        stock_contents(ENTRIES, LOG, pilot(**parameters))


def test_an_image_from_before_the_present_supervisor_is_refused_with_the_first_release_that_flies() -> None:
    with pytest.raises(
        LabError, match=r"no log variable supervisor\.info: .* release 2023\.06, the first one"
    ):
        stock_contents(ENTRIES, {"stateEstimate.x": 4}, pilot())


def test_parameters_that_the_image_takes_are_in_its_table_of_contents() -> None:
    entries = stock_contents(ENTRIES, LOG, pilot(stabilizer={"controller": 255}, posCtlPid={"xKp": 2.1}))
    assert [(name, one.number) for name, one in entries.items()] == [
        (name, one.number) for name, one in ENTRIES.items()
    ]


class Told(CrtpClient):
    """A board that is told the settings of `config`; what `lossy` says is lost both ways."""

    def __init__(self, config: LabConfig, lossy: Callable[[], bool] = lambda: False) -> None:
        super().__init__()
        self.constants = self.firmware._core.parameters
        self.said: list[str] = []
        self.lossy = lossy
        values = {parameter.name: parameter for parameter in self.firmware.parameters}
        table = {
            name: ImageParameter(
                number, PARAMETER_SCALARS[kind & 0x0F], not kind & TYPE_READ_ONLY, values[name].read
            )
            for name, (number, kind) in self.toc(2).items()
        }
        self.sent.clear()
        self.writes_up = 0
        self.settings = ImageSettings(
            table, self.differences, config, self.events, self._up, self.said.append
        )
        self.settings.begin(self.now_us)

    def differences(self, config: LabConfig) -> str:
        return differences(self.constants.memory, config, lambda symbol: False)

    def _up(self, now_us: int, data: bytes) -> None:
        self.writes_up += 1
        assert now_us == self.now_us
        if not self.lossy():
            self.firmware.radio_received(data)

    def listen(self, duration_us: int) -> None:
        end_us = self.now_us + duration_us
        while self.now_us < end_us:
            self.run(self.now_us + 1000)
            for _, data in self.sent:
                if not self.lossy():
                    self.settings.on_packet(self.now_us, data)
            self.sent.clear()


def test_a_board_given_a_profile_has_its_constants_bit_for_bit() -> None:
    config = load_config("floaty", list(OTHER))
    board = Told(config)
    assert board.constants.bytes() != parameters_of(config).bytes()
    board.listen(100_000)
    assert board.constants.bytes() == parameters_of(config).bytes()
    assert board.constants.fields.pose_timeout_us == 700_000
    assert board.writes_up == len(OTHER) + 3  # one packet each, four for the trims
    differs, said = board.said
    assert differs.startswith("the image was built with other constants: ")
    names = [one.partition(" = ")[0] for one in differs.split(": ")[1].split("; ")]
    assert {"opening_min", "limit_u3", "trim"} <= set(names) <= set(board.constants.memory.dtype.names)
    assert said.startswith("set over the radio: ")
    assert "RandConsts.openMin -0.192" in said


@pytest.mark.long
def test_every_profile_without_own_laws_can_be_set() -> None:
    for profile in ("as-flown", "cad", "design-best", "design-half"):
        config = load_config(profile)
        board = Told(config)
        board.listen(400_000)
        assert board.constants.bytes() == parameters_of(config).bytes(), profile


@pytest.mark.long
def test_settings_arrive_over_a_link_that_loses_a_third() -> None:
    config = load_config("floaty", list(OTHER))
    dice = random.Random(3)
    board = Told(config, lambda: dice.random() < 1 / 3)
    board.listen(3_000_000)
    assert board.constants.bytes() == parameters_of(config).bytes()


def test_a_board_that_matches_its_profile_gets_no_writes() -> None:
    board = Told(load_config())
    board.listen(50_000)
    assert board.writes_up == 0
    assert board.said == []


def test_values_without_a_parameter_are_reported_in_one_line() -> None:
    board = Told(load_config("floaty", ["predictor.age=fixed", "controller.limit_u3=0.6"]))
    board.listen(50_000)
    assert board.said == [
        "the image was built with other constants: age_measured = 1, in the profile 0; "
        "limit_u3 = 0.46000000834465027, in the profile 0.6000000238418579",
        "set over the radio: extCtrl.limU3 0.6",
        "the image keeps its own age_measured = 1, in the profile 0",
    ]
    unset = Told(load_config("floaty", ["predictor.age=fixed"]))
    unset.listen(50_000)
    differs = "age_measured = 1, in the profile 0"
    assert (unset.writes_up, unset.said) == (
        0, [f"the image was built with other constants: {differs}", f"the image keeps its own {differs}"]
    )  # fmt: skip


@pytest.mark.parametrize("packet", [b"\x2e", struct.pack("<BHf", 0x2E, 9999, 1.0), b"\x3c hello"])
def test_packets_that_answer_nothing_change_nothing(packet: bytes) -> None:
    board = Told(load_config("floaty", ["controller.limit_u3=0.6"]))
    before = list(board.said)
    board.settings.on_packet(board.now_us, packet)
    assert board.said == before
    board.listen(50_000)
    assert board.constants.fields.limit_u3 == pytest.approx(0.6)
