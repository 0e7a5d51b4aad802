"""Paths of vehicles show a lens, however the road bends; a bend alone is none."""

from __future__ import annotations

import numpy as np
import pytest
from cameras import Camera
from numpy.typing import NDArray

from geoorbit_ros.calibration.lens import Lens, unit_lens
from geoorbit_ros.calibration.lens_from_paths import estimate_lens_from_paths

SIZE = (1920, 1080)
CAMERA = Camera((0.0, 0.0, 10.0), 80.0, 14.0, 1300.0)
TO_UNIT = (1920.0 / 1300.0) ** 2
"""From k1 in units of the camera's focal length to those of the image's width."""


def paths(
    k1: float, bend_per_m: float = 0.0, seed: int = 0, noise_px: float = 0.8
) -> list[NDArray[np.float64]]:
    """Middles of cars on six lanes, northwards, as a lens shows them."""
    random, lens = np.random.default_rng(seed), Lens(1300.0, 1300.0, 960.0, 540.0, SIZE, k1)
    found = []
    for k in range(60):
        y = np.linspace(12.0, 110.0, 80)
        x = -14.0 + 3.6 * (k % 6) + random.normal(0.0, 0.3) + bend_per_m * y**2 / 2
        x = x + 0.1 * np.sin(y / 25.0 + random.uniform(0.0, 6.0))
        xyz = np.column_stack((x, y, np.full(len(y), random.normal(0.75, 0.1))))
        pixel = lens.distort(CAMERA.project(xyz))
        pixel = pixel + noise_px * random.standard_normal(pixel.shape)
        inside = ((pixel > 20.0) & (pixel < np.array(SIZE) - 20.0)).all(axis=1)
        found.append(pixel[inside][:: 1 if k % 2 else -1])
    return found


@pytest.mark.parametrize("k1", [-0.18, -0.12])
def test_vehicles_on_a_straight_road_show_the_lens(k1: float) -> None:
    estimate = estimate_lens_from_paths(paths(k1), SIZE)
    assert estimate.lens is not None
    assert estimate.lens == unit_lens(SIZE, estimate.k1 + estimate.k1_sigma)
    assert estimate.k1 < estimate.lens.k1 < 0.0, "nearer to none by what it may be wrong"
    assert abs(estimate.k1 - k1 * TO_UNIT) < 3.5 * estimate.k1_sigma
    assert estimate.k1_sigma < 0.03


def test_a_pincushion_is_as_far_from_the_truth_as_is_said() -> None:
    estimate = estimate_lens_from_paths(paths(0.1), SIZE)
    assert abs(estimate.k1 - 0.1 * TO_UNIT) < 3.5 * estimate.k1_sigma < 0.5


@pytest.mark.parametrize("radius_m", [np.inf, 2000.0, -1200.0, 500.0, -300.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_bend_of_the_road_is_no_lens(radius_m: float, seed: int) -> None:
    estimate = estimate_lens_from_paths(paths(0.0, 1.0 / radius_m, seed), SIZE)
    assert estimate.lens is None
    assert np.isinf(estimate.k1_sigma) or abs(estimate.k1) < 3.5 * estimate.k1_sigma
    assert "no lens" in estimate.sentence or "can't tell" in estimate.sentence


@pytest.mark.parametrize("radius_m", [1200.0, -800.0])
def test_a_lens_is_seen_in_a_bend_or_said_not_to_be(radius_m: float) -> None:
    estimate = estimate_lens_from_paths(paths(-0.25, 1.0 / radius_m), SIZE)
    assert abs(estimate.k1 + 0.25 * TO_UNIT) < 3.5 * estimate.k1_sigma


def test_few_or_short_paths_tell_nothing() -> None:
    every = paths(-0.3)
    for few in (every[:5], [path[:20] for path in every], []):
        estimate = estimate_lens_from_paths(few, SIZE)
        assert estimate.lens is None
        assert np.isinf(estimate.k1_sigma)
        assert "can't tell" in estimate.sentence


def test_paths_that_cross_each_other_tell_nothing() -> None:
    random = np.random.default_rng(1)
    wild = []
    for _ in range(40):
        start, end = random.uniform((100.0, 400.0), (1800.0, 1000.0), (2, 2))
        share = np.linspace(0.0, 1.0, 40)[:, None]
        bow = 80.0 * np.sin(np.pi * share) * random.choice([-1.0, 1.0])
        wild.append(start + share * (end - start) + bow)
    assert estimate_lens_from_paths(wild, SIZE).lens is None
