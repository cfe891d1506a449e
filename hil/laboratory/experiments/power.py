"""Power: the power drawn in hover, the battery life, and a comparison (paper, figure robustness a, b).

`endurance` hovers until the battery is empty: the supervisor's failsafe for a low battery ends it. `power` hovers for a
minute and computes the battery life from the mean power and the same battery model.

Specific power of hovering vehicles by the paper's method (Supplement, "Estimation and calculation of specific power").

Drones: energy of the battery over the maker's longest flight time. Helicopters: the paper's assumed share of rated power
in a hover, 75-90 % with pistons and 60-75 % with turbines; the value is the middle of the range. The two quadcopters that
the authors flew: their measurements. Floaty is not included: its power comes from a flight's log.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import pyarrow as pa

from firmware_py.wire.supervisor import Cause, State
from hil.laboratory.experiment import Experiment
from hil.laboratory.files.recorder import stored_in
from hil.laboratory.flight import Flight
from hil.laboratory.metrics import column
from hil.world.battery import endurance
from hil.world.config import BatteryConfig, GeometryConfig
from hil.world.floaty.geometry import weigh

WATCH_US = 100_000
LONGEST_S = 3000.0


def end_with_the_battery(flight: Flight) -> None:
    """End the flight when the supervisor has found the battery empty."""
    flight.events.at(flight.release_us, partial(_watch, flight))


def _watch(flight: Flight, now_us: int) -> None:
    if flight.robot.firmware.signals.supervisor.cause is not Cause.LOW_BATTERY:
        flight.events.at(now_us + WATCH_US, partial(_watch, flight))
        return
    flight.note("lab", f"the battery is empty: {flight.robot.battery.charge:.1%} left")
    flight.lab.end_at(now_us)


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
    minutes = float(times[-1] - times[0]) * 1e-6 / 60.0
    return power(flight) | {"endurance": minutes if stopped else float("nan")}


def _configuration(flight: pa.Table) -> dict[str, Any]:
    return dict(stored_in(flight.schema.metadata, "config"))


POWER = Experiment(
    name="power",
    summary="hover for 60 s: power, W/kg and the minutes a battery would last (paper: 3.4 W, 10 W/kg, 33 min)",
    duration_s=60.0,
    limits={"lost": 0.0, "power": 3.6, "specific_power": 10.5, "endurance": 31.0},
    measure=estimate,
    pictures=("specific-power", "discharge"),
)
ENDURANCE = replace(  # the final failsafe is shorter than the limit `uncontrolled`
    POWER,
    name="endurance",
    summary="hover until the supervisor reports the battery empty (paper: 33 min)",
    duration_s=LONGEST_S,
    script=end_with_the_battery,
    measure=until_empty,
)

WATTS_PER_SHP = 745.7  # the paper's
PISTON, TURBINE = (0.75, 0.90), (0.60, 0.75)
CONVENTIONAL_W_PER_KG = (100.0, 250.0)  # paper: "typically in the range of", shaded grey in its figure


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle in hover; `power_range` [W] are the bounds of the method, equal for a single value."""

    name: str
    kind: Literal["quadcopter", "drone", "helicopter"]
    mass: float  # [kg]
    power_range: tuple[float, float]
    updraft: bool = False

    @property
    def power(self) -> float:
        """Middle of the range [W]."""
        return sum(self.power_range) / 2

    @property
    def specific_power(self) -> float:
        """Power over mass [W/kg]."""
        return self.power / self.mass


def _measured(name: str, mass: float, power: float, updraft: bool = False) -> Vehicle:
    return Vehicle(name, "quadcopter", mass, (power, power), updraft)


def _drone(name: str, mass: float, energy_Wh: float, flight_min: float) -> Vehicle:
    power = 60.0 * energy_Wh / flight_min
    return Vehicle(name, "drone", mass, (power, power))


def _helicopter(name: str, mass: float, shp: float, share: tuple[float, float]) -> Vehicle:
    low, high = share
    return Vehicle(name, "helicopter", mass, (low * shp * WATTS_PER_SHP, high * shp * WATTS_PER_SHP))


VEHICLES = (
    _measured("Crazyflie 2.1", 0.027, 8.0),  # paper, Energy efficiency: 27 g, about 8 W
    _measured("Crazyflie 2.1", 0.027, 6.6, updraft=True),  # the author's plotting script
    _measured("custom quadcopter", 0.950, 145 * 0.950),  # paper: 145 W/kg, 950 g
    _measured("custom quadcopter", 0.950, 68 * 0.950, updraft=True),  # paper: 68 W/kg
    _drone("DJI Mini 4 Pro", 0.249, 18.96, 34),  # the maker's specifications, like the next three
    _drone("DJI Air 3", 0.720, 62.6, 46),
    _drone("DJI Mavic 3 Pro", 0.958, 77.0, 43),
    _drone("DJI Avata", 0.410, 35.71, 18),
    _helicopter("Robinson R22", 622, 124, PISTON),  # derated; maximum continuous
    _helicopter("Bell 206B", 1451, 317, TURBINE),  # limit of the transmission
    _helicopter("Airbus H125", 2250, 847, TURBINE),  # take-off rating
    # Ten-minute rating of the T700-GE-701D: an upper bound.
    _helicopter("Sikorsky UH-60M", 9979, 2 * 2000, TURBINE),
)
