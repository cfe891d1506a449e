"""The battery: what the robot draws, what is left, and the voltage under that load.

The cells are alike and in series. Voltages are those of one cell; the board measures the mean of its cells.
"""

from __future__ import annotations

import math

from pydantic import BaseModel, ConfigDict, Field

from firmware_py.elementary import exp

SERVOS = 4


class BatteryConfig(BaseModel):
    """Two small lithium polymer cells, and what empties them.

    The paper gives 0.925 Wh per cell (3.7 V) and 7.6 V for both (3.8 V each). Both are true of one cell here: 3.80 V is the
    mean open-circuit voltage, and 0.925 Wh is what is left of 0.951 Wh at the paper's 3.4 W.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    cells: int = Field(2, ge=1, le=6, description="in series; paper, Robot design and fabrication")
    capacity: float = Field(
        900.0, gt=1, le=1e5, description="charge of a full cell [A s]; paper: 250 mAh, single cell"
    )
    resistance: float = Field(
        0.22, ge=0, le=2, description="of a cell with its leads [ohm]; chosen: 0.925 Wh per cell at 3.4 W"
    )
    charge: float = Field(1.0, ge=0, le=1, description="at the start, as a share of the capacity")
    electronics_power: float = Field(
        0.3, ge=0, le=50, description="board and inertial sensors [W]; paper, Energy efficiency"
    )
    servo_power: float = Field(
        0.50, ge=0, le=10, description="of each servo at rest, holding [W]; physics.md section 10, calibrated"
    )
    servo_energy: float = Field(
        0.33,
        ge=0,
        le=10,
        description="of each servo per angle turned [J/rad]; physics.md section 10, calibrated",
    )


def open_circuit_voltage(charge: float) -> float:
    """Return the voltage [V] of a cell without load at a `charge` of 0..1.

    A lithium polymer cell: Chen and Rincon-Mora, IEEE Transactions on Energy Conversion 21(2), 2006, equation 2.
    """
    return 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201)) - 1.031 * exp(-35.0 * charge)


class Battery:
    """Charge and voltage over time; `draw` is called at every row of the log.

    Attributes: charge 0..1; voltage [V] of one cell under load, as it reaches the board; power [W] of the whole robot since
    the last call; sag_V [V] lost between each cell and the board, for a fault.
    """

    def __init__(self, config: BatteryConfig) -> None:
        self.sag_V = 0.0
        self.charge = config.charge
        self.power = config.electronics_power + SERVOS * config.servo_power
        self._config = config
        self._at_rest = self.power
        self._time_us = 0
        self._travel = 0.0
        self.voltage = self._loaded()

    @property
    def millivolts(self) -> int:
        """What the board measures: one cell [mV]."""
        return round(1000.0 * self.voltage)

    def draw(self, now_us: int, flap_travel: float) -> None:
        """Take what was needed until now; `flap_travel` [rad] is what all flaps have turned since the start."""
        duration = 1e-6 * (now_us - self._time_us)
        if duration > 0.0:
            turned, self._time_us, self._travel = flap_travel - self._travel, now_us, flap_travel
            self.spend(self._at_rest + self._config.servo_energy * turned / duration, duration)

    def spend(self, power: float, duration: float) -> None:
        """Draw `power` [W] for `duration` [s]."""
        self.power = power
        loaded = self._loaded()
        self.voltage = max(loaded - self.sag_V, 0.0)
        current = power / (self._config.cells * loaded)
        self.charge = max(self.charge - current * duration / self._config.capacity, 0.0)

    def _loaded(self) -> float:
        """Return the voltage V at which V (OCV - V) / R is the power of a cell; half of OCV when it cannot give that."""
        open_circuit = open_circuit_voltage(self.charge)
        per_cell = self.power / self._config.cells
        return 0.5 * (
            open_circuit
            + math.sqrt(max(open_circuit * open_circuit - 4.0 * self._config.resistance * per_cell, 0.0))
        )


def endurance(config: BatteryConfig, power: float, empty_V: float, step: float = 1.0) -> float:
    """Return for how long [s] the battery gives `power` [W] until a cell falls below `empty_V`; inf for no power."""
    if power <= 0.0:
        return math.inf
    battery = Battery(config)
    elapsed = 0.0
    while battery.charge > 0.0:
        battery.spend(power, step)
        if battery.voltage < empty_V:
            break
        elapsed += step
    return elapsed
