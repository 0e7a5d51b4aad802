"""`geoorbit db`: look into the trajectory database, take data out."""

from __future__ import annotations

from dataclasses import astuple
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    import pyarrow as pa

    from geoorbit_ros.lanes.lanes_over_time import LanesOverTime
    from geoorbit_ros.storage.database.reader import TrajectoryReader
    from geoorbit_ros.storage.database.traffic import TrafficReader
    from geoorbit_ros.storage.database.traffic_series import SeriesContent, SeriesName

app = typer.Typer(
    help="Look into the trajectory database that the recorder writes; export it.",
    no_args_is_help=True,
)

DatabaseArgument = Annotated[Path, typer.Argument(help="The recorder's SQLite file.")]


VIEWS_SHOWN = 10
"""So many of the latest events of each camera's view are listed."""


class StoredTable(StrEnum):
    """What can be exported."""

    TRACKS = "tracks"
    INTERVALS = "intervals"
    VEHICLES = "vehicles"
    MOVEMENTS = "movements"
    EVENTS = "events"


OF_SERIES = (StoredTable.INTERVALS, StoredTable.MOVEMENTS)
"""Tables that each length of intervals has; of the others one is enough for a camera."""
_TIME_HELP = "2026-05-01T06:00 (UTC without an offset), or seconds on the stamps' clock."


@app.command("info")
def info(database: DatabaseArgument) -> None:
    """Show what is stored: cameras, times, frames, vehicles, lane maps, traffic.

    Example: [bold]geoorbit db info trajectories.db[/bold]
    """
    from geoorbit_ros.cli.console import console, count_of, format_size, format_time, make_table
    from geoorbit_ros.storage.database.traffic import TrafficReader

    with TrafficReader(database) as reader:
        cameras, series = reader.cameras(), reader.traffic_series()
        vehicles = {c.camera_id: reader.traffic_vehicle_count(c.camera_id) for c in cameras}
        events = [_event_count(reader, found.name) for found in series]
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
    _show_views(database)
    if series:
        _show_traffic(series, vehicles, events)


def _show_views(database: Path) -> None:
    """What happened to the cameras' views, in sentences: the latest of each camera."""
    from geoorbit_ros.cli.console import say
    from geoorbit_ros.storage.database.reader import TrajectoryReader
    from geoorbit_ros.view.timeline import stretch_of, utc_text

    with TrajectoryReader(database) as reader:
        for camera in reader.cameras():
            events = [stretch_of(*astuple(k)) for k in reader.view_events(camera.camera_id)]
            for event in [k for k in events if k.told][-VIEWS_SHOWN:]:
                say(f"{camera.camera_id}: {event.sentence(utc_text)}")


def _event_count(reader: TrafficReader, series: SeriesName) -> int:
    """How many events are stored."""
    import numpy as np

    rows = reader.traffic_events(series)
    return len(np.unique(rows["event_id"])) if len(rows) else 0


def _show_traffic(
    series: tuple[SeriesContent, ...], vehicles: dict[str, int], events: list[int]
) -> None:
    """A row for each camera, length of intervals, time zone and class scheme."""
    from geoorbit_ros.cli.console import console, make_table
    from geoorbit_ros.traffic.class_schemes import stored_scheme
    from geoorbit_ros.traffic.interval_clock import IntervalClock

    head = "camera|from|to|>interval\ns|classes|>intervals|>rows|>passages|>events"
    table = make_table("Traffic", head)
    for found, event_count in zip(series, events, strict=True):
        name = found.name
        clock = IntervalClock(name.length_s, name.zone)
        table.add_row(
            name.camera_id,
            clock.text(found.start_ns)[:16].replace("T", " "),  # local time, to the minute
            clock.text(found.end_ns)[:16].replace("T", " "),
            f"{name.length_s}",
            stored_scheme(name.scheme).name,
            f"{found.intervals}",
            f"{found.rows}",
            f"{vehicles[name.camera_id]}",
            f"{event_count}",
        )
    console.print(table)


@app.command("export")
def export(
    database: DatabaseArgument,
    out: Annotated[Path, typer.Option(help="New file, in .csv or .parquet.")],
    table: Annotated[
        StoredTable, typer.Option(help="Tracks, or traffic that the node traffic has stored.")
    ] = StoredTable.TRACKS,
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
    """Write stored vehicle tracks or traffic to CSV or Parquet, also while the recorder goes on.

    Of tracks, one row per vehicle and frame: camera_id, stamp_ns, track_id, position and speed in
    the map frame (x_m, y_m east and north of the datum), heading, size, score, error, local_time.
    Where a lane map is stored, also latitude_deg, longitude_deg, lane_id, and lane_number, counted
    from the outer edge of the road. The tables intervals, vehicles, movements and events have the
    columns of [bold]geoorbit traffic[/bold] after camera_id; times of intervals are in their own
    zone. Of events that is every one about which something was told between --from and --to.

    Example: [bold]geoorbit db export trajectories.db --out may.parquet --from 2026-05-01
    --to 2026-06-01[/bold]
    """
    from geoorbit_ros.cli.console import format_size, parse_time
    from geoorbit_ros.cli.inputs import time_zone

    start_ns = None if start is None else parse_time(start, "option --from")
    end_ns = None if end is None else parse_time(end, "option --to")
    if table is StoredTable.TRACKS:
        zone = time_zone(timezone)
        rows = _export_tracks(database, out, camera_id or [], start_ns, end_ns, zone)
    else:
        own = None if timezone is None else time_zone(timezone)
        rows = _export_traffic(database, out, table, camera_id or [], start_ns, end_ns, own)
    typer.echo(f"{out}: {rows} rows, {format_size(out.stat().st_size)}")


def _export_tracks(
    database: Path,
    out: Path,
    camera_ids: list[str],
    start_ns: int | None,
    end_ns: int | None,
    zone: str,
) -> int:
    """Write tracks; how many rows."""
    from geoorbit_ros.cli.console import make_progress, say
    from geoorbit_ros.storage.database.export import export_tracks
    from geoorbit_ros.storage.database.reader import TrajectoryReader

    with TrajectoryReader(database) as reader, make_progress() as progress:
        whole = start_ns is None and end_ns is None
        wanted = [c for c in reader.cameras() if not camera_ids or c.camera_id in camera_ids]
        total = sum(c.rows for c in wanted) if whole else None  # unknown for a part of the time
        task = progress.add_task(f"writing {out.name}", total=total)
        maps = {camera.camera_id: _stored_maps(reader, camera.camera_id) for camera in wanted}
        rows = export_tracks(
            reader,
            out,
            camera_ids,
            start_ns,
            end_ns,
            lambda done: progress.update(task, completed=done),
            lambda camera, frames: maps[camera].describe(frames),
            zone,
        )
    without = [camera_id for camera_id, found in maps.items() if not found]
    if without:
        say(f"No lane map is stored of {', '.join(without)}: lane and position on Earth are empty.")
    return rows


def _export_traffic(
    database: Path,
    out: Path,
    table: StoredTable,
    camera_ids: list[str],
    start_ns: int | None,
    end_ns: int | None,
    zone: str | None,
) -> int:
    """Write intervals or vehicles; how many rows.

    Raises:
        ParameterError: Nothing is stored, no such camera, or another suffix.
    """
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.storage.database.traffic import TrafficReader
    from geoorbit_ros.traffic.tables import write_csv, write_parquet

    write = {".csv": write_csv, ".parquet": write_parquet}.get(out.suffix.lower())
    if write is None:
        raise ParameterError("export file", f"'{out.name}'", "a name in .csv or .parquet")
    with TrafficReader(database) as reader:
        series = reader.traffic_series()
        known = list(dict.fromkeys(found.name.camera_id for found in series))
        for camera_id in camera_ids:
            if camera_id not in known:
                raise ParameterError("option --camera-id", f"'{camera_id}'", ", ".join(known))
        if not series:
            found = f"no finished interval in {database}"
            wanted_is = (
                "traffic that the node traffic has stored (geoorbit traffic --database counts)"
            )
            raise ParameterError("option --table", found, wanted_is)
        wanted = [s.name for s in series if not camera_ids or s.name.camera_id in camera_ids]
        parts = [
            _traffic_table(reader, table, name, (start_ns, end_ns), zone)
            for k, name in enumerate(wanted)
            if table in OF_SERIES or name.camera_id != wanted[k - 1].camera_id or not k
        ]
    with atomic_output(out) as temporary:
        write(temporary, parts)
    return sum(part.num_rows for part in parts)


def _traffic_table(
    reader: TrafficReader,
    table: StoredTable,
    series: SeriesName,
    between_ns: tuple[int | None, int | None],
    zone: str | None,
) -> pa.Table:
    """Stored rows of a series, or those of its camera: as `geoorbit traffic` has them."""
    import numpy as np
    import pyarrow as pa

    from geoorbit_ros.traffic import tables
    from geoorbit_ros.traffic.class_schemes import stored_scheme
    from geoorbit_ros.traffic.event_records import EVENT_DTYPE, newest_rows
    from geoorbit_ros.traffic.interval_clock import IntervalClock
    from geoorbit_ros.traffic.movements import MOVEMENT_DTYPE
    from geoorbit_ros.traffic.packed import unpack_measures, unpack_passages

    scheme = stored_scheme(series.scheme)
    clock = IntervalClock(series.length_s, zone or series.zone)
    start_ns = -(2**62) if between_ns[0] is None else between_ns[0]
    end_ns = 2**62 if between_ns[1] is None else between_ns[1]
    if table is StoredTable.INTERVALS:
        rows = unpack_measures(reader.traffic_rows(series, start_ns, end_ns))
        content = tables.interval_table(rows, scheme, clock)
    elif table is StoredTable.MOVEMENTS:
        moved = reader.traffic_movements(series, start_ns, end_ns)
        rows = moved.astype(MOVEMENT_DTYPE) if len(moved) else np.empty(0, MOVEMENT_DTYPE)
        content = tables.movement_table(rows, scheme, clock)
    elif table is StoredTable.EVENTS:
        told = reader.traffic_events(series, start_ns, end_ns)
        rows = newest_rows(told) if len(told) else np.empty(0, EVENT_DTYPE)
        content = tables.event_table(rows)
    else:
        vehicles = unpack_passages(reader.traffic_vehicles(series.camera_id, start_ns, end_ns))
        content = tables.vehicle_table(vehicles, scheme)
    names = pa.array(np.full(content.num_rows, series.camera_id, dtype=object), pa.string())
    return content.add_column(0, "camera_id", names)


def _stored_maps(reader: TrajectoryReader, camera_id: str) -> LanesOverTime:
    from geoorbit_ros.lanes.lanes_over_time import LanesOverTime

    return LanesOverTime(
        reader.lane_map_stamps(camera_id),
        lambda stamp_ns: reader.lane_maps(camera_id, stamp_ns, stamp_ns + 1)[0][1],
        f"{reader.path}, lane map of {camera_id}",
    )


@app.command("delete")
def delete(
    database: DatabaseArgument,
    camera_id: Annotated[str, typer.Option("--camera", "--camera-id", help="Of this camera.")],
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help=_TIME_HELP)] = None,
    end: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="Up to here, not included.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete what a camera recorded in a time: tracks, lane maps, vehicles, intervals, events.

    The recorder may go on meanwhile. What is deleted is overwritten in the file; backups and
    exports keep it.

    Example: [bold]geoorbit db delete trajectories.db --camera north --from 2026-05-01T06:00
    --to 2026-05-01T07:00 --yes[/bold]
    """
    from geoorbit_ros.cli.console import count_of, parse_time
    from geoorbit_ros.storage.database.maintenance import delete as delete_part

    start_ns = -(2**62) if start is None else parse_time(start, "option --from")
    end_ns = 2**62 if end is None else parse_time(end, "option --to")
    if start_ns >= end_ns:
        raise ParameterError("options --from and --to", f"{start} to {end}", "a time that lasts")
    if not yes:
        span = f"from {start or 'the beginning'} to {end or 'the end'}"
        typer.confirm(f"Delete all of '{camera_id}' {span}?", abort=True)
    gone = delete_part(database, camera_id, start_ns, end_ns)
    typer.echo(
        f"{database}: deleted {count_of(gone.frames, 'frame')},"
        f" {count_of(gone.lane_maps, 'lane map')}, {count_of(gone.traffic_rows, 'traffic row')}"
    )


@app.command("backup")
def backup(
    database: DatabaseArgument,
    out: Annotated[Path, typer.Option(help="New file.")],
) -> None:
    """Copy a database as it is at one moment, also while recorders write.

    Example: [bold]geoorbit db backup trajectories.db --out saved.db[/bold]
    """
    from geoorbit_ros.cli.console import format_size, make_progress
    from geoorbit_ros.storage.database.maintenance import backup as copy

    with make_progress() as progress:
        task = progress.add_task(f"writing {out.name}", total=None)
        copy(database, out, lambda done, all_: progress.update(task, completed=done, total=all_))
    typer.echo(f"{out}: {format_size(out.stat().st_size)}")


@app.command("restore")
def restore(
    saved: Annotated[Path, typer.Argument(help="A backup.")],
    database: Annotated[Path, typer.Argument(help="Where no database is.")],
) -> None:
    """Check a backup and put it where a recorder can go on with it.

    Example: [bold]geoorbit db restore saved.db trajectories.db[/bold]
    """
    from geoorbit_ros.cli.console import format_size
    from geoorbit_ros.storage.database.maintenance import restore as put_back

    put_back(saved, database)
    typer.echo(f"{database}: {format_size(database.stat().st_size)}")
