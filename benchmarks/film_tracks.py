"""Ids and classes of the vehicles of a rendered film, as `geoorbit process` found them.

    ./dev run scene render on_ramp_merge --duration 60 --size 1280x720 --fps 12.5 --out out/film
    ./dev run process out/film/video.mp4 --calibration out/film/calibration.csv --out out/found
    .venv/bin/python benchmarks/film_tracks.py out/film/tracks.txt out/found/tracks.txt

A class is right if a track has that of the vehicle that most of its boxes show; tracks with fewer
than five such boxes are not asked.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.storage.mot_text import MotTable, read_mot_tracks
from scores.detection_score import box_corners, box_iou
from scores.tracking_score import MATCH_IOU, score_tracks

FEWEST_BOXES = 5


def vehicles(truth: MotTable, found: MotTable) -> dict[int, Counter[int]]:
    """For each track of `found`, how many of its boxes show which true vehicle."""
    of_frame = dict(truth)
    nobody: NDArray[np.void] = truth.rows[:0]
    shown: dict[int, Counter[int]] = {}
    for number, rows in found:
        true = of_frame.get(number, nobody)
        if not len(true):
            continue
        overlap = box_iou(box_corners(rows), box_corners(true))
        best = overlap.argmax(axis=1)
        for k in np.flatnonzero(overlap.max(axis=1) >= MATCH_IOU).tolist():
            vehicle = int(true["track_id"][best[k]])
            shown.setdefault(int(rows["track_id"][k]), Counter())[vehicle] += 1
    return shown


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("truth", type=Path)
    parser.add_argument("found", type=Path)
    given = parser.parse_args()
    truth, found = read_mot_tracks(given.truth), read_mot_tracks(given.found)
    score = score_tracks(truth.frames(1.0), found.frames(1.0))
    print(f"{score.result_tracks} ids for {score.true_tracks} vehicles")
    class_of = {int(row["track_id"]): int(row["class_id"]) for row in truth.rows}
    right = asked = 0
    for track_id, shown in vehicles(truth, found).items():
        if shown.total() >= FEWEST_BOXES:
            rows = found.rows[found.rows["track_id"] == track_id]
            vehicle, _ = shown.most_common(1)[0]
            (seen, _), *_ = Counter(rows["class_id"].tolist()).most_common(1)
            asked += 1
            right += seen == class_of[vehicle]
    print(f"class right for {right} of {asked} tracks, {100 * right / max(asked, 1):.1f} %")
    print(f"HOTA {100 * score.hota:.1f}, IDF1 {100 * score.idf1:.1f}, of vehicles of any size")


if __name__ == "__main__":
    main()
