"""`geoorbit db`: look into the trajectory database, take data out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from geoorbit_ros.lanes.lanes_over_time import LanesOverTime
    from geoorbit_ros.storage.database.reader import TrajectoryReader

app = typer.Typer(
    help="Look into the trajectory database that the recorder writes; export it.",
    no_args_is_help=True,
)

DatabaseArgument = Annotated[Path, typer.Argument(help="The recorder's SQLite file.")]
_TIME_HELP = "2026-05-01T06:00 (UTC without an offset), or seconds on the stamps' clock."


@app.command("info")
def info(database: DatabaseArgument) -> None:
    """Show what is stored: cameras, times, frames, vehicles, lane maps.

    Example: [bold]geoorbit db info trajectories.db[/bold]
    """
    from geoorbit_ros.cli.console import console, count_of, format_size, format_time, make_table
    from geoorbit_ros.storage.database.reader import TrajectoryReader

    with TrajectoryReader(database) as reader:
        cameras = reader.cameras()
    typer.echo(
        f"{database}: {format_size(database.stat().st_size)}, {count_of(len(cameras), 'camera')}"
    )
    table = make_table("", "camera|from|to|>frames|>rows|>maps")
    for camera in cameras:
        table.add_row(
            camera.camera_id,
            format_time(camera.start_ns).removesuffix(" UTC") if camera.frames else "–",
            format_time(camera.end_ns).removesuffix(" UTC") if camera.frames else "–",
            f"{camera.frames}",
            f"{camera.rows}",
            f"{camera.lane_maps}",
        )
    console.print(table)


@app.command("export")
def export(
    database: DatabaseArgument,
    out: Annotated[Path, typer.Option(help="New file, in .csv or .parquet.")],
    camera_id: Annotated[
        list[str] | None, typer.Option(help="Only this camera; may be given several times.")
    ] = None,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help=_TIME_HELP)] = None,
    end: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="Up to here, not included.")
    ] = None,
    timezone: Annotated[
        str | None,
        typer.Option(metavar="ZONE", help="Of local_time, as Europe/Berlin; default: this one's."),
    ] = None,
) -> None:
    """Write stored vehicle tracks to CSV or Parquet, also while the recorder goes on.

    One row per vehicle and frame: camera_id, stamp_ns, track_id, position and speed in the map
    frame (x_m, y_m east and north of the datum), heading, size, score, error, local_time. Where a
    lane map is stored, also latitude_deg, longitude_deg, lane_id, and lane_number, counted from the
    outer edge of the road.

    Example: [bold]geoorbit db export trajectories.db --out may.parquet --from 2026-05-01
    --to 2026-06-01[/bold]
    """
    from geoorbit_ros.cli.console import format_size, make_progress, parse_time, say
    from geoorbit_ros.cli.inputs import time_zone
    from geoorbit_ros.storage.database.export import export_tracks
    from geoorbit_ros.storage.database.reader import TrajectoryReader

    start_ns = None if start is None else parse_time(start, "option --from")
    end_ns = None if end is None else parse_time(end, "option --to")
    zone = time_zone(timezone)
    with TrajectoryReader(database) as reader, make_progress() as progress:
        whole = start_ns is None and end_ns is None
        wanted = [c for c in reader.cameras() if not camera_id or c.camera_id in camera_id]
        total = sum(c.rows for c in wanted) if whole else None  # unknown for a part of the time
        task = progress.add_task(f"writing {out.name}", total=total)
        maps = {camera.camera_id: _stored_maps(reader, camera.camera_id) for camera in wanted}
        rows = export_tracks(
            reader,
            out,
            camera_id or (),
            start_ns,
            end_ns,
            lambda done: progress.update(task, completed=done),
            lambda camera, frames: maps[camera].describe(frames),
            zone,
        )
    without = [camera_id for camera_id, found in maps.items() if not found]
    if without:
        say(f"No lane map is stored of {', '.join(without)}: lane and position on Earth are empty.")
    typer.echo(f"{out}: {rows} rows, {format_size(out.stat().st_size)}")


def _stored_maps(reader: TrajectoryReader, camera_id: str) -> LanesOverTime:
    from geoorbit_ros.lanes.lanes_over_time import LanesOverTime

    return LanesOverTime(
        reader.lane_map_stamps(camera_id),
        lambda stamp_ns: reader.lane_maps(camera_id, stamp_ns, stamp_ns + 1)[0][1],
        f"{reader.path}, lane map of {camera_id}",
    )
