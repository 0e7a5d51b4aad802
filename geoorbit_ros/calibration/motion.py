"""Velocity and heading of every track, from past positions only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ACCELERATION_PSD = 5.0
"""m^2/s^3: velocities change by 2.2 m/s within a second, between open road and street corner."""
FIRST_SPEED_SIGMA = 20.0
"""m/s, 1-sigma of the speed of a vehicle about which nothing is known."""
MODEL_SIGMA_M = 0.05
"""m, what the vehicle model leaves even where a pixel is a centimetre."""
JUMP_M = 5.0
"""m, on top of five sigma: a track that jumps farther is another vehicle under an old id."""
MIN_MOVE_M = 1.0
MIN_SPEED = 1.0
SIGNIFICANCE = 3.0
"""A heading needs a displacement and a speed this many sigma above noise."""

X, Y, VX, VY, PP, PV, VV, X0, Y0, R0, HEADING, TIME = range(12)


class MotionFilter:
    """Constant-velocity Kalman filters, one per slot, updated together.

    Both axes share one 2x2 covariance because the measurement noise is taken as isotropic with
    its worst-axis sigma: the direction along the view is noisier, never the direction across.
    Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and
    Navigation, section 6.2.2 (white noise acceleration).
    """

    def __init__(self, capacity: int) -> None:
        self._state = np.zeros((capacity, 12))

    def reserve(self, capacity: int) -> None:
        """Make room for that many slots."""
        if capacity <= len(self._state):
            return
        grown = np.zeros((capacity, self._state.shape[1]))
        grown[: len(self._state)] = self._state
        self._state = grown

    def enter(self, slot: NDArray[np.intp], fresh: NDArray[np.bool_]) -> Array:
        """Heading (M,) known before this frame, radians from east; NaN where there is none."""
        if fresh.any():
            self._state[slot[fresh]] = np.nan
        return np.asarray(self._state[slot, HEADING])

    def update(
        self,
        slot: NDArray[np.intp],
        time_s: float,
        xy: Array,
        sigma_m: Array,
        observed: NDArray[np.bool_],
    ) -> tuple[Array, Array]:
        """Take one frame's positions.

        Args:
            slot: (M,) state row of each position.
            time_s: Time of the frame, from any epoch.
            xy: (M, 2) measured ground points, metres.
            sigma_m: (M,) 1-sigma of the measurement.
            observed: (M,) False where the position is a prediction and carries no information.

        Returns:
            Velocity (M, 2) in m/s, NaN before the first observation, and heading (M,), NaN until
            the vehicle has moved.
        """
        s = self._state[slot].T
        r = np.where(observed, sigma_m**2 + MODEL_SIGMA_M**2, 1e12)
        dt = time_s - s[TIME]
        q = ACCELERATION_PSD * dt
        predicted = s[X : Y + 1] + dt * s[VX : VY + 1]
        pp = s[PP] + dt * (2 * s[PV] + dt * (s[VV] + q / 3))
        pv = s[PV] + dt * (s[VV] + q / 2)
        vv = s[VV] + q
        gap = xy.T - predicted
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
            s[X : Y + 1, start] = s[X0 : Y0 + 1, start] = xy[start].T
            s[PP, start] = s[R0, start] = r[start]
            s[VV, start] = FIRST_SPEED_SIGMA**2
            s[HEADING, start] = np.nan
        s[TIME] = np.where(unknown & ~observed, np.nan, time_s)

        speed = np.hypot(s[VX], s[VY])
        moving = speed > np.maximum(MIN_SPEED, SIGNIFICANCE * np.sqrt(s[VV]))
        away = np.hypot(s[X] - s[X0], s[Y] - s[Y0])
        left = away > MIN_MOVE_M + SIGNIFICANCE * np.sqrt(s[PP] + s[R0])
        turn = moving & (left | np.isfinite(s[HEADING]))
        s[HEADING] = np.where(turn, np.arctan2(s[VY], s[VX]), s[HEADING])
        self._state[slot] = s.T
        return s[VX : VY + 1].T, s[HEADING]
