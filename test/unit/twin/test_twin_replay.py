"""The whole way: a scene's boxes, or real ones, through homography and bridge into SUMO."""

import dataclasses
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import sumolib
from made_twin import DATUM, made_network
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.main import main
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.lanes.pipeline import project_frames
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.output import write_scene_run
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene, load_scene
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.scenes.traffic import TrafficRecord, simulate_traffic
from geoorbit_ros.storage.track_bag import write_track_bag
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import Tracker
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.replay import ReplayScore, TrackStream, replay_tracks
from geoorbit_ros.twin.sumo_simulation import SumoSimulation
from scores.twin_truth import LaneScore, LaneTruth

DURATION_S, SEED = 20.0, 3
REAL = os.environ.get("GEOORBIT_REAL_DATA")


@dataclasses.dataclass(frozen=True)
class Watched:
    """A scene, its run and its traffic."""

    scene: Scene
    run: SceneRun
    record: TrafficRecord
    net: Path


@pytest.fixture(scope="module", params=["curve_250m", "on_ramp_merge"])
def watched(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Watched:
    scene = load_scene(request.param)
    run = simulate(scene, DURATION_S, SEED)
    placed = place_roads(scene)
    record = simulate_traffic(scene, placed, DURATION_S, SEED)
    net = write_network(placed, tmp_path_factory.mktemp("net"), run.datum)
    return Watched(scene, run, record, net)


def through_the_twin(
    watched: Watched, frames: list[tuple[int, NDArray[np.void]]]
) -> tuple[ReplayScore, LaneScore, list[TwinStep]]:
    network = load_network(watched.net, watched.run.datum)
    truth, steps = LaneTruth(watched.record, network), list[TwinStep]()

    def take(step: TwinStep) -> None:
        truth.count(step)
        steps.append(step)

    simulation = SumoSimulation(watched.net, 0.1)
    try:
        stream = TrackStream("c", frames, watched.run.datum)
        return replay_tracks(network, simulation, [stream], take), truth.score, steps
    finally:
        simulation.close()


def test_true_vehicles_are_followed_exactly(watched: Watched) -> None:
    """No vehicle is lost while it is tracked, none is doubled, and all are in their lanes."""
    clean = watched.run.clean
    frames = [(int(stamp), clean.frame(k)) for k, stamp in enumerate(clean.stamp_ns)]
    score, lanes, steps = through_the_twin(watched, frames)
    assert score.health.position_error_m_p95 < 0.05
    assert score.health.heading_error_deg_p95 < 1.0
    assert score.health.lost == score.health.overlapping_steps == 0
    assert lanes.false_tracks == lanes.doubled == 0
    assert lanes.share >= 0.995
    assert lanes.right > 800
    # Every track that both frames around a step have is a vehicle at that step.
    checked = 0
    for step in steps[1:]:
        after = int(np.searchsorted(clean.stamp_ns, step.stamp_ns))
        if after == len(clean):
            break
        there = np.intersect1d(clean.frame(after - 1)["track_id"], clean.frame(after)["track_id"])
        assert np.count_nonzero(step.observed) >= len(there)
        checked += len(there)
    assert checked > 800


def test_detections_through_the_tracker_are_in_their_lanes(watched: Watched) -> None:
    """The imagined detector's boxes without their ids, through our tracker and homography."""
    run = watched.run
    tracker = Tracker(TrackerParameters())
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    frames = []
    for k, stamp in enumerate(run.frames.stamp_ns.tolist()):
        boxes = run.frames.frame(k)
        detections = np.zeros(len(boxes), DETECTION_DTYPE)
        for name in DETECTION_DTYPE.names or ():
            detections[name] = boxes[name]
        frames.append((stamp, projector.project(stamp, tracker.update(stamp, detections))))
    score, lanes, _ = through_the_twin(watched, frames)
    assert score.health.position_error_m_p95 < 0.05
    assert score.health.heading_error_deg_p95 < 1.0
    assert score.health.lost == 0
    assert lanes.share >= (0.98 if "ramp" in watched.scene.name else 0.995)
    assert lanes.right > 600
    assert lanes.doubled <= 0.005 * lanes.right


@pytest.mark.parametrize("watched", ["on_ramp_merge"], indirect=True)
def test_replay_and_routes_of_a_bag(
    watched: Watched, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = write_scene_run(watched.run, tmp_path / "scene")
    given = [str(files.bag), "--net", str(files.network), "--calibration", str(files.calibration)]
    assert main(["twin", "replay", *given, "--out", str(tmp_path / "twin")]) == 0
    score = json.loads((tmp_path / "twin" / "score.json").read_text())
    assert score["position_error_m_p95"] < 0.05
    assert score["vehicles_total"] > 10
    lines = (tmp_path / "twin" / "vehicles.csv").read_text().splitlines()
    assert lines[0].startswith("time_s,vehicle,type,latitude")
    assert len(lines) - 1 == score["vehicle_steps"] + score["unseen_steps"]
    assert (tmp_path / "twin" / "twin.png").stat().st_size > 10_000

    assert main(["twin", "routes", *given, "--out", str(tmp_path / "demand")]) == 0
    capsys.readouterr()
    command = [sumolib.checkBinary("sumo"), "-c", str(tmp_path / "demand" / "traffic.sumocfg")]
    summary = tmp_path / "trips.xml"
    done = subprocess.run(
        [*command, f"--tripinfo-output={summary}"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert summary.read_text().count("<tripinfo ") > 10


@pytest.mark.parametrize("watched", ["on_ramp_merge"], indirect=True)
def test_what_can_not_be_replayed_is_one_sentence(
    watched: Watched, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = write_scene_run(watched.run, tmp_path / "scene")
    elsewhere = made_network(tmp_path)
    given = ["twin", "replay", str(files.bag), "--out", str(tmp_path / "twin")]
    calibration = ["--calibration", str(files.calibration)]
    for more, said in (
        (["--net", str(tmp_path / "no.net.xml"), *calibration], "no such file"),
        (["--net", str(files.network), *calibration, *calibration], "one per bag"),
        (["--net", str(elsewhere), *calibration], "a network that covers what the camera sees"),
        (["--net", str(files.truth), *calibration], "broken XML"),
    ):
        assert main([*given, *more]) == 2
        sentence = capsys.readouterr().err.strip().splitlines()[-1]
        assert said in sentence
        assert not (tmp_path / "twin").exists()
    assert watched.run.datum != DATUM


@pytest.mark.skipif(REAL is None, reason="GEOORBIT_REAL_DATA is not set")
@pytest.mark.parametrize(("name", "lane_error"), [("Monona", 0.005), ("Yahara", 0.03)])
def test_real_cameras_drive_their_network(name: str, lane_error: float, tmp_path: Path) -> None:
    """Yahara's map lies 1.4 m beside what the camera sees: there, lanes are near their borders."""
    folder = Path(str(REAL)) / "us12" / name
    frames = read_track_csv(folder / "trajectory.csv", (1920, 1080))
    count = int(np.searchsorted(frames.stamp_ns, frames.stamp_ns[0] + 20 * 10**9))
    kept = dataclasses.replace(
        frames,
        stamp_ns=frames.stamp_ns[:count],
        offset=frames.offset[: count + 1],
        rows=frames.rows[: frames.offset[count]],
    )
    write_track_bag(tmp_path / "bag", name, kept)
    command = ["twin", "replay", str(tmp_path / "bag"), "--net", str(folder / "osm.net.xml.gz")]
    command += ["--calibration", str(folder / "calibration.csv"), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    score = json.loads((tmp_path / "out" / "score.json").read_text())
    assert score["position_error_m_p95"] < 0.05
    assert score["heading_error_deg_p95"] < 1.0
    assert score["lost"] == 0
    assert score["lane_error_share"] < lane_error
    assert score["vehicle_steps"] > 2000


@pytest.mark.parametrize("watched", ["on_ramp_merge"], indirect=True)
def test_a_replay_is_the_same_every_time(watched: Watched) -> None:
    """Bit for bit, and whether frames come as a list or one by one."""
    run = watched.run
    made = [
        project_frames(run.frames, BoxProjector(fit_homography(run.control_points), run.image_size))
        for _ in range(2)
    ]
    as_list = through_the_twin(watched, list(made[0]))[2]
    network = load_network(watched.net, run.datum)
    simulation, steps = SumoSimulation(watched.net, 0.1), list[TwinStep]()
    replay_tracks(network, simulation, [TrackStream("c", made[1], run.datum)], steps.append)
    simulation.close()
    assert [s.stamp_ns for s in steps] == [s.stamp_ns for s in as_list]
    for a, b in zip(steps, as_list, strict=True):
        assert a.xy.tobytes() == b.xy.tobytes()
        assert (a.vehicle_id == b.vehicle_id).all()
