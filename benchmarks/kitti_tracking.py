"""The tracker beside those of the package `trackers` on KITTI tracking: cars from a moving car.

    export GEOORBIT_TRACKERS_PYTHON=peers/bin/python
    .venv/bin/python benchmarks/kitti_tracking.py LABELS DETECTIONS

LABELS is the benchmark's folder of `0000.txt` … `0020.txt`; DETECTIONS one of files of the same
names with lines `frame,type,left,top,right,bottom,score,…`, such as those of PointRCNN that come
with AB3DMOT (Weng et al. 2020), whose scores are logits. As in the benchmark, boxes that match a
van, that lie in unlabelled parts of the image or are lower than 25 pixels and match nothing are not
counted. Means over the sequences are weighted by their number of labelled boxes.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.core.tables import DETECTION_DTYPE, PIXEL_TRACK_DTYPE, Frames
from scores.detection_score import box_corners
from scores.tracking_score import score_tracks
from trackers import EVERY_PEER, PYTHON, Case, observed, peers, stacked, track

FPS = 10
SIZE = (1242, 375)
MIN_HEIGHT_PX = 25.0
"""Lower boxes are not counted where they match no label (KITTI's own evaluation)."""
MATCH = 0.5
"""Overlap (intersection over union) of a match, and share of a box in an unlabelled region."""


@dataclass
class Sequence:
    """A recording.

    Attributes:
        case: Detections and labelled cars.
        vans: Per frame, (V, 4) corners of vans.
        unlabelled: Per frame, (U, 4) corners of unlabelled regions.
    """

    case: Case
    vans: list[NDArray[np.float64]]
    unlabelled: list[NDArray[np.float64]]


def load(labels: Path, detections: Path) -> Sequence:
    """Read one sequence."""
    rows = [line.split() for line in labels.read_text().splitlines()]
    found = np.loadtxt(detections, delimiter=",", ndmin=2)
    count = int(max(max(int(row[0]) for row in rows), found[:, 0].max())) + 1
    stamps = np.arange(count, dtype=np.int64) * (10**9 // FPS) + 1
    cars, boxes, vans, unlabelled = [], [], [], []
    for k in range(count):
        of_frame = [row for row in rows if int(row[0]) == k]
        kind = {
            name: np.array([row[6:10] for row in of_frame if row[2] == name], float).reshape(-1, 4)
            for name in ("Car", "Van", "DontCare")
        }
        truth = table(kind["Car"], PIXEL_TRACK_DTYPE)
        truth["track_id"] = [int(row[1]) for row in of_frame if row[2] == "Car"]
        cars.append(truth)
        here = found[found[:, 0] == k]
        seen = table(here[:, 2:6], DETECTION_DTYPE)
        seen["score"] = 1.0 / (1.0 + np.exp(-here[:, 6]))
        boxes.append(seen)
        vans.append(kind["Van"])
        unlabelled.append(kind["DontCare"])
    case = Case(labels.stem, "KITTI", stacked(stamps, boxes), stacked(stamps, cars), SIZE)
    return Sequence(case, vans, unlabelled)


def table(corners: NDArray[np.float64], dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Rows of cars in boxes of left, top, right, bottom."""
    rows = np.zeros(len(corners), dtype)
    rows["x"], rows["y"] = 0.5 * (corners[:, :2] + corners[:, 2:]).T
    rows["width"], rows["height"] = (corners[:, 2:] - corners[:, :2]).T
    rows["score"], rows["class_id"] = 1.0, 2
    return rows


def overlaps(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """(A, B) intersection over union, and share of each `b` that lies in each `a`."""
    low, high = (
        np.maximum(a[:, None, :2], b[None, :, :2]),
        np.minimum(a[:, None, 2:], b[None, :, 2:]),
    )
    shared = np.clip(high - low, 0.0, None).prod(axis=2)
    area_a, area_b = (np.prod(c[:, 2:] - c[:, :2], axis=1) for c in (a, b))
    return shared / (area_a[:, None] + area_b - shared), shared / area_b


def counted(sequence: Sequence, tracks: Frames) -> Frames:
    """Tracks without the boxes that the benchmark does not count."""
    tables = []
    for k in range(len(tracks)):
        rows = tracks.frame(k)
        boxes, cars = box_corners(rows), box_corners(sequence.case.truth.frame(k))
        labelled = np.concatenate([cars, sequence.vans[k]])
        iou, _ = overlaps(labelled, boxes)
        label, box = linear_sum_assignment(-np.where(iou >= MATCH, iou, 0.0))
        good = iou[label, box] >= MATCH
        matched = np.isin(np.arange(len(rows)), box[good])
        van = np.isin(np.arange(len(rows)), box[good & (label >= len(cars))])
        _, inside = overlaps(sequence.unlabelled[k], boxes)
        nowhere = (rows["height"] <= MIN_HEIGHT_PX) | (inside > MATCH).any(axis=0)
        tables.append(rows[~van & (matched | ~nowhere)])
    return stacked(tracks.stamp_ns, tables)


def summary(name: str, sequences: list[Sequence], results: list[tuple[Frames, float]]) -> None:
    """Print one row of the table."""
    scores = [
        score_tracks(s.case.truth, counted(s, frames))
        for s, (frames, _) in zip(sequences, results, strict=True)
    ]
    weight = [len(s.case.truth.rows) for s in sequences]
    hota, idf1 = (
        np.average([getattr(s, n) for s in scores], weights=weight) for n in ("hota", "idf1")
    )
    switches = sum(s.id_switches for s in scores)
    rate = sum(len(s.case.frames) for s in sequences) / sum(seconds for _, seconds in results)
    print(f"| {name} | {100 * hota:.1f} | {100 * idf1:.1f} | {switches} | {rate:.0f} |", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("labels", type=Path)
    parser.add_argument("detections", type=Path)
    given = parser.parse_args()
    files = sorted(given.labels.glob("*.txt"))
    sequences = [load(file, given.detections / file.name) for file in files]
    print("| tracker | HOTA | IDF1 | id switches | frames per second |\n|---|--:|--:|--:|--:|")
    ours = [track(s.case) for s in sequences]
    summary("geoorbit", sequences, [(observed(frames), seconds) for frames, seconds in ours])
    summary("geoorbit, predicted boxes, too", sequences, ours)
    if not os.environ.get(PYTHON):
        print(json.dumps({"name": "peers", "skipped": f"{PYTHON} isn't set"}), file=sys.stderr)
        return
    for name in EVERY_PEER:
        summary(name, sequences, peers([s.case for s in sequences], name, {}))


if __name__ == "__main__":
    main()
