"""How likely a camera is, given the boxes that it showed of traffic.

Every vehicle is a box on the road of one unknown size, turned the way it drives. A camera is likely
if sizes that its class has explain the boxes all along each vehicle's way, and if neighbours drive
side by side. Sizes and positions are solved for within each evaluation (variable projection, Golub
and Pereyra (2003)), and the determinant that marginalising the sizes leaves is part of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.traffic.boxes import PlacedBoxes, place_boxes
from geoorbit_ros.calibration.traffic.image_directions import (
    alike,
    in_image,
    metres_across,
    on_road,
    pixel_turn,
    pixels_per_metre,
    rough_angle,
)
from geoorbit_ros.calibration.traffic.parameters import (
    FEW,
    FOCAL,
    HEIGHT,
    MANY,
    MARGIN,
    PLACE,
    ROOF,
    ROOF_OF_LARGE,
    YAW,
    KnownPoints,
    prior_residuals,
    projection_matrix,
)
from geoorbit_ros.calibration.traffic.paths import (
    PARALLEL_CAUCHY,
    PARALLEL_SIGMA_RAD,
    Headings,
    Neighbours,
    find_neighbours,
    path_headings,
)
from geoorbit_ros.calibration.traffic.road_direction import Places, road_headings
from geoorbit_ros.calibration.traffic.samples import TrafficSamples
from geoorbit_ros.calibration.vehicle_fit import (
    corners,
    edges,
    on_plane,
    vehicle_axes,
)
from geoorbit_ros.calibration.vehicle_size import BUS, CAR, MEAN_M, PRECISION

Array = NDArray[np.float64]

SIDE_SIGMA_PX = 1.1
SIDE_SIGMA_RATIO = 0.025
CORRELATION_S = 1.4
"""1-sigma of a box's side: as `vehicle_fit` has it of an edge, and a slow part, which stays the
same for a second: places that are nearer in time have more of it each, so that they don't count
as independent."""
PATH_SIGMA_PX, PATH_SIGMA_RATIO = 0.6, 0.02
"""The same of the middle of a box across the way."""
START_LOSS, LOSS = 1.5, 2.5
"""Sigma beyond which a box counts less, while looking for the camera (pseudo-Huber) and in the end
(Cauchy): tracks that change vehicles are far off."""
INDEPENDENT_VEHICLES = 25.0
"""The boxes of all vehicles weigh as much as those of so many: real ones aren't boxes, and miss
them together in the same places. Chosen on some twenty simulated cameras, for the mean scale to
lie within two of its sigma in 95 %; larger claims too much, smaller lets the priors decide."""
SIZE_BOUNDS = 0.4, 2.8
"""Sizes stay between these shares of the usual one: a pickup is a truck of half the length."""
LEAST_TURN_RAD = np.radians(0.2)
"""1-sigma by which a direction that many vehicles share is wrong all the same: roads are bent in
other ways than the regression allows."""
OFFSET = 1e3
"""Added to the logarithm of a vehicle's determinant, so that its root exists."""
BEYOND = 6.0
"""Residual of a vehicle that would stand beyond the horizon."""


@dataclass(frozen=True, slots=True)
class Explained:
    """What a camera makes of the boxes.

    Attributes:
        fit: Positions and sides of the vehicles.
        headings: At every place, shared with the neighbours.
        own_headings: At every place, of the vehicle alone.
        size_m: (3, K) of the vehicles.
        residual: (2, N) width and height of the boxes, in sigma.
        information: (3, 3, K) about each size, its prior included.
    """

    fit: PlacedBoxes
    headings: Headings
    own_headings: Headings
    size_m: Array
    residual: Array
    information: Array


LEAST_DEPTH_M, UNSEEN = 1.0, 10.0
"""A known point nearer to the camera's plane than this, or behind it, is off by so many sigma."""


class TrafficModel:
    """Residuals of a camera, for least squares.

    Args:
        samples: Boxes.
        image_size: (width, height) in pixels.
        points: Points that the user knows.
        focal_px: The focal length, where it is known.

    Attributes:
        noise: What the sides' errors are multiplied with.
        misfit: How far boxes are off the camera that was settled last, over their usual errors.
        robust: Cauchy's loss in place of the milder one.
        focal_px: The focal length, where it is known.
    """

    def __init__(
        self,
        samples: TrafficSamples,
        image_size: tuple[int, int],
        points: KnownPoints | None = None,
        focal_px: float | None = None,
    ) -> None:
        self.samples, self.image_size = samples, image_size
        self.points, self.focal_px = points, focal_px
        low, high = samples.edges[:2], samples.edges[2:]
        self.centre, self.side = (low + high) / 2, high - low
        self.vehicle, self.group = samples.vehicle, samples.group
        self.first = np.flatnonzero(np.diff(self.vehicle, prepend=-1))
        slow = alike(self.vehicle, samples.time_s, CORRELATION_S)
        self.sigma = np.sqrt(SIDE_SIGMA_PX**2 + SIDE_SIGMA_RATIO**2 * slow * self.side**2)
        across = PATH_SIGMA_RATIO**2 * slow * self.side.max(axis=0) ** 2
        self._path_sigma = np.sqrt(PATH_SIGMA_PX**2 + across)
        self._size = np.ones((3, len(self.group)))
        self._unit = float(np.log(10.0))
        self._aside: Neighbours | None = None
        self._aside_sigma: Array = np.ones(0)
        self._turned: Array = np.zeros_like(self.side)
        self._directions: tuple[Array, ...] | None = None
        self._settled: Headings | None = None
        self._mean, self._prior_size = (
            MEAN_M[self.group].T,
            PRECISION[self.group].transpose(1, 2, 0),
        )
        self._root = np.linalg.cholesky(PRECISION).transpose(0, 2, 1)[self.group]
        self._weight = np.sqrt(min(1.0, INDEPENDENT_VEHICLES / max(len(self.group), 1)))
        self.noise, self.misfit, self.robust = 1.0, 0.0, False

    @property
    def parameters(self) -> int:
        """How many a vector has."""
        return FEW if self.points is None else MANY

    def usual_size(self, x: Array) -> Array:
        """(3, K) mean size of each vehicle's group, in this fleet."""
        larger = np.empty((4, 3))
        larger[CAR], larger[CAR + 1 :] = x[4:7], x[7:10, None]
        return np.asarray((MEAN_M * (1.0 + larger))[self.group].T)

    def explain(self, x: Array, steps: int = 2, size_m: Array | None = None) -> Explained:
        """Positions, headings and sizes of all vehicles for a camera."""
        matrix, usual = projection_matrix(x, self.image_size), self.usual_size(x)
        size = self._size * usual if size_m is None else size_m
        relative = self._mean / usual
        prior = self._prior_size * relative[:, None] * relative
        xy = on_plane(matrix, self.centre, size[2][self.vehicle] / 2)[0]
        roof = x[ROOF] * np.where(self.group < BUS, 1.0, ROOF_OF_LARGE)[self.vehicle]
        sigma = np.hypot(self.sigma * self.noise, self._turned)
        for _ in range(steps):
            own, headings = self._headings(matrix, x, xy)
            fit = place_boxes(matrix, self.centre, headings.angle, size[:, self.vehicle])
            slope, predicted = fit.side_slope.copy(), fit.side_px + x[MARGIN][:, None]
            predicted[1] -= roof * fit.by_length * size[0][self.vehicle]
            slope[1, 0] -= roof * fit.by_length
            slope /= sigma[:, None]
            residual = (self.side - predicted) / sigma
            new = self._sizes(residual, slope, fit.good, size, usual, prior)
            residual -= (slope * (new - size)[:, self.vehicle]).sum(axis=1)
            size, xy = new, fit.xy
        full = (slope[:, :, None] * slope[:, None]).sum(axis=0) * fit.good
        return Explained(fit, headings, own, size, residual, self._sums(full) + prior)

    def _sizes(
        self,
        residual: Array,
        slope: Array,
        good: NDArray[np.bool_],
        size: Array,
        usual: Array,
        prior: Array,
    ) -> Array:
        """(3, K) sizes that explain the boxes best, with what is known of them."""
        weighted = slope * self._box_weight(residual, good)[:, None]
        target = residual + (slope * size[:, self.vehicle]).sum(axis=1)
        normal = self._sums((slope[:, :, None] * weighted[:, None]).sum(axis=0)) + prior
        vector = self._sums((weighted * target[:, None]).sum(axis=0))
        vector += (prior * usual).sum(axis=1)
        new = np.linalg.solve(normal.transpose(2, 0, 1), vector.T[:, :, None])[:, :, 0].T
        return np.clip(new, *(share * usual for share in SIZE_BOUNDS))

    def _sums(self, values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, self.first, axis=-1))

    def _box_weight(self, residual: Array, good: NDArray[np.bool_]) -> Array:
        if self.robust:
            weight = np.broadcast_to(
                1.0 / (1.0 + (residual**2).sum(axis=0) / LOSS**2), (2, len(good))
            )
        else:
            weight = 1.0 / np.sqrt(1.0 + (residual / 2.0) ** 2)
        return np.where(good, weight, 0.0)

    def _headings(self, matrix: Array, x: Array, xy: Array) -> tuple[Headings, Headings]:
        """Of each vehicle alone, and shared with its neighbours."""
        zoom = np.exp(self._unit - x[HEIGHT])
        if self._directions is not None and self._settled is not None:
            slope = pixels_per_metre(matrix, xy)
            alone, shared = (on_road(slope, shown) for shown in self._directions)
            variance, bend = self._settled.variance, self._settled.curvature
            return Headings(alone, variance, bend), Headings(shared, variance, bend)
        xy = xy * zoom
        depth = np.maximum(matrix[2, :2] @ np.nan_to_num(xy) + matrix[2, 3] * zoom, 0.5)
        noise = self._path_sigma * depth / (np.exp(x[FOCAL]) * self.image_size[0])
        own = path_headings(xy, noise, self.vehicle)
        return own, own

    def settle(self, x: Array) -> None:
        """Take a camera for nearly right: neighbours, ways, sizes and noise are as it shows them.

        From then on the ways' directions in the image are given. Smoothed anew for every camera,
        they would favour one that shortens the road, where less of their noise is left.
        """
        self._unit, self._aside = float(x[HEIGHT]), None
        found = self.explain(x, 4)
        good = found.fit.good
        road, own = self._way_headings(x, found)
        self._aside = find_neighbours(found.fit.xy, road, self.vehicle, good)
        here, there = self._aside.here, self._aside.there
        variance = PARALLEL_SIGMA_RAD**2 + road.variance[here] + road.variance[there]
        slope = pixels_per_metre(projection_matrix(x, self.image_size), found.fit.xy)
        self._settled = road
        self._directions = tuple(in_image(slope, turned.angle) for turned in (road, own))
        self._turned = self._side_turn(x, found) * np.hypot(np.sqrt(own.variance), LEAST_TURN_RAD)
        found = self.explain(x, 4)
        self._aside_sigma = np.sqrt(variance) * self._pixel_turn(x, found)[here]
        self._size = found.size_m / self.usual_size(x)
        middle = float(np.median(np.abs(found.residual[:, good]))) / 0.6745
        self.misfit = self.noise * middle
        self.noise = float(np.clip(1.1 * self.misfit, 0.4, 2.0))

    def _way_headings(self, x: Array, found: Explained) -> tuple[Headings, Headings]:
        """Directions of the road and of the vehicles at the boxes, from all ways."""
        matrix, samples = projection_matrix(x, self.image_size), self.samples
        whose = samples.way_vehicle
        low, high = samples.way_edges[:2], samples.way_edges[2:]
        centre, side = (low + high) / 2, high - low
        size = found.size_m[:, whose]
        rough = rough_angle(on_plane(matrix, centre, size[2] / 2)[0], whose)
        fit = place_boxes(matrix, centre, rough, size)
        xy = np.where(fit.good, fit.xy, np.nan)
        slow = alike(whose, samples.way_time_s, CORRELATION_S)
        noise = np.sqrt(PATH_SIGMA_PX**2 + PATH_SIGMA_RATIO**2 * slow * side.max(axis=0) ** 2)
        noise = noise * metres_across(pixels_per_metre(matrix, fit.xy), rough)
        places = Places(xy, whose, samples.way_time_s, rough, noise)
        slope = pixels_per_metre(matrix, found.fit.xy)
        at = self._path_sigma * metres_across(slope, found.headings.angle)
        return road_headings(places, found.fit.xy, self.vehicle, found.headings.angle, at)

    def _side_turn(self, x: Array, found: Explained) -> Array:
        """(2, N) how much the sides of the boxes change when a vehicle turns, pixels per radian."""
        matrix, small = projection_matrix(x, self.image_size), 0.01
        size = found.size_m[:, self.vehicle]
        sides = []
        for turn in (-small, small):
            unit = vehicle_axes(matrix, found.headings.angle + turn)
            edge = edges(corners(matrix, found.fit.xy, unit * size[:, None])[0])
            sides.append(edge[2:] - edge[:2])
        slope = np.abs(sides[1] - sides[0]) / (2.0 * small)
        return np.asarray(np.where(found.fit.good & np.isfinite(slope), slope, 0.0))

    def _pixel_turn(self, x: Array, found: Explained) -> Array:
        """(N,) how much a way turns in the image when it turns on the road."""
        slope = pixels_per_metre(projection_matrix(x, self.image_size), found.fit.xy)
        return pixel_turn(slope, found.own_headings.angle)

    def residuals(self, x: Array) -> Array:
        """Everything, in sigma, robust losses applied: half the sum of squares is to be least.

        Args:
            x: (13,) or (16,), see `FOCAL` and so on.
        """
        found = self.explain(x)
        usual = self.usual_size(x)
        boxes = np.where(found.fit.good, found.residual, BEYOND)
        if self.robust:
            square = (boxes**2).sum(axis=0)
            boxes = boxes * LOSS * np.sqrt(np.log1p(square / LOSS**2) / (square + 1e-9))
        else:
            boxes = _pseudo_huber(boxes)
        sizes = found.size_m / usual * self._mean - self._mean
        sizes = _pseudo_huber(np.einsum("kij,jk->ik", self._root, sizes))
        scaled = np.nan_to_num(found.information * usual[:, None] * usual).transpose(2, 0, 1)
        spread = np.linalg.slogdet(scaled + 1e-9 * np.eye(3))[1]
        parts = [
            self._weight * boxes.ravel(),
            self._weight * sizes.ravel(),
            self._weight * np.sqrt(np.maximum(OFFSET + spread, 0.0)),
            self._parallel(x, found),
            prior_residuals(x, self.image_size[0], self.focal_px),
            self.known_points(x),
        ]
        whole = np.concatenate(parts)
        return np.asarray(np.nan_to_num(whole, nan=4.0, posinf=10.0, neginf=-10.0))

    def _parallel(self, x: Array, found: Explained) -> Array:
        """Angles in the image between neighbours' ways; each vehicle counts as two comparisons."""
        pairs = self._aside
        if pairs is None or not len(pairs.here):
            return np.empty(0)
        turn, _ = pairs.difference(
            found.fit.xy * np.exp(self._unit - x[HEIGHT]), found.own_headings
        )
        good = found.fit.good[pairs.here] & found.fit.good[pairs.there]
        turn = np.where(good, turn, 0.0) * self._pixel_turn(x, found)[pairs.here]
        turn = turn / self._aside_sigma / PARALLEL_CAUCHY
        robust = PARALLEL_CAUCHY * np.sign(turn) * np.sqrt(np.log1p(turn**2))
        return np.asarray(robust / np.sqrt(max(len(turn) / (2.0 * len(self.group)), 1.0)))

    def known_points(self, x: Array) -> Array:
        """(2M,) errors of the user's points in the image, in sigma."""
        if self.points is None:
            return np.empty(0)
        points, matrix = self.points, projection_matrix(x, self.image_size)
        cos, sin = np.cos(x[YAW]), np.sin(x[YAW])
        turn = np.array([[cos, sin], [-sin, cos]])
        xy = turn @ (points.local_m - x[PLACE]).T
        uvw = matrix[:, :2] @ xy + matrix[:, 3:]
        depth = np.maximum(uvw[2], LEAST_DEPTH_M)
        uv = uvw[:2] / depth
        slope = (matrix[:2, :2, None] - uv[:, None] * matrix[2, :2, None]) / depth
        ground = points.sigma_m * np.sqrt((slope**2).sum(axis=(0, 1)) / 2.0)
        off = (uv - points.pixel.T) / np.hypot(points.sigma_px, ground)
        # Behind the camera every error on the ground would excuse any pixel.
        return np.asarray(np.where(uvw[2] > LEAST_DEPTH_M, off, UNSEEN).ravel())


def _pseudo_huber(residual: Array) -> Array:
    """Signed roots of the loss that grows like a line beyond `START_LOSS`."""
    square = np.sqrt(1.0 + (residual / START_LOSS) ** 2) - 1.0
    return np.asarray(np.sign(residual) * START_LOSS * np.sqrt(2.0 * square))
