"""Live traffic is the offline one: the same intervals from frames as they come, each once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from made_traffic_days import (
    CLOCK,
    LANES,
    MOVED,
    NS,
    SCHEME,
    SUMMER_ENDS_NS,
    blocks,
    day,
    lane,
    offline,
    without,
)
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import TRACK_DTYPE, Frames
from geoorbit_ros.traffic.interval_clock import IntervalClock
from geoorbit_ros.traffic.lane_maps import StampedLanes, same_lanes
from geoorbit_ros.traffic.live import LEAD_NS, Finished, LiveTraffic, Resume
from geoorbit_ros.traffic.packed import (
    pack_measures,
    pack_passages,
    unpack_measures,
    unpack_passages,
)
from geoorbit_ros.traffic.records import last_seen
from geoorbit_ros.traffic.tables import interval_table, vehicle_table
from geoorbit_ros.traffic.track_links import LONGEST_NS, cut_ns


def fixed(lanes: Sequence[Lane]) -> LiveTraffic:
    return LiveTraffic(SCHEME, CLOCK, lambda _: StampedLanes(0, lanes))


def run(live: LiveTraffic, parts: Iterator[Frames]) -> list[Finished]:
    found = []
    for part in parts:
        live.add(part)
        found.extend(live.finished())
    return found


def joined(found: list[Finished]) -> tuple[NDArray[np.void], NDArray[np.void]]:
    return (
        np.concatenate([f.measures for f in found]),
        np.concatenate([f.passages for f in found]),
    )


def assert_same_bytes(found: list[Finished], frames: Frames) -> None:
    """All intervals but the last ones, which are still open, and their vehicles."""
    recorded, expected = offline(frames)
    measures, passages = joined(found)
    edges = np.concatenate([found[0].edges_ns[:1], *(f.edges_ns[1:] for f in found)])
    assert (edges[1:] > edges[:-1]).all()
    assert edges[0] == CLOCK.start_of(int(frames.stamp_ns[0]))
    assert edges[-1] >= frames.stamp_ns[-1] - 90 * NS
    expected = expected[expected["start_ns"] < edges[-1]]
    assert measures.tobytes() == expected.tobytes()
    wanted = recorded.passages
    wanted = wanted[last_seen(wanted) < edges[-1]]
    assert passages.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("seed", range(4))
def test_live_is_offline_however_frames_come(seed: int) -> None:
    frames = day(SUMMER_ENDS_NS - 5 * 60 * NS + 17 * NS, 10, seed)
    assert_same_bytes(run(fixed(LANES), blocks(frames, seed)), frames)


def test_an_outage_leaves_intervals_that_say_so() -> None:
    frames = day(SUMMER_ENDS_NS, 12)
    frames = without(frames, SUMMER_ENDS_NS + 100 * NS, SUMMER_ENDS_NS + 400 * NS)
    found = run(fixed(LANES), blocks(frames, 1))
    assert_same_bytes(found, frames)
    measures, _ = joined(found)
    starts, first = np.unique(measures["start_ns"], return_index=True)
    observed = measures["observed"][first]
    assert (np.diff(starts) == 60 * NS).all()
    assert (observed[2:6] == 0.0).all()
    assert observed[1] == pytest.approx(40 / 60, abs=0.02)
    assert np.isnan(measures["flow_veh_per_h"][measures["observed"] == 0.0]).all()


def test_hours_that_come_twice_have_their_intervals_twice() -> None:
    clock = IntervalClock(1800, "Europe/Berlin")
    frames = day(SUMMER_ENDS_NS - 1800 * NS, 100, vehicles=1)
    live = LiveTraffic(SCHEME, clock, lambda _: StampedLanes(0, LANES))
    measures, _ = joined(run(live, blocks(frames, 3)))
    texts = [clock.text(int(s)) for s in np.unique(measures["start_ns"])]
    assert texts == [
        "2026-10-25T02:30:00+02:00",
        "2026-10-25T02:00:00+01:00",
        "2026-10-25T02:30:00+01:00",
    ]


@pytest.mark.parametrize("stopped_at", [0.3, 0.52, 0.97])
def test_a_counter_that_was_stopped_goes_on_with_the_same_bytes(stopped_at: float) -> None:
    frames = day(SUMMER_ENDS_NS, 80, vehicles=4)
    stop = int(stopped_at * len(frames))
    before = run(fixed(LANES), blocks(frames.part(0, stop), 1))
    from_ns = int(before[-1].edges_ns[-1])
    _, passages = joined(before)
    known = unpack_passages(pack_passages(passages))
    resume = Resume(from_ns, int(known["vehicle_id"].max()), known)
    begin = int(np.searchsorted(frames.stamp_ns, from_ns - LEAD_NS))
    live = LiveTraffic(SCHEME, CLOCK, lambda _: StampedLanes(0, LANES), resume=resume)
    after = run(live, blocks(frames.part(begin, len(frames)), 2))
    assert int(after[0].edges_ns[0]) == from_ns
    assert_same_bytes(before + after, frames)
    told = live.gone().passages
    assert (last_seen(told) >= from_ns).all()


def test_a_parked_vehicle_holds_intervals_back_for_half_an_hour_at_most() -> None:
    """And they are still those of the offline way."""
    frames = day(SUMMER_ENDS_NS, 50, vehicles=2)
    rows, counts = [], np.diff(frames.offset)
    parked = np.zeros(1, TRACK_DTYPE)
    parked["x"], parked["track_id"], parked["class_id"], parked["sigma"] = 40.0, 999_999, 2, 0.1
    for k in range(len(frames)):
        rows += [frames.frame(k), parked]
    offset = np.append(0, np.cumsum(counts + 1)).astype(np.int64)
    frames = Frames(frames.stamp_ns, offset, np.concatenate(rows))
    live, ends = fixed(LANES), []
    found = []
    for part in blocks(frames, 5):
        live.add(part)
        found.extend(live.finished())
        if found and live.newest_ns is not None:
            ends.append(live.newest_ns - int(found[-1].edges_ns[-1]))
    assert max(ends) < 30 * 60 * NS
    recorded, expected = offline(frames)
    measures, _ = joined(found)
    last_ns = int(found[-1].edges_ns[-1])
    assert measures.tobytes() == expected[expected["start_ns"] < last_ns].tobytes()
    assert recorded.vehicles - recorded.in_no_lane == 2 * 2 * 50


@pytest.mark.parametrize("stands_at_m", [30.0, 58.0, 62.0, 90.0])
def test_who_stands_for_long_crosses_the_line_once(stands_at_m: float) -> None:
    """Its path is cut, as nothing tells it from a parked vehicle; its crossing is one."""
    time_s = np.arange(0.0, 2000.0, 0.1)
    x = np.minimum(10.0 * time_s, stands_at_m)
    x = np.maximum(x, 10.0 * (time_s - 1900.0))
    kept = x < 120.0
    rows = np.zeros(int(kept.sum()), TRACK_DTYPE)
    noise = np.random.default_rng(0).normal(0.0, 0.1, (2, len(rows)))
    rows["x"], rows["y"] = x[kept] + noise[0], noise[1]
    rows["track_id"], rows["class_id"], rows["sigma"], rows["score"] = 1, 2, 0.1, 0.9
    stamps = SUMMER_ENDS_NS + np.round(time_s[kept] * 1e9).astype(np.int64)
    frames = Frames(stamps, np.arange(len(rows) + 1), rows)
    recorded, _ = offline(frames)
    assert len(recorded.crossings) == 1
    assert recorded.vehicles > 1
    assert (recorded.passages["lane_id"] == 3).all()


def test_paths_are_cut_at_the_same_times_wherever_one_begins_to_read() -> None:
    for begin_ns in np.random.default_rng(0).integers(0, 10**15, 200).tolist():
        at_ns = cut_ns(begin_ns)
        assert at_ns % LONGEST_NS == 0
        assert LONGEST_NS // 2 <= at_ns - begin_ns <= 3 * LONGEST_NS // 2
        assert cut_ns(at_ns + 9 * NS) == at_ns + LONGEST_NS


def test_a_map_counts_from_the_next_interval_on() -> None:
    begin_ns = SUMMER_ENDS_NS
    change_ns = begin_ns + 150 * NS  # within the third minute

    def lanes_at(stamp_ns: int) -> StampedLanes:
        if stamp_ns < change_ns:
            return StampedLanes(begin_ns, LANES)
        return StampedLanes(change_ns, MOVED)

    frames = day(begin_ns, 6)
    results = []
    for seed in range(2):
        live = LiveTraffic(SCHEME, CLOCK, lanes_at)
        results.append(run(live, blocks(frames, seed)))
        for found in results[-1]:
            wanted = LANES if found.edges_ns[0] < begin_ns + 180 * NS else MOVED
            assert {x.lane_id for x in found.lanes.lanes} == {x.lane_id for x in wanted}
    assert joined(results[0])[0].tobytes() == joined(results[1])[0].tobytes()
    measures, _ = joined(results[0])
    totals = measures[(measures["lane_id"] == 0) & (measures["category"] == -1)]
    assert totals["volume"].sum() == pytest.approx(16 * len(totals), abs=8)


def test_a_map_that_is_nearly_the_same_changes_nothing() -> None:
    assert same_lanes(LANES, [lane(3, 0.1), lane(5, 3.6)])
    assert not same_lanes(LANES, MOVED)
    assert not same_lanes(LANES, LANES[:1])
    assert not same_lanes(LANES, [lane(3, 0.4), lane(5, 3.5)])
    frames = day(SUMMER_ENDS_NS, 5)
    at = iter(range(1, 100))
    live = LiveTraffic(SCHEME, CLOCK, lambda t: StampedLanes(t - next(at), LANES))
    found = run(live, blocks(frames, 0))
    assert len({f.lanes.map_ns for f in found}) == 1
    assert_same_bytes(found, frames)


def test_frames_wait_for_the_first_map() -> None:
    frames = day(SUMMER_ENDS_NS, 5)
    known: list[StampedLanes] = []
    live = LiveTraffic(SCHEME, CLOCK, lambda _: known[0] if known else None)
    found = []
    for k, part in enumerate(blocks(frames, 0)):
        if k == 4:
            known.append(StampedLanes(0, LANES))
        live.add(part)
        found.extend(live.finished())
    assert_same_bytes(found, frames)


def test_a_map_that_comes_after_all_frames_counts_them() -> None:
    frames = day(SUMMER_ENDS_NS, 3)
    known: list[StampedLanes] = []
    live = LiveTraffic(SCHEME, CLOCK, lambda _: known[0] if known else None)
    assert run(live, blocks(frames, 0)) == []
    known.append(StampedLanes(0, LANES))
    live.start()
    assert_same_bytes(live.finished(), frames)


def test_what_is_packed_gives_the_same_tables() -> None:
    recorded, measures = offline(day(SUMMER_ENDS_NS, 5))
    again = unpack_measures(pack_measures(measures))
    assert interval_table(again, SCHEME, CLOCK).equals(interval_table(measures, SCHEME, CLOCK))
    passages = unpack_passages(pack_passages(recorded.passages))
    assert vehicle_table(passages, SCHEME).equals(vehicle_table(recorded.passages, SCHEME))
