"""Time from boxes to lanes in blocks of frames, as `geoorbit lanes` runs, beside frame by frame.

Traffic: the recording of Yahara where GEOORBIT_REAL_DATA names its folder, else one minute of the
shipped scene motorway_4x4. Ground points are the lower edges of the boxes of every tenth vehicle.
`--day SHARE` plays the minute again and again, until a share of a busy day (40 million boxes) has
gone through in two processes, lanes and traffic, and says time and memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import Homography, fit_homography
from geoorbit_ros.core.frame_spool import FrameSpool
from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    PIXEL_TRACK_DTYPE,
    Frames,
    frames_from_rows,
)
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import BLOCK_ROWS, map_blocks, map_lanes, project_blocks
from geoorbit_ros.lanes.projection_helper import ProjectionHelper
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.traffic.count import record
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.traffic.interval_clock import GAP_S

ROUNDS = 5
DAY_ROWS = 40_000_000
EVERY = 10
"""Of so many vehicles, one is a ground point: one or two in a frame, as on a quiet road."""
LIMITS = {"boxes": 0.4, "ground points": 0.25}


@dataclass(frozen=True)
class Camera:
    """A minute of boxes and what projects them."""

    name: str
    frames: Frames
    homography: Homography
    image_size: tuple[int, int]

    def projector(self) -> BoxProjector:
        """A fresh one."""
        return BoxProjector(self.homography, self.image_size)


def minute_of_traffic() -> Camera:
    """The busiest minute at hand."""
    folder = os.environ.get("GEOORBIT_REAL_DATA")
    place = Path(folder) / "us12" / "Yahara" if folder else None
    if place and place.exists():
        frames = read_track_csv(place / "trajectory.csv")
        homography = fit_homography(read_control_points(place / "calibration.csv"))
        return Camera("Yahara", frames, homography, (1920, 1080))
    run = simulate(load_scene("motorway_4x4"), 60.0, 1)
    return Camera("motorway_4x4", run.frames, fit_homography(run.control_points), run.image_size)


def ground_points(frames: Frames) -> Frames:
    """The middles of the lower edges of some vehicles' boxes."""
    some = np.flatnonzero(frames.rows["track_id"] % EVERY == 0)
    rows, stamp_ns = frames.rows[some].copy(), frames.row_stamp_ns()[some]
    rows["y"] += rows["height"] / 2
    rows["width"] = rows["height"] = 0.0
    rows["flags"] |= FLAG_GROUND_POINT
    return frames_from_rows(stamp_ns, rows)


def frame_by_frame(camera: Camera, frames: Frames) -> None:
    """As the nodes do it."""
    projector = camera.projector()
    tracks = ((stamp_ns, projector.project(stamp_ns, rows)) for stamp_ns, rows in frames.tables())
    map_lanes(tracks, LaneMapper(make_estimator("curvilinear")))


def in_blocks(camera: Camera, frames: Frames) -> None:
    """As `geoorbit lanes` does it."""
    blocks = project_blocks(frames, camera.projector())
    map_blocks(blocks, LaneMapper(make_estimator("curvilinear")))


def seconds(call: Callable[[], object]) -> float:
    """Processor time of one call: other work on the machine does not count."""
    start = time.process_time()
    call()
    return time.process_time() - start


def compare(camera: Camera) -> None:
    """Print the ratios."""
    for what, frames in (("boxes", camera.frames), ("ground points", ground_points(camera.frames))):
        samples = [
            (
                seconds(lambda frames=frames: in_blocks(camera, frames)),  # type: ignore[misc]
                seconds(lambda frames=frames: frame_by_frame(camera, frames)),  # type: ignore[misc]
            )
            for _ in range(ROUNDS)
        ]
        blocks_s, frames_s = (statistics.median(times) for times in zip(*samples, strict=True))
        name = f"{what} of {camera.name} to lanes, in blocks / frame by frame"
        print(json.dumps({"name": name, "ratio": blocks_s / frames_s, "limit": LIMITS[what]}))
        note = f"{len(frames.rows)} rows, {len(frames)} frames, {blocks_s:.3f} s, {frames_s:.3f} s"
        print(f"{name}: {note}", file=sys.stderr)


def laps(frames: Frames, rows: int) -> Iterator[Frames]:
    """The minute again and again in blocks, with new vehicles and other noise each time."""
    random = np.random.default_rng(1)
    lap_ns = int(frames.stamp_ns[-1] - frames.stamp_ns[0]) + 50_000_000
    ids = 1 + int(frames.rows["track_id"].max())
    together = max(1, BLOCK_ROWS // len(frames.rows))
    for first in range(0, -(-rows // len(frames.rows)), together):
        lap = np.arange(first, first + together)
        table = np.tile(frames.rows, together)
        table["track_id"] += ids * np.repeat(lap, len(frames.rows)).astype(np.int32)
        for name in ("x", "y"):
            table[name] += random.normal(0.0, 0.3, len(table))
        stamps = (frames.stamp_ns + lap_ns * lap[:, None]).ravel()
        counts = np.tile(np.diff(frames.offset), together)
        yield Frames(stamps, np.append(0, np.cumsum(counts)), table)


def long_run(camera: Camera, share: float) -> None:
    """A share of a day, as `geoorbit traffic` takes a long recording."""
    blocks = laps(camera.frames, round(share * DAY_ROWS))
    boxes = FrameSpool.of(blocks, PIXEL_TRACK_DTYPE)
    mapper, times = LaneMapper(make_estimator("curvilinear")), [_times()]
    helper = ProjectionHelper(boxes, camera.projector())
    lanes, ground = map_blocks(helper.blocks(), mapper).lanes, helper.ground
    times.append(_times())
    counter = TrafficCounter(lanes, camera.homography)
    recorded = record(counter, ground.blocks(BLOCK_ROWS), GAP_S, beside=ground)
    times.append(_times())
    print(
        f"{boxes.row_count} boxes of {camera.name}, {recorded.vehicles} vehicles", file=sys.stderr
    )
    for what, before, after in zip(("lanes", "traffic"), times[:-1], times[1:], strict=True):
        wall_s, here_s, helper_s = (b - a for a, b in zip(before, after, strict=True))
        print(
            f"{what}: {wall_s:.1f} s, of processor time {here_s:.1f} s here and {helper_s:.1f} s "
            "in the second process",
            file=sys.stderr,
        )
    sizes = [resource.getrusage(of).ru_maxrss / 1e6 for of in (_HERE, _HELPERS)]
    print(f"memory: {sizes[0]:.2f} GB here, {sizes[1]:.2f} GB in the second", file=sys.stderr)


_HERE, _HELPERS = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN


def _times() -> tuple[float, float, float]:
    """Seconds on the wall, and of processor time here and in processes that have ended."""
    used = [resource.getrusage(of) for of in (_HERE, _HELPERS)]
    here_s, helpers_s = (one.ru_utime + one.ru_stime for one in used)
    return time.perf_counter(), here_s, helpers_s


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--day", type=float, metavar="SHARE", help="of a busy day, 0 to 1")
    options = parser.parse_args()
    camera = minute_of_traffic()
    if options.day:
        long_run(camera, options.day)
    else:
        compare(camera)


if __name__ == "__main__":
    main()
