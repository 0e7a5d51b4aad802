"""Tracks that have just jumped, or begun beside a vehicle: a vehicle, or a false box.

The steps that follow tell. A vehicle moves on with the speed that its track says; a track that took
a false box for a moment jumps back. A track that begins where a vehicle may be that another track
has is often that vehicle's second box, and ends after some frames. Until then it moves nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SETTLE_S = 0.3
"""A track that has moved as it says for so long follows something: false boxes come in single
frames, three of which in a row are rare."""
JUMP_ALONG_M, JUMP_ACROSS_M = 4.0, 2.0
"""From one step to the next no vehicle leaves its predicted place by more, but for its errors: a
swap of ids moves a track to the next lane (3 m) or the next vehicle (6 m and more)."""
JUMP_SIGMAS = 3.0


def reach_along_m(
    sigma_m: NDArray[np.float64], other_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far two places of one vehicle may lie apart along its way, by their 1-sigma errors."""
    return np.maximum(JUMP_ALONG_M, JUMP_SIGMAS * np.hypot(sigma_m, other_m))


@dataclass(slots=True)
class _Path:
    """Where a track should be by its velocities since a time, and where it was last."""

    since_ns: int
    now_ns: int
    xy: NDArray[np.float64]
    velocity: NDArray[np.float64]
    sigma_m: float


class JumpWatch:
    """Remembers which tracks have jumped, or begun beside a vehicle, and not settled yet.

    Args:
        cameras: How many there are.
    """

    def __init__(self, cameras: int) -> None:
        self._paths: list[dict[int, _Path | None]] = [{} for _ in range(cameras)]

    def forget(self, camera: int) -> None:
        """A camera's tracker started again."""
        self._paths[camera].clear()

    def add(self, camera: int, track: int) -> None:
        """A track has jumped, or jumped again."""
        self._paths[camera][track] = None

    def add_new(self, camera: int, tracks: Iterable[int]) -> None:
        """Tracks without a vehicle are where one may be; those remembered go on settling."""
        for track in tracks:
            self._paths[camera].setdefault(track, None)

    def unsettled(self, camera: int, rows: NDArray[np.void], time_ns: int) -> NDArray[np.bool_]:
        """Which rows (R,), all that no vehicle has, are of tracks that have not settled yet.

        Tracks that are not among them are forgotten: they have a vehicle, or are gone.
        """
        paths, flag = self._paths[camera], np.zeros(len(rows), dtype=np.bool_)
        if not paths:
            return flag
        waiting: dict[int, _Path | None] = {}
        for k, track in enumerate(rows["track_id"].tolist()):
            if track not in paths:
                continue
            path = _followed(paths[track], rows[k], time_ns)
            if time_ns - path.since_ns < SETTLE_S * 1e9:
                waiting[track] = path
                flag[k] = True
        self._paths[camera] = waiting
        return flag


def _followed(path: _Path | None, row: NDArray[np.void], time_ns: int) -> _Path:
    """A path with one more step; it begins anew where the track is not on it."""
    xy, velocity, sigma_m = row["xy"].copy(), row["velocity"].copy(), float(row["sigma"])
    if path is None:
        return _Path(time_ns, time_ns, xy, velocity, sigma_m)
    step_s = (time_ns - path.now_ns) * 1e-9
    expected = path.xy + 0.5 * (path.velocity + velocity) * step_s
    reach_m = reach_along_m(np.array(sigma_m), np.array(path.sigma_m))
    if np.hypot(*(xy - expected)) > reach_m:
        return _Path(time_ns, time_ns, xy, velocity, sigma_m)
    return _Path(path.since_ns, time_ns, expected, velocity, path.sigma_m)
