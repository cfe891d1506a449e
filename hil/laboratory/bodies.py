"""The bodies that can fly: shipped ones by name, and a user's in a file (docs/tutorials/your-own-robot.md)."""

from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hil.config import LabConfig
from hil.errors import LabError, blame, hint
from hil.laboratory.files.own_files import load_file
from hil.world.battery import open_circuit_voltage
from hil.world.body import Body, Failure, Vector
from hil.world.floaty.correction import PAPER_TABLE
from hil.world.floaty.plant import SERVO_FAILURES, Plant
from hil.world.quadrotor import MOTOR_FAILURES, Quadrotor

Make = Callable[[LabConfig, np.random.Generator, Vector], Body]
MOTORS, TIMERS = 4, 14  # outputs of the board, timers of its microcontroller
OWN = "Robot"  # what a file defines: a class or function that is called as a `Make`
SIZES = {
    "state": 13,
    "p_WB": 3,
    "q_WB": 4,
    "omega_B": 3,
    "specific_force_B": 3,
    "flow_W": 3,
    "pushes": 6,
    "vibration": 2,
}
PARTS = (
    "outputs", "tunnel", "settings", "sensors", "room", "escs", "look", "markers", "lost", "lift", "advance", "set_counts",
    "draw",
    "hold", "release", "put_back", "push", "channels",
)  # fmt: skip


def floaty(config: LabConfig, rng_gust: np.random.Generator, p_WB: Vector) -> Body:
    """Return a Floaty of the profile's shape."""
    return Plant(
        config.geometry, config.plant, config.tunnel, config.actuators, rng_gust, p_WB, config.battery
    )


def crazyflie(config: LabConfig, rng: np.random.Generator, p_WB: Vector) -> Body:
    """Return a Crazyflie with its decks."""
    from hil.emulator.crazyflie.decks import DECKS

    mass = config.quadrotor.mass + sum(DECKS[name].mass for name in config.robot.decks)
    quadrotor = config.quadrotor.model_copy(update={"mass": mass})
    return Quadrotor(quadrotor, config.tunnel, config.battery, rng, p_WB)


BODIES: dict[str, Make] = {"floaty": floaty, "crazyflie": crazyflie}
FAILURES: dict[str, Mapping[str, Failure]] = {  # kinds of faults by body
    "floaty": SERVO_FAILURES,
    "crazyflie": MOTOR_FAILURES,
}
MEASURED: Mapping[str, tuple[float, float]] = (
    PAPER_TABLE  # `plant.constant_factors`: values and their uncertainty
)


def make_body(config: LabConfig, rng_gust: np.random.Generator, p_WB: Vector) -> Body:
    """Return the body of a profile, upright and at rest at a place. Raises `LabError` when it cannot be made."""
    name = config.robot.body
    if name in BODIES:
        return BODIES[name](config, rng_gust, p_WB)
    what = f"robot.body = {name}"
    if not name.endswith(".py"):
        raise LabError(f"{what}: neither a body ({hint(name, BODIES)}) nor a path that ends in .py")
    module, _ = load_file("robot.body =", Path(name))
    make = getattr(module, OWN, None)
    if not callable(make):
        raise LabError(f"{what}: no {OWN} in it; expected a class {OWN}, made of RigidBody")
    try:
        body = make(config, rng_gust, p_WB)
        _check(body)
    except Exception as error:
        raise LabError(f"{what}: {blame(error)}") from error
    made: Body = body
    return made


def digest_of_body(config: LabConfig) -> str:
    """Return the SHA-256 of the file of the user's own body; empty for one that ships."""
    name = config.robot.body
    return load_file("robot.body =", Path(name))[1] if name.endswith(".py") else ""


def _check(body: Any) -> None:
    """Raise `LabError` for what lacks a part of a body, has arrays of other sizes, or fails at rest."""
    kind = type(body).__name__
    missing = [name for name in (*SIZES, *PARTS) if not hasattr(body, name)]
    if missing:
        raise LabError(f"{kind} has no {', '.join(missing)}; RigidBody has them all")
    for name, size in SIZES.items():
        value = getattr(body, name)
        if not (isinstance(value, np.ndarray) and value.shape == (size,) and value.dtype == np.float64):
            raise LabError(f"{kind}.{name} = {value!r}: expected an array of {size} float64")
    if not _are_outputs(body.outputs):
        raise LabError(
            f"{kind}.outputs = {body.outputs!r}: expected four (timer, channel), of the board's M1 to M4; more or "
            "fewer actuators are mixed from their counts in `actuate`"
        )
    body.draw(0, open_circuit_voltage(1.0))
    columns = [
        name for channel in body.channels() for quantity in channel.quantities for name in quantity.names
    ]
    columns += [f"sensor.{name}" for sensor in body.sensors.values() for name in sensor.names]
    for name, count in Counter(columns).items():
        if count > 1:
            raise LabError(f"{kind} logs {name} {count} times: expected different names")
    for sensor in body.sensors.values():
        sensor.read()
    body.look.stored()
    for channel in body.channels():
        channel.read()
    if body.lost is not None:
        raise LabError(body.lost)


def _are_outputs(outputs: Any) -> bool:
    """Whether these are four different channels of the microcontroller's timers, counted from 0."""
    try:
        pairs = [(int(timer), int(channel)) for timer, channel in outputs]
    except (TypeError, ValueError):
        return False
    return len(set(pairs)) == len(pairs) == MOTORS and all(
        t in range(TIMERS) and c in range(4) for t, c in pairs
    )
