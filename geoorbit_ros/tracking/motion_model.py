"""Motion of vehicles in the image: constant speed on the road, in time.

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

A state holds one `Axis` for each of x, y in pixels and the logarithms of width and height. They are
tuples of plain numbers: a camera sees a handful of vehicles at once, and for so few one call of an
array library costs as much as the whole arithmetic (docs/adr/0045-the-tracker-in-plain-numbers.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Axis = tuple[float, float, float, float, float]
"""Mean, rate, variance of the mean, covariance of both, variance of the rate."""
State = tuple[Axis, Axis, Axis, Axis]
"""x, y in pixels, logarithms of width and height."""
Four = tuple[float, float, float, float]
"""Of x, y, width, height, or of what is measured of them."""

MEAN, RATE, VARIANCE, COVARIANCE, RATE_VARIANCE = range(5)
"""Indices of an axis."""
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

    def rate_variance(self, box: Four) -> Four:
        """Of the rates of a vehicle not seen before, in a box x, y, width, height."""
        speed = self.speed**2 * box[2] * box[3]
        growth = self.growth_rate**2
        return speed, speed, growth, growth


def measurements(box: Four) -> Four:
    """x, y, log width, log height of a box x, y, width, height."""
    x, y, width, height = box
    return x, y, math.log(width), math.log(height)


def box_of(state: State) -> Four:
    """Box x, y, width, height that a state shows."""
    x, y, width, height = state
    return x[MEAN], y[MEAN], math.exp(width[MEAN]), math.exp(height[MEAN])


def measurement_variance(box: Four, noise: MotionNoise) -> Four:
    """Variances of `measurements`."""
    size = noise.size**2
    return (noise.position * box[2]) ** 2, (noise.position * box[3]) ** 2, size, size


def start(box: Four, variance: Four, rate: Four, rate_variance: Four) -> State:
    """State of a track first seen in a box, with what is expected of its rates.

    Args:
        box: x, y, width, height.
        variance: Of its measurements.
        rate: Expected rates.
        rate_variance: Their variances.
    """
    x, y, width, height = (
        (mean, rate[k], variance[k], 0.0, rate_variance[k])
        for k, mean in enumerate(measurements(box))
    )
    return x, y, width, height


def predict(state: State, elapsed_s: float, noise: MotionNoise) -> State:
    """State `elapsed_s` after the observation that `state` is of."""
    x, y, width, height = state
    across, upward = _bounded(width[RATE]), _bounded(height[RATE])
    # Shares of the time to contact that are left. Of both sides' growth, the middle moves with the
    # mean: noise halves, and a turning vehicle's width says little.
    left = _left(0.5 * (across + upward) * elapsed_s)
    left_across, left_upward = _left(across * elapsed_s), _left(upward * elapsed_s)
    step, pace = elapsed_s / left, 1.0 / (left * left)
    drift = noise.acceleration**2 * math.exp(width[MEAN] + height[MEAN]) * step
    growth = noise.growth**2
    step_across, step_upward = elapsed_s / left_across, elapsed_s / left_upward
    # Both coordinates alike, written out: a call for each takes longer than the arithmetic.
    mean_x, rate_x, variance_x, covariance_x, rate_variance_x = x
    mean_y, rate_y, variance_y, covariance_y, rate_variance_y = y
    carried_x = covariance_x + step * rate_variance_x
    carried_y = covariance_y + step * rate_variance_y
    spread, lean = drift * step * step / 3.0, 0.5 * drift * step
    return (
        (
            mean_x + step * rate_x,
            pace * rate_x,
            variance_x + step * (covariance_x + carried_x) + spread,
            pace * (carried_x + lean),
            pace * pace * (rate_variance_x + drift),
        ),
        (
            mean_y + step * rate_y,
            pace * rate_y,
            variance_y + step * (covariance_y + carried_y) + spread,
            pace * (carried_y + lean),
            pace * pace * (rate_variance_y + drift),
        ),
        _carried(
            width,
            width[MEAN] - math.log(left_across),
            across / left_across,
            step_across,
            1.0 / (left_across * left_across),
            growth * step_across,
        ),
        _carried(
            height,
            height[MEAN] - math.log(left_upward),
            upward / left_upward,
            step_upward,
            1.0 / (left_upward * left_upward),
            growth * step_upward,
        ),
    )


def _bounded(growth: float) -> float:
    if growth > MAX_GROWTH:
        return MAX_GROWTH
    return growth if growth > -MAX_GROWTH else -MAX_GROWTH


def _left(approach: float) -> float:
    """Share of the time to contact that is left after a share `approach` of it."""
    return 1.0 - (approach if approach < MAX_APPROACH else MAX_APPROACH)


def _carried(axis: Axis, mean: float, rate: float, step: float, pace: float, drift: float) -> Axis:
    """`axis` with its new mean and rate.

    Args:
        axis: At the observation.
        mean: The new one.
        rate: The new one.
        step: Stretched time since, seconds.
        pace: How many times faster stretched time passes now.
        drift: Variance of the random change of the rate.
    """
    _, _, variance, covariance, rate_variance = axis
    carried = covariance + step * rate_variance
    return (
        mean,
        rate,
        variance + step * (covariance + carried) + drift * step * step / 3.0,
        pace * (carried + 0.5 * drift * step),
        pace * pace * (rate_variance + drift),
    )


def correct(predicted: State, measured: Four, variance: Four, doubt: float = 1.0) -> State:
    """State after observing `measured` with `doubt` times its `variance`, by Kalman."""
    return (
        _corrected(predicted[0], measured[0], doubt * variance[0]),
        _corrected(predicted[1], measured[1], doubt * variance[1]),
        _corrected(predicted[2], measured[2], doubt * variance[2]),
        _corrected(predicted[3], measured[3], doubt * variance[3]),
    )


def _corrected(axis: Axis, measured: float, noise: float) -> Axis:
    mean, rate, variance, covariance, rate_variance = axis
    error, total = measured - mean, variance + noise
    gain, rate_gain = variance / total, covariance / total
    return (
        mean + gain * error,
        rate + rate_gain * error,
        gain * noise,
        rate_gain * noise,
        rate_variance - rate_gain * covariance,
    )


def squared_distance(predicted: State, measured: Four, variance: Four) -> float:
    """In 1-sigma errors of prediction and measurement together."""
    distance = distance_within(math.inf, predicted, measured, variance)
    return math.inf if distance is None else distance


def distance_within(limit: float, predicted: State, measured: Four, variance: Four) -> float | None:
    """Squared distance in 1-sigma errors of prediction and measurement; None from `limit` on."""
    (x, _, of_x, _, _), (y, _, of_y, _, _), (w, _, of_w, _, _), (h, _, of_h, _, _) = predicted
    error = measured[0] - x
    distance = error * error / (of_x + variance[0])
    if distance >= limit:
        return None
    error = measured[1] - y
    distance += error * error / (of_y + variance[1])
    if distance >= limit:
        return None
    error = measured[2] - w
    distance += error * error / (of_w + variance[2])
    error = measured[3] - h
    distance += error * error / (of_h + variance[3])
    return distance if distance < limit else None


def spread_ratio(predicted: State, variance: Four) -> float:
    """How many times larger errors are with the prediction's than with the measurement's alone.

    The product over the four measurements, of variances.
    """
    (_, _, x, _, _), (_, _, y, _, _), (_, _, width, _, _), (_, _, height, _, _) = predicted
    of_x, of_y, of_width, of_height = variance
    return (
        ((x + of_x) / of_x)
        * ((y + of_y) / of_y)
        * ((width + of_width) / of_width)
        * ((height + of_height) / of_height)
    )


def correct_in_doubt(predicted: State, measured: Four, variance: Four) -> State:
    """`correct`, in which measurements count less the farther they are from their prediction.

    Errors of boxes have heavy tails: a detector splits a vehicle, or merges it with another. Under
    Student's t distribution with `TAIL` degrees of freedom a measurement at squared distance d in
    1-sigma errors has (TAIL + d) / (TAIL + 4) times its variance (Lange, Little, Taylor 1989,
    "Robust statistical modeling using the t distribution"); near ones keep theirs.
    """
    distance = squared_distance(predicted, measured, variance)
    return correct(predicted, measured, variance, max((TAIL + distance) / (TAIL + 4.0), 1.0))
