import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.core.frame_order import LEAP_NS, Arrival, FrameOrder, capture_times
from geoorbit_ros.core.input_report import InputReport

FRAME_NS = 33_333_333


def fed(
    stamps: list[int], restart_jump_s: float = 1.0
) -> tuple[FrameOrder[None], list[tuple[Arrival, int]]]:
    order = FrameOrder[None](restart_jump_s)
    return order, [found[:2] for stamp in stamps for found in order.take(stamp, None)]


@given(st.lists(st.integers(0, 10**12), max_size=60))
def test_frames_that_pass_increase_except_at_a_restart(stamps: list[int]) -> None:
    _, arrivals = fed(stamps)
    assert [stamp for _, stamp in arrivals] in (stamps, stamps[:-1])  # at most one waits
    last = None
    for arrival, stamp in arrivals:
        if arrival is Arrival.NEXT:
            assert last is None or stamp > last
        elif arrival is Arrival.RESTART:
            assert last is not None
            assert stamp < last - 10**9
        elif arrival is Arrival.LATE:
            assert last is not None
            assert last - 10**9 <= stamp <= last
            continue
        else:
            assert last is not None
            assert not last - 10**9 <= stamp <= last + LEAP_NS
            continue
        last = stamp


@pytest.mark.parametrize("wrong", [10**18, 0, -(10**18)])
@pytest.mark.parametrize("at", [1, 40, 98])
def test_one_wrong_stamp_ends_no_sequence(wrong: int, at: int) -> None:
    stamps = [10**12 + k * FRAME_NS for k in range(100)]
    order, arrivals = fed([*stamps[:at], wrong, *stamps[at:]])
    assert [stamp for arrival, stamp in arrivals if arrival is Arrival.NEXT] == stamps
    assert [stamp for arrival, stamp in arrivals if arrival is Arrival.ODD] == [wrong]
    assert order.missing == 0


def test_wrong_stamps_among_good_ones_end_no_sequence() -> None:
    stamps = [10**12 + k * FRAME_NS for k in range(100)]
    mixed = [stamp for k, good in enumerate(stamps) for stamp in (good, 10**18 + k)]
    _, arrivals = fed(mixed)
    assert [stamp for arrival, stamp in arrivals if arrival is Arrival.NEXT] == stamps


def test_after_a_pause_nothing_is_lost_also_where_each_frame_is_one() -> None:
    stamps = [k * FRAME_NS for k in range(50)]
    stamps += [stamps[-1] + 3600 * 10**9 + k * FRAME_NS for k in range(50)]
    assert fed(stamps)[1] == [(Arrival.NEXT, stamp) for stamp in stamps]
    sparse = [k * 600 * 10**9 for k in range(9)]  # every ten minutes
    assert fed(sparse)[1] == [(Arrival.NEXT, stamp) for stamp in sparse]


def test_the_same_frame_twice_is_late() -> None:
    assert fed([5, 5])[1] == [(Arrival.NEXT, 5), (Arrival.LATE, 5)]


def test_a_stream_in_order_misses_nothing_although_it_jitters() -> None:
    jitter = np.random.default_rng(1).integers(-FRAME_NS // 6, FRAME_NS // 6, 500)
    stamps = (np.arange(500) * FRAME_NS + 10**9 + jitter).tolist()
    assert fed(stamps)[0].missing == 0


@pytest.mark.parametrize("lost", [1, 2, 7])
def test_missing_frames_are_counted(lost: int) -> None:
    stamps = [k * FRAME_NS for k in range(100) if not 60 <= k < 60 + lost]
    assert fed(stamps)[0].missing == lost


def test_every_second_frame_lost_from_some_time_on_is_counted_then_taken_for_the_rate() -> None:
    stamps = [k * FRAME_NS for k in range(300) if k < 100 or k % 2]
    assert 10 <= fed(stamps)[0].missing <= 16


def test_a_camera_that_was_off_for_an_hour_lost_no_frames() -> None:
    stamps = [k * FRAME_NS for k in range(50)]
    assert fed([*stamps, stamps[-1] + 3600 * 10**9])[0].missing == 0


def test_a_restart_is_no_gap() -> None:
    stamps = [k * FRAME_NS for k in range(100)]
    order, arrivals = fed(stamps + stamps)
    assert order.missing == 0
    assert [stamp for arrival, stamp in arrivals if arrival is Arrival.RESTART] == [0]
    assert [stamp for _, stamp in arrivals] == stamps + stamps


@pytest.mark.parametrize("wrong", [2_100_000_000 * 10**9, 5])
def test_one_wrong_stamp_of_a_recording_moves_no_other(wrong: int) -> None:
    stamps = 10**18 + np.arange(100, dtype=np.int64) * FRAME_NS
    given, report = stamps.copy(), InputReport("a.mcap", "messages", 100)
    given[40] = wrong
    times, run = capture_times(given, stamps + 10**7, report)
    assert times.tolist() == stamps.tolist()
    assert not run.any()
    assert "1 of 100 messages have a time far from those around them" in str(report.remarks)
