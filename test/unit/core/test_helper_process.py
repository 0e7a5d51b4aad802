"""A second process sends what it has; its errors come back, and nothing of it is left."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator

import numpy as np
import pytest

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.frame_spool import FrameSpool
from geoorbit_ros.core.helper_process import HelperError, HelperProcess
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames, one_frame


def numbers(last: int) -> Iterator[tuple[int, int]]:
    for k in range(last):
        yield os.getpid(), k


def fails_after(count: int, error: Exception) -> Iterator[int]:
    yield from range(count)
    raise error


def interrupts_itself() -> Iterator[int]:
    os.kill(os.getpid(), signal.SIGINT)
    yield 1


def dies() -> Iterator[int]:
    yield 1
    os.kill(os.getpid(), signal.SIGKILL)


def doubles(spool: FrameSpool, out: FrameSpool) -> Iterator[int]:
    done = 0
    for block in spool.blocks(3):
        rows = block.rows.copy()
        rows["x"] *= 2.0
        out.put(done, rows)
        done += len(rows)
        yield len(rows)


def test_items_come_in_order_from_another_process() -> None:
    with HelperProcess(numbers, 50) as helper:
        found = list(helper)
    assert [k for _, k in found] == list(range(50))
    assert os.getpid() not in {pid for pid, _ in found}
    assert not multiprocessing.active_children()


def test_an_error_comes_back_with_its_sentence_after_what_came_before_it() -> None:
    wrong = InputFileError("day.csv", "a full disk", "room")
    seen: list[int] = []
    with (
        pytest.raises(InputFileError, match=f"^{wrong}$") as caught,
        HelperProcess(fails_after, 3, wrong) as helper,
    ):
        seen.extend(helper)
    assert seen == [0, 1, 2]
    assert caught.value.place == "day.csv"
    assert not multiprocessing.active_children()


def test_a_defect_comes_back_with_its_traceback() -> None:
    with (
        pytest.raises(ZeroDivisionError) as caught,
        HelperProcess(fails_after, 0, ZeroDivisionError("x")) as helper,
    ):
        list(helper)
    assert "in fails_after" in "".join(caught.value.__notes__)


def test_a_process_that_is_killed_is_told_in_a_sentence() -> None:
    with pytest.raises(HelperError, match="exit code -9"), HelperProcess(dies) as helper:
        assert list(helper) == [1]


def test_leaving_early_ends_the_process() -> None:
    def interrupted() -> None:
        with HelperProcess(numbers, 10**9) as helper:
            assert next(iter(helper))
            assert len(multiprocessing.active_children()) == 1
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not multiprocessing.active_children()


def test_an_interruption_is_not_for_the_helper() -> None:
    with HelperProcess(interrupts_itself) as helper:
        assert list(helper) == [1]


def test_both_processes_read_and_write_a_spool() -> None:
    parts = []
    for k in range(10):
        rows = np.zeros(k % 4, TRACK_DTYPE)
        rows["x"] = k + np.arange(len(rows)) / 10
        parts.append(one_frame(1000 + k, rows))
    spool, out = FrameSpool.of(parts, TRACK_DTYPE), FrameSpool(TRACK_DTYPE)
    with HelperProcess(doubles, spool, out) as helper:
        assert sum(helper) == spool.row_count == 13
    out.announce(spool.stamp_ns, np.diff(spool.offset))
    assert (out.part(0, 10).rows["x"] == 2.0 * spool.part(0, 10).rows["x"]).all()


def test_a_spool_gives_back_what_was_put() -> None:
    random = np.random.default_rng(1)
    counts = random.integers(0, 5, 40)
    rows = np.zeros(counts.sum(), TRACK_DTYPE)
    rows["y"] = random.random(len(rows))
    whole = Frames(np.arange(40) * 7, np.append(0, np.cumsum(counts)), rows)
    spool = FrameSpool.of(whole.blocks(11), TRACK_DTYPE)
    assert len(spool) == 40
    for size in (1, 6, 1000):
        for a, b in zip(spool.blocks(size), whole.blocks(size), strict=True):
            assert a.rows.tobytes() == b.rows.tobytes()
            assert a.stamp_ns.tolist() == b.stamp_ns.tolist()
            assert a.offset.tolist() == b.offset.tolist()
    assert spool.between(14, 35).stamp_ns.tolist() == [14, 21, 28, 35]
    assert len(spool.between(15, 20)) == 0


def test_a_full_disk_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(InputFileError, match=r"No space left.*TMPDIR"):
        FrameSpool.of([one_frame(1, np.zeros(2, TRACK_DTYPE))], TRACK_DTYPE)
