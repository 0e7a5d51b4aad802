"""Continuous mapping: schedule by data time, lasting ids, bounded memory."""

from __future__ import annotations

import numpy as np
import pytest
from made_lane_traffic import Stream, straight, traffic

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import UNKNOWN_CLASS, Frames
from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator
from geoorbit_ros.lanes.estimators.curvilinear.evidence import Evidence
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.parameters import LaneParameters

LANE_M = 3.6


def maps_of(frames: Frames, period_s: float = 5.0) -> list[LaneMap]:
    mapper = LaneMapper(make_estimator("curvilinear"), update_period_s=period_s)
    maps = [mapper.add(int(t), frames.frame(k)) for k, t in enumerate(frames.stamp_ns)]
    return [m for m in maps if m is not None] + [mapper.finish()]


def test_one_map_per_period_of_data_time() -> None:
    frames = traffic([Stream(straight(), 12)], duration_s=60.0)
    maps = maps_of(frames, 10.0)
    stamps = np.array([m.stamp_ns for m in maps[:-1]])
    span_s = (frames.stamp_ns[-1] - frames.stamp_ns[0]) * 1e-9
    assert len(stamps) == int(span_s // 10.0)
    assert np.all(np.diff(stamps) > 0)


def test_tracks_of_unknown_class_are_vehicles() -> None:
    frames = traffic([Stream(straight(), 12)], duration_s=60.0)
    known = maps_of(frames)[-1]
    frames.rows["class_id"] = UNKNOWN_CLASS
    unknown = maps_of(frames)[-1]
    assert len(known.lanes) == len(unknown.lanes) == 1
    assert np.array_equal(known.lanes[0].centerline_m, unknown.lanes[0].centerline_m)


def test_lanes_keep_their_ids_while_others_appear() -> None:
    streams = [Stream(straight(0.2, k * LANE_M), 14) for k in range(2)]
    early = traffic(streams, duration_s=30.0)
    late = traffic([*streams, Stream(straight(0.2, -LANE_M), 12)], duration_s=60.0, seed=4)
    mapper = LaneMapper(CurvilinearEstimator())
    place_of_id: dict[int, float] = {}
    offset_ns = int(early.stamp_ns[-1]) + 5_000_000_000
    for start_ns, frames, base in ((0, early, 0), (offset_ns, late, 1000)):
        for k, stamp_ns in enumerate(frames.stamp_ns):
            rows = frames.frame(k).copy()
            rows["track_id"] += base
            renewed = mapper.add(start_ns + int(stamp_ns), rows)
            for lane in renewed.lanes if renewed else ():
                x, y, _ = lane.middle
                place = y * np.cos(0.2) - x * np.sin(0.2)
                assert abs(place_of_id.setdefault(lane.lane_id, place) - place) < 1.0
    final = mapper.finish()
    assert len(final.confirmed) == 3
    assert len({lane.lane_id for lane in final.lanes}) == len(final.lanes)


def test_same_frames_give_the_same_bits() -> None:
    frames = traffic([Stream(straight(1.0, k * LANE_M), 10) for k in range(3)])
    first, second = maps_of(frames)[-1], maps_of(frames)[-1]
    for a, b in zip(first.lanes, second.lanes, strict=True):
        assert (a.lane_id, a.centerline_m.tobytes()) == (b.lane_id, b.centerline_m.tobytes())


def test_memory_is_bounded_and_the_newest_traffic_stays() -> None:
    evidence = Evidence(max_segments=20)
    frames = traffic([Stream(straight(), 30)], duration_s=60.0)
    for lap in range(5):
        for k, stamp_ns in enumerate(frames.stamp_ns):
            rows = frames.frame(k).copy()
            rows["track_id"] += 1000 * lap
            evidence.add(lap * 80_000_000_000 + int(stamp_ns), rows)
        segments, weight = evidence.segments()
        assert len(segments) <= 20 + 5
        assert segments.time_s.max() > 80.0 * lap
        assert np.all((weight > 0.0) & (weight <= 1.0))


def test_old_evidence_decays() -> None:
    evidence = Evidence(half_life_s=100.0)
    frames = traffic([Stream(straight(), 5)], duration_s=30.0)
    for k, stamp_ns in enumerate(frames.stamp_ns):
        evidence.add(int(stamp_ns), frames.frame(k))
    evidence.add(int(frames.stamp_ns[-1]) + 200_000_000_000, frames.frame(0)[:0])
    segments, weight = evidence.segments()
    assert len(segments) == 5
    assert np.all(weight <= 0.27)


@pytest.mark.parametrize("period_s", [0.0, -1.0, float("nan")])
def test_a_period_that_is_not_positive_is_refused(period_s: float) -> None:
    with pytest.raises(ParameterError, match="update_period_s"):
        LaneMapper(CurvilinearEstimator(), update_period_s=period_s)


def test_unknown_estimator_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ParameterError, match="curvilinear or geolane"):
        make_estimator("hough")


def test_parameters_outside_their_bounds_are_refused() -> None:
    with pytest.raises(ParameterError, match="smoothing"):
        LaneParameters(smoothing=0.5)
