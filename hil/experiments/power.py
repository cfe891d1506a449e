"""Power: the power drawn in hover, the battery life, and a comparison (paper, figure robustness a, b).

`endurance` hovers until the battery is empty: the supervisor's failsafe for a low battery ends it. `power` hovers for a
minute and computes the battery life from the mean power and the same battery model.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from firmware_py.wire.supervisor import Cause, State
from hil.floaty.geometry import weigh
from hil.laboratory.experiment import Experiment
from hil.laboratory.metrics import column
from hil.laboratory.recorder import stored_in
from hil.world.battery import endurance
from hil.world.config import BatteryConfig, GeometryConfig

if TYPE_CHECKING:
    import pyarrow as pa

    from hil.laboratory.flight import Flight

WATCH_US = 100_000
LONGEST_S = 3000.0


def end_with_the_battery(flight: Flight) -> None:
    """End the flight when the supervisor has found the battery empty."""
    flight.events.at(flight.release_us, partial(_watch, flight))


def _watch(flight: Flight, now_us: int) -> None:
    if flight.robot.firmware.signals.supervisor.cause is Cause.LOW_BATTERY:
        flight.note("lab", f"the battery is empty: {flight.robot.battery.charge:.1%} left")
        flight.lab.end_at(now_us)
        return
    flight.events.at(now_us + WATCH_US, partial(_watch, flight))


def power(flight: pa.Table) -> dict[str, float]:
    """Return the mean power [W] and that per mass [W/kg]."""
    mean = float(column(flight, "battery.power").mean())
    config = _configuration(flight)
    mass = weigh(GeometryConfig.model_validate(config["geometry"])).mass * config["plant"]["mass_factor"]
    return {"power": mean, "specific_power": mean / mass}


def estimate(flight: pa.Table) -> Mapping[str, float]:
    """Return power, and the minutes that the battery model can supply it."""
    values, config = power(flight), _configuration(flight)
    empty_V = 1e-3 * config["supervisor"]["low_battery_mv"]
    battery = BatteryConfig.model_validate(config["battery"])
    return values | {"endurance": endurance(battery, values["power"], empty_V) / 60.0}


def until_empty(flight: pa.Table) -> Mapping[str, float]:
    """Return power, and the minutes until the failsafe; NaN if the flight ended earlier."""
    times = column(flight, "t")
    stopped = column(flight, "supervisor.state")[-1] == State.FAILSAFE
    return power(flight) | {
        "endurance": float(times[-1] - times[0]) * 1e-6 / 60.0 if stopped else float("nan")
    }


def _configuration(flight: pa.Table) -> dict[str, Any]:
    config = stored_in(flight.schema.metadata, "config")
    return config


# The paper: about 33 min, 3.4 W, 10 W/kg
LIMITS = {"lost": 0.0, "power": 3.6, "specific_power": 10.5, "endurance": 31.0}
POWER = Experiment(
    name="power",
    summary="hover for 60 s: power, W/kg and the minutes a battery would last (paper: 3.4 W, 10 W/kg, 33 min)",
    duration_s=60.0,
    limits=LIMITS,
    measure=estimate,
    pictures=("specific-power", "discharge"),
)
ENDURANCE = Experiment(
    name="endurance",
    summary="hover until the supervisor reports the battery empty (paper: 33 min)",
    duration_s=LONGEST_S,
    limits=LIMITS,  # the final failsafe is shorter than the limit `uncontrolled`
    script=end_with_the_battery,
    measure=until_empty,
    pictures=("specific-power", "discharge"),
)
