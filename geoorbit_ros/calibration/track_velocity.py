"""Velocity and heading of every track, from past positions only; a row of state per track."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FORGET_NS = 10_000_000_000
"""An id unseen for 10 s of data time is a new vehicle when it comes back. Chosen: longer joins
vehicles that share an id, shorter forgets a vehicle behind another."""
SWEEP_NS = 1_000_000_000
"""Period of looking for such ids. Chosen: shorter costs time, longer holds more memory."""
NO_IDENTITY = -(2**40)
"""Keys from here downwards stand for detections without identity; no int32 id gets there."""


class TrackSlots:
    """Maps track ids to slots of a growing table; slots of forgotten ids are used again.

    The answer depends on stamps and ids alone, never on when old slots are swept.
    """

    def __init__(self, capacity: int = 64) -> None:
        self._slot: dict[int, int] = {}
        self._free = list(range(capacity - 1, -1, -1))
        self._last_ns = np.zeros(capacity, dtype=np.int64)
        self._sweep_ns: int | None = None
        self._anonymous = NO_IDENTITY

    @property
    def capacity(self) -> int:
        """Rows that the state arrays need."""
        return len(self._last_ns)

    def __len__(self) -> int:
        return len(self._slot)

    def enter(
        self, stamp_ns: int, track_id: NDArray[np.int32]
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Slots of the ids in one frame.

        Args:
            stamp_ns: Capture time, not earlier than in the last call.
            track_id: (M,); negative ids are detections without identity, new every time.

        Returns:
            slot (M,) and whether the id is new (M,), so that the caller starts its state afresh.
        """
        self._sweep(stamp_ns)
        ids = track_id.tolist()
        known = [self._slot.get(identity, -1) for identity in ids]
        fresh = np.zeros(len(ids), dtype=bool)
        if -1 in known:
            for k, identity in enumerate(ids):
                if identity < 0 or identity not in self._slot:
                    known[k] = self._new(identity)
                    self._last_ns[known[k]] = stamp_ns
                    fresh[k] = True
                else:
                    known[k] = self._slot[identity]
        slot = np.array(known, dtype=np.intp)
        fresh |= stamp_ns - self._last_ns[slot] > FORGET_NS
        self._last_ns[slot] = stamp_ns
        return slot, fresh

    def _new(self, track_id: int) -> int:
        if track_id < 0:
            self._anonymous -= 1
            track_id = self._anonymous
        if not self._free:
            size = self.capacity
            self._last_ns = np.append(self._last_ns, np.zeros(size, dtype=np.int64))
            self._free = list(range(2 * size - 1, size - 1, -1))
        slot = self._free.pop()
        self._slot[track_id] = slot
        return slot

    def _sweep(self, stamp_ns: int) -> None:
        """Once per second of data time, take back the slots of ids that are gone.

        Detections without identity carry negative keys and go at the first sweep.
        """
        if self._sweep_ns is not None and stamp_ns - self._sweep_ns < SWEEP_NS:
            return
        self._sweep_ns = stamp_ns
        gone = [
            key
            for key, slot in self._slot.items()
            if key < 0 or stamp_ns - self._last_ns[slot] > FORGET_NS
        ]
        self._free.extend(self._slot.pop(key) for key in gone)


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
"""Columns of the filter's table."""


class VelocityFilter:
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
