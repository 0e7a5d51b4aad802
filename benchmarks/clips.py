"""Vehicles found in real films of fixed cameras, beside OpenCV's background models.

The clips are not part of the repository. A folder holds films and, for each film NAME.ext, a table
`truth/NAME.csv` with `frame,x1,y1,x2,y2` (pixels; frames count from 0; a row without numbers is a
frame that was looked at and shows no vehicle), and, if wanted, `truth/NAME.unsure.csv` with regions
in which boxes are neither right nor wrong. Of each film the first minute counts.

A true box counts if it is at least 20 px high and moves: a quarter of it differs from the median of
31 images. A box is right if it overlaps a true one by an IoU of 0.5. Recordings are seen once to
learn, as `geoorbit detect` does.

    python benchmarks/clips.py FOLDER [--names NAME,…] [--methods network,…] [--seconds 60]
        [--out FILE.json]
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.cli.console import console, make_progress
from geoorbit_ros.cli.images import SPACING_S
from geoorbit_ros.detection.detector import Detector
from geoorbit_ros.detection.motion.detector import MotionDetector
from geoorbit_ros.detection.network.detector import NetworkDetector
from scores.detection_score import MATCH_IOU, box_corners, box_iou

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Find = Callable[[int, Image], Array]

LONGEST_S = 60.0
"""Of each film so much counts; `--seconds` takes less."""
MIN_HEIGHT_PX = 20.0
MOVING_SHARE = 0.25
MOVING_CONTRAST = 26
"""Grey levels by which a moving vehicle differs from the median of the film."""
UNSURE_SHARE = 0.4
"""Share of a box in an unsure region from which it is neither right nor wrong."""
MEDIAN_IMAGES = 31
FILMS = (".mp4", ".avi", ".m4v", ".mkv", ".mov", ".wmv", ".webm")


@dataclass(frozen=True)
class Outcome:
    """What one method found in one film.

    Attributes:
        film: Its name.
        method: Such as `motion`.
        size: `width x height @ frames per second`.
        vehicles: True boxes that count.
        recall: Share of them that were found.
        precision: Share of the boxes that are right, unsure ones left out.
        frame_ms: Median processor time per image.
    """

    film: str
    method: str
    size: str
    vehicles: int
    recall: float
    precision: float
    frame_ms: float


class Film:
    """Images with stamps, and what is true in some of them."""

    def __init__(self, path: Path, longest_s: float) -> None:
        self.path, self.longest_s = path, longest_s
        video = cv2.VideoCapture(str(path))
        rate = video.get(cv2.CAP_PROP_FPS)
        self.fps = rate if 1.0 < rate < 130.0 else 25.0
        self.size = (int(video.get(3)), int(video.get(4)))
        self.truth = _boxes(path.parent / "truth" / f"{path.stem}.csv")
        self.unsure = _boxes(path.parent / "truth" / f"{path.stem}.unsure.csv")

    def images(self, spacing_s: float = 0.0) -> Iterator[tuple[int, int, Image]]:
        """Number, stamp and image, at least `spacing_s` apart."""
        video, number, last_s = cv2.VideoCapture(str(self.path)), 0, -1e9
        while (time_s := number / self.fps) < self.longest_s:
            there, image = video.read()
            if not there:
                return
            if time_s - last_s >= 0.99 * spacing_s:
                last_s = time_s
                yield number, round(1e9 * time_s), np.asarray(image, np.uint8)
            number += 1

    def median(self) -> Image:
        """The film without what moves."""
        count = sum(1 for _ in self.images())
        step = max(count // MEDIAN_IMAGES, 1)
        kept = [image for k, (_, _, image) in enumerate(self.images()) if k % step == step // 2]
        rows = range(0, self.size[1], 60)
        parts = [np.median([i[r : r + 60] for i in kept[:MEDIAN_IMAGES]], axis=0) for r in rows]
        return np.concatenate(parts).astype(np.uint8)


def _boxes(file: Path) -> dict[int, Array]:
    """Boxes (N, 4) by frame; nothing where there is no file."""
    found: dict[int, list[list[float]]] = defaultdict(list)
    if file.exists():
        with file.open(newline="", encoding="utf-8") as lines:
            for row in csv.DictReader(lines):
                boxes = found[int(row["frame"])]
                if row["x1"]:
                    boxes.append([float(row[name]) for name in ("x1", "y1", "x2", "y2")])
    return {frame: np.array(boxes).reshape(-1, 4) for frame, boxes in found.items()}


def own(make: Callable[[], Detector], film: Film) -> Find:
    """A detector of the package, which has seen the film once."""
    detector = make()
    detector.warm_up((stamp_ns, image) for _, stamp_ns, image in film.images(SPACING_S))
    return lambda stamp_ns, image: box_corners(detector.detect(stamp_ns, image))


def library(make: Callable[[], cv2.BackgroundSubtractor], film: Film) -> Find:
    """A background model of OpenCV with its shadow detection, opened, closed, boxes of blobs."""
    model = make()
    for _, _, image in film.images(SPACING_S):
        model.apply(image)
    kernel = np.ones((3, 3), np.uint8)

    def find(_stamp_ns: int, image: Image) -> Array:
        mask = (np.asarray(model.apply(image)) == 255).astype(np.uint8)
        mask = cv2.morphologyEx(cv2.medianBlur(mask, 3), cv2.MORPH_CLOSE, kernel, iterations=2)
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
        boxes = stats[1:, :4].astype(np.float64)
        boxes = boxes[stats[1:, 4] >= 0.3 * boxes[:, 2] * boxes[:, 3]]
        return np.column_stack((boxes[:, :2], boxes[:, :2] + boxes[:, 2:]))

    return find


METHODS: dict[str, Callable[[Film], Find]] = {
    "network": partial(own, NetworkDetector),
    "motion": partial(own, MotionDetector),
    "mog2": partial(library, cv2.createBackgroundSubtractorMOG2),
    "knn": partial(library, cv2.createBackgroundSubtractorKNN),
}


def run(path: Path, methods: list[str], longest_s: float) -> list[Outcome]:
    """Every method on one film."""
    cv2.setNumThreads(1)
    film = Film(path, longest_s)
    median = film.median()
    return [_score(film, median, method) for method in methods]


def _score(film: Film, median: Image, method: str) -> Outcome:
    find, times = METHODS[method](film), []
    hits = missed = false = 0
    for number, stamp_ns, image in film.images():
        start_s = time.process_time()
        boxes = find(stamp_ns, image)
        times.append(time.process_time() - start_s)
        if number not in film.truth:
            continue
        truth = film.truth[number]
        asked = _moves(truth, image, median) & (truth[:, 3] - truth[:, 1] >= MIN_HEIGHT_PX)
        overlap = box_iou(boxes, truth)
        row, column = linear_sum_assignment(-np.where(overlap >= MATCH_IOU, overlap, 0.0))
        right = overlap[row, column] >= MATCH_IOU
        found = np.isin(np.arange(len(truth)), column[right])
        hits, missed = hits + int((found & asked).sum()), missed + int((~found & asked).sum())
        wrong = boxes[~np.isin(np.arange(len(boxes)), row[right])]
        wrong = wrong[wrong[:, 3] - wrong[:, 1] >= MIN_HEIGHT_PX]
        unsure = np.vstack((film.unsure.get(number, np.empty((0, 4))), truth[~asked]))
        false += int((_inside(wrong, unsure) < UNSURE_SHARE).sum())
    size = f"{film.size[0]}x{film.size[1]} @ {film.fps:.0f}"
    recall, precision = hits / max(hits + missed, 1), hits / max(hits + false, 1)
    frame_ms = 1e3 * float(np.median(times))
    return Outcome(film.path.stem, method, size, hits + missed, recall, precision, frame_ms)


def _moves(boxes: Array, image: Image, median: Image) -> NDArray[np.bool_]:
    """(N,) whether a quarter of each box differs from the film's median."""
    differs = np.asarray(cv2.absdiff(image, median)).max(axis=2) > MOVING_CONTRAST
    corners = np.maximum(boxes, 0.0).astype(int)
    shares = [differs[y : b + 1, x : r + 1].mean() for x, y, r, b in corners]
    return np.array(shares, dtype=np.float64).reshape(-1) >= MOVING_SHARE


def _inside(boxes: Array, regions: Array) -> Array:
    """(N,) largest share of each box that lies in one of the regions."""
    if not len(boxes) or not len(regions):
        return np.zeros(len(boxes))
    low = np.maximum(boxes[:, None, :2], regions[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], regions[None, :, 2:])
    area = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-9, None).prod(axis=1)
    return np.asarray((np.clip(high - low, 0.0, None).prod(axis=2) / area[:, None]).max(axis=1))


def show(outcomes: list[Outcome], methods: list[str]) -> None:
    """One row per film, and the median and the worst of each method."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for k, column in enumerate(("film", "size", "vehicles", *methods)):
        table.add_column(column, justify="right" if k > 1 else "left")
    films = list(dict.fromkeys(o.film for o in outcomes))
    for film in films:
        of = {o.method: o for o in outcomes if o.film == film}
        cells = [
            f"{of[m].recall:.2f} / {of[m].precision:.2f} {of[m].frame_ms:.0f} ms" for m in methods
        ]
        first = of[methods[0]]
        table.add_row(film, first.size, str(first.vehicles), *cells)
    for word, take in (("median", np.median), ("worst", np.min)):
        cells = []
        for method in methods:
            mine = [o for o in outcomes if o.method == method and o.vehicles]
            cells.append(
                f"{take([o.recall for o in mine]):.2f} / {take([o.precision for o in mine]):.2f}"
            )
        table.add_row(f"[b]{word}[/b]", "", "", *cells)
    console.print("Recall / precision and processor time per image")
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--names", help="comma between names of films; default: all with a truth")
    parser.add_argument("--seconds", type=float, default=LONGEST_S, help="of each film that count")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--out", type=Path, help="also write the outcomes as JSON")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    methods = options.methods.split(",")
    films = sorted(f for f in options.folder.iterdir() if f.suffix.lower() in FILMS)
    names = options.names.split(",") if options.names else None
    films = [f for f in films if (f.parent / "truth" / f"{f.stem}.csv").exists()]
    films = [f for f in films if names is None or f.stem in names]
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(options.workers) as pool, make_progress() as progress:
        task = progress.add_task("finding vehicles", total=len(films))
        for found in pool.map(partial(run, methods=methods, longest_s=options.seconds), films):
            outcomes += found
            progress.advance(task)
    show(outcomes, methods)
    if options.out:
        text = json.dumps([asdict(outcome) for outcome in outcomes], indent=1)
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
