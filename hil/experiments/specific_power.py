"""Specific power of hovering vehicles by the paper's method (Supplement, "Estimation and calculation of specific power").

Drones: energy of the battery over the maker's longest flight time. Helicopters: the paper's assumed share of rated power
in a hover, 75-90 % with pistons and 60-75 % with turbines; the value is the middle of the range. The two quadcopters that
the authors flew: their measurements. Floaty is not included: its power comes from a flight's log.
"""

from dataclasses import dataclass
from typing import Literal

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
