"""Runs the trackers of the package `trackers` on boxes from files.

Run by the Python of an environment with `trackers`: track_boxes.py JOBS.json

Each job names an input, an output, a tracker, its options and the frame rate. Input: `offset`
(F+1,) rows of frame k, `corners` (N, 4), `score` (N,), `class_id` (N,). Output: `frame`, `corners`,
`score`, `class_id`, `track_id` of the boxes that got an id, and the processor time `seconds`.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
import warnings
from typing import Any

import numpy as np
import supervision  # type: ignore[import-not-found,unused-ignore]

import trackers  # type: ignore[import-not-found,unused-ignore]

TRACKERS = {
    "SORT": "SORTTracker",
    "ByteTrack": "ByteTrackTracker",
    "OC-SORT": "OCSORTTracker",
    "BoT-SORT": "BoTSORTTracker",
}


def run(job: dict[str, Any]) -> None:
    """Track one recording."""
    with np.load(job["input"]) as file:
        offset, corners, score = file["offset"], file["corners"], file["score"]
        class_id = file["class_id"]
    tracker = getattr(trackers, TRACKERS[job["tracker"]])(frame_rate=job["fps"], **job["options"])
    found: list[Any] = []
    start = time.process_time()
    for a, b in itertools.pairwise(offset.tolist()):
        boxes = supervision.Detections(
            xyxy=corners[a:b], confidence=score[a:b], class_id=class_id[a:b]
        )
        found.append(tracker.update(boxes))
    seconds = time.process_time() - start
    frame = np.repeat(np.arange(len(found)), [len(f) for f in found])
    ids = np.concatenate([np.empty(0, int), *(f.tracker_id for f in found if len(f))])
    named = ids >= 0
    np.savez(
        job["output"],
        frame=frame[named],
        corners=np.concatenate([np.empty((0, 4)), *(f.xyxy for f in found)])[named],
        score=np.concatenate([np.empty(0), *(f.confidence for f in found if len(f))])[named],
        class_id=np.concatenate([np.empty(0), *(f.class_id for f in found if len(f))])[named],
        track_id=ids[named],
        seconds=seconds,
    )


def main() -> None:
    """Run all jobs."""
    warnings.simplefilter("ignore")
    with open(sys.argv[1], encoding="utf-8") as file:
        for job in json.load(file):
            run(job)


if __name__ == "__main__":
    main()
