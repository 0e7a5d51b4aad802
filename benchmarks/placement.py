"""Lanes without a place, laid on a network by `mapcheck.placement`, against where they belong.

Scenes run for a minute with their surveyed calibration; the lanes are then turned and moved at
random and their scale is changed by some percent, as a calibration from traffic leaves it. The
network is the scene's own, the given place is off by up to 50 m. The two real cameras take part
where GEOORBIT_REAL_DATA names their folder, on OpenStreetMap's lanes as SUMO reads them.

    python benchmarks/placement.py [--random 60] [--first 0] [--shipped]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_blocks, project_blocks
from geoorbit_ros.mapcheck.placement import Placement, place_lanes
from geoorbit_ros.mapcheck.placement_fit import RoughPlace
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.random_scene import random_scene
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import simulate
from geoorbit_ros.storage.track_csv import read_track_csv

Array = NDArray[np.float64]
Case = tuple[str, tuple[Lane, ...], RoadNetwork, Array]

SCALE_SIGMA, TURN_SIGMA_RAD = 0.02, np.radians(30.0)
ALONG_M, ACROSS_M = 1.5, 0.3


def scenes(names: Sequence[str], seconds: float) -> Iterator[Case]:
    """Lanes, network, and the camera's foot."""
    for name in names:
        scene = random_scene(int(name)) if name.isdigit() else load_scene(name)
        run = simulate(scene, seconds, 3)
        plane = fit_homography(run.control_points)
        projector = BoxProjector(plane, run.image_size)
        mapper = LaneMapper(make_estimator("curvilinear"))
        lanes = map_blocks(project_blocks(run.frames, projector), mapper).lanes
        with tempfile.TemporaryDirectory() as folder:
            path = write_network(place_roads(scene), Path(folder), run.datum)
            yield name, lanes, load_network(path, run.datum), run.camera.centre_m[:2]


def real(folder: Path) -> Iterator[Case]:
    """The same of the two real cameras; below the camera is not known, so the lanes' middle."""
    for name in ("Yahara", "Monona"):
        frames = read_track_csv(folder / "us12" / name / "trajectory.csv")
        points = read_control_points(folder / "us12" / name / "calibration.csv")
        projector = BoxProjector(fit_homography(points), (1920, 1080))
        mapper = LaneMapper(make_estimator("curvilinear"))
        lanes = map_blocks(project_blocks(frames, projector), mapper).lanes
        network = load_network(folder / "us12" / name / "osm.net.xml.gz", points.datum)
        yield name, lanes, network, np.concatenate([k.centerline_m for k in lanes]).mean(axis=0)


def moved(lane: Lane, centre: Array, turn: float, shift: Array, scale: float) -> Lane:
    """A lane in another frame."""
    cos, sin = np.cos(turn), np.sin(turn)
    matrix = scale * np.array([[cos, sin], [-sin, cos]])
    lines = (lane.centerline_m, lane.left_m, lane.right_m)
    a, b, c = ((line - centre) @ matrix + shift for line in lines)
    return replace(lane, centerline_m=a, left_m=b, right_m=c)


def errors(placement: Placement, own: Array, true: Array) -> Array:
    """(2,) largest error along and across the road of points of the lanes and where they are."""
    error = placement.best.points(own) - true
    along, normal = placement.along, np.array([-placement.along[1], placement.along[0]])
    return np.array([np.abs(error @ along).max(), np.abs(error @ normal).max()])


def main() -> None:
    """Print a line per camera and the summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--random", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--shipped", action="store_true")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--near-sigma", type=float, default=25.0, help="of the pole's place, m")
    parser.add_argument("--looks", action="store_true", help="the direction is known to 30 degrees")
    args = parser.parse_args()
    names = [str(args.first + k) for k in range(args.random)]
    if args.shipped:
        names += shipped_scenes()
    cases = scenes(names, args.seconds)
    if data := os.environ.get("GEOORBIT_REAL_DATA"):
        cases = (case for part in (real(Path(data)), cases) for case in part)
    random = np.random.default_rng(1)
    rows = []
    for name, lanes, network, foot in cases:
        lanes = tuple(k for k in lanes if k.status == "confirmed")
        turn, scale = (
            float(random.uniform(0, 2 * np.pi)),
            float(np.exp(SCALE_SIGMA * random.standard_normal())),
        )
        near = foot + args.near_sigma * random.standard_normal(2)
        looks = -turn + TURN_SIGMA_RAD * float(np.clip(random.standard_normal(), -2, 2))
        away = [moved(k, foot, turn, np.zeros(2), scale) for k in lanes]
        started = time.process_time()
        try:
            turn_rad = looks if args.looks else None
            rough = RoughPlace(near, np.zeros(2), args.near_sigma, turn_rad=turn_rad)
            found = place_lanes(away, network, rough)
        except GeoOrbitError as error:
            print(f"{name:18} {error}")
            continue
        seconds = time.process_time() - started
        own = np.concatenate([k.centerline_m for k in away])
        true = np.concatenate([k.centerline_m for k in lanes])
        middle = np.argsort(np.hypot(*(own - own.mean(axis=0)).T))[: max(3, len(own) // 3)]
        along, across = errors(found, own[middle], true[middle])
        right = along <= ALONG_M and across <= ACROSS_M
        rows.append((found.sure, right, along, across))
        print(
            f"{name:18} {len(lanes):2} lanes  {'sure  ' if found.sure else 'unsure'} "
            f"{'right' if right else 'WRONG'}  along {along:6.2f} ± {found.along_sigma_m:6.2f}  "
            f"across {across:5.2f} ± {found.across_sigma_m:5.2f}  places {len(found.places):2} "
            f"residual {found.best.residual_m:.2f}  {seconds:.1f} s",
            flush=True,
        )
    sure = np.array([r[0] for r in rows])
    right = np.array([r[1] for r in rows])
    print(
        f"{len(rows)} cameras: {100 * right.mean():.0f} % placed within {ALONG_M} m along and "
        f"{ACROSS_M} m across, {sure.sum()} sure, {(sure & right).sum()} of them right"
    )


if __name__ == "__main__":
    main()
