"""Laws of the simulated traffic, before any camera sees it."""

from __future__ import annotations

import re
import subprocess

import numpy as np
import pytest
from made_scenes import changed

from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene, load_scene
from geoorbit_ros.scenes.traffic import (
    STEP_S,
    WARM_UP_S,
    Halt,
    TrafficError,
    TrafficRecord,
    simulate_traffic,
)

DURATION_S = 10.0


def traffic(scene: Scene, seed: int = 1) -> TrafficRecord:
    return simulate_traffic(scene, place_roads(scene), DURATION_S, seed)


@pytest.fixture(scope="module")
def straight() -> TrafficRecord:
    return traffic(load_scene("straight_3x3"))


def test_the_seed_decides_which_vehicles_come(straight: TrafficRecord) -> None:
    scene = load_scene("straight_3x3")
    again, other = traffic(scene), traffic(scene, seed=2)
    assert np.array_equal(again.xy, straight.xy)
    assert np.array_equal(again.vehicle_sizes, straight.vehicle_sizes)
    assert other.vehicle_sizes[:5].tolist() != straight.vehicle_sizes[:5].tolist()


def test_a_vehicle_that_is_to_halt_stands_at_its_place_and_goes_on() -> None:
    scene = load_scene("straight_3x3")
    placed = place_roads(scene)
    name = scene.roads[0].id
    x_m, y_m = placed[name].centerline(1)[-1] * 0.5 + placed[name].centerline(1)[0] * 0.5
    halt = Halt(float(x_m), float(y_m), name, 1, 0.0, 6.0)
    record = simulate_traffic(scene, placed, 40.0, 1, [halt])
    near = np.hypot(*(record.xy - [x_m, y_m]).T) < 12.0
    stands = near & (record.speed < 0.1)
    vehicles, steps = np.unique(record.vehicle[stands], return_counts=True)
    assert steps.max() * STEP_S == pytest.approx(6.0, abs=1.0)
    gone = record.vehicle == vehicles[steps.argmax()]
    assert record.speed[gone][-1] > 1.0


def test_as_many_vehicles_come_as_the_scene_says(straight: TrafficRecord) -> None:
    per_hour = sum(flow.per_hour for flow in load_scene("straight_3x3").traffic.flows)
    expected = per_hour * (WARM_UP_S + DURATION_S) / 3600.0
    assert abs(len(straight.vehicle_types) - expected) < 4.0 * np.sqrt(expected)


def test_steps_cover_the_duration(straight: TrafficRecord) -> None:
    assert straight.step[0] == 0
    assert straight.step[-1] * STEP_S >= DURATION_S
    assert np.all(np.diff(straight.step) >= 0)


def test_a_vehicle_vanishes_when_its_front_reaches_the_roads_end(straight: TrafficRecord) -> None:
    road = place_roads(load_scene("straight_3x3"))["north"]
    along = np.array([np.cos(road.heading_rad[0]), np.sin(road.heading_rad[0])])
    on_road = np.array([name == "north" for name, _ in straight.lane_names])[straight.lane]
    length = straight.vehicle_sizes[straight.vehicle, 0]
    front = (straight.xy - road.border_m[0]) @ along + 0.5 * length
    assert np.all(front[on_road] <= 600.0 + 0.01)
    assert front[on_road].max() > 600.0 - 45.0 * STEP_S


def test_a_share_of_zero_leaves_a_lane_empty() -> None:
    scene = load_scene("straight_3x3")
    flow = {"route": ["north"], "per_hour": 1200, "lane_shares": [0.0, 0.0, 1.0]}
    # One type at one speed: no driver has a reason to leave the lane.
    calm = {"flows": [flow], "mix": {"car": 1.0}, "speed_factor_sigma": 0.0}
    record = traffic(changed(scene, traffic=calm))
    assert record.lane_names == [("north", 2)]


def test_ramp_vehicles_come_down_the_ramp_and_merge() -> None:
    scene = load_scene("on_ramp_merge")
    record = traffic(scene)
    roads = [name for name, _ in record.lane_names]
    assert {"ramp", "merge", "main_out"} <= set(roads)
    on_ramp = set(record.vehicle[[roads[k] == "ramp" for k in record.lane]].tolist())
    later = set(record.vehicle[[roads[k] in ("merge", "main_out") for k in record.lane]].tolist())
    assert on_ramp & later


def test_what_sumo_says_last_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    real = subprocess.run

    def broken(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        if "geoorbit_ros.scenes.traffic" in command:
            return subprocess.CompletedProcess(command, 1, "", "Trace\nError: out of road\n")
        return real(command, **options)  # type: ignore[call-overload,no-any-return]

    monkeypatch.setattr(subprocess, "run", broken)
    sentence = "sumo: found Error: out of road, expected a simulation"
    with pytest.raises(TrafficError, match=f"^{re.escape(sentence)}$"):
        traffic(load_scene("s_curve"))


def test_a_simulation_that_does_not_end_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("geoorbit_ros.scenes.traffic.TIME_LIMIT_S", 0.01)
    with pytest.raises(TrafficError, match=r"no end after 0\.01 s"):
        traffic(load_scene("s_curve"))
