"""Where drivers are in their lanes, and in which lanes lorries are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scenes import changed
from numpy.typing import NDArray

from geoorbit_ros.scenes.moving_traffic import MovingTraffic
from geoorbit_ros.scenes.scene import (
    MEASURED_DRIVERS,
    Scene,
    load_scene,
    with_measured_drivers,
)
from geoorbit_ros.scenes.traffic import STEP_S, TrafficRecord, _departures

LANES = 3
VEHICLES, STEPS = 300, 60


def scene(**traffic: object) -> Scene:
    """Three lanes each way."""
    own = load_scene("straight_3x3")
    return changed(own, traffic=own.traffic.model_copy(update=traffic))


def record(lane_at: NDArray[np.int64]) -> TrafficRecord:
    """Vehicles that drive east in the middle of lanes, (STEPS, VEHICLES) the lane of each."""
    steps, count = lane_at.shape
    step, vehicle = (a.ravel() for a in np.mgrid[:steps, :count])
    lane = lane_at.ravel()
    xy = np.column_stack((20.0 * STEP_S * step, 3.6 * np.maximum(lane, 0)))
    n = len(step)
    names = [("north", k) for k in range(LANES)]
    sizes = np.tile((4.5, 1.8, 1.5), (count, 1))
    zero = np.zeros(n)
    return TrafficRecord(step, vehicle, xy, zero, zero + 20.0, lane, names, ["car"] * count, sizes)


def left_of_middle(scene: Scene, lane_at: NDArray[np.int64], seed: int = 1) -> NDArray[np.float64]:
    """(STEPS, VEHICLES) metres."""
    given = record(lane_at)
    moving = MovingTraffic(given, scene, seed)
    return np.asarray(moving._xy[:, 1] - given.xy[:, 1]).reshape(lane_at.shape)


def test_drivers_in_edge_lanes_keep_towards_the_lane_beside() -> None:
    lane = np.tile(np.arange(VEHICLES) % LANES, (STEPS, 1))
    shifts = []
    for seed in range(40):
        offset = left_of_middle(with_measured_drivers(scene()), lane, seed)
        shifts.append([np.median(offset[:, lane[0] == k]) for k in range(LANES)])
    outer, middle, inner = np.transpose(shifts)
    assert np.mean(outer) == pytest.approx(0.24, abs=0.08)
    assert np.mean(inner) == pytest.approx(-0.24, abs=0.08)
    assert np.mean(middle) == pytest.approx(0.0, abs=0.05)
    assert np.std(outer) == pytest.approx(0.15, abs=0.06)
    between = np.std(offset[:, lane[0] == 1].mean(axis=0))
    assert between == pytest.approx(MEASURED_DRIVERS["driver_offset_sigma_m"], abs=0.1)


def test_without_habits_drivers_are_in_the_middle_in_the_mean() -> None:
    lane = np.tile(np.arange(VEHICLES) % LANES, (STEPS, 1))
    assert np.mean(left_of_middle(scene(), lane)) == pytest.approx(0.0, abs=0.05)


def test_who_changes_lanes_moves_over_slowly() -> None:
    """No step sideways of more than a few centimetres, through a junction (-1), too."""
    lane = np.repeat([[0], [-1], [1], [2]], STEPS // 4, axis=0) * np.ones(5, np.int64)
    calm = scene(driver_offset_sigma_m=0.0, wander_sigma_m=0.0, edge_shift_m=0.5)
    offset = left_of_middle(calm, lane.astype(np.int64))
    assert np.abs(np.diff(offset, axis=0)).max() < 0.07
    assert offset[0, 0] == pytest.approx(0.5)
    assert offset[-1, 0] < -0.2


def test_a_single_lane_has_no_lane_beside() -> None:
    own = load_scene("on_ramp_merge")
    single = next(road.id for road in own.roads if road.lanes == 1)
    given = record(np.zeros((STEPS, 10), np.int64))
    given = replace(given, lane_names=[(single, 0)])
    habits = with_measured_drivers(own).traffic.model_copy(
        update={"driver_offset_sigma_m": 0.0, "wander_sigma_m": 0.0}
    )
    moving = MovingTraffic(given, changed(own, traffic=habits), 1)
    assert np.abs(moving._xy - given.xy).max() == 0.0


def lorry_shares(scene: Scene) -> tuple[float, float]:
    """Share of lorries among those that enter in the outermost lane, and of lorries in all."""
    found = _departures(scene, 3600.0, 1)
    lorry = np.array([d.type_name == "truck" for d in found])
    outer = np.array([d.lane == 0 for d in found])
    return float(np.mean(outer[lorry])), float(np.mean(lorry))


def test_lorries_enter_in_the_outermost_lane_and_are_as_many() -> None:
    outside, share = lorry_shares(with_measured_drivers(scene()))
    _, before = lorry_shares(scene())
    assert outside == pytest.approx(MEASURED_DRIVERS["lorries_outside"], abs=0.05)
    assert share == pytest.approx(before, rel=0.15)
