"""A vehicle's numbers are the same bits in any company: alone, or among hundreds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from cameras import Camera
from numpy.typing import NDArray

from geoorbit_ros.calibration.elementwise import inverse_2x2, solve, total, worst_sigma
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.track_velocity import ROWS as MOTION_ROWS
from geoorbit_ros.calibration.track_velocity import follow
from geoorbit_ros.calibration.vehicle_fit import fit_points, fit_vehicles
from geoorbit_ros.calibration.vehicle_size import COVARIANCE, MEAN_M, learn_sizes, start_sizes
from geoorbit_ros.calibration.vehicle_size import ROWS as SIZE_ROWS

Array = NDArray[np.float64]
N = 203
RANDOM = np.random.default_rng(7)
CAMERA = Camera()
PLANE = fit_homography(CAMERA.control_points())
GROUP = RANDOM.integers(0, 4, N)
PIXEL = np.stack((RANDOM.uniform(100, 1800, N), RANDOM.uniform(450, 1000, N)))
SIDE = RANDOM.uniform(20, 200, (2, N))
HEADING = np.where(RANDOM.random(N) < 0.2, np.nan, RANDOM.uniform(-3, 3, N))
SIZE, SIZE_COV = MEAN_M[GROUP].T, COVARIANCE[GROUP].transpose(1, 2, 0)
SQUARE = RANDOM.normal(size=(4, 4, N))
SYMMETRIC = total(SQUARE[:, :, None] * SQUARE[:, None])


def fitted(at: slice) -> tuple[Array, ...]:
    fit = fit_vehicles(
        CAMERA.projection, PIXEL[:, at], SIDE[:, at], HEADING[at], SIZE[:, at], SIZE_COV[..., at]
    )
    return fit.xy, fit.noise, fit.covariance, fit.side_px, fit.side_slope


def pointed(at: slice) -> tuple[Array, ...]:
    fit = fit_points(CAMERA.projection, PIXEL[:, at], SIDE[:, at])
    return fit.xy, fit.noise


def learnt(at: slice) -> tuple[Array, ...]:
    state, number = np.empty((SIZE_ROWS, N)), len(GROUP[at])
    start_sizes(state, np.arange(N), np.zeros(N), GROUP)
    part, slope = np.ascontiguousarray(state[:, at]), 9.0 * SYMMETRIC[:2, :3, at]
    for step in range(1, 4):
        time_s, usable = np.full(number, 0.1 * step), np.ones(number, dtype=bool)
        score = PIXEL[0, at] / 2000
        learn_sizes(part, time_s, GROUP[at], score, SIDE[:, at], PIXEL[:, at] / 9, slope, usable)
    return (part,)


def followed(at: slice) -> tuple[Array, ...]:
    state, number = np.full((MOTION_ROWS, len(GROUP[at])), np.nan), len(GROUP[at])
    for step in range(9):
        xy = SIDE[:, at] + 2.3 * step + 0.01 * SQUARE[step % 4, :2, at]
        sigma, observed = PIXEL[0, at] / 9000, HEADING[at] < 2.5
        follow(state, np.full(number, 0.1 * step), xy, sigma, observed)
    return (state,)


def small_systems(at: slice) -> tuple[Array, ...]:
    pair = SYMMETRIC[:2, :2, at]
    return solve(SYMMETRIC[..., at], SQUARE[:, :2, at]), inverse_2x2(pair), worst_sigma(pair)


def plane_error(at: slice) -> tuple[Array, ...]:
    return (PLANE.fit_covariance(PIXEL[:, at].T).transpose(1, 2, 0),)


@pytest.mark.parametrize(
    "work",
    [fitted, pointed, learnt, followed, small_systems, plane_error],
    ids=lambda w: w.__name__,
)
def test_alone_or_among_others(work: Callable[[slice], tuple[Array, ...]]) -> None:
    with np.errstate(all="ignore"):
        together = work(slice(None))
        for size in (1, 2, 7, 64):
            for first in range(0, N, size):
                at = slice(first, first + size)
                for part, whole in zip(work(at), together, strict=True):
                    assert part.tobytes() == np.ascontiguousarray(whole[..., at]).tobytes()


def test_solutions_solve_their_systems() -> None:
    right = RANDOM.normal(size=(4, 3, N))
    found = solve(SYMMETRIC, right)
    expected = np.linalg.solve(SYMMETRIC.transpose(2, 0, 1), right.transpose(2, 0, 1))
    np.testing.assert_allclose(found.transpose(2, 0, 1), expected, rtol=1e-6, atol=1e-6)
