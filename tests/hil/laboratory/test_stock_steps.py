"""Steps of the unmodified firmware against crazyflow's, which flies the same control law with the same gains."""

import os
import struct
from math import degrees

import numpy as np
import pytest

from firmware_py.geometry import to_euler_zyx
from hil.config import load_config
from hil.emulator.events import EventQueue
from hil.laboratory.lockstep import image_at
from hil.laboratory.robot import Ports, Robot, Site, Streams, nobody_listens

ELF = os.environ.get("FLOATY_STOCK_ELF", "")
# crazyflow 0.4, first_principles of cf2x_P250 (31.8 g), Mellinger with the firmware's gains at 500 Hz, computed by it.
ROLL_S, PLACE_S, OVERSHOOT = 0.246, 0.524, 0.059  # rises from 10 to 90 %: 10 deg in roll, 0.5 m in y
SETTINGS = (
    "quadrotor.mass=0.0318", "quadrotor.rotor_lag=0.11",  # as crazyflow's
    "quadrotor.motor_spread=0", "imu.gyro_bias=0", "imu.accel_bias=0",
)  # fmt: skip
MELLINGER, KALMAN, HOVER = 2, 2, 42_600  # HOVER: of 65535, a quarter of the weight over the firmware's 0.12 N
FREE_MS, STEP_MS, LEVEL_MS = 2_000, 5_000, 9_000
ROLLS, LONG_MS, END_MS = {9_500: 10.0, 11_100: -10.0}, 800, 11_900


class Stick:
    """A robot whose set-points come from here; its poses are the truth."""

    def __init__(self) -> None:
        self.events = EventQueue()
        site = Site(
            load_config("crazyflie", SETTINGS),
            self.events,
            Streams.of_seed(1),
            lambda *_: None,
            image_at(ELF, None),
        )
        self.robot = Robot(site, Ports(nobody_listens))
        self.robot.watch(0)
        self.robot.body.put_back((0.0, 0.0, 1.0))

    def send(self, port: int, layout: str, *values: float) -> None:
        self.robot.packet_received(0, bytes((port,)) + struct.pack(layout, *values))

    def set(self, name: str, value: int) -> None:
        assert self.robot.firmware.flashed is not None
        self.send(0x22, "<HB", self.robot.firmware.flashed.parameters[name].number, value)

    def run(self, ms: int) -> None:
        robot, now_us = self.robot, 1_000 * ms
        robot.run(now_us - 1_000, now_us - 1)
        robot.advance(now_us)
        self.events.run(now_us)
        if ms % 10 == 0:
            assert robot.advance_truth(now_us) is None
        if ms % 10 == 5:
            w, x, y, z = robot.body.q_WB
            self.send(0x61, "<B7f", 8, *robot.body.p_WB, x, y, z, w)


def rise_s(values: np.ndarray, end: float) -> float:
    return float(np.argmax(values >= 0.9 * end) - np.argmax(values >= 0.1 * end)) * 1e-3


@pytest.mark.skipif(
    not ELF, reason="FLOATY_STOCK_ELF names no build of Bitcraze's firmware: no step was flown"
)
def test_steps_in_place_and_roll_rise_as_crazyflows() -> None:
    stick, seen = Stick(), []
    for ms in range(1, END_MS):
        stick.run(ms)
        if ms == 100:
            stick.set("stabilizer.controller", MELLINGER)
            stick.set("stabilizer.estimator", KALMAN)
        elif ms == 300:
            stick.send(0xD0, "<BB", 1, 1)  # arm
        elif ms == FREE_MS:
            stick.robot.body.release()
        if ms % 10 == 0 and 1_500 <= ms < LEVEL_MS:
            stick.send(0x70, "<B4f", 7, 0.0, 0.5 if ms >= STEP_MS else 0.0, 1.0, 0.0)
        elif ms % 10 == 0 and ms >= 500:
            stick.send(
                0x30,
                "<3fH",
                sum(roll for begin, roll in ROLLS.items() if 0 <= ms - begin < LONG_MS),
                0.0,
                0.0,
                0 if ms < 700 else HOVER,
            )
        seen.append((stick.robot.body.p_WB[1], degrees(to_euler_zyx(stick.robot.body.q_WB)[0])))
    place, roll = np.array(seen).T
    rises = []
    for begin, wanted in ROLLS.items():
        step = roll[begin : begin + LONG_MS] / wanted
        assert step[-50:].mean() == pytest.approx(1.0, abs=0.05)
        rises.append(rise_s(step, float(step[-50:].mean())))
    assert np.mean(rises) == pytest.approx(ROLL_S, rel=0.15)
    place = place[STEP_MS:LEVEL_MS] / 0.5
    assert rise_s(place, 1.0) == pytest.approx(PLACE_S, rel=0.2)
    assert place.max() - 1.0 == pytest.approx(OVERSHOOT, abs=0.03)
