"""Take-off and landing by the speed of the tunnel, as in the original operator's menu, but without an operator.

The robot stands on the net in still air, its flaps at the hover angle. The fans run up to the take-off speed, the controller
is switched on (a request to arm, over the radio), the robot lifts off; flight speed, then landing speed: it sinks onto
the net; controller and fans off. The goal is the hover point all the time.

Order and times are the menu's, but not the speeds: it uses 75 to 80 % of the flight speed for take-off and landing, where
this plant's lift is 0.6 to 0.7 times its weight. Here the flow gains 5 % per metre towards the net; with flat flaps the
robot lifts off at 90 % and stays at the hover point at 95 %.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np
import pyarrow as pa

from firmware_py.wire.crtp import PORT_PLATFORM, Packet, encode
from hil.laboratory.experiment import Experiment
from hil.laboratory.flight import Flight
from hil.laboratory.metrics import BOX, CLEAR, TOUCHING_ROWS, body, column, position_error

TAKE_OFF, FLIGHT, LANDING = 0.93, 1.0, 0.88  # of the flight speed
STANDING_Z = 0.049  # [m] of the centre of mass: the feet's height minus their depth in the net

# After the release [s]; waits and stages as in the menu
SPIN_UP = 1.0
RAMP = 0.9
CONTROLLER_ON = SPIN_UP + RAMP + 0.3
FLIGHT_FROM = CONTROLLER_ON + 6.0
LANDING_FROM = FLIGHT_FROM + 10.0  # the menu: 30 s
FANS_OFF = LANDING_FROM + 8.0
END = FANS_OFF + 3.0
RAMP_STEP_US = 50_000
BOOTED_US = 500_000


def operate(flight: Flight) -> None:
    """Plan the operator's actions."""
    flight.robot.body.tunnel.set_fan_factor(0.0)
    release_us = flight.release_us
    flight.events.at(max(BOOTED_US, flight.now_us), partial(_switch, flight, False))
    flight.events.at(release_us + _us(CONTROLLER_ON), partial(_switch, flight, True))
    flight.events.at(release_us + _us(FANS_OFF), partial(_switch, flight, False))
    speed = 0.0
    stages = (SPIN_UP, TAKE_OFF), (FLIGHT_FROM, FLIGHT), (LANDING_FROM, LANDING), (FANS_OFF, 0.0)
    for start, factor in stages:
        _ramp(flight, release_us + _us(start), speed, factor)
        speed = factor


def _us(seconds: float) -> int:
    return round(1e6 * seconds)


def _switch(flight: Flight, on: bool, now_us: int) -> None:
    """Request the board to close or open the loop, as a Crazyflie client arms and disarms."""
    flight.line.command(now_us, encode(Packet(PORT_PLATFORM, 0, bytes((1, on)))))
    flight.note("lab", f"controller {'on' if on else 'off'}")


def _ramp(flight: Flight, start_us: int, before: float, after: float) -> None:
    steps = _us(RAMP) // RAMP_STEP_US
    for step in range(1, steps + 1):
        factor = before + (after - before) * step / steps
        flight.events.at(start_us + step * RAMP_STEP_US, partial(_set_fans, flight, factor))
    text = f"fans from {before:.0%} to {after:.0%} of the flight speed"
    flight.events.at(start_us, lambda now_us: flight.note("lab", text))


def _set_fans(flight: Flight, factor: float, now_us: int) -> None:
    flight.robot.body.tunnel.set_fan_factor(factor)


def measure(flight: pa.Table) -> Mapping[str, float]:
    """Return the times of lift-off and in the box, and the touch-down; NaN for events that did not occur."""
    times = column(flight, "t") * 1e-6
    times = times - times[0]
    x, y, z, climb = body(flight, "x", "y", "z", "vz").T
    airborne = np.asarray(z > STANDING_Z + CLEAR)
    names = ("lift_off", "reached_box", "touch_down_speed", "landed_off_axis", "hover_in_box")
    values = dict.fromkeys(names, float("nan"))
    if not airborne.any():
        return values
    first = int(np.argmax(airborne))
    values["lift_off"] = float(times[first]) - CONTROLLER_ON
    inside = np.asarray((np.abs(position_error(flight)) <= BOX).all(axis=1))
    hovering = (times >= FLIGHT_FROM) & (times < LANDING_FROM)
    if (inside & hovering).any():
        entered = int(np.argmax(inside & hovering))
        values["reached_box"] = float(times[entered]) - FLIGHT_FROM
        values["hover_in_box"] = float(inside[entered:][hovering[entered:]].mean())
    down = np.flatnonzero((times > LANDING_FROM) & ~airborne)
    if len(down):
        touched = int(down[0])
        before = slice(max(touched - TOUCHING_ROWS, 0), touched + 1)
        values["touch_down_speed"] = float(-climb[before].min())
        values["landed_off_axis"] = float(np.hypot(x[-1], y[-1]))
    return values


TAKE_OFF_LANDING = Experiment(
    name="take-off-landing",
    summary="stand on the net, take off, hover and land by the speed of the tunnel (the original's operator menu)",
    duration_s=END,
    limits={
        "lost": 0.0,
        "lift_off": 1.5,
        "reached_box": 3.0,
        "hover_in_box": 0.95,
        "touch_down_speed": 0.8,  # a fall from 3 cm
        "landed_off_axis": 0.10,
        "attitude_max": 0.349066,  # 20 deg
        "uncontrolled": CONTROLLER_ON + END - FANS_OFF + 0.2,  # before and after
    },
    script=operate,
    settings=(
        "flight.start_offset=[0.0, 0.0, -1.101]",  # on the net
        "plant.limits.below=1.15",
        "plant.tether.length=2.65",  # slack on the net
    ),
    measure=measure,
    pictures=("take-off",),
)
