"""Accuracy of the lane estimators against exact truth, curvilinear beside the paper's geolane.

Every shipped scene runs for a minute through its camera, detector faults included; boxes become
ground tracks and lanes as `geoorbit lanes` does it. The real cameras take part where
GEOORBIT_REAL_DATA names their folder. Scores are defined in `geoorbit_ros.metrics.score`.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.console import error_console, make_progress
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import StampedRows, map_lanes, project_frames
from geoorbit_ros.metrics.lane_score import Tally
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.scenes.random_scene import random_scene
from geoorbit_ros.scenes.scene import Scene, load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.storage.track_csv import read_track_csv

ESTIMATORS = ("curvilinear", "geolane")
DURATION_S = 60.0
MEAN_M, P95_M, WIDTH_M, CLEAN_MEAN_M = 0.20, 0.40, 0.15, 0.05
"""What is promised of every scene, and of clean trajectories."""
CLEAN_SCENE, CLEAN_POINTS = "motorway_4x4", 20_000
CLEAN = {f"clean tracks, {duration_s:.0f} s": duration_s for duration_s in (60.0, 200.0)}
"""About `CLEAN_POINTS` of each, evenly thinned: more vehicles, each with fewer points."""
REAL_CAMERAS = ("Yahara", "Monona")
REAL_LANES = 4
"""Of each real camera: towards it, and as many away from it."""
GAIN = 0.25
"""The error of curvilinear is at most this share of geolane's."""
COLUMNS = (
    "place",
    "estimator",
    "8+ veh. confirmed",
    "3–7 veh. found",
    "invented",
    "wrong way",
    "centre mean m",
    "95 % m",
    "width m",
    "seen %",
)


def cells(tally: Tally) -> list[str]:
    """The table's cells after place and estimator; what breaks a promise is red."""

    def mark(text: str, good: bool) -> str:
        return text if good else f"[red]{text}[/]"

    errors = zip(tally.errors_m(), (MEAN_M, P95_M, WIDTH_M), strict=True)
    return [
        mark(f"{tally.busy_confirmed}/{tally.busy}", tally.busy_confirmed == tally.busy),
        mark(f"{tally.sparse_found}/{tally.sparse}", tally.sparse_found == tally.sparse),
        mark(str(tally.invented), tally.invented == 0),
        mark(str(tally.wrong_way), tally.wrong_way == 0),
        *(mark(_number(value, 3), not value > limit) for value, limit in errors),
        _number(100 * tally.coverage, 0),
    ]


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else "–"


Tallies = dict[str, Tally]
"""By estimator."""


def lanes_of(tracks: Iterable[StampedRows], estimator: str) -> Sequence[Lane]:
    """What `geoorbit lanes` finds."""
    try:
        return map_lanes(tracks, LaneMapper(make_estimator(estimator))).lanes
    except NoTrafficError:
        return ()


def clean_tracks(run: SceneRun) -> list[StampedRows]:
    """The true ground tracks of a run."""
    return [(int(stamp), run.clean.frame(k)) for k, stamp in enumerate(run.clean.stamp_ns)]


def scene_of(name: str) -> Scene:
    """A shipped scene, or `random_<seed>`."""
    kind, _, seed = name.rpartition("_")
    return random_scene(int(seed)) if kind == "random" else load_scene(name)


def scene_tallies(name: str, seeds: int, clean: bool) -> Tallies:
    """Both estimators on a scene, through the camera or from the true ground tracks."""
    tallies = {estimator: Tally() for estimator in ESTIMATORS}
    for seed in range(1, seeds + 1):
        run = simulate(scene_of(name), DURATION_S, seed)
        if clean:
            tracks = clean_tracks(run)
        else:
            projector = BoxProjector(fit_homography(run.control_points), run.image_size)
            tracks = list(project_frames(run.frames, projector))
        for estimator, tally in tallies.items():
            tally.add(score_lanes(lanes_of(tracks, estimator), run.truth))
    return tallies


def clean_tallies(duration_s: float) -> Tallies:
    """Both estimators on about `CLEAN_POINTS` true ground points of so many seconds."""
    run = simulate(load_scene(CLEAN_SCENE), duration_s, 1)
    tracks = clean_tracks(run)[:: max(1, round(len(run.clean.rows) / CLEAN_POINTS))]
    tallies = {estimator: Tally() for estimator in ESTIMATORS}
    for estimator, tally in tallies.items():
        tally.add(score_lanes(lanes_of(tracks, estimator), run.truth))
    return tallies


def real_tallies(folder: Path) -> Tallies:
    """Both estimators on a real camera: its lanes are counted per direction of travel."""
    projector = BoxProjector(
        fit_homography(read_control_points(folder / "calibration.csv")), (1920, 1080)
    )
    tracks = list(project_frames(read_track_csv(folder / "trajectory.csv"), projector))
    tallies = {}
    for estimator in ESTIMATORS:
        lanes = [lane for lane in lanes_of(tracks, estimator) if lane.status == "confirmed"]
        along = sum(bool(np.cos(lane.middle[2] - lanes[0].middle[2]) > 0.0) for lane in lanes)
        counts = along, len(lanes) - along
        found = [min(n, REAL_LANES) for n in counts]
        tallies[estimator] = Tally(2 * REAL_LANES, sum(found), invented=sum(counts) - sum(found))
    return tallies


def report(name: str, ratio: float, limit: float | None = None) -> None:
    """Print one line for the runner."""
    line = {"name": name, "ratio": round(ratio, 4)}
    print(json.dumps(line if limit is None else {**line, "limit": limit}), flush=True)


def report_scenes(rows: dict[str, Tallies], total: Tallies) -> None:
    """Print the ratios of all scenes."""
    ours = {name: tallies["curvilinear"] for name, tallies in rows.items()}
    mean = total["curvilinear"].errors_m()[0]
    report("curvilinear / geolane: centreline error", mean / total["geolane"].errors_m()[0], GAIN)
    report("curvilinear: lanes missed, invented or turned", total["curvilinear"].faults, 0.0)
    kinds = (("mean", MEAN_M), ("95 %", P95_M), ("width", WIDTH_M))
    for k, (kind, limit) in enumerate(kinds):
        worst = np.nanmax([tally.errors_m()[k] for tally in ours.values()])
        report(f"curvilinear: {kind} error of the worst scene / {limit:.2f} m", worst / limit, 1.0)


def run_jobs(jobs: dict[str, Callable[[], Tallies]], workers: int) -> dict[str, Tallies]:
    """Results by name, in the order of `jobs`."""
    with make_progress() as progress, ProcessPoolExecutor(workers) as pool:
        task = progress.add_task("measuring", total=len(jobs))
        names = {pool.submit(job): name for name, job in jobs.items()}
        done = {}
        for future in as_completed(names):
            done[names[future]] = future.result()
            progress.advance(task)
    return {name: done[name] for name in jobs}


def show(rows: dict[str, Tallies], markdown: Path | None) -> None:
    """Print the table, and write it for a README if asked for."""
    body = [
        [place if estimator == ESTIMATORS[0] else "", estimator, *cells(tallies[estimator])]
        for place, tallies in rows.items()
        for estimator in ESTIMATORS
    ]
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, column in enumerate(COLUMNS):
        table.add_column(column, justify="left" if k < 2 else "right", no_wrap=k < 2)
    for row in body:
        table.add_row(*row)
    error_console.print(table)
    if markdown:
        plain = [[c.replace("[red]", "**").replace("[/]", "**") for c in row] for row in body]
        lines = [" | ".join(row) for row in (COLUMNS, ["---"] * 2 + ["--:"] * 8, *plain)]
        markdown.write_text("".join(f"| {line} |\n" for line in lines), encoding="utf-8")


def real_cameras() -> tuple[dict[str, Path], str]:
    """Folders of the real cameras, and why there are none."""
    root = os.environ.get("GEOORBIT_REAL_DATA")
    if not root:
        return {}, "GEOORBIT_REAL_DATA isn't set"
    folders = {name: Path(root) / "us12" / name for name in REAL_CAMERAS}
    missing = [str(folder) for folder in folders.values() if not folder.is_dir()]
    return ({}, f"no folder {missing[0]}") if missing else (folders, "")


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", help="comma between names; default: all shipped scenes")
    parser.add_argument("--seeds", type=int, default=1, help="run each scene with seeds 1 to N")
    parser.add_argument("--clean", action="store_true", help="true ground tracks, no camera")
    parser.add_argument("--random", type=int, metavar="N", help="N random scenes instead")
    parser.add_argument("--seed", type=int, default=0, help="first of the random scenes")
    parser.add_argument(
        "--markdown", type=Path, metavar="FILE", help="write the table of docs/results.md"
    )
    parser.add_argument("--workers", type=int, default=2)
    return parser.parse_args()


def main() -> None:
    chosen = options()
    names = chosen.scenes.split(",") if chosen.scenes else shipped_scenes()
    if chosen.random:
        names = [f"random_{chosen.seed + k}" for k in range(chosen.random)]
    everything = not (chosen.scenes or chosen.random or chosen.clean)
    cameras, reason = real_cameras() if everything else ({}, "")

    jobs: dict[str, Callable[[], Tallies]] = {
        name: partial(scene_tallies, name, chosen.seeds, chosen.clean) for name in names
    }
    if everything:
        jobs |= {name: partial(clean_tallies, duration_s) for name, duration_s in CLEAN.items()}
    jobs |= {name: partial(real_tallies, folder) for name, folder in cameras.items()}
    rows = run_jobs(jobs, chosen.workers)
    scenes = {name: rows[name] for name in names}
    total: Tallies = {estimator: Tally() for estimator in ESTIMATORS}
    for tallies in scenes.values():
        for estimator, tally in total.items():
            tally.join(tallies[estimator])
    show({**rows, "all scenes": total}, chosen.markdown)

    report_scenes(scenes, total)
    if everything:
        for name in CLEAN:
            mean = rows[name]["curvilinear"].errors_m()[0]
            report(f"curvilinear: {name}, mean error / {CLEAN_MEAN_M} m", mean / CLEAN_MEAN_M, 1.0)
        name = "curvilinear: real cameras, lanes missed or invented"
        if reason:
            print(json.dumps({"name": name, "skipped": reason}))
        else:
            report(name, sum(rows[place]["curvilinear"].faults for place in cameras), 0.0)


if __name__ == "__main__":
    main()
