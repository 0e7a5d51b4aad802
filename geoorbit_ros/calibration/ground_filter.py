"""Positions, velocities and sizes of boxed vehicles, many tracks side by side.

Arrays hold their components first and the rows last, in the order of `track_waves.Waves`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.elementwise import worst_sigma
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.track_velocity import HEADING, follow
from geoorbit_ros.calibration.track_velocity import ROWS as MOTION_ROWS
from geoorbit_ros.calibration.track_waves import Waves
from geoorbit_ros.calibration.vehicle_fit import VehicleFit, fit_points, fit_vehicles
from geoorbit_ros.calibration.vehicle_size import COV, DIM, learn_sizes, start_sizes
from geoorbit_ros.calibration.vehicle_size import ROWS as SIZE_ROWS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = slice | NDArray[np.intp]

STATE_ROWS = MOTION_ROWS + SIZE_ROWS
"""Numbers that are remembered of a track."""
PATH_HEIGHT_M = 0.8
"""Height of a box's centre where nothing is known of the vehicle: half the height of a car."""


@dataclass(frozen=True, slots=True)
class Boxes:
    """N rows as the filters need them.

    Attributes:
        time_s: (N,) from any epoch.
        centre: (2, N) of the boxes, pixels; the ground point where not `solid`.
        side: (2, N) width and height, pixels.
        group: (N,) size group of the class.
        score: (N,).
        solid: (N,) False where the pixel already is the ground point.
        observed: (N,) False for the tracker's predictions.
        whole: (N,) an observed box that no border cuts: it shows the vehicle's size.
        sampled: (N,) from a frame that sizes are learnt from.
    """

    time_s: Array
    centre: Array
    side: Array
    group: NDArray[np.int64]
    score: Array
    solid: Mask
    observed: Mask
    whole: Mask
    sampled: Mask


@dataclass(frozen=True, slots=True)
class GroundRows:
    """What came out for N rows.

    Attributes:
        xy: (2, N) centre of the footprint, metres.
        first_xy: (2, N) first guess of it; see `VehicleFit`.
        covariance: (2, 2, N) m^2, without the error of the road plane.
        noise: (N,) 1-sigma of the frame-to-frame noise, metres.
        side_px: (2, N) width and height of the box that the vehicle would have.
        side_slope: (2, 3, N) their slopes with length, width and height, pixels per metre.
        good: (N,) see `VehicleFit`.
        size: (3, N) length, width, height as known before the row, metres.
        velocity: (2, N) m/s; NaN before the first observation.
        heading: (N,) radians from east; NaN until the vehicle has moved.
    """

    xy: Array
    first_xy: Array
    covariance: Array
    noise: Array
    side_px: Array
    side_slope: Array
    good: Mask
    size: Array
    velocity: Array
    heading: Array

    @classmethod
    def empty(cls, n: int) -> GroundRows:
        """Room for `n` rows."""
        return cls(
            xy=np.empty((2, n)),
            first_xy=np.empty((2, n)),
            covariance=np.empty((2, 2, n)),
            noise=np.empty(n),
            side_px=np.empty((2, n)),
            side_slope=np.empty((2, 3, n)),
            good=np.empty(n, dtype=bool),
            size=np.empty((3, n)),
            velocity=np.empty((2, n)),
            heading=np.empty(n),
        )

    def put(self, row: Rows, fit: VehicleFit) -> None:
        """Take the fit of some rows."""
        self.xy[:, row], self.first_xy[:, row] = fit.xy, fit.first_xy
        self.covariance[..., row], self.noise[row] = fit.covariance, worst_sigma(fit.noise)
        self.side_px[:, row], self.side_slope[..., row] = fit.side_px, fit.side_slope
        self.good[row] = fit.good


class GroundFilter:
    """Takes rows wave by wave.

    Args:
        projection: (3, 4) local metres to ideal pixels.
        camera_m: (3,) the camera's place; None where it isn't known, and no row is `solid`.
        max_sigma_m: Rows of more frame-to-frame noise say nothing about motion.
        lens: From ideal pixels to those of the boxes; None: the same.
    """

    def __init__(
        self,
        projection: Array,
        camera_m: Array | None,
        max_sigma_m: float,
        lens: Lens | None = None,
    ) -> None:
        self._projection, self._camera_m = projection, camera_m
        self._max_sigma_m, self._lens = max_sigma_m, lens

    def run(self, waves: Waves, boxes: Boxes) -> GroundRows:
        """Ground of the rows; the states in `waves` go on to the tracks' last rows."""
        n = len(waves.order)
        ground = GroundRows.empty(n)
        points = (~boxes.solid).nonzero()[0]
        if len(points):  # nothing is to be known of their tracks
            centre, side = boxes.centre[:, points], boxes.side[:, points]
            ground.put(points, fit_points(self._projection, centre, side, self._lens))
        for start, stop in pairwise(waves.bounds):
            state, at = waves.state[:, : stop - start], slice(start, stop)
            self._wave(state, at, waves.fresh[at], boxes, ground)
        return ground

    def _wave(self, state: Array, at: slice, fresh: Mask, boxes: Boxes, ground: GroundRows) -> None:
        """One row of each track, all at the rows `at`."""
        motion, sizes = state[:MOTION_ROWS], state[MOTION_ROWS:]
        new = fresh.nonzero()[0]
        if len(new):
            motion[:, new] = np.nan
            start_sizes(sizes, new, boxes.time_s[at][new], boxes.group[at][new])
        ground.size[:, at] = sizes[DIM]
        box = boxes.solid[at].nonzero()[0]
        if len(box):
            every = len(box) == len(fresh)
            track, row = (slice(None), at) if every else (box, at.start + box)
            known = motion[HEADING, track], sizes[DIM, track]
            size_cov = sizes[COV].reshape(3, 3, -1)[:, :, track]
            centre, side = boxes.centre[:, row], boxes.side[:, row]
            fit = fit_vehicles(self._projection, centre, side, *known, size_cov, self._lens)
            ground.put(row, fit)
        learnt = boxes.sampled[at].nonzero()[0]
        if len(learnt):
            row = at.start + learnt
            of_these = sizes[:, learnt]
            learn_sizes(
                of_these,
                boxes.time_s[row],
                boxes.group[row],
                boxes.score[row],
                boxes.side[:, row],
                ground.side_px[:, row],
                ground.side_slope[:, :, row],
                boxes.whole[row] & ground.good[row] & ~np.isnan(motion[HEADING, learnt]),
            )
            sizes[:, learnt] = of_these
        other = self._move(motion, at, boxes, ground).nonzero()[0]
        if len(other):  # what was learnt of the vehicle before says nothing of this one
            start_sizes(sizes, other, boxes.time_s[at][other], boxes.group[at][other])

    def _move(self, motion: Array, at: slice, boxes: Boxes, ground: GroundRows) -> Mask:
        """Velocities and headings after the rows `at`; which tracks jumped to another vehicle.

        While a vehicle's size is being learnt its ground point shifts, which isn't motion. The
        image of its body's centre on a plane of fixed height doesn't shift, and another height
        only scales that plane's path about the point below the camera.
        """
        noise = ground.noise[at]
        # A vehicle of unknown size moves all the same, and its size is learnt with its heading:
        # only the noise of the box decides whether a position is any use for the motion.
        observed = boxes.observed[at] & (noise <= self._max_sigma_m)
        path, scale = ground.first_xy[:, at], 1.0
        if self._camera_m is not None:
            below, height = self._camera_m[:2, None], self._camera_m[2]
            middle = np.where(boxes.solid[at], ground.size[2, at] / 2, PATH_HEIGHT_M)
            scale = (height - middle) / (height - PATH_HEIGHT_M)
            path = below + (path - below) / scale
        time_s = boxes.time_s[at]
        velocity, ground.heading[at], jumped = follow(motion, time_s, path, noise, observed)
        ground.velocity[:, at] = velocity * scale
        return jumped
