"""One camera's tracks and calibration, read and checked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from geoorbit_ros.cli.inputs import (
    ASSUMED_SIZE,
    REACH_BEYOND,
    ROAD_IMAGE,
    check_no_input,
    find_lanes,
    load_calibration,
    stated_image_size,
    with_image_size,
)
from geoorbit_ros.core.errors import ParameterError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from geoorbit_ros.calibration.box_projector import BoxProjector
    from geoorbit_ros.calibration.datum import Datum
    from geoorbit_ros.calibration.homography import Homography
    from geoorbit_ros.core.frame_spool import AnyFrames
    from geoorbit_ros.core.input_report import InputReport
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.core.tables import Frames
    from geoorbit_ros.lanes.mapping.mapper import LaneMapper
    from geoorbit_ros.lanes.projection_helper import ProjectionHelper
    from geoorbit_ros.storage.tracks.cleaning import ReadOptions

    Placed = Callable[[tuple[int, int], InputReport], tuple[BoxProjector, Datum]]
    """Makes the projector for an image size, and the map frame's origin."""


@dataclass(frozen=True, slots=True)
class CameraInput:
    """One camera's tracks and calibration, read and checked.

    Attributes:
        camera_id: From the option, the bag's topic, or the track file's name.
        source: The CSV file or bag.
        calibration: The control point file.
        boxes: Tracked boxes, `PIXEL_TRACK_DTYPE`; of a long recording in a file.
        datum: Origin of the map frame.
        input_report: What was done with the rows of the track file or bag.
        projector: From boxes to the road; it has seen no frame before `ground_tracks`.
        bag_topic: The bag's topic with the boxes; empty for a track file.
        helper: Places the boxes of a long recording; None: it isn't long.
        image_reports: What is said about images of the road that were looked at.
    """

    camera_id: str
    source: Path
    calibration: Path
    boxes: AnyFrames
    datum: Datum
    input_report: InputReport
    projector: BoxProjector
    bag_topic: str = ""
    helper: ProjectionHelper | None = None
    image_reports: list[InputReport] = field(default_factory=list)

    @property
    def frames(self) -> Frames:
        """The tracked boxes, all in memory."""
        from geoorbit_ros.core.tables import Frames

        boxes = self.boxes
        return boxes if isinstance(boxes, Frames) else boxes.part(0, len(boxes))

    @property
    def homography(self) -> Homography:
        """The road plane."""
        return self.projector.homography

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.projector.image_size

    def reports(self) -> tuple[InputReport, ...]:
        """What was done with the files and images, and what the traffic says against them."""
        traffic = self.projector.reports(str(self.source))
        return (self.input_report, *traffic, *self.image_reports)

    def find_lanes(self, tracks: Iterable[Frames], mapper: LaneMapper) -> LaneMap:
        """See `find_lanes`; the lanes say how far they may lie aside together."""
        from geoorbit_ros.lanes.common_shift import with_shift_sigma

        found = find_lanes(tracks, mapper, str(self.source), lambda: self.projector)
        return with_shift_sigma(found, self.homography)

    def follow_paint(self, lane_map: LaneMap, source: str) -> tuple[LaneMap, NDArray[np.uint8]]:
        """See `markings.fusion.follow_paint`; also the road's image."""
        from geoorbit_ros.cli.images import road_background
        from geoorbit_ros.core.input_report import InputReport
        from geoorbit_ros.lanes.common_shift import with_shift_sigma
        from geoorbit_ros.markings.fusion import follow_paint

        image, report = road_background(source), InputReport(source, "images")
        found = follow_paint(lane_map, image, self.homography, self.image_size, report)
        self.image_reports.append(report)
        return with_shift_sigma(found, self.homography), image

    def ground_tracks(self) -> Iterator[Frames]:
        """Ground tracks in blocks, under a progress bar."""
        from geoorbit_ros.cli.console import track
        from geoorbit_ros.lanes.pipeline import BLOCK_ROWS, project_blocks

        if self.helper is not None:
            blocks = self.helper.blocks()
        else:
            blocks = project_blocks(self.frames, self.projector)
        total = 1 + int(self.boxes.offset[-1]) // BLOCK_ROWS
        return track(blocks, "finding lanes", total=total)


def load_camera(
    tracks: Path | None,
    bag: Path | None,
    calibration: Path,
    camera_id: str | None,
    image_size: str | None,
    datum: str | None,
    out: Path,
    options: ReadOptions | None = None,
    image: str | None = None,
    camera_info: Path | None = None,
    *,
    long: bool = False,
) -> CameraInput:
    """Read what the options name; `out` must be none of it.

    Args:
        tracks: Option `--tracks`.
        bag: Option `--bag`.
        calibration: Option `--calibration`.
        camera_id: Option `--camera-id`.
        image_size: Option `--image-size`.
        datum: Option `--datum`.
        out: Option `--out`.
        options: What else the user says about the track file.
        image: Option `--image`: boxes are in its pixels where nobody says another size.
        camera_info: Option `--camera-info`.
        long: Whether boxes of a long recording may stay in a file.

    Raises:
        GeoOrbitError: An option, a file or a value in it is wrong.
    """
    from geoorbit_ros.calibration.box_projector import BoxProjector
    from geoorbit_ros.cli.console import status

    source = _source(tracks, bag, calibration, out)
    options = with_image_size(image_size, options, stated_image_size(calibration))
    strict = options.strict

    def placed(size: tuple[int, int], report: InputReport) -> tuple[BoxProjector, Datum]:
        homography, origin = load_calibration(
            calibration, datum, size, strict=strict, camera_info=camera_info
        )
        projector = BoxProjector(homography, size)
        projector.doubted = report.doubtful
        return projector, origin

    view = None if image_size else image or _road_beside(source)
    with status(f"reading {source}"):
        if long and tracks is not None and view is None:
            found = _read_beside(source, options, placed, calibration)
            if found is not None:
                return replace(found, camera_id=camera_id or found.camera_id)
        asked = bag is not None, camera_id, long
        found = _read_whole(source, options, asked, placed, calibration, view)
    return replace(found, camera_id=camera_id or found.camera_id)


def _read_whole(
    source: Path,
    options: ReadOptions,
    asked: tuple[bool, str | None, bool],
    placed: Placed,
    calibration: Path,
    view: str | None,
) -> CameraInput:
    """Any file or bag; boxes are in the pixels of `view` where nobody says another size."""
    from geoorbit_ros.core.frame_spool import FrameSpool
    from geoorbit_ros.lanes.pipeline import note_other_classes
    from geoorbit_ros.lanes.projection_helper import ProjectionHelper

    name, topic, frames, report = _boxes(source, options, *asked)
    if view is not None:
        from geoorbit_ros.cli.images import first_view

        height, width = first_view(view).shape[:2]
        if (seen := (width, height)) != report.image_size and _reach_within(frames, seen):
            options = replace(options, default_size=seen)
            del frames  # two of a long recording don't fit into memory
            name, topic, frames, report = _boxes(source, options, *asked)
    projector, origin = placed(report.image_size or ASSUMED_SIZE, report)
    note_other_classes(report, frames)
    helper = ProjectionHelper(frames, projector) if isinstance(frames, FrameSpool) else None
    return CameraInput(name, source, calibration, frames, origin, report, projector, topic, helper)


def _read_beside(
    source: Path,
    options: ReadOptions,
    placed: Placed,
    calibration: Path,
) -> CameraInput | None:
    """A long track file without any fault, placed on the road while it is read; None: another."""
    from geoorbit_ros.core.frame_spool import FrameSpool
    from geoorbit_ros.core.input_report import InputReport
    from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
    from geoorbit_ros.lanes.pipeline import note_other_classes
    from geoorbit_ros.lanes.projection_helper import ProjectionHelper
    from geoorbit_ros.storage.tracks.long_csv import is_long, read_clean, spooled

    if not is_long(source, options):
        return None
    expected = InputReport(str(source), "boxes")
    projector, origin = placed(options.size(None, expected) or ASSUMED_SIZE, expected)
    boxes = FrameSpool(PIXEL_TRACK_DTYPE)
    helper = ProjectionHelper(boxes, projector)
    try:
        found = read_clean(source, options, boxes, helper.take)
    except BaseException:
        helper.close()
        raise
    kept = spooled(boxes)
    if found is None or kept is not boxes:
        helper.close()
    if found is None:
        return None
    note_other_classes(found[1], kept)
    name, more = source.absolute().parent.name or "camera", helper if kept is boxes else None
    return CameraInput(name, source, calibration, kept, origin, found[1], projector, helper=more)


def _boxes(
    source: Path, options: ReadOptions, is_bag: bool, camera_id: str | None, long: bool
) -> tuple[str, str, AnyFrames, InputReport]:
    """Name, topic, boxes and report of a track file or a bag."""
    from geoorbit_ros.storage.tracks.long_csv import spool_tracks, spooled
    from geoorbit_ros.storage.tracks.reader import read_tracks

    if is_bag:
        from geoorbit_ros.storage.track_bag import read_track_bag

        content = read_track_bag(source, camera_id, options)
        boxes = spooled(content.frames) if long else content.frames
        return content.camera_id or "camera", content.topic, boxes, content.report
    name = source.absolute().parent.name or "camera"
    return name, "", *(spool_tracks if long else read_tracks)(source, options)


def _road_beside(source: Path) -> str | None:
    """The image that `geoorbit process` wrote beside its tracks: it tells the size."""
    road = source.parent / ROAD_IMAGE
    return str(road) if source.is_file() and road.is_file() else None


def _reach_within(boxes: AnyFrames, size: tuple[int, int]) -> bool:
    """Whether boxes may be of an image of this size: nearly none reaches beyond it."""
    import numpy as np

    from geoorbit_ros.lanes.pipeline import BLOCK_ROWS

    reach = []
    for middle, side in (("x", "width"), ("y", "height")):
        blocks = boxes.blocks(BLOCK_ROWS)
        ends = [block.rows[middle] + 0.5 * block.rows[side] for block in blocks]
        if not ends:
            return True
        reach.append(float(np.quantile(np.concatenate(ends), 0.999)))
    return all(end <= REACH_BEYOND * side for end, side in zip(reach, size, strict=True))


def _source(tracks: Path | None, bag: Path | None, calibration: Path, out: Path) -> Path:
    """The one of tracks and bag that is given; `out` must be no input."""
    if (tracks is None) == (bag is None):
        found = "neither" if tracks is None else "both"
        raise ParameterError("options --tracks and --bag", found, "exactly one of them")
    source = tracks or bag
    assert source is not None
    check_no_input("option --out", out, source, calibration)
    return source
