"""Velocity and heading of vehicles, from past positions only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ACCELERATION_PSD = 5.0
"""m^2/s^3: velocities change by 2.2 m/s (1-sigma) within a second. Chosen: larger makes velocities
noisy on open roads, smaller lags behind at street corners."""
FIRST_SPEED_SIGMA = 20.0
"""m/s, 1-sigma of the speed of a vehicle about which nothing is known. Chosen: wide enough for
every road; larger needs more frames for a speed."""
MODEL_SIGMA_M = 0.05
"""m, what the vehicle model leaves even where a pixel is a centimetre. Chosen: larger smooths near
tracks more, smaller follows their jitter."""
JUMP_M = 5.0
"""m, on top of five sigma: a track that jumps farther is another vehicle under an old id. Chosen:
larger drags one vehicle's speed to the next, smaller restarts after bad boxes."""
MIN_MOVE_M = 1.0
"""A heading needs this displacement since the track began. Chosen: larger gives headings later,
smaller gives parked vehicles one."""
MIN_SPEED = 1.0
"""m/s, a heading needs this speed. Chosen: larger leaves slow vehicles without, smaller turns
waiting ones about."""
SIGNIFICANCE = 3.0
"""A heading needs a displacement and a speed this many sigma above noise. Chosen: larger gives
headings later, smaller gives wrong ones."""

X, Y, VX, VY, PP, PV, VV, X0, Y0, R0, HEADING, TIME = range(12)
"""Rows of the filter's state; all NaN before a vehicle is seen."""
ROWS = 12
"""Their number."""


def follow(
    s: Array, time_s: Array, xy: Array, sigma_m: Array, observed: NDArray[np.bool_]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """One step of constant-velocity Kalman filters, one per vehicle.

    Both axes share one 2x2 covariance because the measurement noise is taken as isotropic with
    its worst-axis sigma: the direction along the view is noisier, never the direction across.
    Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and
    Navigation, section 6.2.2 (white noise acceleration).

    Args:
        s: (`ROWS`, M) state, one column per vehicle, changed in place.
        time_s: (M,) time of each position, from any epoch.
        xy: (2, M) measured ground points, metres.
        sigma_m: (M,) 1-sigma of the measurement.
        observed: (M,) False where the position is a prediction and carries no information.

    Returns:
        Velocity (2, M) in m/s, NaN before the first observation, and heading (M,), NaN until the
        vehicle has moved; views of the state. (M,) whether the id jumped to another vehicle.
    """
    r = np.where(observed, sigma_m**2 + MODEL_SIGMA_M**2, 1e12)
    dt = time_s - s[TIME]
    q = ACCELERATION_PSD * dt
    predicted = s[X : Y + 1] + dt * s[VX : VY + 1]
    pp = s[PP] + dt * (2 * s[PV] + dt * (s[VV] + q / 3))
    pv = s[PV] + dt * (s[VV] + q / 2)
    vv = s[VV] + q
    gap = xy - predicted
    total = pp + r
    jumped = gap[0] ** 2 + gap[1] ** 2 > (JUMP_M + 5 * np.sqrt(total)) ** 2
    unknown = np.isnan(dt)
    start = observed & (jumped | unknown)

    gain_p, gain_v = pp / total, pv / total
    s[X : Y + 1] = predicted + gain_p * gap
    s[VX : VY + 1] += gain_v * gap
    s[PP] = pp * (1 - gain_p)
    s[PV] = pv * (1 - gain_p)
    s[VV] = vv - gain_v * pv
    if start.any():
        s[:, start] = 0.0
        s[X : Y + 1, start] = s[X0 : Y0 + 1, start] = xy[:, start]
        s[PP, start] = s[R0, start] = r[start]
        s[VV, start] = FIRST_SPEED_SIGMA**2
        s[HEADING, start] = np.nan
    s[TIME] = np.where(unknown & ~observed, np.nan, time_s)

    speed = np.hypot(s[VX], s[VY])
    moving = speed > np.maximum(MIN_SPEED, SIGNIFICANCE * np.sqrt(s[VV]))
    away = np.hypot(s[X] - s[X0], s[Y] - s[Y0])
    left = away > MIN_MOVE_M + SIGNIFICANCE * np.sqrt(s[PP] + s[R0])
    turn = moving & (left | np.isfinite(s[HEADING]))
    np.copyto(s[HEADING], np.arctan2(s[VY], s[VX]), where=turn)
    return s[VX : VY + 1], s[HEADING], observed & jumped & ~unknown
