"""`geoorbit track`: detections in, tracks out, offline."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.core.plugins import expected

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.storage.mot_text import MotTable
    from geoorbit_ros.tracking.tracker import VehicleTracker


def track(
    detections: Annotated[
        Path,
        typer.Option(
            "--detections", help="MOTChallenge text: frame,id,x,y,w,h,conf,class,-1,-1 per box."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="Where the tracks go: .txt as MOTChallenge text, .csv for geoorbit lanes."
        ),
    ],
    fps: Annotated[float, typer.Option(help="Frames per second of the recording.")] = 30.0,
    image_size: Annotated[
        str | None,
        typer.Option(
            "--image-size",
            metavar="WxH",
            help="Size of the camera's image in pixels, to see what leaves it; better ids.",
        ),
    ] = None,
    max_gap_s: Annotated[
        float, typer.Option("--max-gap-s", help="A vehicle unseen for longer is a new one.")
    ] = 1.5,
    min_score: Annotated[
        float, typer.Option("--min-score", help="Confidence of a detection that begins a track.")
    ] = 0.42,
    method: Annotated[
        str,
        typer.Option(
            "--tracker", metavar="NAME", help=f"What follows vehicles: {expected('tracker')}."
        ),
    ] = "kalman",
) -> None:
    """Give the boxes of a detector ids that last, offline, without a ROS graph.

    The tracks are those that the tracker node publishes for the same detections, without the
    predicted boxes: every box in the file was detected.

    Example: [bold]geoorbit track --detections det.txt --fps 25 --out tracks.txt[/bold]
    """
    from geoorbit_ros.cli.console import console, status
    from geoorbit_ros.cli.inputs import parse_image_size
    from geoorbit_ros.core.errors import ParameterError
    from geoorbit_ros.storage.mot_text import read_mot_detections

    size = parse_image_size(image_size) if image_size else (0, 0)
    tracker = _tracker(method, min_score, max_gap_s, size)
    if out.exists() and detections.exists() and out.samefile(detections):
        raise ParameterError("option --out", f"{out}, the input", "another path")
    with status(f"reading {detections}"):
        boxes = _write(out, read_mot_detections(detections), fps, tracker)
    seen = tracker.counts
    console.print(
        f" {seen.detections} detections in {seen.frames} frames became {seen.births} tracks with "
        f"{boxes} boxes; {seen.weak} were too weak."
    )
    console.print(f" Wrote {out}", soft_wrap=True)


def _tracker(
    method: str, min_score: float, max_gap_s: float, image_size: tuple[int, int]
) -> VehicleTracker:
    from geoorbit_ros.tracking.parameters import TrackerParameters
    from geoorbit_ros.tracking.tracker import make_tracker

    return make_tracker(
        method,
        TrackerParameters(
            high_score=min_score,
            birth_score=min_score,
            max_gap_s=max_gap_s,
            image_width=image_size[0],
            image_height=image_size[1],
        ),
    )


def _write(out: Path, table: MotTable, fps: float, tracker: VehicleTracker) -> int:
    """Write the tracks in the format that the name asks for; how many boxes there are."""
    import numpy as np

    from geoorbit_ros.core.tables import FLAG_PREDICTED, PIXEL_TRACK_DTYPE, Frames
    from geoorbit_ros.storage.mot_text import write_mot
    from geoorbit_ros.storage.track_csv import write_track_csv

    stamp_ns = table.frames(fps).stamp_ns

    def tracked() -> Iterator[tuple[int, NDArray[np.void]]]:
        from geoorbit_ros.cli.console import track as under_progress

        steps = zip(stamp_ns.tolist(), table, strict=True)
        for stamp, (number, rows) in under_progress(steps, "tracking", total=len(stamp_ns)):
            tracks = tracker.update(stamp, rows)
            yield number, tracks[(tracks["flags"] & FLAG_PREDICTED) == 0]

    if out.suffix != ".csv":
        return write_mot(out, tracked())
    tables = [rows for _, rows in tracked()]
    offset = np.append(0, np.cumsum([len(rows) for rows in tables])).astype(np.int64)
    rows = np.concatenate([np.empty(0, PIXEL_TRACK_DTYPE), *tables])
    write_track_csv(out, Frames(stamp_ns, offset, rows))
    return len(rows)
