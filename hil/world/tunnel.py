"""The wind tunnel: mean profile, gusts, side wind, fans, a blocked area; constants, and values that may change in flight.

The air is computed inside the plant's kernel (`hil.world.plates`); `Tunnel` writes that kernel's inputs. World frame: z
up, origin in the middle of the tunnel's exit, hover point `hover_height` above it.
"""

import numpy as np

from firmware_py.elementary import exp
from hil.errors import LabError
from hil.world.config import TunnelConfig
from hil.world.structs import STEP_US, Air

# docs/explanation/plant.md, Tunnel. Rows as in `Air.gusts`: time constant [s]; then rms [m/s] per level.
GUST_TAU = (0.015, 0.015, 0.015, 0.4, 0.4, 0.4, *4 * (0.010,), *4 * (0.15,))
GUST_RMS = {
    "none": 14 * (0.0,),
    "T0": (0.35, 0.35, 0.20, 0.05, 0.05, 0.03, *4 * (0.40,), *4 * (0.10,)),  # as rough as the paper's hover
    "T1": (0.40, 0.40, 0.20, 0.06, 0.06, 0.03, *4 * (0.50,), *4 * (0.15,)),  # harder
}
GUST_RADIUS = 0.25  # [m] gusts grow as 1 + (r / GUST_RADIUS)^4 ...
GUST_GROWTH_MAX = 6.0  # ... up to this


class Tunnel:
    """The knobs of the tunnel during a flight; a change takes effect at the next millisecond.

    `fan_factor`, `gust_scale`, `side_wind` (x, y, z) and `shadow` (the blocked share) are the last values set; `air` is the
    memory of the kernels.
    """

    def __init__(self, config: TunnelConfig) -> None:
        self.air = Air.allocate()
        air = self.air.fields
        air.speed, air.profile_radius = config.speed, config.profile_radius
        air.height_slope, air.hover_height = config.height_slope, config.hover_height
        air.gust_radius, air.gust_growth_max = GUST_RADIUS, GUST_GROWTH_MAX
        decay = np.array([exp(-STEP_US * 1e-6 / tau) for tau in GUST_TAU])
        air.gust_decay[:] = decay  # exact discretisation of an Ornstein-Uhlenbeck process
        air.gust_kick[:] = np.array(GUST_RMS[config.turbulence]) * np.sqrt(1.0 - decay**2)
        self._wake = (0.0, 0.0, 0.0)
        self.set_gust_scale(config.gust_scale)
        self.set_side_wind(*config.side_wind)
        self.set_fan_factor(config.fan_factor)
        self.block(0.0, 0.0, 1.0, 0.0)

    def set_fan_factor(self, factor: float) -> None:
        """Scale the mean flow and the gusts: 1 as configured, 0 fans off."""
        self.air.fields.fan = self.fan_factor = _inside("fan factor", factor, 0.0, 2.0)

    def set_gust_scale(self, scale: float) -> None:
        """Scale the gusts of the configured level."""
        self.air.fields.gust_scale = self.gust_scale = _inside("gust scale", scale, 0.0, 5.0)

    def set_side_wind(self, x: float, y: float, z: float = 0.0) -> None:
        """Add a wind [m/s, W] everywhere; a fan beside the tunnel."""
        self.side_wind = tuple(_inside("side wind", one, -20.0, 20.0) for one in (x, y, z))
        self._blow()

    def set_wake(self, x: float, y: float, z: float) -> None:
        """Add the wake of other robots [m/s, W]."""
        self._wake = (x, y, z)
        self._blow()

    def _blow(self) -> None:
        self.air.fields.side_wind_W[:] = [a + b for a, b in zip(self.side_wind, self._wake, strict=True)]

    def block(self, x: float, y: float, radius: float, depth: float) -> None:
        """Remove the share `depth` of the flow around (x, y) [m, W], half of it at `radius` [m]; depth 0 clears."""
        self.shadow = _inside("occlusion depth", depth, 0.0, 1.0)
        place = [_inside(f"occlusion {name}", value, -2.0, 2.0) for name, value in (("x", x), ("y", y))]
        self.air.fields.occlusion_radius = _inside("occlusion radius", radius, 0.01, 5.0)
        self.air.fields.occlusion_W[:], self.air.fields.occlusion_depth = place, depth


def _inside(what: str, value: float, low: float, high: float) -> float:
    """Return `value`, or raise LabError when it is not a number inside [low, high]."""
    if not low <= value <= high:
        raise LabError(f"{what} = {value}: outside {low:g}..{high:g}")
    return value
