"""From frames to vehicles: places exact, one vehicle per vehicle, whatever trackers do."""

from collections.abc import Callable

import numpy as np
import pytest
from made_twin import DATUM, START_NS, STEP_NS, FakeSimulation, Steps, made_network, rows

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.twin.false_tracks import SETTLE_S
from geoorbit_ros.twin.runner import RETRY_S, TwinRunner
from geoorbit_ros.twin.simulation import Simulation
from geoorbit_ros.twin.sumo_process import SimulationError
from geoorbit_ros.twin.synchronizer import Synchronizer, plausible_course

HOLD_S = 1.5
EAST = {0: -8.75, 1: -5.25, 2: -1.75}


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")))


class Twin:
    """A synchroniser on a fake simulation."""

    def __init__(self, network: RoadNetwork, *cameras: str) -> None:
        self.simulation, self.steps = FakeSimulation(), Steps()
        names = cameras or ("north",)
        self.sync = Synchronizer(
            network, self.simulation, names, STEP_NS * 1e-9, HOLD_S, self.steps.append
        )

    def see(self, k: float, *vehicles: tuple[int, float, float], camera: str = "north") -> None:
        """Frame at k steps after the start."""
        self.sync.add(camera, START_NS + round(k * STEP_NS), rows(vehicles))


def test_the_twin_is_where_the_tracks_are(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(30):
        twin.see(k, (7, 50.0 + 2.0 * k, EAST[1]), (9, 40.0 + 2.0 * k, EAST[2] + 0.3))
    assert len(twin.steps) == 30
    assert twin.simulation.entered == ["v1", "v2"]
    for k, step in enumerate(twin.steps):
        assert step.stamp_ns == START_NS + k * STEP_NS
        truth = np.array([(50.0 + 2.0 * k, EAST[1]), (40.0 + 2.0 * k, EAST[2] + 0.3)])
        assert np.abs(step.xy - truth.astype(np.float32)).max() < 1e-4
        assert np.abs(step.heading_rad).max() < 1e-6
        wanted = [network.lane_id[lane] for lane in step.wanted_lane]
        assert wanted == ["east_1", "east_2"]


def test_frames_between_the_steps_are_interpolated(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in np.arange(0.0, 20.0, 0.37):
        twin.see(float(k), (7, 50.0 + 2.0 * k, EAST[1]))
    assert len(twin.steps) == 20
    for step in twin.steps[1:]:
        k = (step.stamp_ns - START_NS) / STEP_NS
        assert abs(step.xy[0, 0] - (50.0 + 2.0 * k)) < 1e-4


def test_the_front_bumper_is_half_a_length_ahead(network: RoadNetwork) -> None:
    twin = Twin(network)
    twin.see(0, (7, 50.0, EAST[1]))
    x, y, angle = twin.simulation.there["v1"]
    assert (x, y, angle) == pytest.approx((50.0 + 2.3, EAST[1], 90.0), abs=1e-4)


def test_a_track_with_gaps_is_one_vehicle_that_goes_on(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(40):
        twin.see(k, *([] if 10 <= k < 22 else [(7, 50.0 + 2.0 * k, EAST[1])]))
    assert twin.simulation.entered == ["v1"]
    assert twin.simulation.left == []
    error = twin.steps.of(1)[:, 0] - (50.0 + 2.0 * np.arange(40))
    assert np.abs(error).max() < 0.01
    seen = np.array([step.observed[0] for step in twin.steps])
    assert (np.flatnonzero(~seen) == np.arange(10, 22)).all()


def test_unseen_vehicles_follow_the_bend(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(28):
        twin.see(k, *([(7, 270.0 + 2.0 * k, EAST[1])] if k < 14 else []))
    radius = 250.0 + 5.25  # outside of a left bend about (300, 250)
    last = twin.steps.of(1)[-1]
    assert last[0] > 315.0
    assert abs(np.hypot(last[0] - 300.0, last[1] - 250.0) - radius) < 0.1


def test_a_vehicle_leaves_after_the_hold_time_and_not_before(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(60):
        twin.see(k, *([(7, 50.0 + 2.0 * k, EAST[1])] if k < 10 else []))
    there = [1 in step.vehicle_id for step in twin.steps]
    assert sum(there) == 10 + round(HOLD_S * 10)
    assert twin.simulation.left == ["v1"]
    assert twin.simulation.there == {}


def test_swapped_ids_change_no_vehicle(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(30):
        a, b = (7, 9) if k < 15 else (9, 7)
        twin.see(k, (a, 50.0 + 2.0 * k, EAST[1]), (b, 51.0 + 2.0 * k, EAST[2]))
    assert twin.simulation.entered == ["v1", "v2"]
    assert twin.simulation.left == []
    assert twin.sync.fusion.counts.jumps == 2
    for vehicle, lane in ((1, 1), (2, 2)):
        off = np.abs(twin.steps.of(vehicle)[:, 1] - EAST[lane])
        # In the one step between the swap's frames nothing tells which is which.
        assert np.count_nonzero(off > 0.1) == 0


def test_a_track_that_jumps_leaves_and_enters(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(40):
        twin.see(k, (7, (50.0 if k < 15 else 120.0) + 2.0 * k, EAST[1]))
    assert twin.simulation.entered == ["v1", "v2"]
    assert twin.simulation.left == ["v1"]
    assert twin.sync.fusion.counts.jumps == 1


@pytest.mark.parametrize("false", [{15}, {15, 17}, {15, 16}])
def test_a_false_box_in_place_of_a_vehicle_makes_no_other(
    network: RoadNetwork, false: set[int]
) -> None:
    """For single frames the track has a box that stands 15 m ahead, beside another vehicle."""
    twin = Twin(network)
    for k in range(40):
        x = 50.0 + 2.0 * k
        twin.see(k, (7, 95.0 if k in false else x, EAST[1]), (8, x + 14.0, EAST[1] + 1.0))
    assert twin.simulation.entered == ["v1", "v2"]
    assert twin.simulation.left == []
    assert np.abs(twin.steps.of(1)[:, 0] - (50.0 + 2.0 * np.arange(40))).max() < 0.01
    seen = {k for k, step in enumerate(twin.steps) if not step.observed[0]}
    assert seen == false
    assert twin.sync.fusion.counts.unsettled + twin.sync.fusion.counts.doubled == len(false)


def test_a_track_that_stays_where_it_jumped_to_enters_once_it_has_settled(
    network: RoadNetwork,
) -> None:
    twin = Twin(network)
    for k in range(40):
        twin.see(k, (7, (50.0 if k < 15 else 120.0) + 2.0 * k, EAST[1]))
    first = next(k for k, step in enumerate(twin.steps) if 2 in step.vehicle_id)
    assert first == 15 + round(SETTLE_S * 10)
    assert np.abs(twin.steps.of(2)[0, 0] - (120.0 + 2.0 * first)) < 1e-3


def test_a_track_with_a_new_id_is_the_same_vehicle(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(40):
        seen = [] if 15 <= k < 20 else [(7 if k < 15 else 8, 50.0 + 2.0 * k, EAST[1])]
        twin.see(k, *seen)
    assert twin.simulation.entered == ["v1"]
    assert twin.sync.fusion.counts.handovers == 1


def test_two_cameras_see_one_vehicle(network: RoadNetwork) -> None:
    """It drives from one view into the other; each camera has a map frame of its own."""
    twin = Twin(network, "north", "south")
    other = Datum(43.052, -89.347)
    twin.sync.set_datum("south", other)
    for k in range(60):
        x = 50.0 + 2.0 * k
        twin.see(k, *([(7, x, EAST[1])] if k < 40 else []))
        there = other.to_local(*DATUM.to_geodetic([[x + 0.4, EAST[1] - 0.2]]).T)[0]
        table = rows([(7, *there)] if k > 20 else [])
        twin.sync.add("south", START_NS + k * STEP_NS, table)
    assert twin.simulation.entered == ["v1"]
    assert twin.simulation.left == []
    both = [step.cameras[0] for step in twin.steps]
    assert both == [1] * 21 + [2] * 19 + [1] * 20
    error = twin.steps.of(1) - np.column_stack((50.0 + 2.0 * np.arange(60), np.full(60, EAST[1])))
    assert np.hypot(*error[:21].T).max() < 0.01
    assert np.allclose(error[21:40], (0.2, -0.1), atol=0.01)  # half-way between the cameras
    assert np.allclose(error[40:], (0.4, -0.2), atol=0.01)


def test_vehicles_side_by_side_and_nose_to_tail_are_not_merged(network: RoadNetwork) -> None:
    twin = Twin(network, "north", "south")
    for k in range(30):
        x = 50.0 + 1.0 * k
        twin.see(k, (1, x, EAST[1]), (2, x, EAST[2]), (3, x - 6.0, EAST[1]))
        twin.see(k, (1, x, EAST[0]), (2, x + 6.5, EAST[1]), camera="south")
    assert len(twin.simulation.there) == 5
    assert twin.sync.fusion.counts.merged == 0


def test_a_camera_that_stops_does_not_stop_the_others(network: RoadNetwork) -> None:
    twin = Twin(network, "north", "south")
    for k in range(60):
        twin.see(k, (7, 50.0 + 2.0 * k, EAST[1]))
        if k < 20:
            twin.see(k, (3, 150.0 + 2.0 * k, EAST[2]), camera="south")
    assert twin.steps[-1].stamp_ns >= START_NS + 57 * STEP_NS
    assert "v1" in twin.simulation.there
    assert len(twin.simulation.there) == 1  # what the other one saw has left


def test_a_doubled_track_makes_no_second_vehicle(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(20):
        x = 50.0 + 2.0 * k
        twin.see(k, (7, x, EAST[1]), *([(8, x + 0.6, EAST[1] + 0.2)] if k > 5 else []))
    assert twin.simulation.entered == ["v1"]
    assert twin.sync.fusion.counts.doubled == 14


@pytest.mark.parametrize(("frames", "entered"), [(2, ["v1"]), (20, ["v1", "v2"])])
def test_a_track_that_begins_close_to_a_vehicle_must_last(
    network: RoadNetwork, frames: int, entered: list[str]
) -> None:
    """A second box of the vehicle ends soon; a vehicle close behind stays, and then enters."""
    twin = Twin(network)
    for k in range(40):
        x = 50.0 + 2.0 * k
        beside = [(8, x - 3.6, EAST[1] + 1.0)] if 10 <= k < 10 + frames else []
        twin.see(k, (7, x, EAST[1]), *beside)
    assert twin.simulation.entered == entered
    assert twin.sync.fusion.counts.unsettled == min(frames, round(SETTLE_S * 10))
    assert np.abs(twin.steps.of(1)[:, 0] - (50.0 + 2.0 * np.arange(40))).max() < 0.01


def test_a_track_that_begins_in_the_next_lane_is_a_vehicle_at_once(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(20):
        x = 50.0 + 2.0 * k
        twin.see(k, (7, x, EAST[1]), *([(8, x, EAST[2])] if k >= 10 else []))
    assert twin.simulation.entered == ["v1", "v2"]
    assert twin.sync.fusion.counts.unsettled == 0


def test_what_stands_beside_the_road_stays_out(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(10):
        twin.see(k, (7, 50.0, -40.0), (8, np.nan, 0.0))
    assert twin.simulation.entered == []
    assert twin.sync.fusion.counts.off_road == 10


def test_a_wrong_class_now_and_then_changes_nothing(network: RoadNetwork) -> None:
    twin = Twin(network)
    for k in range(60):
        table = rows([(7, 50.0 + 2.0 * k, EAST[1])], class_id=7 if k % 9 == 3 else 2)
        twin.sync.add("north", START_NS + k * STEP_NS, table)
    assert twin.simulation.kinds == {"v1": "car"}
    for k in range(60, 100):
        table = rows([(7, 50.0 + 2.0 * k, EAST[1])], class_id=7)
        twin.sync.add("north", START_NS + k * STEP_NS, table)
    assert twin.simulation.kinds == {"v1": "truck"}


def test_a_source_that_starts_again_starts_the_twin_anew(network: RoadNetwork) -> None:
    twin = Twin(network)
    for _ in range(2):
        for k in range(20):
            twin.see(k, (7, 50.0 + 2.0 * k, EAST[1]))
        twin.sync.restart("north")
    twin.see(0, (7, 50.0, EAST[1]))
    assert twin.simulation.entered == ["v1", "v2", "v3"]
    assert twin.simulation.left == ["v1", "v2"]


@pytest.mark.parametrize("chunk", [1, 7])
def test_the_twin_does_not_depend_on_how_frames_come(network: RoadNetwork, chunk: int) -> None:
    """Two cameras' frames in turn, or one camera in bursts: the same vehicles at the end."""
    twin = Twin(network, "north", "south")
    random = np.random.default_rng(3)
    noise = random.normal(0.0, 0.1, (70, 2))
    for first in range(0, 70, chunk):
        for camera, shift in (("north", 0.0), ("south", 0.3)):
            for k in range(first, min(first + chunk, 70)):
                x = 50.0 + 2.0 * (k + shift)
                if chunk == 1 or camera == "north" or k < 70:
                    twin.see(k + shift, (4, x + noise[k, 0], EAST[1] + noise[k, 1]), camera=camera)
    twin.sync.finish()
    assert twin.simulation.entered == ["v1"]


class Mortal:
    """Starts simulations, and keeps them."""

    def __init__(self) -> None:
        self.made: list[FakeSimulation] = []
        self.refuses = False

    def start(self) -> Simulation:
        if self.refuses:
            raise SimulationError("SUMO", "no program 'sumo'", "pip install eclipse-sumo")
        self.made.append(FakeSimulation())
        return self.made[-1]


def fail(action: Callable[[], None], said: str) -> None:
    with pytest.raises(SimulationError, match=said):
        action()


def test_a_simulation_that_dies_is_started_again_and_catches_up(network: RoadNetwork) -> None:
    mortal, steps, now = Mortal(), Steps(), [0.0]
    runner = TwinRunner(
        network, mortal.start, ["north"], 0.1, HOLD_S, steps.append, clock_s=lambda: now[0]
    )

    def see(k: int) -> None:
        table = rows([(7, 50.0 + 2.0 * k, EAST[1]), (8, 30.0 + 2.0 * k, EAST[2])])
        runner.add("north", START_NS + k * STEP_NS, table)

    for k in range(10):
        see(k)
    mortal.made[0].dead = SimulationError("SUMO", "its process ended", "a running simulation")
    fail(lambda: see(10), "its process ended")
    see(11)
    assert runner.restarts == 1
    assert sorted(mortal.made[1].there) == ["v1", "v2"]  # the same vehicles, not new ones
    assert steps[-1].xy[0, 0] == pytest.approx(72.0, abs=1e-4)

    mortal.made[1].dead = SimulationError("SUMO", "its process ended", "a running simulation")
    mortal.refuses = True
    fail(lambda: see(12), "no program")
    fail(lambda: see(13), "did not start again")  # not tried at every frame
    mortal.refuses, now[0] = False, RETRY_S + 1.0
    see(14)
    assert sorted(mortal.made[2].there) == ["v1", "v2"]
    runner.close()


def test_a_course_is_what_a_vehicle_can_drive() -> None:
    heading = np.radians([0.0, 60.0, 60.0, -170.0, 60.0])
    speed = np.array([25.0, 25.0, 1.0, 25.0, 25.0])
    lane = np.array([0.0, 0.0, 0.0, np.pi, np.nan])
    course = np.degrees(plausible_course(heading, speed, lane))
    assert course[0] == 0.0
    assert 5.0 < course[1] < 12.0  # no fast vehicle turns across the lanes
    assert course[2] == pytest.approx(60.0)  # slowly anybody may
    assert abs((course[3] - 190.0 + 180.0) % 360.0 - 180.0) < 1.0  # 10 degrees off: nearly kept
    assert course[4] == pytest.approx(60.0)  # beside the network nothing is known
