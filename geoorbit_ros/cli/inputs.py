"""The options that name one camera's data, and the data they name."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.core.errors import NoTrafficError, ParameterError
from geoorbit_ros.core.plugins import expected, registered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from geoorbit_ros.calibration.box_projector import BoxProjector
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.calibration.homography import Homography
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.lanes.mapping.mapper import LaneMapper
    from geoorbit_ros.roadnet.driving_side import Side
    from geoorbit_ros.storage.tracks.cleaning import ReadOptions


DEFAULT_ESTIMATOR = "curvilinear"
"""The estimator for use; all others are for comparison."""

TracksOption = Annotated[
    Path | None,
    typer.Option(
        "--tracks",
        help="Tracked boxes: CSV, MOTChallenge, KITTI, UA-DETRAC, CVAT, OTVision, supervision or "
        "Ultralytics, recognised by content.",
    ),
]
TrackFpsOption = Annotated[
    float | None,
    typer.Option("--fps", min=0.01, help="Images per second, for track files without times."),
]
ColumnsOption = Annotated[
    str | None,
    typer.Option(
        "--columns",
        metavar="MEANING=NAME,…",
        help="Names of a CSV's columns, where they are unusual: id=veh,x1=xl,frame=img.",
    ),
]
ClassesOption = Annotated[
    str,
    typer.Option(
        "--classes",
        help="What class numbers mean: coco, visdrone, detrac, mot, 0=car,1=truck or a YAML file.",
    ),
]
StrictOption = Annotated[
    bool,
    typer.Option("--strict", help="Refuse tracks, a bag or control points that have any fault."),
]
StrictPointsOption = Annotated[
    bool, typer.Option("--strict", help="Refuse control points that have any fault.")
]
BagOption = Annotated[
    Path | None, typer.Option("--bag", help="Tracked boxes: a rosbag2 bag with a tracks_px topic.")
]
SourceArgument = Annotated[
    str,
    typer.Argument(help="Video file, address of a stream, folder of images, or scene:NAME?seed=1."),
]
FpsOption = Annotated[
    float | None,
    typer.Option(
        "--fps", help="Frames per second of images without times: a folder, a raw H.264 stream."
    ),
]
StrictImagesOption = Annotated[
    bool, typer.Option("--strict", help="End at the first fault of images or control points.")
]
PasswordFileOption = Annotated[
    Path | None,
    typer.Option(
        "--password-file",
        help="File with the password of a stream whose address names the user alone, "
        "rtsp://USER@HOST/PATH: what stands on the command line, others can read.",
    ),
]
StartTimeOption = Annotated[
    str | None,
    typer.Option(
        "--start-time",
        metavar="TIME",
        help="When a recording begins: 2026-05-01T06:00, or seconds since 1970; default: as the "
        "file says.",
    ),
]
ResumeOption = Annotated[
    bool,
    typer.Option("--resume", help="Go on where the same command ended early; see OUT.resume."),
]
ForceOption = Annotated[
    bool,
    typer.Option(
        "--force", help="Write into OUT though it has content; only files of the same names go."
    ),
]
DurationOption = Annotated[
    float | None,
    typer.Option("--duration", min=0.1, metavar="SECONDS", help="Stop after this time."),
]
MaxFpsOption = Annotated[
    float,
    typer.Option(
        "--max-fps",
        min=0.0,
        max=1000.0,
        help="Look at no more images per second of the recording, evenly; 0: at all. Tracks go on "
        "over the images between.",
    ),
]
DomainOption = Annotated[
    int | None, typer.Option(min=0, max=232, help="ROS domain; default: the environment's.")
]
CalibrationOption = Annotated[
    Path,
    typer.Option(
        "--calibration", help="Control points: a CSV with pixel_x, pixel_y, latitude, longitude."
    ),
]
CameraInfoOption = Annotated[
    Path | None,
    typer.Option(
        "--camera-info",
        help="The camera's lens: camera_info in YAML, as ROS' camera_calibration writes it; "
        "default: as the control points' file says.",
    ),
]
CameraIdOption = Annotated[
    str | None, typer.Option("--camera-id", help="Which camera, for a bag that holds several.")
]
EstimatorOption = Annotated[
    str,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help=f"How lanes are found: {expected('estimator')}.",
    ),
]
ASSUMED_SIZE = (1920, 1080)
"""(width, height) of an image of which nobody says how large it is. Chosen: the commonest."""
REACH_BEYOND = 1.02
"""Boxes may reach so far beyond their image, as a share of it. Chosen: trackers predict vehicles on
their way out. Those of a larger image reach farther."""
ImageSizeOption = Annotated[
    str | None,
    typer.Option(
        "--image-size",
        metavar="WxH",
        help="Size of the camera's image in pixels; default: as the bag's CameraInfo, the track "
        "file or --image says, or the road.png beside it, else 1920x1080.",
    ),
]
RoadImageOption = Annotated[
    str | None,
    typer.Option(
        "--image",
        help="Image, folder or video of the camera: lane boundaries follow its painted lines.",
    ),
]
DatumOption = Annotated[
    str | None,
    typer.Option(
        "--datum",
        metavar="LAT,LON",
        help="Origin of the local map; default: the middle of the control points.",
    ),
]
DrivingSideOption = Annotated[
    str | None,
    typer.Option(
        "--driving-side",
        metavar="left|right",
        help="Where traffic drives; default: as the map's tags say, else as at its place.",
    ),
]
ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        help="YOLO model in an ONNX file, FILE.py:CLASS for your own detector, or a name: "
        f"{', '.join(registered('detector'))}. Without it: whatever moves.",
    ),
]
ClassNamesOption = Annotated[
    str,
    typer.Option(
        "--class-names", help="Names of the model's classes, where its file has none: a,b,c."
    ),
]
MinScoreOption = Annotated[
    float,
    typer.Option("--min-score", min=0.0, max=1.0, help="Boxes that score less are dropped."),
]
UpdatePeriodOption = Annotated[
    float,
    typer.Option(
        "--update-period-s",
        min=0.1,
        metavar="SECONDS",
        help="Data time between two updates of the map.",
    ),
]


ROAD_IMAGE = "road.png"
"""The road without vehicles, on which painted lines were found: `geoorbit process` writes it."""


def find_lanes(
    tracks: Iterable[Frames],
    mapper: LaneMapper,
    place: str,
    projector: Callable[[], BoxProjector | None],
) -> LaneMap:
    """The lanes of all tracks, none of them confirmed where the traffic speaks against the inputs.

    Args:
        tracks: Frames of `TRACK_DTYPE` in time order.
        mapper: A mapper that has seen no frame yet.
        place: Where the tracks came from, for the error.
        projector: What made the rows, asked for when all have been seen; None: there were none.

    Raises:
        NoTrafficError: No lane can be seen; it says what speaks against the inputs.
    """
    from geoorbit_ros.lanes.confidence import unconfirmed
    from geoorbit_ros.lanes.pipeline import map_blocks

    try:
        lane_map = map_blocks(tracks, mapper, place)
    except NoTrafficError as error:
        if (made := projector()) is None:
            raise
        made.traffic.judge()
        doubts = [text for report in made.reports(place) for text in report.sentences(doubts=True)]
        if not doubts:
            raise
        found = f"{error.found} ({'; '.join(doubts)})"
        raise NoTrafficError(error.place, found, error.expected) from None
    made = projector()
    assert made is not None
    made.traffic.judge()
    return unconfirmed(lane_map) if made.doubtful else lane_map


def check_no_input(option: str, out: Path, *inputs: Path | None) -> None:
    """Refuse an output that would replace an input.

    Raises:
        ParameterError: It is one of them.
    """
    for file in inputs:
        if file is not None and out.exists() and file.exists() and out.samefile(file):
            raise ParameterError(option, f"{out}, an input", "another path")


def stated_image_size(calibration: Path) -> tuple[int, int] | None:
    """The image size that a control point file says; None where it says none, or isn't there."""
    from geoorbit_ros.calibration.camera_facts import read_facts
    from geoorbit_ros.calibration.control_point_table import all_comments
    from geoorbit_ros.core.errors import InputFileError
    from geoorbit_ros.storage.tracks.csv_text import split_header

    try:
        comments = all_comments(split_header(calibration, "control points"))
    except InputFileError:
        return None  # its reader says what is wrong with it
    return read_facts(comments, str(calibration)).image_size


def with_image_size(
    image_size: str | None,
    options: ReadOptions | None = None,
    otherwise: tuple[int, int] | None = None,
) -> ReadOptions:
    """The options with `--image-size`, and what is taken where nobody says how large the image is.

    Args:
        image_size: The option.
        options: The others.
        otherwise: Taken where neither the option nor the tracks say it; None: `ASSUMED_SIZE`.

    Raises:
        ParameterError: Not two whole numbers from 16 to 32768.
    """
    from geoorbit_ros.storage.tracks.cleaning import ReadOptions

    size = None if image_size is None else parse_image_size(image_size)
    assumed = otherwise or ASSUMED_SIZE
    return replace(options or ReadOptions(), image_size=size, default_size=assumed)


def read_options(fps: float | None, columns: str | None, classes: str, strict: bool) -> ReadOptions:
    """What the user says about a track file.

    Raises:
        ParameterError: Columns or classes that can't be read.
    """
    from geoorbit_ros.storage.tracks.classes import class_table
    from geoorbit_ros.storage.tracks.cleaning import ReadOptions

    named = dict(pair.split("=", 1) for pair in (columns or "").split(",") if "=" in pair)
    if columns and len(named) != len(columns.split(",")):
        raise ParameterError("option --columns", repr(columns), "MEANING=NAME between commas")
    return ReadOptions(fps=fps, columns=named, classes=class_table(classes), strict=strict)


def load_calibration(
    calibration: Path,
    datum: str | None,
    image_size: tuple[int, int] | None = None,
    *,
    strict: bool = False,
    camera_info: Path | None = None,
) -> tuple[Homography, Datum]:
    """The road plane of a file of control points, and the origin of its map frame.

    Args:
        calibration: The file.
        datum: Option `--datum`.
        image_size: (width, height) in pixels of the camera's images; None: not known yet.
        strict: Whether any fault refuses the file.
        camera_info: Option `--camera-info`.

    Raises:
        GeoOrbitError: The file, a value in it or the datum is wrong.
    """
    homography = read_plane(
        calibration, parse_datum(datum), image_size, strict=strict, camera_info=camera_info
    )
    return homography, homography.points.need_datum("--datum LAT,LON: where x_m = y_m = 0 is")


def read_plane(
    calibration: Path,
    datum: Datum | None = None,
    image_size: tuple[int, int] | None = None,
    *,
    strict: bool = False,
    camera_info: Path | None = None,
) -> Homography:
    """The road plane of a file of control points; see `load_calibration`."""
    from geoorbit_ros.calibration.camera_info import read_calibration
    from geoorbit_ros.calibration.homography import fit_homography
    from geoorbit_ros.calibration.plausibility import calibration_report

    points = read_calibration(calibration, camera_info, datum, image_size=image_size, strict=strict)
    homography = fit_homography(points)
    if strict:
        calibration_report(homography).check(strict, "control points that agree")
    return homography


def make_mapper(estimator: str, update_period_s: float) -> LaneMapper:
    """A fresh mapper with the default lane-estimator parameters."""
    from geoorbit_ros.lanes.estimators.estimator import make_estimator
    from geoorbit_ros.lanes.mapping.mapper import LaneMapper
    from geoorbit_ros.lanes.parameters import LaneParameters

    return LaneMapper(make_estimator(estimator), LaneParameters(), update_period_s)


def parse_names(text: str) -> tuple[str, ...]:
    """Names between commas; blanks around them don't count."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def parse_image_size(text: str) -> tuple[int, int]:
    """(width, height) of `1920x1080`.

    Raises:
        ParameterError: Not two whole numbers from 16 to 32768.
    """
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(
        p.isascii() and p.isdigit() and 16 <= int(p) <= 32768 for p in parts
    ):
        raise ParameterError("option --image-size", repr(text), "WIDTHxHEIGHT such as 1920x1080")
    return int(parts[0]), int(parts[1])


def parse_driving_side(text: str | None) -> Side | None:
    """The side of `left` or `right`.

    Raises:
        ParameterError: Neither.
    """
    from geoorbit_ros.roadnet.driving_side import SIDES

    for side in SIDES:
        if text == side:
            return side
    if text is None:
        return None
    raise ParameterError("option --driving-side", repr(text), "left or right")


def parse_datum(text: str | None, option: str = "--datum") -> Datum | None:
    """The datum of `43.07,-89.40`.

    Args:
        text: What the user wrote; None: nothing.
        option: Where, for errors.

    Raises:
        ParameterError: Not a latitude and a longitude in degrees.
    """
    from geoorbit_ros.calibration.control_point_file import GEODETIC_BOUND_DEG
    from geoorbit_ros.calibration.datum import Datum

    if text is None:
        return None
    try:
        latitude, longitude = (float(part) for part in text.split(","))
    except ValueError:
        latitude = longitude = float("nan")
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        raise ParameterError(f"option {option}", repr(text), "LATITUDE,LONGITUDE in degrees")
    if abs(latitude) > GEODETIC_BOUND_DEG:
        expected = "LATITUDE,LONGITUDE in this order: no road leads beyond 80 degrees of latitude"
        raise ParameterError(f"option {option}", repr(text), expected)
    return Datum(latitude, longitude)


def time_zone(given: str | None) -> str:
    """IANA name of a time zone; by default that of this machine, UTC where it has none.

    Raises:
        ParameterError: No such zone.
    """
    from geoorbit_ros.traffic.interval_clock import checked_zone

    if given is not None:
        return checked_zone(given, "option --timezone")
    link = os.environ.get("TZ") or str(Path("/etc/localtime").resolve())
    try:
        return checked_zone(link.lstrip(":").rpartition("zoneinfo/")[2], "this machine")
    except ParameterError:  # it names none, as small containers don't
        return "UTC"
