"""Frames for the storage tests: drawn by hypothesis, or plain ones."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
    Frames,
)

MAX_STAMP_NS = 2**31 * 10**9 - 1
coordinates = st.floats(width=32, allow_nan=False, allow_infinity=False)
sizes = st.floats(width=32, min_value=0, exclude_min=True, allow_infinity=False)


@st.composite
def stamps(draw: st.DrawFn, number: int) -> NDArray[np.int64]:
    """Strictly increasing stamps that a message can hold."""
    chosen = st.sets(st.integers(0, MAX_STAMP_NS), min_size=number, max_size=number)
    near = st.sets(st.integers(0, 10**6), min_size=number, max_size=number)
    return np.array(sorted(draw(chosen | near)), np.int64)


@st.composite
def pixel_frames(draw: st.DrawFn, min_rows: int = 0) -> Frames:
    """Frames of `PIXEL_TRACK_DTYPE`, any numbers a tracker may write."""
    counts = draw(st.lists(st.integers(min_rows, 3), min_size=1, max_size=4))
    rows = np.zeros(sum(counts), PIXEL_TRACK_DTYPE)
    offset = np.append(0, np.cumsum(counts)).astype(np.int64)
    # -1 stands for no id in files of tracks.
    whole = st.integers(-(2**31), 2**31 - 1).filter(lambda number: number != -1)
    for start, count in zip(offset, counts, strict=False):
        ids = draw(st.lists(whole, min_size=count, max_size=count, unique=True))
        for k in range(count):
            ground = draw(st.booleans())
            rows[start + k] = (
                draw(coordinates),
                draw(coordinates),
                0 if ground else draw(sizes),
                0 if ground else draw(sizes),
                draw(st.floats(0, 1, width=32)),
                draw(whole),
                ids[k],
                FLAG_GROUND_POINT if ground else 0,
            )
    return Frames(draw(stamps(len(counts))), offset, rows)


@st.composite
def ground_frames(draw: st.DrawFn) -> Frames:
    """Frames of `TRACK_DTYPE` with arbitrary bits in every field, NaN included."""
    counts = draw(st.lists(st.integers(0, 5), min_size=1, max_size=6))
    offset = np.append(0, np.cumsum(counts)).astype(np.int64)
    size = int(offset[-1]) * TRACK_DTYPE.itemsize
    rows = np.frombuffer(draw(st.binary(min_size=size, max_size=size)), TRACK_DTYPE)
    return Frames(draw(stamps(len(counts))), offset, rows)


def steady_frames(
    frames: int,
    vehicles: int,
    dtype: np.dtype[np.void],
    start_ns: int = 0,
    step_ns: int = 33_000_000,
) -> Frames:
    """The same number of vehicles in every frame, positions of a seeded generator."""
    generator = np.random.default_rng(frames * 1000 + vehicles)
    rows = np.zeros(frames * vehicles, dtype)
    for name in ("x", "y", "width"):
        rows[name] = generator.uniform(1, 1000, len(rows))
    if "height" in (dtype.names or ()):
        rows["height"] = rows["width"]
    rows["track_id"] = np.tile(np.arange(vehicles), frames)
    offset = np.arange(frames + 1, dtype=np.int64) * vehicles
    return Frames(start_ns + np.arange(frames, dtype=np.int64) * step_ns, offset, rows)


def assert_same(first: Frames, second: Frames) -> None:
    """Equal to the bit, NaN included."""
    np.testing.assert_array_equal(first.stamp_ns, second.stamp_ns)
    np.testing.assert_array_equal(first.offset, second.offset)
    assert first.rows.dtype == second.rows.dtype
    assert first.rows.tobytes() == second.rows.tobytes()
