"""Vehicles on two straight lanes, as tracks and as reference lanes: quick to learn from."""

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import TRACK_DTYPE

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 200_000_000
LANE_Y_M = (0.0, 3.5)
ROAD_M, SPEED_M_S = 60.0, 15.0


def made_up_tracks(duration_s: float = 8.0) -> list[tuple[int, NDArray[np.void]]]:
    """Frames of vehicles that drive east, five frames a second: (stamp_ns, rows)."""
    frames = []
    for k in range(int(duration_s * 1e9 / FRAME_NS) + 1):
        now_s, rows = k * FRAME_NS / 1e9, []
        for lane, y_m in enumerate(LANE_Y_M):
            for vehicle in range(8):
                x_m = SPEED_M_S * (now_s - 1.5 * vehicle - 0.7 * lane) + 30.0
                if 0.0 <= x_m <= ROAD_M:
                    row = np.zeros(1, TRACK_DTYPE)
                    row["x"], row["y"] = x_m, y_m + 0.1 * np.sin(vehicle + x_m / 20)
                    row["vx"], row["length"], row["width"] = SPEED_M_S, 4.5, 1.8
                    row["score"], row["sigma"], row["class_id"] = 0.9, 0.2, 2
                    row["track_id"] = 1 + 10 * lane + vehicle
                    rows.append(row)
        frames.append((START_NS + k * FRAME_NS, np.concatenate(rows)))
    return frames


def made_up_reference() -> dict[int, Lane]:
    """The same two lanes as a map has them, by number."""
    x_m = np.linspace(0.0, ROAD_M, 13)
    lanes = {}
    for k, y_m in enumerate(LANE_Y_M):
        line, left, right = (np.column_stack([x_m, 0 * x_m + y_m + d]) for d in (0, 1.75, -1.75))
        nan = float("nan")
        lanes[k] = Lane(k, line, left, right, 3.5, nan, 1.0, "confirmed", nan)
    return lanes
