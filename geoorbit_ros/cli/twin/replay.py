"""`geoorbit twin replay` and `geoorbit twin routes`: recorded tracks in a SUMO network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import DatumOption, ForceOption, ImageSizeOption

if TYPE_CHECKING:
    from geoorbit_ros.cli.twin.side_by_side import BusiestStep
    from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
    from geoorbit_ros.mapcheck.map_watch import MapCheck
    from geoorbit_ros.roadnet.network import RoadNetwork
    from geoorbit_ros.twin.figures import VehiclePaths
    from geoorbit_ros.twin.placement import TwinStep
    from geoorbit_ros.twin.replay import ReplayScore, TrackStream

BagsArgument = Annotated[
    list[Path], typer.Argument(help="Tracked boxes: one rosbag2 bag with tracks_px per camera.")
]
NetOption = Annotated[
    Path, typer.Option("--net", help="SUMO network with a projection (geoorbit map build).")
]
CalibrationsOption = Annotated[
    list[Path],
    typer.Option("--calibration", help="Control points, a CSV per bag in the same order."),
]
CameraIdsOption = Annotated[
    list[str] | None,
    typer.Option("--camera-id", help="Which camera, per bag; for bags that hold several."),
]
StepOption = Annotated[
    float, typer.Option("--step-s", min=0.01, max=1.0, help="Length of a simulation step.")
]


def replay(
    bags: BagsArgument,
    net: NetOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; new or empty.")],
    calibration: CalibrationsOption,
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_id: CameraIdsOption = None,
    step_s: StepOption = 0.1,
    align: Annotated[
        bool,
        typer.Option(
            "--align/--no-align",
            help="Learn the lanes first; lay the tracks on the map where they don't fit it, and "
            "count vehicles to its lanes where those are driven.",
        ),
    ] = True,
    video: Annotated[
        Path | None,
        typer.Option("--video", help="The first bag's video, for its side-by-side image."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Let the recorded vehicles drive through a SUMO network, and say how well it followed.

    Into the folder go score.json, vehicles.csv (every vehicle of the twin in every step), twin.png
    and, for every camera, what it saw beside what the twin shows: side_by_side_CAMERA.png.

    Example: [bold]geoorbit twin replay north_bag --net area/network.net.xml
    --calibration north.csv --out twin[/bold]
    """
    from geoorbit_ros.cli.console import console, say
    from geoorbit_ros.cli.twin.side_by_side import save_all_side_by_side
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.twin.figures import save_twin_figure

    with atomic_output(out, overwrite=force) as folder:
        streams = open_streams(bags, calibration, image_size, datum, camera_id)
        network = load_network(net, streams[0].datum)
        said, driven = ["Tracks are where the cameras see them."], None
        if align:
            streams, check, said = align_streams(streams, network)
            driven = check.driven
        folder.mkdir()
        run = _drive(streams, network, step_s, folder / "vehicles.csv", driven)
        _check_traffic(run.score, str(net))
        _write_score(folder / "score.json", run.score, streams, driven)
        lasted_s = run.score.health.steps * step_s
        title = f"{run.score.vehicles} vehicles in {lasted_s:.0f} s on {net.name}"
        save_twin_figure(folder / "twin.png", network, run.paths, title)
        said += save_all_side_by_side(folder, network, run.busiest.step, streams, bags, video)
    _print_score(run.score, streams)
    for sentence in (*said, *run.score.reserved.sentences()):
        say(sentence)
    console.print(f" Wrote {out}", soft_wrap=True)


@dataclass(frozen=True, slots=True)
class _Drive:
    """A recording that has been driven: its score, where vehicles went, its busiest step."""

    score: ReplayScore
    paths: VehiclePaths
    busiest: BusiestStep


def _drive(
    streams: list[TrackStream],
    network: RoadNetwork,
    step_s: float,
    states_file: Path,
    driven: DrivenNetwork | None,
) -> _Drive:
    """Let the tracks drive through the network, and write every step's vehicles."""
    from geoorbit_ros.cli.twin.side_by_side import BusiestStep
    from geoorbit_ros.twin.figures import VehiclePaths
    from geoorbit_ros.twin.replay import StateWriter, replay_tracks
    from geoorbit_ros.twin.sumo_simulation import SumoSimulation

    simulation = SumoSimulation(network.path, step_s)
    paths, busiest = VehiclePaths(), BusiestStep()
    try:
        with StateWriter(states_file, network) as states:

            def take(step: TwinStep) -> None:
                states.write(step)
                paths.add(step.xy, step.lane)
                busiest.add(step)

            score = replay_tracks(network, simulation, streams, take, step_s, driven=driven)
    finally:
        simulation.close()
    return _Drive(score, paths, busiest)


def _write_score(
    file: Path, score: ReplayScore, streams: list[TrackStream], driven: DrivenNetwork | None
) -> None:
    import json

    aligned = {s.camera: s.alignment.values() for s in streams if s.alignment is not None}
    moved = round(driven.largest_m, 3) if driven else 0.0
    record = score.values() | {"aligned": aligned, "lanes_moved_m": moved}
    file.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def align_streams(
    streams: list[TrackStream], network: RoadNetwork
) -> tuple[list[TrackStream], MapCheck, list[str]]:
    """Learn the lanes from the same tracks and compare them with the network.

    Returns:
        The streams, with the alignment that lays them on the network where they don't fit it; what
        was found; and that in sentences.
    """
    from dataclasses import replace

    from geoorbit_ros.cli.console import track
    from geoorbit_ros.core.errors import NoTrafficError
    from geoorbit_ros.lanes.estimators.estimator import make_estimator
    from geoorbit_ros.lanes.mapping.mapper import LaneMapper
    from geoorbit_ros.lanes.pipeline import map_lanes
    from geoorbit_ros.mapcheck.map_watch import MapCheck
    from geoorbit_ros.mapcheck.validation import in_frame

    check, aligned, said = MapCheck(network), [], []
    for stream in streams:
        frames, name = list(stream.frames), stream.camera
        try:
            lanes = map_lanes(
                track(frames, "learning the lanes"), LaneMapper(make_estimator("curvilinear"))
            ).lanes
            check = check.with_lanes(name, in_frame(lanes, stream.datum, network.datum))
            said += [f"{name}: {text}" for text in check.validations[name].summary()]
        except NoTrafficError:
            said.append(f"{name}: too little traffic to compare the lanes with the map.")
        aligned.append(replace(stream, frames=frames, alignment=check.alignments.get(name)))
    if check.driven is not None:
        said.append(
            "Vehicles are counted to lanes where those are driven, up to "
            f"{check.driven.largest_m:.2f} m beside where the map has them."
        )
    return aligned, check, said


def open_streams(
    bags: list[Path],
    calibrations: list[Path],
    image_size: str | None,
    datum: str | None,
    camera_ids: list[str] | None = None,
) -> list[TrackStream]:
    """Ground tracks of each bag by its calibration, the first under a progress bar.

    Says what was done with bags that are not as they should be.

    Raises:
        GeoOrbitError: A bag or a calibration can't be used, or not one calibration per bag.
    """
    from geoorbit_ros.calibration.box_projector import BoxProjector
    from geoorbit_ros.calibration.control_point_file import read_control_points
    from geoorbit_ros.calibration.homography import fit_homography
    from geoorbit_ros.cli.console import print_remarks, status, track
    from geoorbit_ros.cli.inputs import ASSUMED_SIZE, parse_datum, with_image_size
    from geoorbit_ros.core.errors import InputFileError, ParameterError
    from geoorbit_ros.lanes.pipeline import project_frames
    from geoorbit_ros.storage.track_bag import read_track_bag
    from geoorbit_ros.twin.replay import TrackStream

    if len(bags) != len(calibrations):
        found = f"{len(calibrations)} for {len(bags)} bags"
        raise ParameterError("option --calibration", found, "one per bag, in the same order")
    if camera_ids and len(camera_ids) != len(bags):
        found = f"{len(camera_ids)} for {len(bags)} bags"
        raise ParameterError("option --camera-id", found, "one per bag, in the same order")
    options, origin = with_image_size(image_size), parse_datum(datum)
    streams: list[TrackStream] = []
    asked: list[str | None] = [*camera_ids] if camera_ids else [None] * len(bags)
    for bag, file, camera_id in zip(bags, calibrations, asked, strict=True):
        with status(f"reading {bag}"):
            content = read_track_bag(bag, camera_id, options)
        print_remarks(content.report)
        size = content.report.image_size or ASSUMED_SIZE
        points = read_control_points(file, origin, image_size=size)
        place = points.need_datum("--datum LAT,LON: where x_m = y_m = 0 is")
        name = content.camera_id or "camera"
        if any(name == stream.camera for stream in streams):
            found = f"a second bag of camera '{name}'"
            raise InputFileError(str(bag), found, "one bag per camera")
        projector = BoxProjector(fit_homography(points), size)
        frames = project_frames(content.frames, projector)
        if not streams:
            frames = track(frames, "driving the twin", total=len(content.frames))
        streams.append(TrackStream(name, frames, place, projector=projector))
    return streams


def print_stream_remarks(streams: list[TrackStream]) -> None:
    """Say what was done with each camera's inputs, and what speaks against them."""
    from geoorbit_ros.cli.console import print_remarks

    for stream in streams:
        if stream.projector is not None:
            print_remarks(*stream.projector.reports(stream.camera))


def _check_traffic(score: ReplayScore, place: str) -> None:
    from geoorbit_ros.core.errors import NoTrafficError

    if not score.vehicles:
        found = f"none of {score.tracks} tracks on its lanes"
        raise NoTrafficError(place, found, "a network that covers what the camera sees")


def _print_score(score: ReplayScore, streams: list[TrackStream]) -> None:
    from geoorbit_ros.cli.console import console, make_table, say

    health, events = score.health, score.events
    table = make_table("The twin against the tracks", "|>95 %|>largest")
    table.add_row(
        "position m", f"{health.position_error_m_p95:.3f}", f"{health.position_error_m_max:.3f}"
    )
    table.add_row(
        "heading °", f"{health.heading_error_deg_p95:.2f}", f"{health.heading_error_deg_max:.2f}"
    )
    console.print(table)
    say(
        f"{score.vehicles} vehicles from {score.tracks} tracks in {health.steps} steps: "
        f"{health.vehicle_steps} times seen, {health.unseen_steps} times not seen by a camera."
    )
    say(
        f"Lane as matched in {1.0 - health.lane_error_share:.2%}, beside every lane in "
        f"{health.beside_share:.2%}; {health.lost} vehicles lost; {events.jumps} tracks jumped, "
        f"{events.handovers} were taken over, {events.off_road} rows lay beside the network."
    )
    say(
        f"A step took {health.step_ms_median:.1f} ms (99 %: {health.step_ms_p99:.1f} ms): "
        f"{health.steps_per_s:.0f} steps per second."
    )
    print_stream_remarks(streams)


def routes(
    bags: BagsArgument,
    net: NetOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files; new or empty.")],
    calibration: CalibrationsOption,
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_id: CameraIdsOption = None,
    force: ForceOption = False,
) -> None:
    """Write the recorded traffic as SUMO's own demand: routes and vehicle types.

    Every vehicle departs when, where, in which lane and how fast it was first seen, and keeps to
    the speed limits as it was seen to. Into the folder go traffic.rou.xml, traffic.add.xml and
    traffic.sumocfg: [bold]sumo -c traffic.sumocfg[/bold] runs them.

    Example: [bold]geoorbit twin routes north_bag --net area/network.net.xml
    --calibration north.csv --out demand[/bold]
    """
    from geoorbit_ros.cli.console import console, count_of, say
    from geoorbit_ros.core.errors import NoTrafficError
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.twin.replay import STEP_S, replay_tracks
    from geoorbit_ros.twin.routes import RouteWriter
    from geoorbit_ros.twin.sumo_simulation import SumoSimulation

    with atomic_output(out, overwrite=force) as folder:
        streams = open_streams(bags, calibration, image_size, datum, camera_id)
        network = load_network(net, streams[0].datum)
        writer = RouteWriter(network)
        simulation = SumoSimulation(net, STEP_S)
        try:
            score = replay_tracks(network, simulation, streams, writer.add)
        finally:
            simulation.close()
        _check_traffic(score, str(net))
        folder.mkdir()
        counts = writer.write(folder, str(net.absolute()))
        if not counts.written:
            found = f"{score.vehicles} vehicles, none seen for long enough to know its speed"
            raise NoTrafficError(str(net), found, "a longer recording")
    say(
        f"{count_of(counts.written, 'vehicle')} in the routes; left out: {counts.too_short} seen "
        f"for less than 20 m, {counts.no_route} on edges without a route between them."
    )
    print_stream_remarks(streams)
    console.print(f" Wrote {out}", soft_wrap=True)
