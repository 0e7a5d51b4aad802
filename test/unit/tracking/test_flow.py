"""What is expected of a new vehicle: what others did at its place, as far as any were there."""

import pytest

from geoorbit_ros.tracking.motion_model import MotionNoise, State
from geoorbit_ros.tracking.traffic_model import CAPACITY, Flow

NOISE = MotionNoise()
BOX = (600.0, 400.0, 40.0, 30.0)
NOTHING = (0.0, 0.0, 0.0, 0.0)


def state(place: tuple[float, float], rate: tuple[float, float]) -> State:
    x, y = ((at, speed, 0.0, 0.0, 0.0) for at, speed in zip(place, rate, strict=True))
    return x, y, (0.0, *NOTHING), (0.0, *NOTHING)


def add(flow: Flow, place: tuple[float, float], rate: tuple[float, float], count: int) -> None:
    for _ in range(count):
        flow.add(state(place, rate))


def test_without_traffic_everything_is_possible() -> None:
    assert Flow().expect(BOX, NOISE) == (NOTHING, NOISE.rate_variance(BOX))


def test_a_vehicle_is_expected_to_move_as_those_did_that_were_there() -> None:
    flow = Flow()
    add(flow, (605.0, 398.0), (120.0, 30.0), 50)
    mean, variance = flow.expect(BOX, NOISE)
    assert mean[:2] == pytest.approx((120.0, 30.0), rel=0.05)
    wide = NOISE.rate_variance(BOX)
    assert variance[0] < 0.1 * wide[0]
    assert variance[1] < 0.1 * wide[1]


def test_what_moved_elsewhere_says_nothing() -> None:
    flow = Flow()
    add(flow, (100.0, 100.0), (120.0, 30.0), 50)
    mean, variance = flow.expect(BOX, NOISE)
    assert mean == pytest.approx(NOTHING, abs=1e-6)
    assert variance == pytest.approx(NOISE.rate_variance(BOX), rel=1e-6)


def test_where_both_directions_pass_either_is_possible() -> None:
    flow = Flow()
    for way in (-1.0, 1.0):
        add(flow, (600.0, 400.0), (way * 120.0, 0.0), 50)
    mean, variance = flow.expect(BOX, NOISE)
    assert abs(mean[0]) < 1.0
    assert variance[0] > 120.0**2


def test_the_mixture_has_the_moments_of_its_parts() -> None:
    """Five samples at the very place and the wide prior, each of weight one."""
    flow = Flow()
    speeds = [100.0, 120.0, 130.0, 90.0, 110.0]
    for speed in speeds:
        flow.add(state((600.0, 400.0), (speed, 0.0)))
    mean, variance = flow.expect(BOX, NOISE)
    assert mean[0] == pytest.approx(sum(speeds) / 6)
    square = (NOISE.rate_variance(BOX)[0] + sum(speed**2 for speed in speeds)) / 6
    assert variance[0] == pytest.approx(square - mean[0] ** 2)


def test_memory_is_bounded_and_the_latest_traffic_counts() -> None:
    flow = Flow()
    add(flow, (600.0, 400.0), (-120.0, 0.0), CAPACITY + 7)
    add(flow, (600.0, 400.0), (120.0, 0.0), CAPACITY)
    mean, _ = flow.expect(BOX, NOISE)
    assert mean[0] == pytest.approx(120.0, rel=0.01)
