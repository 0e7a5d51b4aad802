"""`geoorbit traffic`: vehicles per lane, class and interval; speeds, headways, movements."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.camera_input import load_camera
from geoorbit_ros.cli.inputs import (
    DEFAULT_ESTIMATOR,
    BagOption,
    CameraIdOption,
    CameraInfoOption,
    ClassesOption,
    ColumnsOption,
    DatumOption,
    EstimatorOption,
    ForceOption,
    ImageSizeOption,
    RoadImageOption,
    StrictOption,
    TrackFpsOption,
    TracksOption,
    UpdatePeriodOption,
    read_options,
)
from geoorbit_ros.cli.traffic_source import TrafficSource, source_of_camera, source_of_database
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.traffic.class_schemes import ClassScheme
    from geoorbit_ros.traffic.count import Recorded
    from geoorbit_ros.traffic.interval_clock import IntervalClock
    from geoorbit_ros.traffic.stations import StationPlace

SHOWN_EVENTS = 10
"""So many events are told on the console. Chosen: more push the table out of sight."""
_UNIT_S = {"s": 1, "min": 60, "h": 3600, "d": 86_400}


OutOption = Annotated[Path, typer.Option("--out", help="Folder for the files; new or empty.")]
PointsOption = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="Control points: a CSV with pixel_x, pixel_y, latitude, longitude. With --database it "
        "only says how sure speeds are.",
    ),
]
DatabaseOption = Annotated[
    Path | None, typer.Option("--database", help="Ground tracks: the recorder's SQLite file.")
]
LanesOption = Annotated[
    Path | None, typer.Option("--lanes", help="Count on these lanes instead of finding them.")
]
IntervalOption = Annotated[
    str, typer.Option("--interval", help="Length of intervals: 30s, 15min, 1h, 1d.")
]
TimezoneOption = Annotated[
    str | None,
    typer.Option(
        "--timezone",
        metavar="ZONE",
        help="Of the intervals, as Europe/Berlin; default: this machine's.",
    ),
]
SchemeOption = Annotated[
    str,
    typer.Option("--class-scheme", help="Vehicle classes: coco, fhwa3, tls5+1 or a YAML file."),
]

StationOption = Annotated[
    str | None,
    typer.Option(
        "--station",
        metavar="LAT,LON|METRES",
        help="Count at this place, or so many metres along the longest lane of each direction; "
        "default: where traffic is seen best.",
    ),
]
RoadMapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="AREA.osm|NET.net.xml",
        help="Also write the traffic as SUMO and its tools read it, on this map: OUT/sumo.",
    ),
]


def traffic(
    out: OutOption,
    calibration: PointsOption = None,
    tracks: TracksOption = None,
    bag: BagOption = None,
    database: DatabaseOption = None,
    lanes: LanesOption = None,
    interval: IntervalOption = "15min",
    timezone: TimezoneOption = None,
    class_scheme: SchemeOption = "coco",
    station: StationOption = None,
    road_map: RoadMapOption = None,
    camera_id: CameraIdOption = None,
    estimator: EstimatorOption = DEFAULT_ESTIMATOR,
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_info: CameraInfoOption = None,
    image: RoadImageOption = None,
    update_period_s: UpdatePeriodOption = 5.0,
    fps: TrackFpsOption = None,
    columns: ColumnsOption = None,
    classes: ClassesOption = "coco",
    force: ForceOption = False,
    strict: StrictOption = False,
) -> None:
    """Count vehicles in their lanes: volumes, speeds, headways, movements.

    Into the folder go report.html (tables and pictures), vehicles.csv (a row per vehicle and lane),
    intervals.csv (a row per interval, lane and class), movements.csv (from which lane to which),
    events.csv (stopped and wrong-way vehicles, queues, unused lanes, drops of speed), the same as
    Parquet, and lanes.geojson. Nobody draws a line: the lanes are those of [bold]geoorbit
    lanes[/bold]. With --map, OUT/sumo has a scenario that SUMO runs, and counts for its tools.

    Example: [bold]geoorbit traffic --tracks tracks.csv --calibration calibration.csv
    --interval 5min --out traffic[/bold]
    """
    from geoorbit_ros.scenes.output import check_new_folder
    from geoorbit_ros.storage.atomic import atomic_output

    clock, scheme = clock_of(interval, timezone), _scheme(class_scheme)
    check_new_folder(out, overwrite=force)
    if database is not None:
        if tracks or bag:
            raise ParameterError("options --tracks, --bag and --database", "two", "one of them")
        source = source_of_database(database, camera_id, calibration, lanes)
    else:
        if calibration is None:
            raise ParameterError("option --calibration", "nothing", "a file of control points")
        options = read_options(fps, columns, classes, strict)
        named = (camera_id, image_size, datum, out, options, image, camera_info)
        camera = load_camera(tracks, bag, calibration, *named, long=True)
        source = source_of_camera(camera, lanes, estimator, update_period_s, image)
    with atomic_output(out, overwrite=force) as folder:
        folder.mkdir()
        recorded = _counted(source, clock, station, one_map=road_map is not None)
        _write(folder, source, recorded, scheme, clock)
        _write_page(folder / "report.html", source, recorded, scheme, clock)
        said = _write_for_sumo(folder / "sumo", road_map, source, recorded, clock)
    _tell(out, source, recorded, scheme, clock, said)


def _write(
    folder: Path,
    source: TrafficSource,
    recorded: Recorded,
    scheme: ClassScheme,
    clock: IntervalClock,
) -> None:
    from geoorbit_ros.traffic.count import all_measures, all_movements
    from geoorbit_ros.traffic.tables import (
        event_table,
        interval_table,
        movement_table,
        vehicle_table,
        write_csv,
        write_parquet,
    )

    tables = {
        "vehicles": [vehicle_table(recorded.passages, scheme)],
        "intervals": [
            interval_table(measures, scheme, clock)
            for measures in all_measures(recorded, scheme, clock)
        ],
        "movements": [movement_table(all_movements(recorded, scheme, clock), scheme, clock)],
        "events": [event_table(recorded.events)],
    }
    for name, parts in tables.items():
        write_csv(folder / f"{name}.csv", parts)
        write_parquet(folder / f"{name}.parquet", parts)
    source.write_lanes(folder / "lanes.geojson", recorded)


def _write_page(
    path: Path,
    source: TrafficSource,
    recorded: Recorded,
    scheme: ClassScheme,
    clock: IntervalClock,
) -> None:
    """The tables and pictures as one HTML page."""
    from geoorbit_ros import __version__
    from geoorbit_ros.cli.console import status
    from geoorbit_ros.report.traffic.content import traffic_content
    from geoorbit_ros.report.traffic.page import provenance_of, write_traffic_report

    with status("drawing the report"):
        content = traffic_content(source.camera_id, recorded, scheme, clock, source.frames_between)
        made = [*source.files, *provenance_of(content), ("geoorbit", __version__)]
        write_traffic_report(path, content, made, source.reports())


def _write_for_sumo(
    folder: Path,
    road_map: Path | None,
    source: TrafficSource,
    recorded: Recorded,
    clock: IntervalClock,
) -> list[str]:
    """Counts for SUMO's tools, if a map is given; what is to be said about them."""
    if road_map is None:
        return []
    from geoorbit_ros.roadnet.map_build import build_from_osm
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.roadnet.network_file import is_network
    from geoorbit_ros.twin.demand.count_files import write_counts
    from geoorbit_ros.twin.demand.day_scenario import write_scenario
    from geoorbit_ros.twin.demand.measured_demand import measure_demand

    folder.mkdir()
    if is_network(road_map):
        network = load_network(road_map, source.datum)
    else:
        network = build_from_osm(road_map, folder, source.datum).network
    demand = measure_demand(recorded, network, clock)
    write_counts(folder, demand.counts)
    write_scenario(folder, demand.counts)
    return demand.sentences()


def _tell(
    out: Path,
    source: TrafficSource,
    recorded: Recorded,
    scheme: ClassScheme,
    clock: IntervalClock,
    said: Sequence[str],
) -> None:
    """One row per lane for the whole recording, and the events."""
    import numpy as np

    from geoorbit_ros.cli.console import console, count_of, make_table, print_remarks, say
    from geoorbit_ros.report.text import number
    from geoorbit_ros.report.traffic.tables import with_error
    from geoorbit_ros.report.traffic.text import event_sentences, uncounted_sentences
    from geoorbit_ros.traffic.count import whole_measures

    table = make_table(
        f"Traffic of {source.camera_id}",
        ">station|>lane\nid|>lane\nno.|>vehicles|>veh/h|>km/h|>85 %\nkm/h|>headway\ns|>heavy\n%",
    )
    for row in whole_measures(recorded, scheme):
        total = row["lane_id"] == 0
        table.add_row(
            str(row["station_id"]),
            "all" if total else str(row["lane_id"]),
            "" if total else str(row["lane_number"]),
            str(row["volume"]),
            number(row["flow_veh_per_h"], 0),
            with_error(row["time_mean_speed_kmh"], row["time_mean_speed_sigma_kmh"]),
            number(row["speed_p85_kmh"], 1),
            number(row["headway_mean_s"], 1),
            number(100.0 * row["heavy_share"], 0),
            end_section=bool(total),
        )
    console.print(table)
    crossed = len(np.unique(recorded.crossings["vehicle_id"]))
    not_crossed = recorded.vehicles - recorded.in_no_lane - crossed
    for sentence in uncounted_sentences(recorded.vehicles, recorded.in_no_lane, not_crossed):
        say(sentence)
    for sentence in _station_sentences(recorded, source.datum):
        say(sentence)
    for sentence in event_sentences(recorded.events, clock.zone)[:SHOWN_EVENTS]:
        say(sentence)
    more = len(recorded.events) - SHOWN_EVENTS
    if more > 0:
        say(f"{count_of(more, 'more event')} in events.csv.")
    print_remarks(*source.reports())
    _say_where(out, recorded, clock, said)


def _say_where(out: Path, recorded: Recorded, clock: IntervalClock, said: Sequence[str]) -> None:
    from geoorbit_ros.cli.console import console, say

    for sentence in said:
        say(sentence)
    spans = recorded.observed.spans_ns
    watched_s = sum(b - a for a, b in spans) / 1e9
    length_s = (recorded.last_ns - recorded.first_ns) / 1e9
    pauses = "" if len(spans) < 2 else f" in {len(spans)} stretches"
    console.print(
        f" Watched {watched_s:.0f} of {length_s:.0f} s{pauses}, from "
        f"{clock.text(recorded.first_ns)}; wrote {out}",
        soft_wrap=True,
    )


def _station_place(given: str | None, datum: Datum) -> StationPlace | None:
    """The place of `--station`.

    Raises:
        ParameterError: Neither a place on earth nor metres.
    """
    import numpy as np

    from geoorbit_ros.cli.inputs import parse_datum
    from geoorbit_ros.traffic.stations import StationPlace

    if given is None:
        return None
    try:
        if "," not in given:
            return StationPlace(along_m=float(given))
        place = parse_datum(given)
        assert place is not None
    except (ValueError, ParameterError) as error:
        expected = "LATITUDE,LONGITUDE or metres along the road"
        raise ParameterError("option --station", repr(given), expected) from error
    point_m = datum.to_local(np.array([place.latitude_deg]), np.array([place.longitude_deg]))
    return StationPlace(point_m[0])


def _counted(
    source: TrafficSource, clock: IntervalClock, station: str | None, *, one_map: bool
) -> Recorded:
    """Count all vehicles; SUMO's files are of one network, and so of one lane map."""
    place = _station_place(station, source.datum)
    recorded = source.count(None if one_map else clock, place)
    _check_stations(place, station, recorded)
    return recorded


def _check_stations(place: StationPlace | None, given: str | None, recorded: Recorded) -> None:
    """Whether any direction has its station at the place.

    Raises:
        ParameterError: It is beside no lane.
    """
    if place is None or any(place.on(lane) is not None for lane in recorded.counter.lanes):
        return
    longest_m = max(lane.length_m for lane in recorded.counter.lanes)
    expected = f"a place beside a lane, or 0 to {longest_m:.0f} m along the longest"
    raise ParameterError("option --station", repr(given), expected)


def _station_sentences(recorded: Recorded, datum: Datum) -> list[str]:
    """Where each counting station is."""
    counter = recorded.counter
    said = []
    for station in counter.stations:
        ((latitude, longitude),) = datum.to_geodetic(station.place_m[None]).tolist()
        lanes = [counter.lanes[k] for k in station.lanes]
        longest = max(range(len(lanes)), key=lambda k: lanes[k].length_m)
        said.append(
            f"Station {station.station_id} is at {latitude:.6f},{longitude:.6f}, "
            f"{station.arc_m[longest]:.0f} m along lane {lanes[longest].lane_id}."
        )
    return said


def clock_of(interval: str, timezone: str | None) -> IntervalClock:
    """The intervals of `15min`.

    Raises:
        ParameterError: No length of time, or one that doesn't divide a day; no such zone.
    """
    from geoorbit_ros.cli.inputs import time_zone
    from geoorbit_ros.traffic.interval_clock import IntervalClock

    digits = interval.rstrip("abcdefghijklmnopqrstuvwxyz ")
    unit = interval[len(digits) :].strip() or "s"
    if not (digits.isascii() and digits.isdigit()) or unit not in _UNIT_S:
        raise ParameterError("option --interval", f"'{interval}'", "30s, 15min, 1h or 1d")
    return IntervalClock(int(digits) * _UNIT_S[unit], time_zone(timezone))


def _scheme(given: str) -> ClassScheme:
    """See `named_scheme`."""
    from geoorbit_ros.traffic.class_schemes import named_scheme

    return named_scheme(given, "option --class-scheme")
