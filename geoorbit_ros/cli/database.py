"""`geoorbit db`: look into the trajectory database, take data out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
) -> None:
    """Write stored vehicle tracks to CSV or Parquet, also while the recorder goes on.

    One row per vehicle and frame: camera_id, stamp_ns, track_id, position and speed in the map
    frame (x_m, y_m east and north of the datum), heading, size, score, error.

    Example: [bold]geoorbit db export trajectories.db --out may.parquet --from 2026-05-01
    --to 2026-06-01[/bold]
    """
    from geoorbit_ros.cli.console import format_size, make_progress, parse_time
    from geoorbit_ros.storage.database.export import export_tracks
    from geoorbit_ros.storage.database.reader import TrajectoryReader

    start_ns = None if start is None else parse_time(start, "option --from")
    end_ns = None if end is None else parse_time(end, "option --to")
    with TrajectoryReader(database) as reader, make_progress() as progress:
        whole = start_ns is None and end_ns is None
        wanted = [c for c in reader.cameras() if not camera_id or c.camera_id in camera_id]
        total = sum(c.rows for c in wanted) if whole else None  # unknown for a part of the time
        task = progress.add_task(f"writing {out.name}", total=total)
        rows = export_tracks(
            reader,
            out,
            camera_id or (),
            start_ns,
            end_ns,
            lambda done: progress.update(task, completed=done),
        )
    typer.echo(f"{out}: {rows} rows, {format_size(out.stat().st_size)}")
