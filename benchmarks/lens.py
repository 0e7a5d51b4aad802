"""What a lens costs: lanes of distorted scenes beside those of the same scenes without distortion.

Shipped scenes run for a minute through their camera, detector faults included, at several fields of
view and with k1 from -0.05 to -0.35: once with the lens known, once with the lens that the sixteen
control points show, once with the one that the vehicles' paths show. The traffic is the same each
time. Scores are defined in `geoorbit_ros.metrics.score`.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.lens_from_paths import estimate_lens_from_paths
from geoorbit_ros.cli.console import error_console, make_progress
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_blocks, project_blocks
from geoorbit_ros.metrics.lane_score import Tally
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene, with_camera
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.scenes.traffic import simulate_traffic

SCENES = ("straight_3x3", "motorway_4x4", "curve_250m")
FIELDS_DEG = (40.0, 58.0)
K1 = (-0.05, -0.12, -0.2, -0.28, -0.35)
NONE, KNOWN, POINTS, PATHS, IGNORED = "no lens", "known", "from points", "from paths", "ignored"
KINDS = (KNOWN, POINTS, PATHS, IGNORED)
WORSE_M = {KNOWN: 0.02, POINTS: 0.05, PATHS: 0.05}
"""By how much centrelines and widths may be worse than without distortion."""
DURATION_S, SEED = 60.0, 1
BORDER = 0.01
"""Share of the image's size at its border where boxes are cut; see `box_projector`."""


@dataclass(slots=True)
class Outcome:
    """Lanes of all scenes with one kind of calibration.

    Attributes:
        tally: Their scores.
        told: Scenes whose lens was found.
        scenes: Scenes.
        failed: Scenes that gave no lane at all.
        k1_error: |k1 - truth|, in units of the focal length, of those found.
    """

    tally: Tally
    told: int = 0
    scenes: int = 0
    failed: int = 0
    k1_error: tuple[float, ...] = ()


def paths_of(frames: Frames, image_size: tuple[int, int]) -> list[NDArray[np.float64]]:
    """Middles of each track's boxes, those at the border left out."""
    rows, size = frames.rows, image_size
    whole = np.ones(len(rows), bool)
    for at, side, end in (("x", "width", size[0]), ("y", "height", size[1])):
        whole &= rows[at] - rows[side] / 2 > BORDER * end
        whole &= rows[at] + rows[side] / 2 < (1 - BORDER) * end
    rows = rows[whole]
    xy = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
    return [xy[rows["track_id"] == k] for k in np.unique(rows["track_id"])]


def calibrated(run: SceneRun, kind: str) -> ControlPoints:
    """The control points with what that kind of calibration knows of the lens."""
    points, size = run.control_points, run.image_size
    if kind in (NONE, KNOWN):
        return points
    if kind == POINTS:
        return replace(points, facts=CameraFacts(size))
    if kind == IGNORED:  # nobody knows the size of the image, so that no lens is looked for
        return replace(points, facts=CameraFacts(), image_size=None)
    lens = estimate_lens_from_paths(paths_of(run.frames, size), size).lens
    return replace(points, facts=CameraFacts(size, lens), image_size=None if lens is None else size)


def add(outcome: Outcome, run: SceneRun, kind: str) -> None:
    """Find the lanes of one scene, and score them."""
    outcome.scenes += 1
    try:
        plane = fit_homography(calibrated(run, kind))
        blocks = project_blocks(run.frames, BoxProjector(plane, run.image_size))
        lanes = map_blocks(blocks, LaneMapper(make_estimator("curvilinear")), "scene").lanes
    except GeoOrbitError:
        outcome.failed += 1
        lanes = ()
    else:
        if (lens := plane.lens) is not None:
            outcome.told += 1
            outcome.k1_error += (abs(_k1(lens, run.camera.focal_px) - run.scene.camera.k1),)
    outcome.tally.add(score_lanes(lanes, run.truth))


def _k1(lens: Lens, focal_px: float) -> float:
    """k1 of a lens in units of another focal length."""
    return lens.k1 * (focal_px / lens.fx) ** 2


def runs(names: tuple[str, ...], fields: tuple[float, ...]) -> Iterator[tuple[float, SceneRun]]:
    """Every k1 and field of view of every scene, under the same traffic; k1 = 0 first."""
    for name in names:
        base = load_scene(name)
        record = simulate_traffic(base, place_roads(base), DURATION_S, SEED)
        for fov in fields:
            for k1 in (0.0, *K1):
                asked: dict[str, float | bool] = {"k1": k1, "horizontal_fov_deg": fov}
                scene = with_camera(base, asked, name)
                yield k1, simulate(scene, DURATION_S, SEED, traffic_record=record)


def measure(names: tuple[str, ...], fields: tuple[float, ...]) -> dict[tuple[float, str], Outcome]:
    """Outcomes by k1 and kind."""
    found: dict[tuple[float, str], Outcome] = defaultdict(lambda: Outcome(Tally()))
    total = len(names) * len(fields) * (1 + len(K1))
    with make_progress() as progress:
        task = progress.add_task("measuring", total=total)
        for k1, run in runs(names, fields):
            for kind in KINDS if k1 else (NONE, POINTS, PATHS):
                add(found[k1, kind], run, kind)
            progress.advance(task)
    return found


def show(found: dict[tuple[float, str], Outcome]) -> None:
    """Print the table."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    columns = "k1|lens|centre mean m|95 % m|width m|lanes missed, invented or turned|"
    columns += "lens found|k1 off, median"
    for name in columns.split("|"):
        table.add_column(name, justify="left" if name == "lens" else "right")
    for (k1, kind), outcome in found.items():
        errors = [f"{value:.3f}" for value in outcome.tally.errors_m()]
        off = f"{np.median(outcome.k1_error):.3f}" if outcome.k1_error else "–"
        told = f"{outcome.told}/{outcome.scenes}"
        table.add_row(f"{k1:g}", kind, *errors, str(outcome.tally.faults), told, off)
    error_console.print(table)


def report(found: dict[tuple[float, str], Outcome]) -> None:
    """Print the ratios: by how much the worst k1 is worse, over what it may be."""
    plain = found[0.0, NONE].tally.errors_m()
    for kind, limit in WORSE_M.items():
        for k, what in ((0, "centreline"), (2, "width")):
            worse = max(found[k1, kind].tally.errors_m()[k] - plain[k] for k1 in K1)
            line = {"name": f"lens {kind}: {what} worse than without / {limit:.2f} m"}
            print(json.dumps(line | {"ratio": round(worse / limit, 3), "limit": 1.0}), flush=True)
    seen = found[0.0, POINTS].told + found[0.0, PATHS].told
    line = {"name": "lenses seen where there is none"}
    print(json.dumps(line | {"ratio": float(seen), "limit": 0.0}), flush=True)


def main() -> None:
    """Measure, show and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", default=",".join(SCENES), help="comma between names")
    parser.add_argument("--fields", default=",".join(map(str, FIELDS_DEG)), help="of view, degrees")
    chosen = parser.parse_args()
    fields = tuple(float(word) for word in chosen.fields.split(","))
    found = measure(tuple(chosen.scenes.split(",")), fields)
    show(found)
    report(found)


if __name__ == "__main__":
    main()
