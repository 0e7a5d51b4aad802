"""`geoorbit twin demand`: a SUMO scenario of a day from a trajectory database."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import CameraIdOption, ForceOption
from geoorbit_ros.cli.twin.replay import NetOption

if TYPE_CHECKING:
    from collections.abc import Iterator

    from geoorbit_ros.cli.traffic_source import TrafficSource
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.traffic.interval_clock import IntervalClock

DatabaseArgument = Annotated[Path, typer.Argument(help="The recorder's SQLite file.")]
DayOption = Annotated[
    str | None,
    typer.Option("--day", metavar="YYYY-MM-DD", help="Which day; default: the last one stored."),
]


def demand(
    database: DatabaseArgument,
    net: NetOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; new or empty.")],
    day: DayOption = None,
    interval: Annotated[
        str, typer.Option("--interval", help="Length of intervals: 5min, 15min, 1h.")
    ] = "15min",
    timezone: Annotated[
        str | None,
        typer.Option(metavar="ZONE", help="Of the day, as Europe/Berlin; default: this machine's."),
    ] = None,
    lanes: Annotated[
        Path | None,
        typer.Option("--lanes", help="Count on these lanes, not on the last ones stored."),
    ] = None,
    camera_id: CameraIdOption = None,
    force: ForceOption = False,
) -> None:
    """Write a day's traffic as a SUMO scenario: flows per interval, way, lane and class.

    The vehicles stored are counted in their lanes. Into the folder go network.net.xml,
    demand.rou.xml (flows), demand.add.xml (types with the speeds that were measured) and
    demand.sumocfg: [bold]sumo -c demand.sumocfg[/bold] runs them. Time is in seconds since
    midnight. The folder counts has the same for routeSampler and flowrouter.

    Time that the camera did not watch has the traffic seen before and after it; the command says
    which.

    Example: [bold]geoorbit twin demand tracks.db --net area/network.net.xml --day 2026-05-04
    --out monday[/bold]
    """
    from geoorbit_ros.cli.console import console, say
    from geoorbit_ros.cli.traffic import clock_of
    from geoorbit_ros.cli.traffic_source import source_of_database
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.twin.demand.count_files import write_counts
    from geoorbit_ros.twin.demand.day_scenario import write_scenario
    from geoorbit_ros.twin.demand.measured_demand import measure_demand

    clock = clock_of(interval, timezone)
    check_new_folder(out, overwrite=force)
    source = source_of_database(database, camera_id, None, lanes)
    source = _between(source, database, *_day(database, source.camera_id, day, clock))
    found = measure_demand(source.count(), load_network(net, source.datum), clock)
    with atomic_output(out, overwrite=force) as folder:
        folder.mkdir()
        write_scenario(folder, found.counts)
        write_counts(folder / "counts", found.counts)
    for sentence in found.sentences():
        say(sentence)
    counts = found.counts.counts
    first, last = (clock.text(int(stamp)) for stamp in counts.edges_ns[[0, -1]])
    say(f"{counts.count.sum()} vehicles from {first} to {last}.")
    console.print(f" Wrote {out}", soft_wrap=True)


def _between(source: TrafficSource, database: Path, begin_ns: int, end_ns: int) -> TrafficSource:
    """The same with the frames from one stamp on and before another."""
    from dataclasses import replace

    from geoorbit_ros.storage.database.reader import TrajectoryReader

    def blocks() -> Iterator[Frames]:
        with TrajectoryReader(database) as reader:
            yield from reader.batches(source.camera_id, begin_ns, end_ns)

    return replace(source, blocks=blocks)


def _day(database: Path, camera_id: str, day: str | None, clock: IntervalClock) -> tuple[int, int]:
    """Stamps at which a day begins and ends; a recording that has no date is one day.

    Raises:
        ParameterError: No date, or a day of which nothing is stored.
    """
    from datetime import date, datetime
    from zoneinfo import ZoneInfo

    from geoorbit_ros.core.errors import ParameterError
    from geoorbit_ros.storage.database.reader import TrajectoryReader
    from geoorbit_ros.traffic.interval_clock import CLOCK_SINCE_NS, DAY_S, NS, IntervalClock

    with TrajectoryReader(database) as reader:
        stored = next(c for c in reader.cameras() if c.camera_id == camera_id)
    whole = IntervalClock(DAY_S, clock.zone)
    if stored.end_ns < CLOCK_SINCE_NS:
        if day is not None:
            found = f"times since the recording began in {database}"
            raise ParameterError("option --day", found, "a recording with dates, or no --day")
        return stored.start_ns, stored.end_ns + 1
    begin_ns = whole.start_of(stored.end_ns)
    if day is not None:
        try:
            wanted = date.fromisoformat(day)
        except ValueError as error:
            raise ParameterError("option --day", f"'{day}'", "a date: 2026-05-04") from error
        noon = datetime(wanted.year, wanted.month, wanted.day, 12, tzinfo=ZoneInfo(clock.zone))
        begin_ns = whole.start_of(int(noon.timestamp()) * NS)
    end_ns = whole.end_of(begin_ns)
    if end_ns <= stored.start_ns or begin_ns > stored.end_ns:
        first, last = (whole.text(stamp)[:10] for stamp in (stored.start_ns, stored.end_ns))
        raise ParameterError("option --day", f"'{day}'", f"a day from {first} to {last}")
    return begin_ns, end_ns
