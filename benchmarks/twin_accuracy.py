"""The twin's lanes over all shipped scenes, as a share of the errors that are allowed.

True vehicles and, beside them, the imagined detector's boxes through tracker and homography drive
the scene's own network. A vehicle step is wrong when SUMO has the vehicle in another lane than the
scene's traffic; steps within a second of a true lane change are reported, not counted.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.scenes.traffic import simulate_traffic
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import Tracker
from geoorbit_ros.twin.network import load_network
from geoorbit_ros.twin.replay import STEP_S, TrackStream, replay_tracks
from geoorbit_ros.twin.simulation import SumoSimulation
from geoorbit_ros.twin.truth import LaneTruth

DURATION_S, SEED = 60.0, 1
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


def main() -> None:
    for name in shipped_scenes():
        scene = load_scene(name)
        run, placed = simulate(scene, DURATION_S, SEED), place_roads(scene)
        record = simulate_traffic(scene, placed, DURATION_S, SEED)
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
                title = f"{name}, {kind} tracks: wrong lanes / allowed"
                ratio = (1.0 - score.share) / allowed
                print(json.dumps({"name": title, "ratio": round(ratio, 4), "limit": 1.0}))
                print(
                    f"{title}: {score.share:.2%} right of {score.right + score.wrong}, "
                    f"{score.share_with_crossings:.2%} with crossings; 95 % within "
                    f"{health.position_error_m_p95:.3f} m and {health.heading_error_deg_p95:.2f}°; "
                    f"lost {health.lost}, doubled {score.doubled}, false {score.false_tracks}",
                    file=sys.stderr,
                )


if __name__ == "__main__":
    main()
