"""Rendered video in, lanes out, against the exact truth: every shipped day scene, no model file.

Each scene is filmed for a minute, written as video and read again; moving vehicles are found,
tracked, placed on the road and made into lanes as `geoorbit process` does it. Scores are defined
in `geoorbit_ros.metrics.score`.

    python benchmarks/end_to_end.py [--scenes NAME,…] [--seed 1] [--cache FOLDER]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.camera_run import CameraRun, WatchedMapper
from geoorbit_ros.cli.console import error_console, make_progress
from geoorbit_ros.cli.images import warm_up_detector
from geoorbit_ros.cli.resume import DetectionRun
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.geojson import read_lanes
from geoorbit_ros.lanes.pipeline import map_blocks
from geoorbit_ros.metrics.lane_score import Tally
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.rendering.output import write_rendered_scene
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.storage.frames.open_source import open_frame_source

DURATION_S = 60.0
MEAN_M = 0.30
"""What is promised of every scene."""
NIGHT = "night_sparse"
COLUMNS = (
    "scene",
    "8+ veh. confirmed",
    "3–7 veh. found",
    "invented",
    "wrong way",
    "centre mean m",
    "95 % m",
    "width m",
    "seen %",
    "tracks",
    "images/s",
)


@dataclass(frozen=True)
class Outcome:
    """What came of one scene."""

    tally: Tally
    tracks: int
    images_per_s: float


def filmed(name: str, seed: int, cache: Path) -> Path:
    """Folder with the film of a scene and its truth; made unless that has been done."""
    folder = cache / f"{name}-{seed}"
    if not folder.exists():
        write_rendered_scene(render_scene(load_scene(name), DURATION_S, seed), folder)
    return folder


def run_scene(name: str, seed: int, cache: Path) -> Outcome:
    """Find the lanes of a film."""
    folder = filmed(name, seed, cache)
    points = read_control_points(folder / "calibration.csv")
    if points.datum is None:
        raise RuntimeError(f"{folder}: control points without degrees")
    mapper = WatchedMapper(make_estimator("curvilinear"))
    detector = make_detector(None)
    run = CameraRun(fit_homography(points), DetectionRun(detector), mapper)
    start_s = time.process_time()
    with open_frame_source(str(folder / "video.mp4")) as video:
        warm_up_detector(detector, video, None)
        try:
            lanes = map_blocks(run.ground_tracks(video), mapper).lanes
        except NoTrafficError:
            lanes = ()
    images_per_s = len(run.seen) / (time.process_time() - start_s)
    tally = Tally()
    tally.add(score_lanes(lanes, read_lanes(folder / "truth.geojson", points.datum).lanes))
    ids = np.unique(run.track_frames().rows["track_id"])
    return Outcome(tally, len(ids), images_per_s)


def show(outcomes: dict[str, Outcome]) -> None:
    """Print the table; what breaks the promise is red."""

    def mark(text: str, good: bool) -> str:
        return text if good else f"[red]{text}[/]"

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, column in enumerate(COLUMNS):
        table.add_column(column, justify="right" if k else "left", no_wrap=not k)
    for name, outcome in outcomes.items():
        tally = outcome.tally
        mean, p95, width = tally.errors_m()
        table.add_row(
            name,
            mark(f"{tally.busy_confirmed}/{tally.busy}", tally.busy_confirmed == tally.busy),
            mark(f"{tally.sparse_found}/{tally.sparse}", tally.sparse_found == tally.sparse),
            mark(str(tally.invented), tally.invented == 0),
            mark(str(tally.wrong_way), tally.wrong_way == 0),
            mark(f"{mean:.3f}", mean <= MEAN_M),
            f"{p95:.3f}",
            f"{width:.3f}",
            f"{100 * tally.coverage:.0f}",
            str(outcome.tracks),
            f"{outcome.images_per_s:.0f}",
        )
    error_console.print(table)


def run_scenes(names: list[str], seed: int, cache: Path, workers: int) -> dict[str, Outcome]:
    """Outcomes by scene."""
    with make_progress() as progress, ProcessPoolExecutor(workers) as pool:
        task = progress.add_task("filming and finding lanes", total=len(names))
        jobs = {pool.submit(partial(run_scene, name, seed, cache)): name for name in names}
        done = {}
        for job in as_completed(jobs):
            done[jobs[job]] = job.result()
            print(f"{jobs[job]}: done", file=sys.stderr)
            progress.advance(task)
    return {name: done[name] for name in names}


def main() -> None:
    day = [name for name in shipped_scenes() if name != NIGHT]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", help="comma between names; default: all shipped day scenes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cache", type=Path, help="keep the videos here and use them again")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    names = options.scenes.split(",") if options.scenes else day
    with tempfile.TemporaryDirectory() as scratch:
        cache = options.cache or Path(scratch)
        outcomes = run_scenes(names, options.seed, cache, options.workers)
    show(outcomes)
    faults = sum(outcome.tally.faults for outcome in outcomes.values())
    worst = np.nanmax([outcome.tally.errors_m()[0] for outcome in outcomes.values()])
    for name, ratio, limit in (
        ("rendered video: lanes missed, invented or turned", faults, 0.0),
        (f"rendered video: centreline mean of the worst scene / {MEAN_M} m", worst / MEAN_M, 1.0),
    ):
        print(json.dumps({"name": name, "ratio": round(float(ratio), 4), "limit": limit}))


if __name__ == "__main__":
    main()
