"""Boxes in, lane map out, without a ROS graph: what `geoorbit lanes`, report and benchmarks run.

The node graph gives the same projector and mapper one frame after the other; here they get many
frames at once, to the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.class_names import class_text
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.frame_spool import AnyFrames
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import (
    VEHICLE_CLASS_TEXT,
    VEHICLE_CLASSES,
    Frames,
    distinct,
    one_frame,
)
from geoorbit_ros.lanes.mapping.mapper import LaneMapper


class GroundProjector(Protocol):
    """Turns one camera's tracked boxes into ground tracks, in time order."""

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void]:
        """Project one frame.

        Args:
            stamp_ns: Capture time of the frame, later than that of the previous call.
            rows: (N,) `PIXEL_TRACK_DTYPE`.

        Returns:
            (M,) `TRACK_DTYPE`, M <= N: rows above the horizon are left out.
        """
        ...

    def project_block(self, frames: Frames) -> Frames:
        """Project many frames, to the same bytes as one after the other.

        Args:
            frames: Frames of `PIXEL_TRACK_DTYPE`, later than those before.

        Returns:
            The same frames, those without vehicles included, of `TRACK_DTYPE`.
        """
        ...


StampedRows = tuple[int, NDArray[np.void]]
"""Capture time in nanoseconds and the rows of one frame."""


BLOCK_ROWS = 400_000
"""Rows that are projected together at most: 15 minutes of a busy road. Chosen: more take more
memory (0.7 kB a row), fewer more time."""


def note_other_classes(report: InputReport, frames: AnyFrames) -> None:
    """Say how many tracks make no lane because their class, in most frames, is no vehicle's.

    Args:
        report: Takes the remark.
        frames: Frames of `PIXEL_TRACK_DTYPE`.
    """
    blocks = frames.blocks(BLOCK_ROWS)
    if all(np.isin(block.rows["class_id"], VEHICLE_CLASSES).all() for block in blocks):
        return
    votes = list[NDArray[np.int64]]()
    for block in frames.blocks(BLOCK_ROWS):
        pairs = np.stack((block.rows["track_id"], block.rows["class_id"])).astype(np.int64)
        votes.append(np.array(np.unique(pairs[0] << 32 | pairs[1] + 2**31, return_counts=True)))
    key, place = np.unique(np.concatenate([part[0] for part in votes]), return_inverse=True)
    count = np.bincount(place, np.concatenate([part[1] for part in votes]))
    track_id, kind = key >> 32, (key & (2**32 - 1)) - 2**31
    order = np.lexsort((kind, -count, track_id))
    usual = kind[order][np.diff(track_id[order], prepend=-(2**40)) != 0]
    other = usual[~np.isin(usual, VEHICLE_CLASSES)]
    if not len(other):
        return
    numbers, counts = np.unique(other, return_counts=True)
    named = ", ".join(
        f"{count} of class {number} ({class_text(number)})"
        for number, count in zip(numbers.tolist(), counts.tolist(), strict=True)
    )
    report.note(
        Treatment.NOTED,
        f"{len(other)} of {len(usual)} tracks make no lane, as they are no motor vehicles: {named}",
    )


def project_blocks(
    frames: Frames, projector: GroundProjector, block_rows: int = BLOCK_ROWS
) -> Iterator[Frames]:
    """Ground tracks in blocks, in time order.

    Args:
        frames: Frames of `PIXEL_TRACK_DTYPE`.
        projector: A projector that has seen none of these frames yet.
        block_rows: A block ends where one frame more would make it larger.

    Yields:
        Consecutive frames of `TRACK_DTYPE`, frames without vehicles included.
    """
    for block in frames.blocks(block_rows):
        yield projector.project_block(block)


def project_frames(frames: Frames, projector: GroundProjector) -> Iterator[StampedRows]:
    """Ground tracks of each frame, in time order; the projector is up to a block ahead of them.

    Args:
        frames: Frames of `PIXEL_TRACK_DTYPE`.
        projector: A projector that has seen none of these frames yet.

    Yields:
        Stamp and (M,) `TRACK_DTYPE`, frames without vehicles included.
    """
    for block in project_blocks(frames, projector):
        yield from block.tables()


def map_lanes(tracks: Iterable[StampedRows], mapper: LaneMapper, place: str = "tracks") -> LaneMap:
    """Feed all tracks to the mapper, frame by frame; see `map_blocks`."""
    return map_blocks((one_frame(*frame) for frame in tracks), mapper, place)


def map_blocks(blocks: Iterable[Frames], mapper: LaneMapper, place: str = "tracks") -> LaneMap:
    """Feed all tracks to the mapper and take its last map.

    Args:
        blocks: Frames of `TRACK_DTYPE` in time order.
        mapper: A mapper that has seen no frame yet.
        place: Where the tracks came from, for the error.

    Raises:
        NoTrafficError: No lane, not even a tentative one, can be seen in the tracks.
    """
    frame_count, ids, classes = 0, set[int](), set[int]()
    for block in blocks:
        mapper.add_block(block)
        frame_count += len(block)
        ids.update(distinct(block.rows["track_id"]).tolist())
        classes.update(distinct(block.rows["class_id"]).tolist())
    if not ids:
        found = f"{frame_count} frames without a vehicle on the road"
        raise NoTrafficError(place, found, "vehicles driving by")
    lane_map = mapper.finish()
    if not lane_map.lanes:
        found = f"{len(ids)} tracks in {frame_count} frames, none driving along a lane"
        if classes.isdisjoint(VEHICLE_CLASSES):
            found = f"{len(ids)} tracks of class {', '.join(map(str, sorted(classes)))} only"
            raise NoTrafficError(place, found, f"vehicles: {VEHICLE_CLASS_TEXT}")
        raise NoTrafficError(place, found, "vehicles driving by")
    return lane_map
