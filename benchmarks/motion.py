"""Vehicles found without a YOLO model on rendered day scenes, against the exact truth.

Each scene is filmed for a minute as the end-to-end measurement does it, written as video and read
again; the detector first sees the recording once to learn the road, as `geoorbit detect` does it.
Recall and precision are those within the useful range (`scores.detection_score`):
boxes at least 16 px high in an image 1280 wide, of vehicles at least half visible.

    python benchmarks/motion.py [--detector network|motion] [--scenes NAME,…] [--seeds 1,…]
        [--cache FOLDER] [--every 1]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from end_to_end import filmed
from geoorbit_ros.cli.console import error_console, make_progress
from geoorbit_ros.cli.images import warm_up_detector
from geoorbit_ros.core.tables import FLAG_TRUNCATED, PIXEL_TRACK_DTYPE
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.scenes.scene import shipped_scenes
from geoorbit_ros.storage.frames.open_source import open_frame_source
from geoorbit_ros.storage.mot_text import read_mot_tracks
from scores.detection_score import DetectionScore

NIGHT = "night_sparse"
NEEDED = 0.9
COLUMNS = ("scene", "recall", "precision", "left", "top", "right", "bottom", "vehicles", "ms")


@dataclass(frozen=True)
class Outcome:
    """What came of one film.

    Attributes:
        score: Recall and precision.
        frame_ms: Median processor time per frame.
    """

    score: DetectionScore
    frame_ms: float


def with_flags(rows: NDArray[np.void], size: tuple[int, int]) -> NDArray[np.void]:
    """True boxes of a file, which has no flags: those at the border are cut there."""
    table = np.zeros(len(rows), PIXEL_TRACK_DTYPE)
    for name in rows.dtype.names or ():
        table[name] = rows[name]
    x, y, w, h = (rows[name] for name in ("x", "y", "width", "height"))
    inside = (x - w / 2 > 0.5) & (y - h / 2 > 0.5)
    inside &= (x + w / 2 < size[0] - 0.5) & (y + h / 2 < size[1] - 0.5)
    table["flags"] = np.where(inside, 0, FLAG_TRUNCATED)
    return table


def run_film(film: tuple[str, int], cache: Path, every: int, detector_name: str) -> Outcome:
    """Find the vehicles of one film."""
    cv2.setNumThreads(1)
    folder = filmed(*film, cache)
    truth = dict(iter(read_mot_tracks(folder / "tracks.txt")))
    nothing = np.empty(0, PIXEL_TRACK_DTYPE)
    detector, score, times = make_detector(Path(detector_name)), DetectionScore(), []
    with open_frame_source(str(folder / "video.mp4")) as video:
        warm_up_detector(detector, video, None)
        for number, (stamp_ns, image) in enumerate(video, 1):
            if number % every:
                continue
            start_s = time.process_time()
            rows = detector.detect(stamp_ns, image)
            times.append(time.process_time() - start_s)
            size = (image.shape[1], image.shape[0])
            score.add(rows, with_flags(truth.get(number, nothing), size), size[0])
    return Outcome(score, 1e3 * float(np.median(times)))


def show(outcomes: dict[tuple[str, int], Outcome]) -> None:
    """Print the table; edges are median errors in hundredths of the box's height."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, column in enumerate(COLUMNS):
        table.add_column(column, justify="right" if k else "left", no_wrap=not k)
    for (name, seed), outcome in outcomes.items():
        score = outcome.score
        shares = [f"{x:.3f}" if x >= NEEDED else f"[red]{x:.3f}[/]" for x in _shares(outcome)]
        edges = [f"{100 * x:+.1f}" for x in np.median(score.edge_errors, axis=0)]
        count = str(score.hits + score.missed)
        table.add_row(f"{name} {seed}", *shares, *edges, count, f"{outcome.frame_ms:.1f}")
    error_console.print(table)


def _shares(outcome: Outcome) -> tuple[float, float]:
    return outcome.score.recall, outcome.score.precision


def main() -> None:
    day = [name for name in shipped_scenes() if name != NIGHT]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector", default="network", choices=("network", "motion"))
    parser.add_argument("--scenes", help="comma between names; default: all shipped day scenes")
    parser.add_argument("--seeds", default="1", help="comma between numbers")
    parser.add_argument("--cache", type=Path, help="keep the videos here and use them again")
    parser.add_argument("--every", type=int, default=1, help="look at every so manieth frame")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    names = options.scenes.split(",") if options.scenes else day
    films = [(name, int(seed)) for name in names for seed in options.seeds.split(",")]
    with (
        tempfile.TemporaryDirectory() as scratch,
        ProcessPoolExecutor(options.workers) as pool,
        make_progress() as progress,
    ):
        cache = options.cache or Path(scratch)
        task = progress.add_task("filming and finding vehicles", total=len(films))
        outcomes = {}
        work = partial(run_film, cache=cache, every=options.every, detector_name=options.detector)
        for film, outcome in zip(films, pool.map(work, films), strict=True):
            outcomes[film] = outcome
            recall, precision = _shares(outcome)
            print(f"{film}: {recall:.3f} / {precision:.3f}", file=sys.stderr)
            progress.advance(task)
    show(outcomes)
    worst = np.array([_shares(outcome) for outcome in outcomes.values()]).min(axis=0)
    for what, share in zip(("recall", "precision"), worst, strict=True):
        name = f"{options.detector}, rendered day: 0.9 / {what} of the worst scene"
        print(json.dumps({"name": name, "ratio": round(NEEDED / share, 4), "limit": 1.0}))


if __name__ == "__main__":
    main()
