"""The twin's lanes over all shipped scenes, as a share of the errors that are allowed.

True vehicles and, beside them, the imagined detector's boxes through tracker and homography drive
the scene's own network. A vehicle step is wrong when SUMO has the vehicle in another lane than the
scene's traffic; steps within a second of a true lane change are reported, not counted.

Of real cameras (where GEOORBIT_REAL_DATA names their folder) the true lanes are counted on the road
(`counted_lanes`), without the map, the lane detector or the twin: the twin's own filter can't check
itself, and a lane that both detector and twin have wrong counts as wrong. Three times: on the
map as it is, as the bridge does it by default; the same with its lanes where the map has them; and
on the map as `geoorbit twin patch` corrects it. Two cameras, a minute each.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from counted_lanes import CountedLanes
from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.mapcheck.driven_lanes import as_driven
from geoorbit_ros.mapcheck.patch import patch_network
from geoorbit_ros.mapcheck.validation import validate
from geoorbit_ros.roadnet.network import load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.scenes.traffic import simulate_traffic
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import Tracker
from geoorbit_ros.twin.replay import STEP_S, TrackStream, replay_tracks
from geoorbit_ros.twin.sumo_simulation import SumoSimulation
from scores.twin_truth import LaneTruth

DURATION_S = 60.0
IMAGE_SIZE = (1920, 1080)
REAL_CAMERAS = {
    "Yahara": {"26345858": 4, "6678140": 4},
    "Monona": {"1043656870": 4, "1101191826": 4},
}
"""The edges in view of each, and how many lanes the road has there, read off its traffic."""
ALLOWED, ALLOWED_AT_RAMPS = 0.005, 0.02
RAMPS = {"on_ramp_merge", "off_ramp_diverge", "lane_drop", "lane_begins"}

StampedRows = Iterator[tuple[int, NDArray[np.void]]]


def true_tracks(run: SceneRun) -> StampedRows:
    """Where the vehicles are that the camera sees."""
    for k, stamp_ns in enumerate(run.clean.stamp_ns.tolist()):
        yield stamp_ns, run.clean.frame(k)


def own_tracks(run: SceneRun) -> StampedRows:
    """The imagined detector's boxes, without their ids, through tracker and homography."""
    tracker = Tracker(TrackerParameters())
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    for k, stamp_ns in enumerate(run.frames.stamp_ns.tolist()):
        boxes = run.frames.frame(k)
        detections = np.zeros(len(boxes), DETECTION_DTYPE)
        for name in DETECTION_DTYPE.names or ():
            detections[name] = boxes[name]
        yield stamp_ns, projector.project(stamp_ns, tracker.update(stamp_ns, detections))


def try_scene(name: str, seed: int) -> None:
    """One scene, true tracks and own ones."""
    scene = load_scene(name)
    run, placed = simulate(scene, DURATION_S, seed), place_roads(scene)
    record = simulate_traffic(scene, placed, DURATION_S, seed)
    allowed = ALLOWED_AT_RAMPS if name in RAMPS else ALLOWED
    with tempfile.TemporaryDirectory() as folder:
        net = write_network(placed, Path(folder), run.datum)
        network = load_network(net, run.datum)
        for kind, tracks in (("true", true_tracks(run)), ("own", own_tracks(run))):
            truth, simulation = LaneTruth(record, network), SumoSimulation(net, STEP_S)
            stream = TrackStream("camera", tracks, run.datum)
            result = replay_tracks(network, simulation, [stream], truth.count)
            simulation.close()
            score, health = truth.score, result.health
            title = f"{name}, seed {seed}, {kind} tracks: wrong lanes / allowed"
            ratio = (1.0 - score.share) / allowed
            print(json.dumps({"name": title, "ratio": round(ratio, 4), "limit": 1.0}))
            print(
                f"{title}: {score.share:.2%} right of {score.right + score.wrong}, "
                f"{score.share_with_crossings:.2%} with crossings; 95 % within "
                f"{health.position_error_m_p95:.3f} m and {health.heading_error_deg_p95:.2f}°; "
                f"lost {health.lost}, doubled {score.doubled}, false {score.false_tracks}",
                file=sys.stderr,
            )


def try_camera(name: str, place: Path, counted: Mapping[str, int]) -> None:
    """One real camera: on the map as it is, with lanes as driven and as drawn; corrected."""
    points = read_control_points(place / "calibration.csv")
    content = read_track_csv(place / "trajectory.csv")
    homography = fit_homography(points)
    assert points.datum is not None
    lanes = map_lanes(
        project_frames(content, BoxProjector(homography, IMAGE_SIZE)),
        LaneMapper(make_estimator("curvilinear")),
    ).lanes
    network = load_network(place / "osm.net.xml.gz", points.datum)
    found = validate(lanes, network)
    alignment = found.alignment if found.alignment.significant else None
    driven = as_driven(network, found.discrepancies.driven)
    with tempfile.TemporaryDirectory() as folder:
        patched = patch_network(lanes, network, Path(folder)).network
        for kind, road, used, moved in (
            ("map as it is", network, alignment, driven),
            ("lanes as drawn", network, alignment, None),
            ("patched", patched, None, None),
        ):
            frames = project_frames(content, BoxProjector(homography, IMAGE_SIZE))
            stream = TrackStream(name, frames, points.datum, used)
            simulation, truth = SumoSimulation(road.path, STEP_S), CountedLanes(road, counted)
            result = replay_tracks(road, simulation, [stream], truth.take, driven=moved)
            simulation.close()
            count, health = truth.total(), result.health
            title = f"{name}, {kind}: wrong lanes / allowed"
            if kind == "map as it is":
                ratio = (1.0 - count.share) / ALLOWED
                print(json.dumps({"name": title, "ratio": round(ratio, 4), "limit": 1.0}))
            print(
                f"{title}: {count.share:.2%} right of {count.right + count.wrong}, "
                f"{count.share_with_crossings:.2%} with crossings, {count.left_out} left out; "
                f"nobody can know {count.unsure_right + count.unsure_wrong}, "
                f"of them {count.unsure_wrong} wrong; "
                f"95 % within {health.position_error_m_p95:.3f} m and "
                f"{health.heading_error_deg_p95:.2f}°; in another lane than the filter's "
                f"{health.lane_error_share:.2%}; lost {health.lost}; {result.events}",
                file=sys.stderr,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1])
    parser.add_argument("--scenes", nargs="*", default=shipped_scenes())
    given = parser.parse_args()
    for seed in given.seeds:
        for name in given.scenes:
            try_scene(name, seed)
    if folder := os.environ.get("GEOORBIT_REAL_DATA"):
        for name, counted in REAL_CAMERAS.items():
            try_camera(name, Path(folder) / "us12" / name, counted)


if __name__ == "__main__":
    main()
