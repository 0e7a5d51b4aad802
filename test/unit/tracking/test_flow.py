"""What is expected of a new vehicle: what others did at its place, as far as any were there."""

import numpy as np
import pytest

from geoorbit_ros.tracking.motion_model import MEAN, RATE, MotionNoise
from geoorbit_ros.tracking.traffic_model import CAPACITY, Flow

NOISE = MotionNoise()
BOX = np.array([[600.0], [400.0], [40.0], [30.0]])


def states(place: tuple[float, float], rate: tuple[float, float], count: int) -> np.ndarray:
    found = np.zeros((5, 4, count))
    found[MEAN, 0], found[MEAN, 1] = place
    found[RATE, 0], found[RATE, 1] = rate
    return found


def test_without_traffic_everything_is_possible() -> None:
    mean, variance = Flow().expect(BOX, NOISE)
    assert (mean == 0.0).all()
    assert variance == pytest.approx(NOISE.rate_variance(BOX))


def test_a_vehicle_is_expected_to_move_as_those_did_that_were_there() -> None:
    flow = Flow()
    flow.add(states((605.0, 398.0), (120.0, 30.0), 50))
    mean, variance = flow.expect(BOX, NOISE)
    assert mean[:2, 0] == pytest.approx([120.0, 30.0], rel=0.05)
    assert (variance[:2] < 0.1 * NOISE.rate_variance(BOX)[:2]).all()


def test_what_moved_elsewhere_says_nothing() -> None:
    flow = Flow()
    flow.add(states((100.0, 100.0), (120.0, 30.0), 50))
    mean, variance = flow.expect(BOX, NOISE)
    assert mean == pytest.approx(0.0, abs=1e-6)
    assert variance == pytest.approx(NOISE.rate_variance(BOX), rel=1e-6)


def test_where_both_directions_pass_either_is_possible() -> None:
    flow = Flow()
    for way in (-1.0, 1.0):
        flow.add(states((600.0, 400.0), (way * 120.0, 0.0), 50))
    mean, variance = flow.expect(BOX, NOISE)
    assert abs(mean[0, 0]) < 1.0
    assert variance[0, 0] > 120.0**2


def test_the_mixture_has_the_moments_of_its_parts() -> None:
    """Five samples at the very place and the wide prior, each of weight one."""
    flow = Flow()
    speeds = np.array([100.0, 120.0, 130.0, 90.0, 110.0])
    for speed in speeds:
        flow.add(states((600.0, 400.0), (speed, 0.0), 1))
    mean, variance = flow.expect(BOX, NOISE)
    wide = NOISE.rate_variance(BOX)[0, 0]
    assert mean[0, 0] == pytest.approx(speeds.sum() / 6)
    square = (wide + (speeds**2).sum()) / 6
    assert variance[0, 0] == pytest.approx(square - mean[0, 0] ** 2)


def test_memory_is_bounded_and_the_latest_traffic_counts() -> None:
    flow = Flow()
    for speed in (-120.0, 120.0):
        for _ in range(5):
            flow.add(states((600.0, 400.0), (speed, 0.0), CAPACITY // 2))
    flow.add(states((600.0, 400.0), (120.0, 0.0), 3 * CAPACITY))
    mean, _ = flow.expect(BOX, NOISE)
    assert mean[0, 0] == pytest.approx(120.0, rel=0.01)
