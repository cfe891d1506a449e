"""The battery: the power drawn, the remaining charge, and the voltage under load.

The cells are equal and in series. Voltages are per cell; the board measures the mean of its cells.
"""

import math

from firmware_py.elementary import exp
from hil.world.config import BatteryConfig

STEP_S = 1.0  # of the search for the end of a charge


def open_circuit_voltage(charge: float) -> float:
    """Return the voltage [V] of a cell without load at a `charge` of 0..1.

    A lithium polymer cell: Chen and Rincon-Mora, IEEE Transactions on Energy Conversion 21(2), 2006, equation 2.
    """
    return 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201)) - 1.031 * exp(-35.0 * charge)


class Battery:
    """Charge and voltage over time; the caller calls `draw` at every row of the log.

    Attributes: charge 0..1; voltage [V] of one cell under load, as it reaches the board; power [W] of the whole robot since
    the last call; sag_V [V] lost between each cell and the board, for a fault.
    """

    def __init__(self, config: BatteryConfig, power: float = 0.0) -> None:
        """Start under a load of `power` [W]."""
        self.sag_V = 0.0
        self.charge = config.charge
        self.power = power
        self._config = config
        self._time_us = 0
        self.voltage = self._loaded()

    @property
    def millivolts(self) -> int:
        """The voltage that the board measures, of one cell [mV]."""
        return round(1000.0 * self.voltage)

    def draw(self, now_us: int, power: float) -> None:
        """Draw the robot's mean `power` [W] since the last call."""
        duration = 1e-6 * (now_us - self._time_us)
        if duration > 0.0:
            self._time_us = now_us
            self.spend(power, duration)

    def spend(self, power: float, duration: float) -> None:
        """Draw `power` [W] for `duration` [s]."""
        self.power = power
        loaded = self._loaded()
        self.voltage = max(loaded - self.sag_V, 0.0)
        current = power / (self._config.cells * loaded)
        self.charge = max(self.charge - current * duration / self._config.capacity, 0.0)

    def _loaded(self) -> float:
        """Return the voltage V with V (OCV - V) / R equal to a cell's power; half of OCV when it cannot supply that."""
        open_circuit = open_circuit_voltage(self.charge)
        drop = 4.0 * self._config.resistance * (self.power / self._config.cells)
        return 0.5 * (open_circuit + math.sqrt(max(open_circuit * open_circuit - drop, 0.0)))


def endurance(config: BatteryConfig, power: float, empty_V: float) -> float:
    """Return for how long [s] the battery supplies `power` [W] until a cell falls below `empty_V`; inf for no power."""
    if power <= 0.0:
        return math.inf
    battery = Battery(config)
    elapsed = 0.0
    while battery.charge > 0.0:
        battery.spend(power, STEP_S)
        if battery.voltage < empty_V:
            break
        elapsed += STEP_S
    return elapsed
