"""The ground station within a server: what it sends instead of requests for telemetry, when, and how often."""

from types import SimpleNamespace as Made
from typing import Any

import pytest

from firmware_py.wire.parameters import SetByName, encode_pose_kind, encode_set_by_name
from firmware_py.wire.scalars import Scalar
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal
from hil.config import load_config
from hil.servers.built_in_station import STARTED_US, HiddenLink

PARAMETERS = {"stabilizer": {"estimator": 2.0, "controller": 3.0}}
SETTINGS = [
    encode_set_by_name(SetByName(name, scalar, value))
    for name, scalar, value in (
        ("stabilizer.estimator", Scalar.U8, 2.0), ("stabilizer.controller", Scalar.F32, 3.0),
    )
]  # fmt: skip


class Air:
    """A robot that keeps what arrives, with the instant."""

    def __init__(self, pilot: dict[str, Any], image: bool = True) -> None:
        config = load_config()
        config = config.model_copy(update={"pilot": config.pilot.model_copy(update=pilot)})
        self.arrived: list[tuple[int, bytes]] = []
        self.robot: Any = Made(
            config=config, events=Made(at=lambda t_us, act: act(t_us)), booted_us=0, image=image,
            packet_received=lambda t_us, data: self.arrived.append((t_us, data)),
        )  # fmt: skip
        self.boot(0)
        self.link = HiddenLink(self.robot, absolute=False)

    def boot(self, now_us: int) -> None:
        table = {
            "stabilizer.estimator": Made(scalar=Scalar.U8), "stabilizer.controller": Made(scalar=Scalar.F32),
        }  # fmt: skip
        self.robot.firmware = Made(flashed=Made(parameters=table) if self.robot.image else None)
        self.robot.booted_us = now_us

    def asked(self, now_us: int) -> list[bytes]:
        """Return what a request for telemetry sends, a link's latency later."""
        self.arrived.clear()
        self.link.start_telemetry(now_us)
        late_us = now_us + self.robot.config.station.link_latency_us
        assert {t_us for t_us, _ in self.arrived} <= {late_us}
        assert self.link.latency.us == self.robot.config.station.link_latency_us
        return [data for _, data in self.arrived]


@pytest.mark.parametrize("absolute", [False, True])
def test_a_board_with_the_app_is_told_the_kind_of_poses_each_time(absolute: bool) -> None:
    air = Air({"enabled": False})
    air.link = HiddenLink(air.robot, absolute)
    assert [air.asked(now_us) for now_us in (0, 5_000_000)] == [[encode_pose_kind(absolute)]] * 2
    assert air.link.receive(0, b"") == ()


def test_the_crazyflie_s_own_firmware_gets_its_parameters_once_per_boot_when_it_has_started() -> None:
    air = Air({"enabled": True, "parameters": PARAMETERS})
    assert [air.asked(now_us) for now_us in (0, 1, 1_000_000)] == [SETTINGS, [], []]
    for boot_us in (20_000_000, 30_000_000):
        air.boot(boot_us)
        assert air.asked(boot_us + STARTED_US - 1) == []
        assert [air.asked(boot_us + STARTED_US + after_us) for after_us in (0, 1)] == [SETTINGS, []]
    assert Air({"enabled": True, "parameters": PARAMETERS}, image=False).asked(0) == []


@pytest.mark.parametrize("poses", [True, False])
def test_poses_are_sent_where_the_profile_has_them(poses: bool) -> None:
    air = Air({"poses": poses})
    frame = MocapFrame(0, (0.1, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), True)
    air.link.send(7_000, frame, Goal((0.0, 0.0, 1.0), 0.0))
    assert len(air.arrived) == poses
