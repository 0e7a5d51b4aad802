"""Lanes where they are driven: vehicles are counted to them, and stay where they are."""

from dataclasses import replace

import numpy as np
import pytest
from made_detections import detected
from made_twin import DATUM, START_NS, STEP_NS, FakeSimulation, Steps, made_network, rows

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import offset_line, project
from geoorbit_ros.lanes.geojson import dumps_lanes
from geoorbit_ros.mapcheck.driven_lanes import DrivenLane, DrivenNetwork, as_driven, merged
from geoorbit_ros.mapcheck.map_watch import STEADY_M, MapCheck, MapWatch
from geoorbit_ros.mapcheck.validation import validate
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.twin.synchronizer import Synchronizer


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")), DATUM)


def driven(left_m: float, width_m: float = 3.5) -> DrivenLane:
    return DrivenLane(np.array([100.0, 200.0]), np.full(2, left_m), width_m)


def beside(network: RoadNetwork, moved: RoadNetwork, name: str) -> float:
    """How far to the left a lane of `moved` lies."""
    k = network.number[name]
    return float(np.median(project(moved.line(k), network.line(k), 1.0).offset_m))


def test_lanes_lie_where_they_are_driven_and_keep_their_numbers(network: RoadNetwork) -> None:
    found = as_driven(network, {"east_0": driven(0.2), "east_2": driven(1.0, 3.9)})
    moved = found.network
    assert moved.lane_id == network.lane_id
    assert moved.successors == network.successors
    assert beside(network, moved, "east_0") == pytest.approx(0.2, abs=1e-6)
    assert beside(network, moved, "east_1") == pytest.approx(0.6, abs=1e-6)  # no camera saw it
    assert beside(network, moved, "east_2") == pytest.approx(1.0, abs=1e-6)
    assert moved.width_m[network.number["east_2"]] == 3.9
    for name in ("west_0", "west_1", "bend_2", "ramp_0"):
        assert beside(network, moved, name) == pytest.approx(0.0, abs=1e-9)
    assert found.largest_m == pytest.approx(1.0)
    inside = [k for k in range(len(network)) if network.internal[k]]
    assert inside
    for k in inside:  # between the ends of the lanes that it joins
        shift = np.abs(project(moved.line(k), network.line(k), 2.0).offset_m)
        assert shift.max() <= 1.0 + 1e-6


def test_what_two_cameras_see_of_a_lane_is_put_together() -> None:
    near = {"a": DrivenLane(np.array([10.0, 20.0]), np.array([0.4, 0.4]), 3.0)}
    far = {"a": DrivenLane(np.array([5.0, 15.0]), np.array([0.8, 0.8]), 4.0), "b": driven(1.0)}
    both = merged([near, far])
    assert both["a"].arc_m.tolist() == [5.0, 10.0, 15.0, 20.0]
    assert both["a"].left_m.tolist() == [0.8, 0.4, 0.8, 0.4]
    assert both["a"].width_m == 3.5
    assert set(both) == {"a", "b"}


def test_a_vehicle_is_in_the_lane_that_is_driven_there_and_where_it_is_seen(
    network: RoadNetwork,
) -> None:
    for follows, lane in ((False, "east_2"), (True, "east_1")):
        simulation, steps = FakeSimulation(), Steps()
        twin = Synchronizer(network, simulation, ["north"], STEP_NS * 1e-9, 1.5, steps.append)
        if follows:
            names = ("east_0", "east_1", "east_2")
            twin.follow(as_driven(network, dict.fromkeys(names, driven(2.0))))
        for k in range(20):
            x = 100.0 + 2.0 * k
            twin.add("north", START_NS + k * STEP_NS, rows([(1, x, -5.25 + 2.0)]))
        assert {network.lane_id[step.wanted_lane[0]] for step in steps} == {lane}
        assert np.abs(steps.of(1)[:, 1] + 3.25).max() < 1e-4


def displaced(lanes: list[Lane], left_m: float, numbers: tuple[int, ...]) -> list[Lane]:
    return [
        replace(each, centerline_m=offset_line(each.centerline_m, left_m))
        if each.lane_id in numbers
        else each
        for each in lanes
    ]


def test_only_edges_with_a_lane_out_of_place_are_moved(network: RoadNetwork) -> None:
    lanes = detected(network)
    assert validate(lanes, network).discrepancies.driven == {}
    found = validate(displaced(lanes, 1.0, (4, 5)), network).discrepancies.driven
    assert set(found) == {"west_0", "west_1"}
    assert all(abs(lane.middle_m - 1.0) < 0.25 for lane in found.values())


def shifted(lanes: list[Lane], north_m: float) -> list[Lane]:
    return [
        replace(each, centerline_m=each.centerline_m + np.array([0.0, north_m])) for each in lanes
    ]


def test_a_check_decides_on_all_cameras_and_stays_as_it_was(network: RoadNetwork) -> None:
    lanes = detected(network)
    first = MapCheck(network).with_lanes("north", lanes)
    assert first.alignments == {}
    assert first.driven is None
    both = first.with_lanes("south", displaced(lanes, 1.0, (4, 5)))
    assert first.driven is None
    assert set(first.validations) == {"north"}
    assert both.driven is not None
    assert both.driven.largest_m == pytest.approx(1.0, abs=0.25)
    moved = both.with_lanes("south", shifted(lanes, 1.0))
    assert set(moved.alignments) == {"south"}
    assert moved.alignments["south"].shift_m[1] == pytest.approx(-1.0, abs=0.15)


@pytest.mark.parametrize(("steady_m", "kept"), [(0.0, False), (STEADY_M, True)])
def test_small_differences_change_nothing_that_is_in_use(
    network: RoadNetwork, steady_m: float, kept: bool
) -> None:
    lanes = detected(network)
    before = MapCheck(network, steady_m).with_lanes("north", shifted(lanes, 1.0))
    after = before.with_lanes("north", shifted(lanes, 1.05))
    assert (after.alignments["north"] is before.alignments["north"]) == kept
    away = after.with_lanes("north", shifted(lanes, 1.5))
    assert away.alignments["north"] is not after.alignments["north"]


def test_the_watch_moves_lanes_once_and_back(network: RoadNetwork) -> None:
    lanes = detected(network)
    watch = MapWatch(network, 1.0)

    def look(seen: list[Lane], stamp_s: int) -> DrivenNetwork | None:
        watch.offer("north", dumps_lanes(LaneMap(stamp_s * 10**9, tuple(seen)), DATUM))
        assert watch._running is not None
        watch._running[1].result()
        assert len(watch.collect()) == 1
        return watch.driven

    assert look(lanes, 1) is None
    first = look(displaced(lanes, 1.0, (4, 5)), 5)
    assert first is not None
    assert beside(network, first.network, "west_0") == pytest.approx(1.0, abs=0.25)
    assert look(displaced(lanes, 1.05, (4, 5)), 9) is first
    last = look(lanes, 13)
    assert last is not None
    assert last.largest_m == 0.0
    watch.close()
