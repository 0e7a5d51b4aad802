"""Between two derivations of the map, new vehicles are counted into the lanes that are known."""

from __future__ import annotations

import numpy as np
from made_lane_traffic import Stream, straight, traffic

from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator
from geoorbit_ros.lanes.estimators.curvilinear.evidence import Evidence
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import TrajectorySegments
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.mapping.update_policy import CLUSTER, MORE, LaneCounter, OffLaneVehicles
from geoorbit_ros.lanes.parameters import LaneParameters

LANE_M = 3.6
MINUTE_NS = 70_000_000_000


def mapper_of(estimator: LaneEstimator) -> LaneMapper:
    """A mapper that makes a map when the test asks for one."""
    return LaneMapper(estimator, update_period_s=1e9)


def feed(mapper: LaneMapper, frames: Frames, lap: int) -> None:
    """Give one minute of traffic, as the `lap`-th minute."""
    for k, stamp_ns in enumerate(frames.stamp_ns):
        rows = frames.frame(k).copy()
        rows["track_id"] += 1000 * lap
        mapper.add(int(stamp_ns) + lap * MINUTE_NS, rows)
    # A later frame without vehicles ends all tracks.
    mapper.add(lap * MINUTE_NS + MINUTE_NS - 1, frames.frame(0)[:0])


def lane_near(lane_map: LaneMap, y_m: float) -> int:
    """Index of the lane whose middle is at `y_m`."""
    return int(np.argmin([abs(lane.middle[1] - y_m) for lane in lane_map.lanes]))


def test_new_vehicles_confirm_a_lane_without_moving_it() -> None:
    mapper = mapper_of(CurvilinearEstimator())
    busy = [Stream(straight(0.0, LANE_M * k), 40) for k in (1, 2)]
    feed(mapper, traffic([*busy, Stream(straight(0.0, 0.0), 3)]), 0)
    before = mapper.renew()
    feed(mapper, traffic([Stream(straight(0.0, 0.0), 5)], seed=2), 1)
    after = mapper.renew()
    sparse = lane_near(before, 0.0)
    assert before.lanes[sparse].status == "tentative"
    assert after.lanes[sparse].status == "confirmed"
    assert after.lanes[sparse].vehicles_missing == 0
    assert after.lanes[sparse].vehicles == np.float64(before.lanes[sparse].vehicles + 5)
    for a, b in zip(before.lanes, after.lanes, strict=True):
        assert a.lane_id == b.lane_id
        assert a.centerline_m.tobytes() == b.centerline_m.tobytes()
    assert after.stamp_ns > before.stamp_ns


def test_vehicles_where_no_lane_is_known_bring_a_new_map_at_once() -> None:
    mapper = mapper_of(CurvilinearEstimator())
    feed(mapper, traffic([Stream(straight(0.0, LANE_M * k), 40) for k in (0, 1)]), 0)
    before = mapper.renew()
    feed(mapper, traffic([Stream(straight(0.0, 3 * LANE_M), 4)], seed=2), 1)
    after = mapper.renew()
    assert len(after.lanes) == len(before.lanes) + 1


def test_counting_and_deriving_agree_on_the_vehicles() -> None:
    frames = traffic([Stream(straight(0.4, LANE_M * k), 50) for k in range(3)])
    more = traffic([Stream(straight(0.4, LANE_M * k), 4) for k in range(3)], seed=7)
    mapper = mapper_of(CurvilinearEstimator())
    feed(mapper, frames, 0)
    mapper.renew()
    feed(mapper, more, 1)
    counted = mapper.renew()
    derived = mapper.finish()
    for a, b in zip(counted.lanes, derived.lanes, strict=True):
        assert abs(a.vehicles - b.vehicles) <= 2.0


def test_other_parameters_are_obeyed_at_once() -> None:
    mapper = mapper_of(CurvilinearEstimator())
    feed(mapper, traffic([Stream(straight(), 20)]), 0)
    plain = mapper.renew()
    mapper.parameters = LaneParameters(width_scale=2.0)
    wide = mapper.renew()
    assert abs(wide.lanes[0].width_m - 2.0 * plain.lanes[0].width_m) < 1e-9


def test_geometry_stays_until_the_evidence_has_doubled() -> None:
    mapper = mapper_of(CurvilinearEstimator())
    first = mapper.finish()
    assert first.lanes == ()
    lines = []
    for lap, vehicles in enumerate((20, 8, 14)):
        streams = [Stream(straight(0.0, LANE_M * k), vehicles) for k in (0, 1)]
        feed(mapper, traffic(streams, seed=lap), lap)
        lines.append([x.centerline_m.tobytes() for x in mapper.renew().lanes])
    assert lines[1] == lines[0]
    assert lines[2] != lines[1]


def segments_at(y_m: float, count: int) -> TrajectorySegments:
    """So many vehicles along one line, after each other."""
    evidence = Evidence()
    frames = traffic([Stream(straight(0.0, y_m), count, wander_m=0.0)], noise_m=0.01)
    for k, stamp_ns in enumerate(frames.stamp_ns):
        evidence.add(int(stamp_ns), frames.frame(k))
    evidence.add(int(frames.stamp_ns[-1]) + 10_000_000_000, frames.frame(0)[:0])
    return evidence.segments()[0]


def test_off_lane_vehicles_are_news_when_several_take_the_same_way() -> None:
    off_lane = OffLaneVehicles()
    ways = [segments_at(20.0 * k, 1) for k in range(5)]
    assert not any(off_lane.add(way, np.arange(len(way.xy))) for way in ways)
    again = [off_lane.add(ways[0], np.arange(len(ways[0].xy))) for _ in range(CLUSTER - 1)]
    assert again == [False] * (CLUSTER - 2) + [True]


def test_off_lane_vehicles_that_made_no_lane_are_news_when_many_more_come() -> None:
    off_lane = OffLaneVehicles()
    way = segments_at(0.0, 1)
    news = []
    for _ in range(CLUSTER * MORE):
        news.append(off_lane.add(way, np.arange(len(way.xy))))
        if news[-1]:
            off_lane.derived()
    assert [k + 1 for k, new in enumerate(news) if new] == [CLUSTER, CLUSTER * MORE]


def test_vehicles_in_known_lanes_are_counted_and_none_is_off_lane() -> None:
    mapper = mapper_of(CurvilinearEstimator())
    feed(mapper, traffic([Stream(straight(0.0, LANE_M * k), 20) for k in (0, 1)]), 0)
    counter = LaneCounter(mapper.finish().lanes)
    known, unknown = segments_at(0.0, 4), segments_at(12.0, 2)
    assert len(counter.add(known)) == 0
    assert sorted(counter.vehicles.tolist()) == [0, 4]
    assert len(counter.add(unknown)) == len(unknown.xy)
    assert sorted(counter.vehicles.tolist()) == [0, 4]
