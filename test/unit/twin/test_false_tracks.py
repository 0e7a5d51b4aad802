"""Tracks that stay behind are no vehicles; vehicles that brake or queue are."""

import numpy as np
import pytest
from made_twin import DATUM, START_NS, STEP_NS, FakeSimulation, Steps, made_network, rows

from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.twin.synchronizer import Synchronizer

LANE_Y = -5.25


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")), DATUM)


def drive(
    network: RoadNetwork,
    frames: list[list[tuple[int, float, float]]],
    beside_m: float = 0.0,
) -> tuple[Synchronizer, Steps]:
    """Frames of (track, x, speed) through a twin; track 1 is to the left of the others."""
    steps = Steps()
    twin = Synchronizer(network, FakeSimulation(), ["north"], 0.1, 1.5, steps.append)
    for k, frame in enumerate(frames):
        table = rows([(track, x, LANE_Y + beside_m * (track == 1)) for track, x, _ in frame])
        table["vx"] = [speed for *_, speed in frame]
        twin.add("north", START_NS + k * STEP_NS, table)
    return twin, steps


def test_a_track_that_stops_at_once_is_no_vehicle(network: RoadNetwork) -> None:
    going = [[(1, 20.0 + 2.5 * k, 25.0)] for k in range(20)]
    stays = [[(1, 69.0 + 0.2 * (k % 3), 0.5)] for k in range(60)]
    twin, steps = drive(network, going + stays)
    assert twin.fusion.counts.false_tracks == 1
    assert not steps[-1].observed.any()
    again = [[(1, 69.0 + 1.5 * k, 15.0)] for k in range(20)]  # it has found a vehicle again
    twin, steps = drive(network, going + stays + again)
    assert steps[-1].observed.any()


def test_braking_is_no_reason_to_vanish(network: RoadNetwork) -> None:
    speed = np.maximum(25.0 - 0.8 * np.arange(80), 0.0)  # 8 m/s2
    x = 20.0 + np.append(0.0, np.cumsum(0.1 * speed))[:-1]
    twin, steps = drive(network, [[(1, a, v)] for a, v in zip(x, speed, strict=True)])
    assert twin.fusion.counts.false_tracks == 0
    assert all(step.observed.all() and len(step.observed) == 1 for step in steps)


def test_what_others_drive_through_is_no_vehicle(network: RoadNetwork) -> None:
    frames = [[(1, 100.0, 0.0)] for _ in range(30)]
    frames += [[(1, 100.0, 0.0), (2, 60.0 + 2.0 * k, 20.0)] for k in range(40)]
    twin, steps = drive(network, frames)
    assert twin.fusion.counts.false_tracks == 1
    assert len(steps[29].observed) == 1
    assert np.count_nonzero(steps[-1].observed) == 1


@pytest.mark.parametrize(
    ("beside_m", "vehicles", "false_tracks"), [(1.2, 2, 0), (1.2, 3, 1), (2.0, 5, 0)]
)
def test_what_many_vehicles_overlap_is_no_vehicle(
    network: RoadNetwork, beside_m: float, vehicles: int, false_tracks: int
) -> None:
    frames = [[(1, 100.0, 0.0)] for _ in range(30)]
    for track in range(2, 2 + vehicles):
        frames += [[(1, 100.0, 0.0), (track, 60.0 + 2.0 * k, 20.0)] for k in range(40)]
    twin, _ = drive(network, frames, beside_m)
    assert twin.fusion.counts.false_tracks == false_tracks


def test_a_queue_stays(network: RoadNetwork) -> None:
    frames = []
    for k in range(100):
        x = min(60.0 + 1.0 * k, 93.0)
        frames.append([(1, 100.0, 0.0), (2, x, 10.0 if x < 85 else 3.0 if x < 93.0 else 0.0)])
    twin, steps = drive(network, frames)
    assert twin.fusion.counts.false_tracks == 0
    assert np.count_nonzero(steps[-1].observed) == 2
