"""Motion in the image: exact for steady vehicles, a Kalman filter for the others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_traffic import Vehicle

from geoorbit_ros.tracking.motion_model import (
    MEAN,
    RATE,
    Four,
    MotionNoise,
    State,
    correct,
    correct_in_doubt,
    measurement_variance,
    measurements,
    predict,
    start,
)

NOISE = MotionNoise()


STILL = (0.0, 0.0, 0.0, 0.0)


def begun(box: Four, rate: Four = STILL) -> State:
    """State of a track seen for the first time."""
    return start(box, measurement_variance(box, NOISE), rate, NOISE.rate_variance(box))


def means(state: State) -> list[float]:
    return [axis[MEAN] for axis in state]


def rates(state: State) -> list[float]:
    return [axis[RATE] for axis in state]


def exact_state(vehicle: Vehicle, time_s: float) -> State:
    """The true state: measurements and their derivatives, by differences."""
    step = 1e-4
    before, after = (measurements(vehicle.box(time_s + d)) for d in (-step, step))
    x, y, width, height = ((b - a) / (2 * step) for a, b in zip(before, after, strict=True))
    return begun(vehicle.box(time_s), (x, y, width, height))


@pytest.mark.parametrize("speed_mps", [-25.0, -10.0, 0.0, 15.0, 30.0])
@pytest.mark.parametrize("gap_s", [0.04, 0.5, 1.0])
def test_a_steady_vehicle_is_predicted_exactly_over_any_gap(speed_mps: float, gap_s: float) -> None:
    vehicle = Vehicle(4.0, 60.0, speed_mps)
    ahead = predict(exact_state(vehicle, 0.0), gap_s, NOISE)
    truth = exact_state(vehicle, gap_s)
    assert means(ahead) == pytest.approx(means(truth), abs=1e-4)
    assert rates(ahead) == pytest.approx(rates(truth), rel=1e-4, abs=1e-4)


@given(st.floats(0.001, 2.0), st.floats(0.001, 2.0), st.floats(-30.0, 10.0))
def test_two_steps_are_one_long_step(one_s: float, two_s: float, speed_mps: float) -> None:
    state = exact_state(Vehicle(3.0, 200.0, speed_mps), 0.0)
    at_once = predict(state, one_s + two_s, NOISE)
    in_two = predict(predict(state, one_s, NOISE), two_s, NOISE)
    assert means(in_two) == pytest.approx(means(at_once), rel=1e-9)
    assert rates(in_two) == pytest.approx(rates(at_once), rel=1e-9)
    if speed_mps == 0.0:
        assert np.array(in_two) == pytest.approx(np.array(at_once), rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_filter_is_the_textbook_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    first, second = random.uniform(20.0, 200.0, (2, 4)).tolist()
    along, across = random.normal(0.0, 5.0, 2).tolist()
    # Without growth the model is the plain constant-velocity one.
    state = begun(first, (along, across, 0.0, 0.0))
    t = random.uniform(0.02, 0.5)
    measured, variance = measurements(second), measurement_variance(second, NOISE)
    after = correct(predict(state, t, NOISE), measured, variance)
    for side in range(4):
        q = NOISE.acceleration**2 * first[2] * first[3] if side < 2 else NOISE.growth**2
        step = np.array([[1.0, t], [0.0, 1.0]])
        drift = q * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
        at, rate, of_mean, _, of_rate = state[side]
        spread = step @ np.diag([of_mean, of_rate]) @ step.T + drift
        gain = spread[:, 0] / (spread[0, 0] + variance[side])
        mean = step @ [at, rate]
        mean = mean + gain * (measured[side] - mean[0])
        spread = spread - np.outer(gain, spread[0])
        expected = [*mean, spread[0, 0], spread[0, 1], spread[1, 1]]
        assert after[side] == pytest.approx(expected)


def test_the_second_sight_of_a_vehicle_gives_its_speed_also_after_a_gap() -> None:
    vehicle = Vehicle(0.0, 80.0, 20.0)
    for gap_s in (0.04, 1.0):
        first, second = vehicle.box(0.0), vehicle.box(gap_s)
        state = predict(begun(first), gap_s, NOISE)
        state = correct(state, measurements(second), measurement_variance(second, NOISE))
        assert rates(state)[1] == pytest.approx((second[1] - first[1]) / gap_s, rel=0.25)


def test_a_box_out_of_line_moves_a_track_less_and_one_in_line_as_usual() -> None:
    vehicle = Vehicle(3.0, 60.0, 12.0)
    state = begun(vehicle.box(0.0))
    for k in range(1, 12):
        box = vehicle.box(0.04 * k)
        ahead = predict(state, 0.04, NOISE)
        variance = measurement_variance(box, NOISE)
        state = correct_in_doubt(ahead, measurements(box), variance)
        assert state == correct(ahead, measurements(box), variance)
    x, y, width, height = vehicle.box(0.48)
    joined = x + 0.8 * width, y, 2.6 * width, height  # with its neighbour
    ahead = predict(state, 0.04, NOISE)
    given = measurements(joined), measurement_variance(joined, NOISE)
    doubted, believed = correct_in_doubt(ahead, *given), correct(ahead, *given)
    for side in (0, 2):
        before = ahead[side][RATE]
        assert abs(doubted[side][RATE] - before) < 0.5 * abs(believed[side][RATE] - before)
