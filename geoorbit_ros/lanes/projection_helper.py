"""Ground tracks of a long recording by a second process, while this one reads and finds lanes."""

from __future__ import annotations

import multiprocessing
import weakref
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.connection import Connection

import numpy as np

from geoorbit_ros.calibration.box_projector import BoxProjector, ProjectionCounts, with_doubts
from geoorbit_ros.core.frame_spool import FrameSpool
from geoorbit_ros.core.helper_process import HelperProcess
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.lanes.pipeline import BLOCK_ROWS


class ProjectionHelper:
    """Places boxes on the road in a second process, even while boxes are still being read.

    Whether the traffic is what the inputs can show is looked at here. Both read the boxes from the
    file that they share, and blocks come back in the other one: little goes from process to
    process.

    Args:
        boxes: Frames of `PIXEL_TRACK_DTYPE`, those that there are; `take` tells of more.
        projector: One that has seen none of these frames yet; it remembers no tracks afterwards.
        block_rows: A block ends where one frame more would make it larger.

    Attributes:
        ground: The ground tracks of the blocks so far, `TRACK_DTYPE`.
    """

    def __init__(
        self, boxes: FrameSpool, projector: BoxProjector, block_rows: int = BLOCK_ROWS
    ) -> None:
        self.ground = FrameSpool(TRACK_DTYPE)
        self._boxes, self._projector = boxes, projector
        receiving, self._telling = multiprocessing.Pipe(duplex=False)
        self._helper = HelperProcess(
            _ground_of, boxes, projector, self.ground, block_rows, receiving
        )
        receiving.close()
        self._end = weakref.finalize(self, _end, self._helper, self._telling)

    def take(self) -> None:
        """Tell the process that more boxes are in the file."""
        self._telling.send(self._boxes.frame_count)
        self._helper.receive()

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._end()

    def blocks(self) -> Iterator[Frames]:
        """Ground tracks in blocks, with the bytes of `pipeline.project_blocks`; no boxes follow.

        Yields:
            Consecutive frames of `TRACK_DTYPE`, frames without vehicles included.
        """
        boxes, ground, projector, first = self._boxes, self.ground, self._projector, 0
        try:
            self._telling.send(None)
            for last, projector.counts in self._helper:
                doubtful = projector.traffic.add(boxes.part(first, last))
                begin, (stamps, counts) = ground.row_count, ground.see(last)
                rows = ground.rows(begin, ground.row_count)
                block = with_doubts(Frames(stamps, np.append(0, np.cumsum(counts)), rows), doubtful)
                block = projector.with_bends(block)
                if doubtful.any() or projector.bent:
                    ground.put(begin, block.rows)
                first = last
                yield block
        finally:
            self.close()


def _end(helper: HelperProcess[tuple[int, ProjectionCounts]], telling: Connection) -> None:
    helper.close()
    telling.close()


def _ground_of(
    boxes: FrameSpool,
    projector: BoxProjector,
    ground: FrameSpool,
    block_rows: int,
    told: Connection,
) -> Iterator[tuple[int, ProjectionCounts]]:
    """How many frames are in `ground`, and all rows counted so far, after each block."""
    done, done_rows, whole = 0, 0, False
    while True:
        while not whole and boxes.row_count - done_rows < block_rows:
            frame_count = told.recv()
            whole = frame_count is None
            if frame_count is not None:
                boxes.see(frame_count)
        if done == len(boxes):
            return
        end = int(np.searchsorted(boxes.offset, done_rows + block_rows, side="right")) - 1
        block = boxes.part(done, max(end, done + 1))
        done, done_rows = done + len(block), done_rows + len(block.rows)
        ground.append(projector.place_block(block))
        yield done, replace(projector.counts)
