"""Tracks that stay behind are no vehicles; vehicles that brake or queue are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_twin import DATUM, START_NS, STEP_NS, FakeSimulation, Steps, made_network, rows

from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.twin.false_tracks import STAYS_S
from geoorbit_ros.twin.forecast.observed_traffic import ObservedTraffic
from geoorbit_ros.twin.replay import StateWriter
from geoorbit_ros.twin.routes import RouteWriter
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


def passing(
    count: int, first: int = 2, speed_mps: float = 20.0
) -> list[list[tuple[int, float, float]]]:
    """Track 1 stands at x = 100 for 3 s, then so many vehicles drive past, 4 s each."""
    frames = [[(1, 100.0, 0.0)] for _ in range(30)]
    for track in range(first, first + count):
        frames += [
            [(1, 100.0, 0.0), (track, 60.0 + 0.1 * speed_mps * k, speed_mps)] for k in range(40)
        ]
    return frames


def far_rows(
    network: RoadNetwork, frames: list[list[tuple[int, float, float]]], across_m: float
) -> tuple[Synchronizer, Steps]:
    """As `drive`, far from the camera: errors of 3 m, beyond what is compared by position."""
    steps = Steps()
    twin = Synchronizer(network, FakeSimulation(), ["north"], 0.1, 1.5, steps.append)
    for k, frame in enumerate(frames):
        places = [(track, x, LANE_Y + across_m * (track == 1)) for track, x, _ in frame]
        table = rows(places, sigma_m=3.0)
        table["vx"] = [speed for *_, speed in frame]
        twin.add("north", START_NS + k * STEP_NS, table)
    return twin, steps


@pytest.mark.parametrize(("passes", "false_tracks"), [(2, 0), (3, 1)])
def test_far_away_the_vehicles_that_drive_through_are_counted(
    network: RoadNetwork, passes: int, false_tracks: int
) -> None:
    twin, _ = far_rows(network, passing(passes), 0.6)
    assert twin.fusion.counts.false_tracks == false_tracks


def test_a_vehicle_beside_the_lane_is_not_driven_through(network: RoadNetwork) -> None:
    twin, _ = far_rows(network, passing(10), 2.5)
    assert twin.fusion.counts.false_tracks == 0


def test_what_never_drove_and_stays_while_others_pass_is_no_traffic(network: RoadNetwork) -> None:
    twin, steps = far_rows(network, passing(int(STAYS_S / 4.0) + 1), 2.5)
    assert twin.fusion.counts.false_tracks == 1
    found = [step.false_since_ns for step in steps if step.false_since_ns]
    assert found == [{1: steps[0].stamp_ns}]


def test_a_vehicle_that_drove_up_and_broke_down_stays(network: RoadNetwork) -> None:
    speed = np.maximum(20.0 - 0.4 * np.arange(60), 0.0)
    x = 100.0 - 2.0 * speed.sum() * 0.05 + np.append(0.0, np.cumsum(0.1 * speed))[:-1]
    x += 100.0 - x[-1]
    arrives = [[(1, float(a), float(v))] for a, v in zip(x, speed, strict=True)]
    twin, steps = far_rows(network, arrives + passing(int(STAYS_S / 4.0) + 5), 2.5)
    assert twin.fusion.counts.false_tracks == 0
    assert 1 in steps[-1].vehicle_id


def test_files_do_not_have_what_was_found_to_be_no_vehicle(
    network: RoadNetwork, tmp_path: Path
) -> None:
    writer, routes = StateWriter(tmp_path / "vehicles.csv", network), RouteWriter(network)
    traffic = ObservedTraffic(network, 600.0)
    _, steps = far_rows(network, passing(4), 0.6)
    with writer:
        for step in steps:
            driven = replace(step, lane=step.wanted_lane)
            writer.write(driven)
            routes.add(driven)
            traffic.add(driven)
    lines = (tmp_path / "vehicles.csv").read_text().splitlines()[1:]
    assert {line.split(",")[1] for line in lines} == {"2", "3", "4", "5"}
    assert [path.name for path in tmp_path.iterdir()] == ["vehicles.csv"]
    counts = routes.write(tmp_path, "net.xml")
    assert (counts.written, counts.too_short) == (4, 0)
    demand = traffic.demand()
    assert demand is not None
    flow = demand.edge_flow_per_h["east"]
    assert flow == pytest.approx(4 * 3600.0 / demand.time_s, rel=0.25)


def test_a_queue_stays(network: RoadNetwork) -> None:
    frames = []
    for k in range(100):
        x = min(60.0 + 1.0 * k, 93.0)
        frames.append([(1, 100.0, 0.0), (2, x, 10.0 if x < 85 else 3.0 if x < 93.0 else 0.0)])
    twin, steps = drive(network, frames)
    assert twin.fusion.counts.false_tracks == 0
    assert np.count_nonzero(steps[-1].observed) == 2
