"""`geoorbit traffic`: vehicles per lane, class and interval; speeds, headways, movements."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
    load_camera,
    make_mapper,
    read_options,
)
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.calibration.plane import RoadPlane
    from geoorbit_ros.cli.inputs import CameraInput
    from geoorbit_ros.core.input_report import InputReport
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.traffic.class_schemes import ClassScheme
    from geoorbit_ros.traffic.count import Recorded
    from geoorbit_ros.traffic.interval_clock import IntervalClock

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
        camera = load_camera(tracks, bag, calibration, *named)
        source = _of_camera(camera, lanes, estimator, update_period_s, image)
    with atomic_output(out, overwrite=force) as folder:
        folder.mkdir()
        recorded = source.count()
        _write(folder, source, recorded, scheme, clock)
        _write_page(folder / "report.html", source, recorded, scheme, clock)
        said = _write_for_sumo(folder / "sumo", road_map, source, recorded, clock)
    _tell(source, recorded, scheme, clock)
    _say_where(out, recorded, clock, said)


@dataclass(frozen=True)
class TrafficSource:
    """Ground tracks of one camera and the lanes that they are counted on.

    Attributes:
        camera_id: Its name.
        lane_map: The lanes.
        write_lanes: Writes them to a file.
        datum: Origin of the map frame of both.
        plane: The calibration, if it is known.
        blocks: The ground tracks.
        frames_between: Those from one stamp to another, both included.
        frame_count: How many frames there are.
        max_gap_s: How long a pause between frames may be.
        reports: What is to be said about the input.
        files: Names and values for the report: where tracks and lanes came from.
    """

    camera_id: str
    lane_map: LaneMap
    write_lanes: Callable[[Path], None]
    datum: Datum
    plane: RoadPlane | None
    blocks: Callable[[], Iterator[Frames]]
    frames_between: Callable[[int, int], Frames]
    frame_count: int
    max_gap_s: float
    reports: Callable[[], tuple[InputReport, ...]]
    files: tuple[tuple[str, str], ...] = ()

    def count(self) -> Recorded:
        """Count all vehicles, under a progress bar."""
        from geoorbit_ros.cli.console import shown_progress
        from geoorbit_ros.traffic.count import record
        from geoorbit_ros.traffic.counter import TrafficCounter

        counter = TrafficCounter(self.lane_map.lanes, self.plane)
        with shown_progress() as tell:

            def told() -> Iterator[Frames]:
                done = 0
                for frames in self.blocks():
                    yield frames
                    done += len(frames)
                    tell("counting vehicles", min(done / max(self.frame_count, 1), 1.0))

            return record(counter, told(), self.max_gap_s)


def _of_camera(
    camera: CameraInput,
    lanes: Path | None,
    estimator: str,
    update_period_s: float,
    image: str | None,
) -> TrafficSource:
    """The traffic of a file of tracks or a bag."""
    from geoorbit_ros.cli.console import read_lanes_aloud
    from geoorbit_ros.core.tables import frames_between
    from geoorbit_ros.lanes.geojson import write_lanes
    from geoorbit_ros.traffic.interval_clock import usual_gap_s

    ground = list(camera.ground_tracks())
    if lanes:
        lane_map = read_lanes_aloud(lanes, camera.datum).lane_map
    else:
        lane_map = camera.find_lanes(iter(ground), make_mapper(estimator, update_period_s))
    if image and not lanes:
        lane_map, _ = camera.follow_paint(lane_map, image)

    def write(path: Path) -> None:
        write_lanes(path, lane_map, camera.datum, camera_id=camera.camera_id, estimator=estimator)

    return TrafficSource(
        camera.camera_id,
        lane_map,
        write,
        camera.datum,
        camera.homography,
        lambda: iter(ground),
        lambda first_ns, last_ns: frames_between(ground, first_ns, last_ns),
        len(camera.frames),
        usual_gap_s(camera.frames),
        camera.reports,
        (
            ("Tracks", camera.source.name),
            ("Control points", camera.calibration.name),
            ("Lanes", lanes.name if lanes else estimator),
        ),
    )


def source_of_database(
    database: Path, camera_id: str | None, calibration: Path | None, lanes: Path | None
) -> TrafficSource:
    """The traffic of one camera in a trajectory database.

    Raises:
        GeoOrbitError: No such camera, several and none named, or no lanes.
    """
    from geoorbit_ros.cli.console import read_lanes_aloud
    from geoorbit_ros.cli.inputs import read_plane
    from geoorbit_ros.lanes.geojson import parse_lane_file, write_lanes
    from geoorbit_ros.storage.database.reader import TrajectoryReader
    from geoorbit_ros.traffic.interval_clock import GAP_S

    with TrajectoryReader(database) as reader:
        frame_counts = {camera.camera_id: camera.frames for camera in reader.cameras()}
        known = list(frame_counts)
        name = camera_id or (known[0] if len(known) == 1 else "")
        if not name:
            if not known:
                raise ParameterError(
                    "option --database", f"no camera in {database}", "tracks in it"
                )
            found = f"{len(known)} cameras in {database}"
            raise ParameterError("option --camera-id", found, f"one of {', '.join(known)}")
        stamps = reader.lane_map_stamps(name)
        if not stamps and lanes is None:
            raise ParameterError("option --lanes", f"no lane map of {name} stored", "a lane file")
        text = reader.lane_maps(name, stamps[-1], stamps[-1] + 1)[0][1] if stamps else ""
    stored = parse_lane_file(text, f"{database}, lane map of {name}") if stamps else None
    file = read_lanes_aloud(lanes, stored.datum if stored else None) if lanes else stored
    assert file is not None
    plane = read_plane(calibration, file.datum) if calibration else None

    def blocks() -> Iterator[Frames]:
        with TrajectoryReader(database) as reader:
            yield from reader.batches(name)

    def frames_between(first_ns: int, last_ns: int) -> Frames:
        with TrajectoryReader(database) as reader:
            return reader.read(name, first_ns, last_ns + 1)

    def write(path: Path) -> None:
        write_lanes(path, file.lane_map, file.datum, camera_id=name, estimator=file.estimator)

    files = (("Tracks", database.name), ("Lanes", lanes.name if lanes else database.name))
    return TrafficSource(
        name,
        file.lane_map,
        write,
        file.datum,
        plane,
        blocks,
        frames_between,
        frame_counts.get(name, 0),
        GAP_S,
        lambda: (),
        files,
    )


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
    source.write_lanes(folder / "lanes.geojson")


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
    source: TrafficSource, recorded: Recorded, scheme: ClassScheme, clock: IntervalClock
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
    for sentence in event_sentences(recorded.events, clock.zone)[:SHOWN_EVENTS]:
        say(sentence)
    more = len(recorded.events) - SHOWN_EVENTS
    if more > 0:
        say(f"{count_of(more, 'more event')} in events.csv.")
    print_remarks(*source.reports())


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
