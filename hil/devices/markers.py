"""Eight reflective markers on the robot, and which of them the cameras around the tunnel see.

The robot's body defines their places. `hil.devices.rigid_body` computes points and poses from those seen.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import cos, sin
from firmware_py.geometry import Quaternion, Vector
from hil.devices.config import MARKERS, MarkersConfig
from hil.scene import Markers, Points
from hil.world.fixed_order import product

COUNT = MARKERS
DIAMETER = 0.014  # [m]; chosen, a common size
TRUNK_RADIUS = 0.03  # [m] of the parts around the centre of mass: batteries and boards; chosen
TRUNK_AREA = TRUNK_RADIUS * TRUNK_RADIUS  # [m2]

Mask = NDArray[np.bool_]
NO_POINTS: Points = np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """The view of one robot's markers in one exposure; row k belongs to label k + 1."""

    points: Points  # (8, 3) [m] in W; an unseen label has its place on the fitted body
    seen: Mask  # (8,)
    residuals: Points  # (8,) [m] distance from the fitted body; 0 where nothing is seen or fitted
    ghosts: Points  # (N, 3) [m] in W
    error: float  # [m] mean residual of the markers seen
    pose: tuple[Vector, Quaternion] | None  # p_WB [m], q_WB w x y z; None: not tracked

    @property
    def bits(self) -> int:
        """Bit k is set when label k + 1 is seen."""
        return int(np.packbits(self.seen, bitorder="little")[0])

    @property
    def unlabelled(self) -> Points:
        """Points of no tracked body, (N, 3) [m] in W: ghosts, and all markers when the body is not tracked."""
        return self.ghosts if self.pose else np.vstack((self.points[self.seen], self.ghosts))


class Cameras:
    """The cameras' places, and how the robot itself blocks their view.

    A flat square and a ball around the centre of mass hide markers. A marker is located when enough cameras see it.
    """

    def __init__(self, config: MarkersConfig, markers: Markers) -> None:
        azimuths = [2.0 * math.pi * camera / config.cameras for camera in range(config.cameras)]
        self._p_WC = np.array(
            [
                (*(config.camera_distance * f(azimuth) for f in (cos, sin)), config.camera_height)
                for azimuth in azimuths
            ]
        )
        self._needed = config.min_cameras
        self._plate_height, self._plate_half = markers.plate_height, markers.plate_half
        self._places = markers.places
        self._squares = (self._places**2).sum(axis=1)[:, None]
        self._over_plate = self._places[:, 2:] - self._plate_height

    def see(self, p_WB: Points, R_WB: Points) -> Mask:
        """Return which markers enough cameras see, (8,), at a pose: (3,) [m] and (3, 3)."""
        p_BC = product(self._p_WC - p_WB, R_WB)
        in_sight = ~(self._behind_plate(p_BC) | self._behind_trunk(p_BC))
        return np.asarray(in_sight.sum(axis=1) >= self._needed)

    def _behind_plate(self, p_BC: Points) -> Mask:
        """Which rays, marker by camera, pass through the square; markers in its plane are seen from both sides."""
        over, camera_over = self._over_plate, p_BC[:, 2] - self._plate_height
        reach = self._plate_half * np.abs(camera_over - over)
        # The ray is in the plane at (marker * camera_over - camera * over) / (camera_over - over).
        x = np.abs(self._places[:, :1] * camera_over - p_BC[:, 0] * over)
        y = np.abs(self._places[:, 1:2] * camera_over - p_BC[:, 1] * over)
        return np.asarray((over * camera_over < 0.0) & (x < reach) & (y < reach))

    def _behind_trunk(self, p_BC: Points) -> Mask:
        """Which rays, marker by camera, pass through the ball towards the camera, which is outside."""
        along = product(self._places, p_BC.T) - self._squares  # marker times ray
        rays = (p_BC**2).sum(axis=1) - self._squares - 2.0 * along  # squared lengths
        return np.asarray((along < 0.0) & (self._squares * rays - along**2 < TRUNK_AREA * rays))
