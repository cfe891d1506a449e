"""Eight reflective markers on the robot: which the cameras around the tunnel see, and the pose of the body that fits best.

The robot's body defines their places. Exchanging two labels leaves the fitted pose unchanged or turns it by 180 degrees, and
raises the mean error; a body that fits badly is not tracked, as in Motive.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import cos, sin
from firmware_py.geometry import Quaternion, Vector, rotation_matrix
from hil.board.config import MARKERS, MarkersConfig
from hil.world.fixed_order import eigen, normal, product
from hil.world.scene import Markers, Points

COUNT = MARKERS
DIAMETER = 0.014  # [m]; chosen, a common size
TRUNK_RADIUS = 0.03  # [m] of the parts around the centre of mass: batteries and boards; chosen
TRUNK_AREA = TRUNK_RADIUS * TRUNK_RADIUS  # [m2]
NOISE_ROWS = 512  # exposures of noise drawn at once
SPREAD = 0.01  # [m] root of the sum of squared distances from the best line through markers; below, they count as collinear
WORST_PAIR = (0, 2)  # rows: the best-fitting pair whose exchange turns the body by 180 deg
GHOST_REACH = 0.3  # [m] from the body, along each axis; chosen

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
        distance, height = config.camera_distance, config.camera_height
        azimuths = [2.0 * math.pi * camera / config.cameras for camera in range(config.cameras)]
        self._p_WC = np.array([(distance * cos(at), distance * sin(at), height) for at in azimuths])
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


@dataclass(frozen=True, slots=True, eq=False)
class BodyFit:
    """The body fitted to points."""

    p_WB: Vector  # [m]
    q_WB: Quaternion  # w x y z
    points: Points  # (8, 3) [m] in W: the places of its markers


class MarkerBody:
    """A body defined by its markers' places, (8, 3) [m] in B."""

    def __init__(self, places: Points) -> None:
        self._places = places
        self._parts: dict[bytes, tuple[Points, Points] | None] = {}  # by the markers seen

    def fit(self, points: Points, seen: Mask) -> BodyFit | None:
        """Return the best fit to the points (8, 3) [m, W] that are seen; None when they are collinear."""
        part = self._part(seen)
        if part is None:
            return None
        centre_B, around_B = part
        shown = points[seen]
        centre_W = shown.sum(axis=0) / len(shown)
        q_WB = _best_turn(around_B, shown - centre_W)
        R_WB = rotation_matrix(q_WB)
        p_WB = centre_W - product(R_WB, centre_B[:, None])[:, 0]
        x, y, z = p_WB.tolist()
        return BodyFit((x, y, z), q_WB, product(self._places, R_WB.T) + p_WB)

    def _part(self, seen: Mask) -> tuple[Points, Points] | None:
        """Return the centre (3,) of the markers seen and their places about it; None if these are collinear."""
        key = seen.tobytes()
        if key not in self._parts:
            places = self._places[seen]
            around = places - places.mean(axis=0) if len(places) > 2 else np.zeros((3, 3))
            variances, _ = eigen(product(around.T, around))
            across2 = np.sort(variances)[1]
            self._parts[key] = (places.mean(axis=0), around) if across2 > SPREAD * SPREAD else None
        return self._parts[key]


def _best_turn(body: Points, points: Points) -> Quaternion:
    """Return w x y z of the turn of `body` that is closest to `points`, both (N, 3) about their centres.

    Horn, "Closed-form solution of absolute orientation using unit quaternions", JOSA A 4(4), 1987: the eigenvector of the
    largest eigenvalue.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = product(body.T, points).tolist()
    N = (
        (xx + yy + zz, yz - zy, zx - xz, xy - yx),
        (yz - zy, xx - yy - zz, xy + yx, zx + xz),
        (zx - xz, xy + yx, yy - xx - zz, yz + zy),
        (xy - yx, zx + xz, yz + zy, zz - xx - yy),
    )
    values, vectors = eigen(np.array(N))
    w, x, y, z = vectors[:, np.argmax(values)].tolist()
    return (w, x, y, z) if w >= 0.0 else (-w, -x, -y, -z)


class VirtualMarkers:
    """The markers on one robot. Plain attributes that may change in flight:

    `hidden` number of covered markers, from marker 1 on; `swapped` 1: markers 1 and 3 have each other's label;
    `noise_scale` factor on the noise; `ghosts` per frame.
    """

    def __init__(self, config: MarkersConfig, markers: Markers, rng: np.random.Generator) -> None:
        self._config = config
        self._cameras = Cameras(config, markers)
        self._places = markers.places
        self._body = MarkerBody(self._places)
        self._rng = rng
        self._rng_labels, self._rng_ghosts = rng.spawn(2)
        self._draws = NO_POINTS.reshape(0, COUNT, 3)
        self._row = 0
        self.hidden = 0.0
        self.swapped = 0.0
        self.noise_scale = 1.0
        self.ghosts = float(config.ghosts)

    def sighting_of(self, p_WB: Points, q_WB: Points) -> Sighting:
        """Return the sighting of a robot at a pose: (3,) [m], (4,) w x y z."""
        w, x, y, z = q_WB.tolist()
        R_WB = rotation_matrix((w, x, y, z))
        seen = self._cameras.see(p_WB, R_WB)
        if self.hidden:
            seen[: round(self.hidden)] = False
        points = product(self._places, R_WB.T) + p_WB + self._noise()
        labels = self._labels()
        if labels is not None:
            points, seen = points[labels], seen[labels]
        ghosts = NO_POINTS
        if self.ghosts:
            ghosts = p_WB + self._rng_ghosts.uniform(-GHOST_REACH, GHOST_REACH, (round(self.ghosts), 3))
        return self._sighting(points, seen, ghosts)

    def _sighting(self, points: Points, seen: Mask, ghosts: Points) -> Sighting:
        count = np.count_nonzero(seen)
        fit = self._body.fit(points, seen) if count >= self._config.min_markers else None
        if fit is None:
            return Sighting(points, seen, np.zeros(COUNT), ghosts, 0.0, None)
        errors = points - fit.points
        residuals = np.sqrt((errors * errors).sum(axis=1)) * seen
        error = math.fsum(residuals) / count
        pose = (fit.p_WB, fit.q_WB) if error <= self._config.max_error else None
        return Sighting(np.where(seen[:, None], points, fit.points), seen, residuals, ghosts, error, pose)

    def _noise(self) -> Points:
        """Return the noise of one exposure, (8, 3) [m]."""
        if self._row == len(self._draws):
            self._draws = self._config.noise * normal(self._rng, (NOISE_ROWS, COUNT, 3))
            self._row = 0
        self._row += 1
        return np.asarray(self.noise_scale * self._draws[self._row - 1])

    def _labels(self) -> NDArray[np.intp] | None:
        """Return which marker each label is on, (8,) rows; None where all are correct."""
        wrong = self._config.mislabelled
        mislabelled = wrong > 0.0 and self._rng_labels.random() < wrong
        if not (mislabelled or self.swapped):
            return None
        labels = np.arange(COUNT)
        if self.swapped:
            labels[list(WORST_PAIR)] = WORST_PAIR[::-1]
        if mislabelled:
            pair = self._rng_labels.choice(COUNT, 2, replace=False)
            labels[pair] = labels[pair[::-1]]
        return labels
