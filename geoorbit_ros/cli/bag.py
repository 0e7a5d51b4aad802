"""`geoorbit bag`: rosbag2 bags of tracked boxes."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from geoorbit_ros.cli.inputs import (
    ClassesOption,
    ColumnsOption,
    ForceOption,
    StrictOption,
    TrackFpsOption,
    read_options,
    read_plane,
)

app = typer.Typer(help="Make and inspect bags of tracked boxes (rosbag2).", no_args_is_help=True)


class StorageName(StrEnum):
    """How the messages of a bag are stored."""

    MCAP = "mcap"
    SQLITE3 = "sqlite3"


@app.command("from-csv")
def from_csv(
    tracks: Annotated[
        Path,
        typer.Option(help="Tracked boxes, in any format that `geoorbit lanes` takes."),
    ],
    calibration: Annotated[
        Path, typer.Option(help="Control points: pixel_x,pixel_y,latitude,longitude (or x_m,y_m).")
    ],
    camera_id: Annotated[
        str, typer.Option(help="Namespace of the camera: the topic is /CAMERA_ID/tracks_px.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the new bag; new or empty.")],
    storage: Annotated[
        StorageName, typer.Option(help="mcap: a third of the size; sqlite3: older tools.")
    ] = StorageName.MCAP,
    fps: TrackFpsOption = None,
    columns: ColumnsOption = None,
    classes: ClassesOption = "coco",
    strict: StrictOption = False,
    force: ForceOption = False,
) -> None:
    """Turn a file of tracked boxes into a bag that `ros2 bag play` and `geoorbit replay` take.

    The calibration is only checked: the bag holds pixels.

    Example: [bold]geoorbit bag from-csv --tracks tracks.csv --calibration calibration.csv
    --camera-id north --out north_bag[/bold]
    """
    import numpy as np

    from geoorbit_ros.calibration.plausibility import calibration_report
    from geoorbit_ros.cli.console import format_size, print_remarks, status
    from geoorbit_ros.core.errors import CalibrationError
    from geoorbit_ros.storage.track_bag import describe_bag, write_track_bag
    from geoorbit_ros.storage.tracks.reader import read_tracks

    with status("reading"):
        plane = read_plane(calibration, strict=strict)
        frames, remarks = read_tracks(tracks, read_options(fps, columns, classes, strict))
        foot = frames.rows["y"] + frames.rows["height"] / 2
        on_road = plane.visible(np.column_stack((frames.rows["x"], foot)))
    if not on_road.any():
        raise CalibrationError(
            f"{calibration} with {tracks}",
            "every box above the horizon of these control points",
            "control points of the same camera at the same image size",
        )
    with status("writing"):
        write_track_bag(out, camera_id, frames, storage.value, overwrite=force)
    print_remarks(remarks, calibration_report(plane))
    info = describe_bag(out)
    typer.echo(
        f"{out}: /{camera_id}/tracks_px, {info.messages} messages, {len(frames.rows)} boxes, "
        f"{info.duration_ns / 1e9:.1f} s, {format_size(info.size_bytes)}; {on_road.mean():.0%} "
        "of the boxes have a place on the road by these control points"
    )


@app.command("info")
def info(
    bag: Annotated[Path, typer.Argument(help="Folder of the bag, or one of its files.")],
) -> None:
    """Show what is in a bag: topics, types, counts, duration.

    Example: [bold]geoorbit bag info north_bag[/bold]
    """
    from geoorbit_ros.cli.console import (
        console,
        format_size,
        format_time,
        make_table,
        print_remarks,
    )
    from geoorbit_ros.storage.track_bag import describe_bag

    found = describe_bag(bag)
    seconds = found.duration_ns / 1e9
    typer.echo(
        f"{bag}: {found.storage}, {format_size(found.size_bytes)}, {found.messages} messages, "
        f"{seconds:.3f} s from {format_time(found.start_ns)}"
    )
    table = make_table("", "topic|type|>messages|>rate (Hz)")
    for topic in found.topics:
        rate = f"{(topic.messages - 1) / seconds:.1f}" if seconds and topic.messages > 1 else "–"
        kind = topic.message_type or "unknown"
        kind += "" if topic.encoding == "cdr" else f" ({topic.encoding})"
        table.add_row(topic.name, kind, f"{topic.messages}", rate)
    console.print(table)
    print_remarks(found.report)
