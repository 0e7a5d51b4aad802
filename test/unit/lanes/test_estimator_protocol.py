"""The mapper gives an estimator's lanes ids that last, keeps them confirmed, and remembers them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_lane_traffic import Stream, straight, traffic
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, LaneMap, Status
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.confidence import KEEP_CONFIRMED
from geoorbit_ros.lanes.estimators.curvilinear.estimator import CurvilinearEstimator
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator, make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper, derive_once
from geoorbit_ros.lanes.parameters import LaneParameters

LANE_M = 3.6
THREE_LANES = [Stream(straight(0.0, LANE_M * k), 30) for k in range(3)]


class WithoutTheMiddle(CurvilinearEstimator):
    """Leaves out lanes between y = 2 m and y = 5 m."""

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        found = super().lanes(parameters)
        kept = tuple(lane for lane in found.lanes if not 2.0 < lane.middle[1] < 5.0)
        return replace(found, lanes=kept)


class Minimal:
    """Two methods: one straight lane per whole y that vehicles drive on, in changing order."""

    def __init__(self) -> None:
        self.stamp_ns, self.asked, self.confidence = 0, 0, 0.9
        self.places_m: set[int] = set()

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        self.stamp_ns = stamp_ns
        self.places_m |= set(np.rint(rows["y"]).astype(int).tolist())

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        self.asked += 1
        places = sorted(self.places_m, reverse=self.asked % 2 == 0)
        return LaneMap(self.stamp_ns, tuple(self.lane(float(y_m)) for y_m in places))

    def lane(self, y_m: float) -> Lane:
        line = np.array([[0.0, y_m], [50.0, y_m], [100.0, y_m]])
        half = np.array([0.0, 1.75])
        status: Status = "confirmed" if self.confidence >= 0.8 else "tentative"
        return Lane(0, line, line + half, line - half, 3.5, 0.1, self.confidence, status, 9.0)


def maps_of(mapper: LaneMapper, frames: Frames) -> list[LaneMap]:
    """The map of each update, and the last one."""
    maps = [mapper.add(int(t), frames.frame(k)) for k, t in enumerate(frames.stamp_ns)]
    return [found for found in maps if found is not None] + [mapper.finish()]


def rows_at(*places_m: float) -> NDArray[np.void]:
    rows = traffic([Stream(straight(), 3)]).rows[: len(places_m)].copy()
    rows["y"] = places_m
    return rows


def ids_of(lane_map: LaneMap) -> dict[int, int]:
    """Lane ids by place."""
    return {round(lane.middle[1]): lane.lane_id for lane in lane_map.lanes}


def test_a_lane_that_a_subclass_filters_is_in_no_map() -> None:
    maps = maps_of(LaneMapper(WithoutTheMiddle(), update_period_s=2.0), traffic(THREE_LANES))
    every = maps_of(LaneMapper(CurvilinearEstimator(), update_period_s=2.0), traffic(THREE_LANES))
    middles = [lane.middle[1] for found in maps for lane in found.lanes]
    assert len(maps) > 10
    assert len(maps[-1].lanes) == len(every[-1].lanes) - 1 == 2
    assert not any(2.0 < y_m < 5.0 for y_m in middles)


def test_between_derivations_vehicles_are_counted_into_the_lanes_of_a_subclass() -> None:
    maps = maps_of(LaneMapper(WithoutTheMiddle(), update_period_s=2.0), traffic(THREE_LANES))
    pairs = [
        (a, b)
        for before, after in pairwise(maps)
        for a, b in zip(before.lanes, after.lanes, strict=False)
    ]
    assert any(
        a.centerline_m is b.centerline_m and b.vehicles > a.vehicles and a.lane_id == b.lane_id
        for a, b in pairs
    )


def test_lanes_of_a_minimal_estimator_have_ids_that_last() -> None:
    mapper = LaneMapper(Minimal(), update_period_s=1.0)
    mapper.add(0, rows_at(0.0, 4.0))
    seen = [mapper.add(k * 10**9, rows_at(0.0, 4.0)) for k in range(1, 4)]
    first, *later = [ids_of(found) for found in seen if found is not None]
    assert later == [first, first]
    more = mapper.add(4 * 10**9, rows_at(8.0))
    assert more is not None
    assert ids_of(more) == {**first, 8: 3}
    assert [lane.lane_id for lane in more.lanes] == [1, 2, 3]


def test_a_minimal_estimator_is_asked_at_every_update() -> None:
    estimator = Minimal()
    mapper = LaneMapper(estimator, update_period_s=1.0)
    for k in range(6):
        mapper.add(k * 10**9, rows_at(0.0))
    assert estimator.asked == 5


def test_lanes_of_a_minimal_estimator_stay_confirmed_and_weak_new_ones_are_hidden() -> None:
    estimator = Minimal()
    mapper = LaneMapper(estimator, update_period_s=1.0)
    mapper.add(0, rows_at(0.0))
    assert [lane.status for lane in mapper.finish().lanes] == ["confirmed"]
    estimator.confidence = KEEP_CONFIRMED
    assert [lane.status for lane in mapper.finish().lanes] == ["confirmed"]
    estimator.confidence = 0.3
    mapper.add(1, rows_at(4.0))
    (left,) = mapper.finish().lanes
    assert (left.lane_id, left.status) == (1, "tentative")


def test_a_minimal_estimator_remembers_its_ids_over_a_restart() -> None:
    first = LaneMapper(Minimal())
    first.add(0, rows_at(0.0))
    first.finish()
    again = LaneMapper(Minimal())
    again.restore(first.state(), 10)
    again.add(10, rows_at(-4.0, 0.0))
    assert ids_of(again.finish()) == {0: 1, -4: 2}


@pytest.mark.parametrize("name", ["curvilinear", "geolane"])
def test_asking_twice_gives_the_same_map(name: str) -> None:
    estimator = make_estimator(name)
    frames = traffic(THREE_LANES)
    fed = len(frames.stamp_ns) * 2 // 3
    for k in range(fed):
        estimator.add(int(frames.stamp_ns[k]), frames.frame(k))
    first = estimator.lanes(LaneParameters())
    estimator.lanes(LaneParameters(smoothing=6.0))
    assert _bits(estimator.lanes(LaneParameters())) == _bits(first)
    for k in range(fed, len(frames.stamp_ns)):
        estimator.add(int(frames.stamp_ns[k]), frames.frame(k))
    later = estimator.lanes(LaneParameters())
    assert _bits(estimator.lanes(LaneParameters())) == _bits(later) != _bits(first)


def test_derive_once_shows_what_a_mapper_without_history_shows() -> None:
    def filled() -> LaneEstimator:
        estimator = CurvilinearEstimator()
        frames = traffic([*THREE_LANES, Stream(straight(0.0, -LANE_M), 1)])
        for k, stamp_ns in enumerate(frames.stamp_ns):
            estimator.add(int(stamp_ns), frames.frame(k))
        return estimator

    shown = derive_once(filled(), LaneParameters())
    assert [lane.lane_id for lane in shown.lanes] == list(range(1, len(shown.lanes) + 1))
    assert _bits(shown) == _bits(LaneMapper(filled()).finish())


def _bits(lane_map: LaneMap) -> list[tuple[bytes, float, float, str]]:
    return [
        (lane.centerline_m.tobytes(), lane.width_m, lane.confidence, lane.status)
        for lane in lane_map.lanes
    ]
