"""Two flights that take the supervisor through all of its states and causes.

Parameters and watchdog packets arrive over the radio, as from a client. Changes that last for seconds happen while the
robot is held. In free flight poses and samples fail for a moment; at the end the watchdog of the emergency stop expires.
The cause `no control` belongs to a board whose controller has stopped: `hil.deploy.check` ends each flight with it.
"""

import struct
from functools import partial
from pathlib import Path

import firmware_py.logic
from firmware_py.wire import high_level
from firmware_py.wire.crtp import CHANNEL_GENERIC, PORT_COMMANDER, PORT_LOCALISATION, Packet, encode
from firmware_py.wire.localisation import EMERGENCY_STOP_WATCHDOG
from firmware_py.wire.parameters import SetByName, encode_set_by_name
from firmware_py.wire.scalars import Scalar
from hil.laboratory.experiment import Experiment
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import parse
from hil.laboratory.flight import Flight

FEED = encode(Packet(PORT_LOCALISATION, CHANNEL_GENERIC, bytes((EMERGENCY_STOP_WATCHDOG,))))
PATH = bytes((high_level.PathCommand.GO_TO, 0, 1)) + bytes(17) + struct.pack("<f", 1.0)
GO_TO = encode(Packet(high_level.PORT, 0, PATH))
STOP = encode(Packet(high_level.PORT, 0, bytes((high_level.PathCommand.STOP, 0))))
THRUST = encode(Packet(PORT_COMMANDER, 0, bytes(12) + b"\1\0"))  # an attitude set-point, which is refused
FAILING = Path(firmware_py.logic.__path__[0]) / "failing.py"
RECOVERY = ((0.0, "floaty.stop", Scalar.U8, 1), (0.2, "floaty.stop", Scalar.U8, 0))


def drill(flight: Flight) -> None:
    """Plan the first poses and a client's reversed actions: disarm, stop, tighten bounds, move the flaps, plan a path."""
    estimator, supervisor = flight.config.estimator, flight.config.supervisor
    [cameras] = KINDS["mocap.dropout"].knobs
    cameras.turn(flight.robot, 1.0)
    flight.events.at(1_500_000, lambda now_us: cameras.turn(flight.robot, 0.0))
    plan(flight, 2.0, (0.0, "floaty.armed", Scalar.U8, 0), (0.2, "floaty.armed", Scalar.U8, 1))
    plan(flight, 2.4, *RECOVERY)
    bounds = (0.0, 1e-4), (0.4, estimator.bound_velocity)
    plan(flight, 2.8, *((after_s, "FloatyKalm.maxVel", Scalar.F32, value) for after_s, value in bounds))
    plan(flight, 4.0, *((0.2 * mode, "extCtrl.manual", Scalar.U8, mode % 3) for mode in (1, 2, 3)))
    plan(
        flight,
        3.45,
        *((after_s, "extPose.absolute", Scalar.U8, value) for after_s, value in ((0.0, 1), (0.2, 0))),
    )
    limits = (0.0, 20_000), (5.2, supervisor.low_battery_mv)
    plan(flight, 4.8, *((after_s, "supervisor.lowBattery", Scalar.U16, value) for after_s, value in limits))
    plan(flight, 10.2, *RECOVERY)
    free_us = flight.release_us
    packets = (
        (3_400_000, GO_TO),  # poses are corrections: its set-points are not followed
        (3_500_000, GO_TO),  # they are absolute: it is judged as a whole
        (3_600_000, STOP),
        (free_us + 3_000_000, FEED),
        (free_us + 4_200_000, THRUST),
    )
    for at_us, packet in packets:
        flight.events.at(at_us, partial(flight.line.command, packet=packet))


def fail(flight: Flight) -> None:
    """Plan a NaN from user logic."""
    for start_s, name in ((2.0, "logic.law_fails"), (3.0, "logic.filter_fails")):
        plan(flight, start_s, (0.0, name, Scalar.F32, 1), (0.2, name, Scalar.F32, 0))
        plan(flight, start_s + 0.4, *RECOVERY)


def plan(flight: Flight, start_s: float, *writes: tuple[float, str, Scalar, float]) -> None:
    """Plan writes of parameters: time after the start [s], name, type and value."""
    for after_s, name, scalar, value in writes:
        packet = encode_set_by_name(SetByName(name, scalar, value))
        at_us = round((start_s + after_s) * 1e6)
        flight.events.at(at_us, partial(flight.line.command, packet=packet))


DRILL = Experiment(
    name="supervisor",
    summary="all states, and the causes that the core itself has",
    duration_s=4.4,
    limits={},
    settings=("flight.release_us=11_000_000",),
    faults=(parse("radio.cut@0.5:0.7"), parse("imu.freeze@2:0.05")),
    script=drill,
)
FAILURE = Experiment(
    name="failing-logic",
    summary="the causes that own logic has",
    duration_s=0.5,
    limits={},
    settings=("flight.release_us=4_000_000", f"logic.controller={FAILING}", f"logic.estimator={FAILING}"),
    script=fail,
)
