"""Time of the lane estimators: curvilinear beside the paper's geolane, and how it grows.

Traffic: the recording of Yahara where GEOORBIT_REAL_DATA names its folder, else one minute of the
shipped scene motorway_4x4, which is about as busy.
"""

from __future__ import annotations

import os

# scikit-learn's threads cost geolane more than they save on two cores: the peer runs at its best.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import Homography, fit_homography
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.estimators.estimator import LaneEstimator, make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper, derive_once
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate
from geoorbit_ros.storage.track_csv import read_track_csv

ROUNDS = 9
UPDATE_S = 5.0
LAPS = 6
GROWTH_POINTS = (1_000_000, 10_000_000)
Stream = list[tuple[int, NDArray[np.void]]]


def minute_of_traffic() -> tuple[str, Frames, Homography, tuple[int, int]]:
    """Name, boxes and camera of the busiest minute at hand."""
    folder = os.environ.get("GEOORBIT_REAL_DATA")
    camera = Path(folder) / "us12" / "Yahara" if folder else None
    if camera and camera.exists():
        frames = read_track_csv(camera / "trajectory.csv")
        homography = fit_homography(read_control_points(camera / "calibration.csv"))
        return "Yahara", frames, homography, (1920, 1080)
    run = simulate(load_scene("motorway_4x4"), 60.0, 1)
    return "motorway_4x4", run.frames, fit_homography(run.control_points), run.image_size


def filled(name: str, tracks: Stream) -> LaneEstimator:
    """An estimator that has seen `tracks`."""
    estimator = make_estimator(name)
    for stamp_ns, rows in tracks:
        estimator.add(stamp_ns, rows)
    return estimator


def seconds(call: Callable[[], object]) -> float:
    """Processor time of one call: other work on the machine does not count."""
    start = time.process_time()
    call()
    return time.process_time() - start


def once(name: str, tracks: Stream) -> float:
    """Time from ground tracks to lanes, all at once."""
    return seconds(lambda: derive_once(filled(name, tracks), LaneParameters()))


def from_boxes(name: str, frames: Frames, homography: Homography, size: tuple[int, int]) -> float:
    """Time from boxes to lanes as `geoorbit lanes` runs it, an update every five seconds."""
    mapper = LaneMapper(make_estimator(name))
    projector = BoxProjector(homography, size)
    return seconds(lambda: map_lanes(project_frames(frames, projector), mapper))


def laps(tracks: Stream, count: int) -> Iterator[tuple[int, NDArray[np.void]]]:
    """The minute again and again, with new vehicles each time."""
    lap_ns = tracks[-1][0] - tracks[0][0] + 1_000_000_000
    ids = 1 + max(int(rows["track_id"].max()) for _, rows in tracks if len(rows))
    for lap in range(count):
        for stamp_ns, rows in tracks:
            again = rows.copy()
            again["track_id"] += ids * lap
            yield stamp_ns + lap_ns * lap, again


def mean_update(lapped: Stream) -> float:
    """Mean time of an update over `LAPS` minutes, taking frames and derivations included."""
    mapper = LaneMapper(make_estimator("curvilinear"), update_period_s=UPDATE_S)
    spent, count = 0.0, 0
    for stamp_ns, rows in lapped:
        start = time.process_time()
        renewed = mapper.add(stamp_ns, rows)
        spent += time.process_time() - start
        count += renewed is not None
    return spent / count


def growth_s(tracks: Stream, points: int) -> float:
    """Time for about `points` rows, through the mapper."""
    per_lap = sum(len(rows) for _, rows in tracks)
    mapper = LaneMapper(make_estimator("curvilinear"), update_period_s=UPDATE_S)
    start = time.process_time()
    for stamp_ns, rows in laps(tracks, max(1, round(points / per_lap))):
        mapper.add(stamp_ns, rows)
    mapper.finish()
    return time.process_time() - start


def say(name: str, ratio: float, limit: float | None = None) -> None:
    """Print one ratio for the runner and for a reader."""
    line: dict[str, object] = {"name": name, "ratio": ratio}
    if limit is not None:
        line["limit"] = limit
    print(json.dumps(line), flush=True)
    print(f"{ratio:8.3f}  {name}", file=sys.stderr)


def main() -> None:
    """Measure and print."""
    place, frames, homography, size = minute_of_traffic()
    tracks = list(project_frames(frames, BoxProjector(homography, size)))
    lapped = list(laps(tracks, LAPS))
    once("geolane", tracks)  # loads scikit-learn
    samples: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        # In turn, so that a machine that slows down slows all of them.
        for name in ("geolane", "curvilinear"):
            samples.setdefault(f"{name} from scratch", []).append(once(name, tracks))
            samples.setdefault(f"{name} boxes", []).append(
                from_boxes(name, frames, homography, size)
            )
        samples.setdefault("curvilinear update", []).append(mean_update(lapped))
    median = {key: statistics.median(values) for key, values in samples.items()}
    for key, value in median.items():
        print(f"{1e3 * value:8.1f} ms  {key}", file=sys.stderr)
    what = f"{len(frames.rows)} boxes of {place}"
    geolane_s = median["geolane from scratch"]
    say(
        f"curvilinear / geolane from scratch: {what}, one map",
        median["curvilinear from scratch"] / geolane_s,
        1.0,
    )
    say(
        f"mean update of curvilinear, every {UPDATE_S:.0f} s of {LAPS} min, derivations included"
        f" / geolane: {what}",
        median["curvilinear update"] / geolane_s,
        0.2,
    )
    say(
        f"curvilinear / geolane: {what} to lanes, a map every {UPDATE_S:.0f} s",
        median["curvilinear boxes"] / median["geolane boxes"],
        1.0,
    )
    (few, few_s), (many, many_s) = ((n, growth_s(tracks, n)) for n in GROWTH_POINTS)
    say(
        f"time per point, {many:.0e} / {few:.0e} points",
        (many_s / many) / (few_s / few),
        1.2,
    )


if __name__ == "__main__":
    main()
