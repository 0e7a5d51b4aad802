"""Intervals on local clocks, and the time that a camera watched."""

from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames, join_frames
from geoorbit_ros.traffic.interval_clock import NS, IntervalClock, ObservedTime, usual_gap_s

LENGTHS = (1, 30, 300, 900, 3600, 7200, 21600, 86400)
BERLIN, ADELAIDE, LORD_HOWE = "Europe/Berlin", "Australia/Adelaide", "Australia/Lord_Howe"
CHANGES = [
    (BERLIN, "2026-03-29", "2026-10-25"),
    (ADELAIDE, "2026-10-04", "2026-04-05"),
    (LORD_HOWE, "2026-10-04", "2026-04-05"),
]


def stamp(text: str, zone: str) -> int:
    return int(datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(zone)).timestamp()) * NS


@pytest.mark.parametrize(("zone", "spring", "autumn"), CHANGES)
@pytest.mark.parametrize("length_s", LENGTHS)
def test_intervals_follow_one_another_over_the_days_on_which_clocks_change(
    zone: str, spring: str, autumn: str, length_s: int
) -> None:
    clock = IntervalClock(length_s, zone)
    for day in (spring, autumn, "2026-06-15"):
        noon = stamp(f"{day}T12:00", zone)
        begin, end = noon - 13 * 3600 * NS, noon + 13 * 3600 * NS
        if length_s == 1:
            begin, end = noon - 11 * 3600 * NS, noon - 8 * 3600 * NS
        edges = clock.edges(begin, end)
        assert edges[0] <= begin < edges[1]
        assert edges[-2] <= end < edges[-1]
        lengths = np.diff(edges) / NS
        assert (lengths > 0).all()
        assert len(set(clock.text(int(edge)) for edge in edges)) == len(edges)
        if day == "2026-06-15":
            assert (lengths == length_s).all()
        for edge in edges[:-1:7].tolist():
            assert clock.start_of(edge) == edge, clock.text(edge)
            assert clock.start_of(edge + NS // 2) == edge


@pytest.mark.parametrize(("zone", "spring", "autumn"), CHANGES[:2])
def test_a_day_of_quarters_has_23_or_25_hours_when_clocks_change(
    zone: str, spring: str, autumn: str
) -> None:
    for day, hours in ((spring, 23), (autumn, 25), ("2026-06-15", 24)):
        first = stamp(f"{day}T00:00", zone)
        day_clock, quarters = IntervalClock(86_400, zone), IntervalClock(900, zone)
        assert day_clock.end_of(first) - first == hours * 3600 * NS
        assert len(quarters.edges(first, day_clock.end_of(first) - 1)) - 1 == 4 * hours


def test_intervals_begin_on_the_local_clock_not_on_that_of_utc() -> None:
    clock = IntervalClock(3600, "Asia/Kolkata")  # UTC+5:30
    edge = clock.start_of(stamp("2026-05-01T08:10", "Asia/Kolkata"))
    assert clock.text(edge) == "2026-05-01T08:00:00+05:30"


def test_recordings_that_count_from_their_beginning_have_intervals_from_zero() -> None:
    clock = IntervalClock(900, BERLIN)
    assert clock.edges(12 * NS, 1000 * NS).tolist() == [0, 900 * NS, 1800 * NS]
    assert clock.text(900 * NS) == "900"


@pytest.mark.parametrize("length_s", [0, -5, 7, 25 * 3600, 86_401])
def test_lengths_that_do_not_divide_a_day_are_refused(length_s: int) -> None:
    with pytest.raises(ParameterError, match="divides a day"):
        IntervalClock(length_s)


def test_a_pause_between_frames_was_not_watched() -> None:
    observed = ObservedTime()
    stamps = np.concatenate((np.arange(0, 100), np.arange(300, 600))) * (NS // 10)
    observed.add(stamps)
    edges = np.array([0, 10, 20, 30, 70]) * NS
    assert observed.seconds(edges) == pytest.approx([9.9, 0.0, 0.0, 29.9])
    assert observed.watched(
        np.array([1, 5, 31, 31]) * NS, np.array([9, 31, 59, 80]) * NS
    ).tolist() == [True, False, True, False]


@pytest.mark.parametrize("step", [1, 7, 50])
def test_watched_time_is_the_same_however_frames_come_in(step: int) -> None:
    random = np.random.default_rng(3)
    stamps = np.cumsum(random.choice([NS // 10, 5 * NS], 300, p=[0.95, 0.05]))
    whole, parts = ObservedTime(), ObservedTime()
    whole.add(stamps)
    for k in range(0, len(stamps), step):
        parts.add(stamps[k : k + step])
    assert whole.spans_ns == parts.spans_ns


def made_up(arrivals_s: np.ndarray, empty: bool) -> Frames:
    """Each vehicle is seen for two seconds, ten times a second; `empty`: frames without any too."""
    tables = dict[int, list[int]]()
    for vehicle, arrival in enumerate(arrivals_s.tolist()):
        for k in range(20):
            tables.setdefault(round(10 * arrival) + k, []).append(vehicle)
    if empty:
        tables = {k: tables.get(k, []) for k in range(max(tables) + 1)}
    frames = []
    for k in sorted(tables):
        rows = np.zeros(len(tables[k]), TRACK_DTYPE)
        rows["track_id"] = tables[k]
        frames.append((k * NS // 10, rows))
    return join_frames(frames, TRACK_DTYPE)


@pytest.mark.parametrize("headway_s", [3.0, 12.0, 60.0])
def test_in_a_file_of_vehicles_alone_an_empty_road_is_no_outage(headway_s: float) -> None:
    arrivals = np.cumsum(np.random.default_rng(0).exponential(headway_s, 400))
    assert usual_gap_s(made_up(arrivals, empty=True)) == 2.0
    frames = made_up(arrivals, empty=False)
    assert np.diff(frames.stamp_ns).max() / NS < usual_gap_s(frames)


@pytest.mark.parametrize(("outages", "length_s"), [(1, 60.0), (6, 540.0), (40, 300.0)])
def test_outages_are_outages_however_many_there_are(outages: int, length_s: float) -> None:
    arrivals = np.cumsum(np.random.default_rng(1).exponential(1.5, 1200))
    for k in range(outages):
        after = arrivals > arrivals[(k + 1) * 1200 // (outages + 1)]
        arrivals[after] += length_s
    frames = made_up(arrivals, empty=False)
    usual = usual_gap_s(frames)
    assert usual < length_s
    observed = ObservedTime(usual)
    observed.add(frames.stamp_ns)
    assert len(observed.spans_ns) == outages + 1
