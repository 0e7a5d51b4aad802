"""`geoorbit calibrate`: a camera's calibration from the traffic it sees, without any point."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import (
    CameraInfoOption,
    ClassesOption,
    ClassNamesOption,
    ColumnsOption,
    DurationOption,
    ImageSizeOption,
    MinScoreOption,
    ModelOption,
    StrictOption,
    check_no_input,
    parse_datum,
    parse_names,
    read_options,
    stated_image_size,
    with_image_size,
)
from geoorbit_ros.cli.place_on_map import (
    NEAR_SIGMA_M,
    Whereabouts,
    place_on_map,
    whereabouts,
)
from geoorbit_ros.core.errors import NoTrafficError, ParameterError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.calibration.control_points import ControlPoints
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.calibration.lens import Lens
    from geoorbit_ros.calibration.traffic.estimate import TrafficCalibration
    from geoorbit_ros.calibration.traffic.parameters import KnownPoints
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.storage.tracks.cleaning import ReadOptions

PICTURE = "calibration.png"
"""Name of the picture, beside the calibration."""


OutOption = Annotated[Path, typer.Option("--out", help="Where the calibration goes: a CSV.")]
CameraArgument = Annotated[
    str | None,
    typer.Argument(help="Video file, address of a stream, folder of images, or scene:NAME."),
]
TracksOption = Annotated[
    Path | None,
    typer.Option("--tracks", help="Tracked boxes in place of images; formats as for lanes."),
]
NearOption = Annotated[
    str | None,
    typer.Option("--near", metavar="LAT,LON", help="Where the camera stands, roughly."),
]
MapOption = Annotated[
    Path | None,
    typer.Option("--map", help="Map to find the place on: OpenStreetMap extract or network."),
]
NearSigmaOption = Annotated[
    float | None,
    typer.Option(
        "--near-sigma",
        min=0.1,
        max=1000.0,
        help=f"1σ of --near in metres; default: {NEAR_SIGMA_M:g}.",
    ),
]
LooksOption = Annotated[
    str | None, typer.Option("--looks", help="Where the camera looks, roughly: NE, or degrees.")
]
PointsOption = Annotated[
    Path | None,
    typer.Option("--points", help="Control points that you know, even one to three."),
]
PictureImageOption = Annotated[
    str | None, typer.Option("--image", help="Image of the camera, for the picture.")
]
PictureOption = Annotated[
    Path | None,
    typer.Option("--picture", help=f"Where the picture goes; default: {PICTURE} beside OUT."),
]
RateOption = Annotated[
    float | None,
    typer.Option("--fps", min=0.01, help="Images per second, where nothing says so."),
]


def calibrate(
    out: OutOption,
    source: CameraArgument = None,
    tracks: TracksOption = None,
    image_size: ImageSizeOption = None,
    near: NearOption = None,
    near_sigma: NearSigmaOption = None,
    looks: LooksOption = None,
    road_map: MapOption = None,
    points: PointsOption = None,
    camera_info: CameraInfoOption = None,
    image: PictureImageOption = None,
    picture: PictureOption = None,
    model: ModelOption = None,
    class_names: ClassNamesOption = "",
    min_score: MinScoreOption = 0.25,
    duration: DurationOption = None,
    fps: RateOption = None,
    columns: ColumnsOption = None,
    classes: ClassesOption = "coco",
    strict: StrictOption = False,
) -> None:
    """Calibrate a camera from its traffic: focal length, tilt, roll, height and scale.

    A minute of traffic does, five are better. The scale is that of vehicles' usual sizes. Look at
    the picture: green boxes must stand on the road like vehicles. --map finds the camera's place.

    Example: [bold]geoorbit calibrate north.mp4 --near 43.07,-89.40 --out calibration.csv[/bold]
    """
    from geoorbit_ros.calibration.control_point_writer import write_control_points
    from geoorbit_ros.calibration.traffic.control_grid import control_grid
    from geoorbit_ros.calibration.traffic.estimate import calibrate_from_traffic
    from geoorbit_ros.cli.console import status
    from geoorbit_ros.report.image_overlay import write_image
    from geoorbit_ros.report.traffic_calibration import draw_traffic_calibration
    from geoorbit_ros.storage.atomic import atomic_output

    picture = _checked_picture(picture, out, source, tracks, road_map, points, camera_info, image)
    origin, pointed = parse_datum(near, "--near"), points is not None
    where = whereabouts(road_map, origin, near_sigma, looks, with_points=pointed)
    camera_lens = _camera_lens(camera_info)
    with atomic_output(out) as new_file, atomic_output(picture) as new_picture:
        if tracks is not None:
            options = read_options(fps, columns, classes, strict)
            frames, size, view = _read(tracks, image_size, points, options)
        else:
            frames, size, view = _look(str(source), fps, duration, model, class_names, min_score)
        view = _view(image, size) if image else view
        lens, known, datum = _given(points, camera_lens, str(camera_info), origin, size, strict)
        with status(f"fitting a camera to {len(frames)} frames"):
            camera = calibrate_from_traffic(frames, size, lens=lens, points=known)
        grid = control_grid(camera, datum, str(out))
        on_map, where_said = _on_map(grid, frames, size, where)
        placed = on_map is not grid or (known is not None and len(known.pixel) > 1)
        grid = on_map if placed else _without_north(grid)
        write_control_points(new_file, grid, _comments(camera, placed))
        with status("drawing the picture"):
            write_image(new_picture, draw_traffic_calibration(camera, grid, view))
    _tell([*sentences(camera, grid, placed, known is not None), *where_said], out, picture)


def _camera_lens(camera_info: Path | None) -> Lens | None:
    from geoorbit_ros.calibration.camera_info import read_camera_info

    return read_camera_info(camera_info) if camera_info else None


def _tell(said: list[str], out: Path, picture: Path) -> None:
    from geoorbit_ros.cli.console import console

    text = "\n ".join([*said, f"Wrote {out} and {picture}: look at the picture."])
    console.print(f" {text}", soft_wrap=True)


def _check_one_input(source: str | None, tracks: Path | None) -> None:
    if (source is None) == (tracks is None):
        found = "neither" if source is None else "both"
        raise ParameterError("SOURCE and option --tracks", found, "exactly one of them")


def _checked_picture(
    picture: Path | None,
    out: Path,
    source: str | None,
    tracks: Path | None,
    *others: Path | str | None,
) -> Path:
    """Where the picture goes; outputs that can't be written are refused before any work is done."""
    _check_one_input(source, tracks)
    picture = picture or out.parent / PICTURE
    if picture.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise ParameterError("option --picture", str(picture), "a name that ends in .png or .jpg")
    if out.absolute() == picture.absolute():
        raise ParameterError("option --out", f"{out}, the picture", "another path")
    for option, file in (("option --out", out), ("option --picture", picture)):
        if file.is_dir():
            raise ParameterError(option, f"{file}, a folder", "the path of a file")
        check_no_input(option, file, *(Path(given) for given in (source, tracks, *others) if given))
    return picture


def _on_map(
    grid: ControlPoints, frames: Frames, size: tuple[int, int], where: Whereabouts | None
) -> tuple[ControlPoints, list[str]]:
    """The points laid on the map, and what is to be said; unchanged without a map."""
    from geoorbit_ros.cli.console import status

    if where is None:
        return grid, []
    with status("looking for the road on the map"):
        return place_on_map(grid, frames, size, where)


def _view(image: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    """An image of the camera."""
    from geoorbit_ros.cli.images import first_view

    view = first_view(image)
    if view.shape[1::-1] != size:
        shown = f"{view.shape[1]}x{view.shape[0]}"
        raise ParameterError("option --image", shown, f"{size[0]}x{size[1]}, as the tracks")
    return view


def sentences(
    camera: TrafficCalibration, grid: ControlPoints, placed: bool, with_points: bool
) -> list[str]:
    """What was found, and what would make it surer."""
    from geoorbit_ros.calibration.traffic.doubts import doubts, scale_sigmas
    from geoorbit_ros.calibration.traffic.estimate import ODD_POINT_SIGMAS
    from geoorbit_ros.calibration.traffic.parameters import ROLL, TILT

    (focal, focal_s), (height, height_s) = camera.focal_px, camera.height_m
    (view, view_s), (tilt, tilt_s) = camera.field_of_view_deg, camera.degrees(TILT)
    roll, roll_s = camera.degrees(ROLL)
    along, across = scale_sigmas(camera)
    found = [
        f"From {camera.vehicles} of {len(camera.samples.group)} vehicles:",
        f"  focal length {focal:.0f} ± {focal_s:.0f} px (field of view {view:.1f} ± {view_s:.1f}°)",
        f"  tilt {tilt:.1f} ± {tilt_s:.1f}° below the horizontal, roll {roll:.1f} ± {roll_s:.1f}°",
        f"  height {height:.1f} ± {height_s:.1f} m",
        f"  distances along the road ± {100 * along:.1f} %, across ± {100 * across:.1f} %",
        f"Lens: {camera.lens_sentence}.",
        *doubts(camera),
    ]
    if camera.points_off > ODD_POINT_SIGMAS:
        found.append(
            f"Doubtful: the points of --points are off by {camera.points_off:.1f} times their "
            "errors. Are they of this image, in this size?"
        )
    surer = []
    if len(camera.samples.group) < 60:
        surer.append("more traffic")
    if focal_s > 0.03 * focal:
        surer.append("the focal length (--camera-info)")
    if not with_points:
        surer.append("two points or more that you know, far apart along the road (--points)")
    if surer:
        found.append("What would make it surer: " + "; ".join(surer) + ".")
    if grid.datum is None:
        found.append(
            "Nobody said where the camera stands: give --near LAT,LON, or --datum to the commands "
            "that read the file."
        )
    elif not placed:
        found.append("The file's north is where the camera looks: its true heading is not known.")
    return found


def _without_north(grid: ControlPoints) -> ControlPoints:
    return replace(grid, facts=replace(grid.facts, north_known=False))


def _comments(camera: TrafficCalibration, placed: bool) -> list[str]:
    lines = [f"from traffic: {camera.vehicles} vehicles; computed points, none was surveyed"]
    if not placed:
        lines.append("origin below the camera; y or north is where the camera looks")
    return lines


def _read(
    tracks: Path, image_size: str | None, points: Path | None, options: ReadOptions
) -> tuple[Frames, tuple[int, int], NDArray[np.uint8] | None]:
    """Frames of a track file, the image size and no image; what is to be said of it is said."""
    from geoorbit_ros.cli.console import print_remarks, status
    from geoorbit_ros.cli.inputs import ASSUMED_SIZE
    from geoorbit_ros.storage.tracks.reader import read_tracks

    stated = None if points is None else stated_image_size(points)
    options = with_image_size(image_size, options, stated)
    with status(f"reading {tracks}"):
        frames, report = read_tracks(tracks, options)
    print_remarks(report)
    return frames, report.image_size or ASSUMED_SIZE, None


def _look(
    source: str,
    fps: float | None,
    duration_s: float | None,
    model: Path | None,
    class_names: str,
    min_score: float,
) -> tuple[Frames, tuple[int, int], NDArray[np.uint8]]:
    """Tracks of the vehicles in a film, its size, and the image with the most of them."""
    from geoorbit_ros.cli.images import ImageOptions, shown_images
    from geoorbit_ros.cli.resume import prepared_run
    from geoorbit_ros.core.tables import join_frames
    from geoorbit_ros.detection.detector import DetectorSettings
    from geoorbit_ros.storage.frames.source import LeftOut
    from geoorbit_ros.tracking.parameters import TrackerParameters
    from geoorbit_ros.tracking.tracker import make_tracker

    settings = DetectorSettings(min_score, class_names=parse_names(class_names))
    options = ImageOptions(fps, duration_s, None, LeftOut(), None, 0.0)
    found, tracker, view, most = [], None, None, -1
    with prepared_run(source, Path(), options, model, settings, resume=None) as (images, run):
        for stamp_ns, image, boxes in run.boxes(
            shown_images(images, duration_s, "finding vehicles")
        ):
            if tracker is None:
                height, width = image.shape[:2]
                tracker = make_tracker(
                    parameters=TrackerParameters(image_width=width, image_height=height)
                )
            found.append((stamp_ns, tracker.update(stamp_ns, boxes)))
            if len(boxes) > most:
                view, most = image.copy(), len(boxes)
    if view is None:
        raise NoTrafficError(source, "no images", "at least one")
    return join_frames(found), (view.shape[1], view.shape[0]), view


def _given(
    points: Path | None,
    lens: Lens | None,
    lens_place: str,
    near: Datum | None,
    size: tuple[int, int],
    strict: bool,
) -> tuple[Lens | None, KnownPoints | None, Datum | None]:
    """The lens and the points that the user knows, and the frame's origin."""
    import numpy as np

    from geoorbit_ros.calibration.camera_info import behind_lens, lens_of_images
    from geoorbit_ros.calibration.control_point_file import read_control_points
    from geoorbit_ros.calibration.plane_fit import GROUND_SIGMA_M, PIXEL_SIGMA
    from geoorbit_ros.calibration.traffic.parameters import KnownPoints
    from geoorbit_ros.cli.console import print_remarks

    lens = None if lens is None else lens_of_images(lens, size, lens_place)
    if points is None:
        return lens, None, near
    read = read_control_points(points, near, image_size=size, strict=strict, few=True)
    if lens is not None and len(read):
        read = behind_lens(read, lens, lens_place)
    print_remarks(read.report)
    lens = read.facts.lens or lens
    pixel = read.pixel if lens is None else lens.undistort(read.pixel)
    seen = np.isfinite(pixel).all(axis=1)
    if not seen.any():
        beyond = f" that the lens can show, of {len(read)}" if len(read) else ""
        raise ParameterError("option --points", f"{points} without a point{beyond}", "at least one")

    def sigma(given: NDArray[np.float64] | None, default: float) -> NDArray[np.float64]:
        values = np.full(len(read), default) if given is None else given
        return np.where(np.isfinite(values), values, default)[seen]

    sigma_px, sigma_m = sigma(read.sigma_px, PIXEL_SIGMA), sigma(read.sigma_m, GROUND_SIGMA_M)
    return lens, KnownPoints(pixel[seen], read.local_m[seen], sigma_px, sigma_m), read.datum
