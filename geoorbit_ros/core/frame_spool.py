"""Frames of a long recording in a temporary file: a camera's day doesn't fit into memory.

The file has no name in its folder from the beginning, so that nothing is left of it however the
program ends. Its index, 16 bytes a frame, is in memory, and in a second file for other processes.
"""

from __future__ import annotations

import mmap
import multiprocessing.context
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.reduction import DupFd
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.tables import Frames, bounds_of_blocks

SPOOLED_ROWS = 1_000_000
"""Recordings of more rows are kept in a file, and two processes work on them. Chosen: an hour of a
quiet road takes five seconds; with fewer rows the start of a process costs more than it saves, with
more they take memory."""


FIRST_FRAMES = 4096
"""Room for so many frames in the index from the beginning."""
_INDEX = np.dtype([("stamp_ns", "<i8"), ("count", "<i8")])


class FrameSpool:
    """Frames on disk, of rows of one dtype; what is asked for is read.

    A process that is started with a spool among its arguments reads and writes the same files. What
    one of them appends the other one sees when it is told how many frames there are (`see`).

    Args:
        dtype: Of the rows.

    Attributes:
        row_count: How many rows there are.
        frame_count: How many frames.

    Raises:
        InputFileError: By every method, when the folder for temporary files has no room.
    """

    def __init__(self, dtype: np.dtype[np.void]) -> None:
        self.dtype = dtype
        with _told():
            self._file = tempfile.TemporaryFile(prefix="geoorbit-", buffering=0)  # noqa: SIM115
            self._index_file = tempfile.TemporaryFile(  # noqa: SIM115
                prefix="geoorbit-", buffering=0
            )
        # They double when they are full: arrays of every size would leave holes in memory.
        self._stamp_ns = np.zeros(FIRST_FRAMES, np.int64)
        self._offset = np.zeros(FIRST_FRAMES + 1, np.int64)
        self.row_count = self.frame_count = 0

    @classmethod
    def of(cls, blocks: Iterable[Frames], dtype: np.dtype[np.void]) -> Self:
        """A spool of frames in time order."""
        spool = cls(dtype)
        for frames in blocks:
            spool.append(frames)
        return spool

    def append(self, frames: Frames) -> None:
        """Take frames that are later than those before."""
        self.put(self.row_count, frames.rows)
        self.announce(frames.stamp_ns, np.diff(frames.offset))

    def put(self, first_row: int, rows: NDArray[np.void]) -> None:
        """Write rows at their place; `announce` says to which frames they belong."""
        _write(self._file.fileno(), np.ascontiguousarray(rows, self.dtype), first_row)

    def announce(self, stamp_ns: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Say which frames the next rows belong to.

        Args:
            stamp_ns: (F,) capture times, later than those before.
            counts: (F,) rows of each frame.
        """
        index = np.empty(len(stamp_ns), _INDEX)
        index["stamp_ns"], index["count"] = stamp_ns, counts
        _write(self._index_file.fileno(), index, self.frame_count)
        self._know(stamp_ns, counts)

    def see(self, frame_count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Know of frames that another process appended.

        Args:
            frame_count: So many frames there are.

        Returns:
            Stamps and counts of rows, of those that were not known.
        """
        index = np.empty(frame_count - self.frame_count, _INDEX)
        _read(self._index_file.fileno(), index, self.frame_count)
        new = index["stamp_ns"].copy(), index["count"].copy()
        self._know(*new)
        return new

    def _know(self, stamp_ns: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        before, after = self.frame_count, self.frame_count + len(stamp_ns)
        while after > len(self._stamp_ns):
            self._stamp_ns = np.concatenate((self._stamp_ns, np.zeros_like(self._stamp_ns)))
            self._offset = np.concatenate((self._offset, np.zeros_like(self._offset[1:])))
        self._stamp_ns[before:after] = stamp_ns
        np.cumsum(counts, out=self._offset[before + 1 : after + 1])
        self._offset[before + 1 : after + 1] += self.row_count
        self.row_count, self.frame_count = int(self._offset[after]), after

    def __len__(self) -> int:
        return self.frame_count

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """(F,) see `Frames`."""
        return self._stamp_ns[: self.frame_count]

    @property
    def offset(self) -> NDArray[np.int64]:
        """(F + 1,) see `Frames`."""
        return self._offset[: self.frame_count + 1]

    def rows(self, first_row: int, last_row: int) -> NDArray[np.void]:
        """Rows `first_row` to `last_row` - 1."""
        size = (last_row - first_row) * self.dtype.itemsize
        # Pages of their own: in the heap, block after block leaves holes that nothing fits into.
        room = mmap.mmap(-1, max(size, 1))
        rows = np.frombuffer(room, self.dtype, last_row - first_row)
        _read(self._file.fileno(), rows, first_row)
        return rows

    def part(self, first: int, last: int) -> Frames:
        """Frames `first` to `last` - 1."""
        stamp_ns, offset = self.stamp_ns, self.offset
        begin, end = int(offset[first]), int(offset[last])
        rows = self.rows(begin, end)
        return Frames(stamp_ns[first:last], offset[first : last + 1] - begin, rows)

    def blocks(self, rows: int) -> Iterator[Frames]:
        """See `Frames.blocks`."""
        for first, last in bounds_of_blocks(self.offset, rows):
            yield self.part(first, last)

    def between(self, first_ns: int, last_ns: int) -> Frames:
        """Frames from one stamp to another, both included."""
        first = int(np.searchsorted(self.stamp_ns, first_ns))
        last = int(np.searchsorted(self.stamp_ns, last_ns, side="right"))
        return self.part(first, max(first, last))

    def close(self) -> None:
        """Give the room back."""
        self._file.close()
        self._index_file.close()

    def __getstate__(self) -> dict[str, Any]:
        if multiprocessing.context.get_spawning_popen() is None:
            raise TypeError("a spool goes to a process only as it is started")
        files = {name: DupFd(getattr(self, name).fileno()) for name in _FILES}
        return self.__dict__ | files

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for name in _FILES:
            setattr(self, name, os.fdopen(state[name].detach(), "r+b", buffering=0))


_FILES = "_file", "_index_file"


def _write(file: int, rows: NDArray[np.void], first: int) -> None:
    """Put rows at their place in a file of such rows."""
    left, at = rows.view(np.uint8).data, first * rows.dtype.itemsize
    with _told():
        while left:
            written = os.pwrite(file, left, at)
            left, at = left[written:], at + written


def _read(file: int, rows: NDArray[np.void], first: int) -> None:
    """Fill `rows` with those from `first` on."""
    left, at = rows.view(np.uint8).data, first * rows.dtype.itemsize
    while left:
        read = os.preadv(file, [left], at)
        if not read:
            raise InputFileError("temporary file", "its end", "all rows that were put into it")
        left, at = left[read:], at + read


AnyFrames = Frames | FrameSpool
"""Of a recording, in memory or in a file."""


@contextmanager
def _told() -> Iterator[None]:
    """A full disk is a sentence that says which one, and how to take another."""
    try:
        yield
    except OSError as error:
        place = os.environ.get("TMPDIR") or "folder for temporary files"
        expected = "room for temporary files; the variable TMPDIR names another folder"
        raise InputFileError(place, error.strerror or str(error), expected) from None
