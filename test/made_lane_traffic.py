"""Small synthetic traffic on the ground plane for tests: exact roads, no camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import TRACK_DTYPE, Frames, frames_from_rows

Curve = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def arc(radius_m: float, heading_rad: float = 0.0, offset_m: float = 0.0) -> Curve:
    """A road from the origin that bends left with `radius_m`; `offset_m` is to its left."""

    def at(s: NDArray[np.float64]) -> NDArray[np.float64]:
        turn = s / radius_m
        centre = radius_m * np.array([-np.sin(heading_rad), np.cos(heading_rad)])
        ray = (radius_m - offset_m) * np.column_stack(
            [np.sin(heading_rad + turn), -np.cos(heading_rad + turn)]
        )
        return centre + ray

    return at


def straight(heading_rad: float = 0.0, offset_m: float = 0.0) -> Curve:
    """A straight road from the origin; `offset_m` is to its left."""

    def at(s: NDArray[np.float64]) -> NDArray[np.float64]:
        c, k = np.cos(heading_rad), np.sin(heading_rad)
        return np.column_stack([s * c - offset_m * k, s * k + offset_m * c])

    return at


@dataclass(frozen=True)
class Stream:
    """Vehicles on one lane: `vehicles` of them over the minute, seen from `start_m` to `end_m`."""

    curve: Curve
    vehicles: int
    start_m: float = 0.0
    end_m: float = 120.0
    speed_mps: float = 25.0
    wander_m: float = 0.2


def traffic(
    streams: Sequence[Stream],
    seed: int = 0,
    noise_m: float = 0.05,
    duration_s: float = 60.0,
    fps: float = 10.0,
) -> Frames:
    """`TRACK_DTYPE` frames of all streams; every vehicle has its own offset and speed."""
    random = np.random.default_rng(seed)
    stamps, tables = [], []
    track = 0
    for stream in streams:
        headway_s = (duration_s - 8.0) / max(stream.vehicles, 1)
        starts = headway_s * (np.arange(stream.vehicles) + random.uniform(0, 0.5, stream.vehicles))
        for start in starts:
            track += 1
            speed = stream.speed_mps * random.uniform(0.9, 1.1)
            times = np.arange(0.0, (stream.end_m - stream.start_m) / speed, 1.0 / fps)
            s = stream.start_m + speed * times
            middle = stream.curve(s)
            along = stream.curve(s + 0.01) - middle
            normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
            own = random.normal(0.0, stream.wander_m)
            xy = middle + own * normal + random.normal(0.0, noise_m, (len(s), 2))
            rows = np.zeros(len(s), TRACK_DTYPE)
            rows["x"], rows["y"] = xy.T
            rows["sigma"], rows["class_id"], rows["track_id"] = max(noise_m, 0.02), 2, track
            rows["heading"] = np.nan
            tables.append(rows)
            grid = np.round((start + times) * fps) / fps
            stamps.append(np.round(grid * 1e9).astype(np.int64))
    return frames_from_rows(np.concatenate(stamps), np.concatenate(tables))


def rotated(frames: Frames, angle_rad: float, shift_m: tuple[float, float]) -> Frames:
    """The same traffic in a turned and shifted world."""
    rows = frames.rows.copy()
    c, k = np.cos(angle_rad), np.sin(angle_rad)
    x, y = frames.rows["x"].astype(float), frames.rows["y"].astype(float)
    rows["x"], rows["y"] = c * x - k * y + shift_m[0], k * x + c * y + shift_m[1]
    return Frames(frames.stamp_ns, frames.offset, rows)
