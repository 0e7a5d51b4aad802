"""The twin's lanes over all shipped scenes, as a share of the errors that are allowed.

True vehicles and, beside them, the imagined detector's boxes through tracker and homography drive
the scene's own network. A vehicle step is wrong when SUMO has the vehicle in another lane than the
scene's traffic; steps within a second of a true lane change are reported, not counted.

Of real cameras (where GEOORBIT_REAL_DATA names their folder) the true lanes are not known: a step
is wrong when SUMO has the vehicle in another lane than its track lies in, by place, heading and
history (`twin.matching`); steps within a second of a change of that lane are not counted either.
Twice: on the map as it is, and as `geoorbit twin patch` corrects it.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_points import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.lanes.factory import make_estimator
from geoorbit_ros.lanes.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.scenes.traffic import simulate_traffic
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import Tracker
from geoorbit_ros.twin.network import NONE, load_network
from geoorbit_ros.twin.patch import patch_network
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.replay import STEP_S, TrackStream, replay_tracks
from geoorbit_ros.twin.simulation import SumoSimulation
from geoorbit_ros.twin.truth import CROSSING_S, LaneTruth
from geoorbit_ros.twin.validation import validate

DURATION_S = 60.0
IMAGE_SIZE = (1920, 1080)
REAL_CAMERAS = ("Yahara", "Monona")
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


class MatchedLanes:
    """Counts vehicle steps in another lane than their tracks, away from changes of lane.

    Attributes:
        right, wrong: Steps.
    """

    def __init__(self) -> None:
        self._steps: dict[int, list[tuple[int, int, int]]] = {}

    def take(self, step: TwinStep) -> None:
        """Remember one step's vehicles."""
        known = step.observed & np.isfinite(step.xy[:, 0]) & (step.wanted_lane != NONE)
        for k in np.flatnonzero(known):
            row = (step.stamp_ns, int(step.wanted_lane[k]), int(step.lane[k]))
            self._steps.setdefault(int(step.vehicle_id[k]), []).append(row)

    def shares(self) -> tuple[float, float]:
        """Right of all steps, and of those a second away from changes."""
        every, steady = [], []
        for rows in self._steps.values():
            stamp, wanted, found = np.array(rows).T
            changes = stamp[1:][np.diff(wanted) != 0]
            gap = np.abs(stamp[:, None] - changes[None]).min(axis=1, initial=2**62)
            every.append(wanted == found)
            steady.append((wanted == found)[gap > CROSSING_S * 1e9])
        return float(np.concatenate(every).mean()), float(np.concatenate(steady).mean())


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
            result = replay_tracks(network, simulation, [stream], truth.judge)
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


def try_camera(name: str, place: Path) -> None:
    """One real camera, on the map as it is and on the corrected one."""
    points = read_control_points(place / "calibration.csv")
    content = read_track_csv(place / "trajectory.csv")
    homography = fit_homography(points)
    assert points.datum is not None
    lanes = map_lanes(
        project_frames(content, BoxProjector(homography, IMAGE_SIZE)),
        LaneMapper(make_estimator("curvilinear")),
    ).lanes
    network = load_network(place / "osm.net.xml.gz", points.datum)
    alignment = validate(lanes, network).alignment
    with tempfile.TemporaryDirectory() as folder:
        patched = patch_network(lanes, network, Path(folder)).network
        for road, move, kind in ((network, alignment, "map as it is"), (patched, None, "patched")):
            used = move if move is not None and move.significant else None
            frames = project_frames(content, BoxProjector(homography, IMAGE_SIZE))
            stream = TrackStream(name, frames, points.datum, used)
            simulation, matched = SumoSimulation(road.path, STEP_S), MatchedLanes()
            result = replay_tracks(road, simulation, [stream], matched.take)
            simulation.close()
            every, steady = matched.shares()
            title = f"{name}, {kind}: wrong lanes / allowed"
            ratio = (1.0 - steady) / ALLOWED
            print(json.dumps({"name": title, "ratio": round(ratio, 4), "limit": 1.0}))
            print(
                f"{title}: {steady:.2%} right, {every:.2%} with changes; 95 % within "
                f"{result.health.position_error_m_p95:.3f} m and "
                f"{result.health.heading_error_deg_p95:.2f}°; beside every lane "
                f"{result.health.beside_share:.2%}; lost {result.health.lost}; {result.events}",
                file=sys.stderr,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1])
    given = parser.parse_args()
    for seed in given.seeds:
        for name in shipped_scenes():
            try_scene(name, seed)
    if folder := os.environ.get("GEOORBIT_REAL_DATA"):
        for name in REAL_CAMERAS:
            try_camera(name, Path(folder) / "us12" / name)


if __name__ == "__main__":
    main()
