"""Vehicles on a straight road under a pinhole camera, as exact boxes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from geoorbit_ros.core.tables import DETECTION_DTYPE, FLAG_PREDICTED
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import Tracker

FOCAL_PX = 1200.0
CAMERA_HEIGHT_M = 9.0
SIZE = (1920, 1080)
SECOND = 1_000_000_000
Table = np.ndarray[tuple[int], np.dtype[np.void]]


@dataclass(frozen=True)
class Vehicle:
    """Drives along the camera's view with constant speed.

    Attributes:
        right_m: Of the camera's axis.
        ahead_m: Distance at time 0.
        speed_mps: Away from the camera; negative comes nearer.
    """

    right_m: float
    ahead_m: float
    speed_mps: float
    class_id: int = 2
    width_m: float = 1.8
    height_m: float = 1.5
    score: float = 0.9

    def box(self, time_s: float) -> tuple[float, float, float, float]:
        """x, y, width, height in pixels."""
        scale = FOCAL_PX / (self.ahead_m + self.speed_mps * time_s)
        middle_m = CAMERA_HEIGHT_M - 0.5 * self.height_m
        return (
            960.0 + scale * self.right_m,
            300.0 + scale * middle_m,
            scale * self.width_m,
            scale * self.height_m,
        )


def detections(vehicles: Iterable[Vehicle], time_s: float) -> Table:
    rows = [(*v.box(time_s), v.score, v.class_id) for v in vehicles]
    return np.array(rows, DETECTION_DTYPE)


def track_all(
    frames: Iterable[tuple[int, Table]], tracker: Tracker | None = None, **parameters: object
) -> list[Table]:
    """Output of a tracker for stamped detections."""
    if tracker is None:
        tracker = Tracker(TrackerParameters(**parameters))  # type: ignore[arg-type]
    return [tracker.update(stamp_ns, rows) for stamp_ns, rows in frames]


def stamps(count: int, fps: float = 25.0) -> list[int]:
    return [SECOND + round(k * SECOND / fps) for k in range(count)]


def seconds(stamp_ns: int) -> float:
    return (stamp_ns - SECOND) / SECOND


def observed(rows: Table) -> Table:
    seen: Table = rows[(rows["flags"] & FLAG_PREDICTED) == 0]
    return seen


def id_at(rows: Table, box: Sequence[float]) -> int:
    """Id of the row that is exactly this box."""
    here = (np.abs(rows["x"] - box[0]) < 0.01) & (np.abs(rows["y"] - box[1]) < 0.01)
    assert here.sum() == 1, (rows, box)
    return int(rows["track_id"][here][0])
