"""Ground tracks of a long recording by a second process, while this one finds lanes in them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector, ProjectionCounts, with_doubts
from geoorbit_ros.core.frame_spool import FrameSpool
from geoorbit_ros.core.helper_process import HelperProcess
from geoorbit_ros.core.tables import Frames, bounds_of_blocks
from geoorbit_ros.lanes.pipeline import BLOCK_ROWS


def project_beside(
    frames: FrameSpool,
    projector: BoxProjector,
    ground: FrameSpool,
    block_rows: int = BLOCK_ROWS,
) -> Iterator[Frames]:
    """Ground tracks in blocks, with the bytes of `pipeline.project_blocks`.

    The other process places boxes on the road. Whether the traffic is what the inputs can show is
    looked at here. Both read the boxes from the file that they share, and blocks come back in the
    other one: little goes from process to process.

    Args:
        frames: Frames of `PIXEL_TRACK_DTYPE`.
        projector: One that has seen none of these frames yet; it remembers no tracks afterwards.
        ground: Takes the ground tracks; it is empty.
        block_rows: A block ends where one frame more would make it larger.

    Yields:
        Consecutive frames of `TRACK_DTYPE`, frames without vehicles included.
    """
    bounds = bounds_of_blocks(frames.offset, block_rows)
    with HelperProcess(_ground_of, frames, projector, ground, block_rows) as helper:
        for (first, last), (counts, projector.counts) in zip(bounds, helper, strict=False):
            doubtful = projector.traffic.add(frames.part(first, last))
            begin, stamps = ground.row_count, frames.stamp_ns[first:last]
            ground.announce(stamps, counts)
            rows = ground.rows(begin, ground.row_count)
            block = with_doubts(Frames(stamps, np.append(0, np.cumsum(counts)), rows), doubtful)
            block = projector.with_bends(block)
            if doubtful.any() or projector.bent:
                ground.put(begin, block.rows)
            yield block


def _ground_of(
    frames: FrameSpool, projector: BoxProjector, ground: FrameSpool, block_rows: int
) -> Iterator[tuple[NDArray[np.int64], ProjectionCounts]]:
    """How many rows each frame of a block has, which stand in `ground`; all rows counted so far."""
    done = 0
    for block in frames.blocks(block_rows):
        placed = projector.place_block(block)
        ground.put(done, placed.rows)
        done += len(placed.rows)
        yield np.diff(placed.offset), replace(projector.counts)
