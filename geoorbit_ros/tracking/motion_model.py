"""Motion of vehicles in the image, for all tracks at once: constant speed on the road, in time.

A vehicle that moves steadily on a flat road seen by a pinhole camera has homogeneous image
coordinates that are linear in time: its box grows as 1 / (1 - g t), with g the relative growth per
second, and its centre moves as x(t) = x + v t / (1 - g t) (one over g is the time to contact of
Lee 1976, "A theory of visual control of braking"). So the usual constant-velocity Kalman filter
holds in the stretched time tau = t / (1 - g t): vehicles that come nearer speed up in the image
as they grow.

The state of a track is that of its last observation and is predicted from there to any later time
in one step. A gap is therefore one long step, whose correction re-estimates the velocity from the
two observations at its ends (the observation-centric re-update of OC-SORT, Cao et al. 2023,
arXiv:2203.14360, section 4.1, in closed form), and frames without detections change nothing.

Arrays are (5, 4, N): mean, rate, and the three entries of the covariance (variance of the mean,
covariance, variance of the rate), of x, y in pixels and of the logarithms of width and height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MEAN, RATE, VARIANCE, COVARIANCE, RATE_VARIANCE = range(5)
"""Indices of a state's first axis."""
MAX_GROWTH = 2.0
"""Relative growth, 1/s, beyond which it is an error: that of a vehicle 15 m away at 30 m/s."""
TAIL = 6.0
"""Degrees of freedom of Student's t distribution of box errors. Chosen: larger lets a wild box end
a track, smaller accepts neighbours' boxes."""
MAX_APPROACH = 0.6
"""Share of the time to contact up to which a prediction is stretched. Chosen: beyond, an error of
the growth moves the prediction far off."""


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """How exact boxes are and how steadily vehicles move; sizes are the geometric mean of a box's.

    Attributes:
        position: 1-sigma of a box's centre, share of its width or height.
        size: 1-sigma of a box's width or height, relative.
        acceleration: Random change of speed, sizes per second^1.5: a vehicle is about two
            sizes high and changes speed by some m/s within a second.
        growth: Random change of the relative growth, 1/s^1.5.
        speed: 1-sigma of the speed of a vehicle not seen before, sizes per second.
        growth_rate: 1-sigma of its relative growth, 1/s.
    """

    position: float = 0.065
    size: float = 0.15
    acceleration: float = 0.5
    growth: float = 0.15
    speed: float = 6.0
    growth_rate: float = 0.65

    def rate_variance(self, box: Array) -> Array:
        """(4, N) of the rates of vehicles not seen before, in boxes (4, N)."""
        variance = np.full(box.shape, self.growth_rate**2)
        variance[:2] = self.speed**2 * box[2] * box[3]
        return variance


def measurements(box: Array) -> Array:
    """(4, N) x, y, log width, log height of boxes (4, N) x, y, width, height."""
    found = box.copy()
    np.log(box[2:], out=found[2:])
    return found


def measurement_variance(box: Array, noise: MotionNoise) -> Array:
    """(4, N) variances of `measurements`."""
    variance = np.full(box.shape, noise.size**2)
    np.square(noise.position * box[2:], out=variance[:2])
    return variance


def start(box: Array, variance: Array, rate: Array, rate_variance: Array) -> Array:
    """(5, 4, N) states of tracks first seen in boxes (4, N), with what is expected of their rates.

    Args:
        box: (4, N) x, y, width, height.
        variance: (4, N) of its measurements.
        rate: (4, N) expected rates.
        rate_variance: (4, N) their variances.
    """
    state = np.zeros((5, *box.shape))
    state[MEAN], state[VARIANCE] = measurements(box), variance
    state[RATE], state[RATE_VARIANCE] = rate, rate_variance
    return state


def predict(state: Array, elapsed_s: Array, noise: MotionNoise) -> Array:
    """(5, 4, N) states `elapsed_s` (N,) after the observations that `state` (5, 4, N) is of."""
    growth = np.minimum(np.maximum(state[RATE, 2:], -MAX_GROWTH), MAX_GROWTH)
    per_side = np.empty((4, len(elapsed_s)))
    # Of both sides' growth, the mean: noise halves, and a turning vehicle's width says little.
    per_side[:2] = 0.5 * (growth[0] + growth[1])
    per_side[2:] = growth
    left = 1.0 - np.minimum(per_side * elapsed_s, MAX_APPROACH)
    step, pace = elapsed_s / left, 1.0 / (left * left)
    intensity = np.empty_like(step)
    intensity[:2] = noise.acceleration**2 * np.exp(state[MEAN, 2] + state[MEAN, 3])
    intensity[2:] = noise.growth**2
    drift = intensity * step
    carried = state[COVARIANCE] + step * state[RATE_VARIANCE]
    after = np.empty_like(state)
    after[MEAN, :2] = state[MEAN, :2] + step[:2] * state[RATE, :2]
    after[MEAN, 2:] = state[MEAN, 2:] - np.log(left[2:])
    after[RATE, :2] = pace[:2] * state[RATE, :2]
    after[RATE, 2:] = growth / left[2:]
    after[VARIANCE] = (
        state[VARIANCE] + step * (state[COVARIANCE] + carried) + drift * step * step / 3.0
    )
    after[COVARIANCE] = pace * (carried + 0.5 * drift * step)
    after[RATE_VARIANCE] = pace * pace * (state[RATE_VARIANCE] + drift)
    return after


def correct(predicted: Array, measured: Array, variance: Array) -> Array:
    """(5, 4, N) states after observing `measured` (4, N) with `variance` (4, N), by Kalman."""
    error = measured - predicted[MEAN]
    total = predicted[VARIANCE] + variance
    gain = predicted[VARIANCE] / total
    rate_gain = predicted[COVARIANCE] / total
    after = np.empty_like(predicted)
    after[MEAN] = predicted[MEAN] + gain * error
    after[RATE] = predicted[RATE] + rate_gain * error
    after[VARIANCE] = gain * variance
    after[COVARIANCE] = rate_gain * variance
    after[RATE_VARIANCE] = predicted[RATE_VARIANCE] - rate_gain * predicted[COVARIANCE]
    return after


def correct_in_doubt(predicted: Array, measured: Array, variance: Array) -> Array:
    """`correct`, in which measurements count less the farther they are from their prediction.

    Errors of boxes have heavy tails: a detector splits a vehicle, or merges it with another. Under
    Student's t distribution with `TAIL` degrees of freedom a measurement at squared distance d in
    1-sigma errors has (TAIL + d) / (TAIL + 4) times its variance (Lange, Little, Taylor 1989,
    "Robust statistical modeling using the t distribution"); near ones keep theirs.
    """
    error = measured - predicted[MEAN]
    distance = (error * error / (predicted[VARIANCE] + variance)).sum(axis=0)
    doubt = np.maximum((TAIL + distance) / (TAIL + 4.0), 1.0)
    return correct(predicted, measured, variance * doubt)
