"""Motion in the image: exact for steady vehicles, a Kalman filter for the others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_traffic import Vehicle

from geoorbit_ros.tracking.motion_model import (
    COVARIANCE,
    MEAN,
    RATE,
    RATE_VARIANCE,
    VARIANCE,
    MotionNoise,
    correct,
    correct_in_doubt,
    measurement_variance,
    measurements,
    predict,
    start,
)

NOISE = MotionNoise()


def begun(box: np.ndarray) -> np.ndarray:
    """States of tracks seen for the first time."""
    variance = measurement_variance(box, NOISE)
    return start(box, variance, np.zeros(box.shape), NOISE.rate_variance(box))


def exact_state(vehicle: Vehicle, time_s: float) -> np.ndarray:
    """The true state: measurements and their derivatives, by differences."""
    step = 1e-4
    at = [measurements(np.array(vehicle.box(time_s + d)).reshape(4, 1)) for d in (-step, 0.0, step)]
    state = begun(np.array(vehicle.box(time_s)).reshape(4, 1))
    state[RATE] = (at[2] - at[0]) / (2 * step)
    return state


@pytest.mark.parametrize("speed_mps", [-25.0, -10.0, 0.0, 15.0, 30.0])
@pytest.mark.parametrize("gap_s", [0.04, 0.5, 1.0])
def test_a_steady_vehicle_is_predicted_exactly_over_any_gap(speed_mps: float, gap_s: float) -> None:
    vehicle = Vehicle(4.0, 60.0, speed_mps)
    ahead = predict(exact_state(vehicle, 0.0), np.array([gap_s]), NOISE)
    truth = measurements(np.array(vehicle.box(gap_s)).reshape(4, 1))
    assert ahead[MEAN] == pytest.approx(truth, abs=1e-4)
    assert ahead[RATE] == pytest.approx(exact_state(vehicle, gap_s)[RATE], rel=1e-4, abs=1e-4)


@given(st.floats(0.001, 2.0), st.floats(0.001, 2.0), st.floats(-30.0, 10.0))
def test_two_steps_are_one_long_step(one_s: float, two_s: float, speed_mps: float) -> None:
    state = exact_state(Vehicle(3.0, 200.0, speed_mps), 0.0)
    at_once = predict(state, np.array([one_s + two_s]), NOISE)
    in_two = predict(predict(state, np.array([one_s]), NOISE), np.array([two_s]), NOISE)
    assert in_two[MEAN] == pytest.approx(at_once[MEAN], rel=1e-9)
    assert in_two[RATE] == pytest.approx(at_once[RATE], rel=1e-9)
    if speed_mps == 0.0:
        assert in_two == pytest.approx(at_once, rel=1e-9)


def test_the_filter_is_the_textbook_one() -> None:
    random = np.random.default_rng(5)
    state = begun(random.uniform(20.0, 200.0, (4, 6)))
    state[RATE] = random.normal(0.0, 5.0, (4, 6))
    state[RATE, 2:] = 0.0  # without growth the model is the plain constant-velocity one
    gap_s = random.uniform(0.02, 0.5, 6)
    box = random.uniform(20.0, 200.0, (4, 6))
    measured, variance = measurements(box), measurement_variance(box, NOISE)
    after = correct(predict(state, gap_s, NOISE), measured, variance)
    for side in range(4):
        for k in range(6):
            size2 = np.exp(state[MEAN, 2, k] + state[MEAN, 3, k])
            q = NOISE.acceleration**2 * size2 if side < 2 else NOISE.growth**2
            t = gap_s[k]
            step = np.array([[1.0, t], [0.0, 1.0]])
            drift = q * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])
            mean = step @ state[[MEAN, RATE], side, k]
            spread = step @ np.diag(state[[VARIANCE, RATE_VARIANCE], side, k]) @ step.T + drift
            gain = spread[:, 0] / (spread[0, 0] + variance[side, k])
            mean = mean + gain * (measured[side, k] - mean[0])
            spread = spread - np.outer(gain, spread[0])
            assert after[[MEAN, RATE], side, k] == pytest.approx(mean)
            found = after[[VARIANCE, COVARIANCE, RATE_VARIANCE], side, k]
            assert found == pytest.approx([spread[0, 0], spread[0, 1], spread[1, 1]])


def test_the_second_sight_of_a_vehicle_gives_its_speed_also_after_a_gap() -> None:
    vehicle = Vehicle(0.0, 80.0, 20.0)
    for gap_s in (0.04, 1.0):
        first, second = (np.array(vehicle.box(t)).reshape(4, 1) for t in (0.0, gap_s))
        state = predict(begun(first), np.array([gap_s]), NOISE)
        state = correct(state, measurements(second), measurement_variance(second, NOISE))
        mean_rate = (second - first)[1, 0] / gap_s
        assert state[RATE, 1, 0] == pytest.approx(mean_rate, rel=0.25)


def test_a_box_out_of_line_moves_a_track_less_and_one_in_line_as_usual() -> None:
    vehicle = Vehicle(3.0, 60.0, 12.0)
    state = begun(np.array(vehicle.box(0.0)).reshape(4, 1))
    for k in range(1, 12):
        box = np.array(vehicle.box(0.04 * k)).reshape(4, 1)
        ahead = predict(state, np.array([0.04]), NOISE)
        variance = measurement_variance(box, NOISE)
        state = correct_in_doubt(ahead, measurements(box), variance)
        assert state == pytest.approx(correct(ahead, measurements(box), variance))
    box = np.array(vehicle.box(0.48)).reshape(4, 1)
    box[0] += 0.8 * box[2]
    box[2] *= 2.6  # joined with its neighbour
    ahead = predict(state, np.array([0.04]), NOISE)
    given = measurements(box), measurement_variance(box, NOISE)
    moved = [abs(each(ahead, *given)[RATE] - ahead[RATE]) for each in (correct_in_doubt, correct)]
    assert (moved[0][[0, 2]] < 0.5 * moved[1][[0, 2]]).all()
