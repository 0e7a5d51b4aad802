"""One camera's images to lanes and files, for `geoorbit process` and `geoorbit camera add`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import Homography, plane_of_images
from geoorbit_ros.cli.camera_input import CameraInput
from geoorbit_ros.cli.images import (
    DEFAULT_FPS,
    check_images,
    shown_images,
)
from geoorbit_ros.cli.inputs import DEFAULT_ESTIMATOR, ROAD_IMAGE, find_lanes
from geoorbit_ros.cli.report import describe_method, save_report
from geoorbit_ros.cli.resume import DetectionRun
from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.core.input_report import InputReport, Treatment
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import (
    FLAG_PREDICTED,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
    Frames,
    join_frames,
    one_class_each,
    one_frame,
)
from geoorbit_ros.detection.detector import doubt_of
from geoorbit_ros.lanes.common_shift import with_shift_sigma
from geoorbit_ros.lanes.confidence import unconfirmed
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.geojson import write_lanes
from geoorbit_ros.lanes.mapping.mapper import DEFAULT_UPDATE_PERIOD_S, LaneMapper
from geoorbit_ros.lanes.pipeline import note_other_classes
from geoorbit_ros.markings.fusion import follow_paint
from geoorbit_ros.markings.road_image import SPACING_S, RoadBackground
from geoorbit_ros.report.image_overlay import ImageOverlay, write_image
from geoorbit_ros.report.recording import Recording
from geoorbit_ros.storage.frames.source import FrameSource, StampedImage
from geoorbit_ros.storage.frames.video_writer import VideoWriter
from geoorbit_ros.storage.track_csv import write_track_csv
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import make_tracker
from geoorbit_ros.view.compensation import ViewAt, boxes_in_reference, image_in_reference
from geoorbit_ros.view.looks import MAIN_VIEW
from geoorbit_ros.view.projection import ViewProjector
from geoorbit_ros.view.record import ViewRecord

TRACKS_CSV, LANES, REPORT = "tracks.csv", "lanes.geojson", "report.html"


@dataclass(frozen=True, slots=True)
class TrackedImage:
    """One image and what was seen in it.

    Attributes:
        stamp_ns: Capture time.
        image: (H, W, 3) uint8 BGR.
        detections: (N,) `DETECTION_DTYPE`.
        tracks: (M,) `PIXEL_TRACK_DTYPE`.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    detections: NDArray[np.void]
    tracks: NDArray[np.void]


class WatchedMapper(LaneMapper):
    """A mapper that remembers its latest map, for the video.

    Attributes:
        latest: The map of the last update; None before the first.
    """

    latest: LaneMap | None = None

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> LaneMap | None:
        """As `LaneMapper.add`."""
        renewed = super().add(stamp_ns, rows)
        self.latest = renewed or self.latest
        return renewed


NO_VIEW = -1
"""Key of what was seen while no view was known, where a view's number is expected."""


@dataclass(slots=True)
class CameraRun:
    """One camera's images on their way to lanes.

    Attributes:
        homography: The road plane.
        detection: Finds vehicles.
        mapper: Is given the ground tracks by the caller; its latest map is drawn into the video.
        image_size: (width, height) of the images, (0, 0) before the first.
        projector: From boxes to the road; None before the first image.
        seen: Stamp, detections and tracks of every image so far.
        pictures: Of each view the image with the fewest vehicles, for the report, and their number.
        backgrounds: Of each view the road without vehicles.
        views: How each image lies on its view.
    """

    homography: Homography
    detection: DetectionRun
    mapper: WatchedMapper
    image_size: tuple[int, int] = (0, 0)
    projector: BoxProjector | None = None
    seen: list[tuple[int, NDArray[np.void], NDArray[np.void]]] = field(default_factory=list)
    pictures: dict[int, tuple[int, NDArray[np.uint8]]] = field(default_factory=dict)
    backgrounds: dict[int, RoadBackground] = field(default_factory=dict)
    views: ViewRecord = field(default_factory=ViewRecord)
    _watched: ViewProjector | None = None
    _looked_ns: int = -(10**18)

    def ground_tracks(
        self, images: Iterable[StampedImage], video: Path | None = None, fps: float = 25.0
    ) -> Iterator[Frames]:
        """Frames of `TRACK_DTYPE`, one for every image that shows the first view.

        Args:
            images: In time order.
            video: Also write the annotated video there.
            fps: Its frame rate.

        Raises:
            GeoOrbitError: No image, one that can't be used, or control points outside of it.
        """
        detected = self.detection.boxes(images)
        first = next(detected, None)
        if first is None:
            raise NoTrafficError("images", "none", "at least one")
        width, height = self.image_size = (first[1].shape[1], first[1].shape[0])
        self.homography = plane_of_images(self.homography, self.image_size)
        self.projector = projector = BoxProjector(self.homography, self.image_size)
        parameters = TrackerParameters(image_width=width, image_height=height)
        tracker = make_tracker(parameters=parameters)
        with ExitStack() as files:
            writer = None
            if video:
                writer = files.enter_context(closing(VideoWriter(video, fps, self.image_size)))
            overlay = ImageOverlay(self.homography)
            for stamp_ns, image, boxes in chain([first], detected):
                seen = TrackedImage(stamp_ns, image, boxes, tracker.update(stamp_ns, boxes))
                at = self.views.add(stamp_ns, image)
                self.seen.append((seen.stamp_ns, seen.detections, seen.tracks))
                shown = self._keep_picture(seen, at)
                if not at.usable or at.view != MAIN_VIEW:
                    if writer:
                        writer.write(self._annotated(overlay, seen, np.empty(0, TRACK_DTYPE)))
                    continue
                tracks = boxes_in_reference(seen.tracks, at.to_reference, self.image_size)
                ground = projector.project(stamp_ns, tracks)
                if writer:
                    drawn = replace(seen, image=seen.image if shown is None else shown)
                    writer.write(self._annotated(overlay, replace(drawn, tracks=tracks), ground))
                yield one_frame(stamp_ns, ground)

    def _keep_picture(self, seen: TrackedImage, at: ViewAt) -> NDArray[np.uint8] | None:
        """Keep what the report shows of a view; the image as the view shows it.

        Images that no view is known of are kept, too: of a dark film they are all there is.
        """
        shown = image_in_reference(seen.image, replace(at, view=MAIN_VIEW)) if at.usable else None
        view, image = (NO_VIEW, seen.image) if shown is None else (at.view, shown)
        fewest, _ = self.pictures.get(view, (len(seen.detections) + 1, image))
        if len(seen.detections) < fewest:
            self.pictures[view] = (len(seen.detections), image.copy())
        if seen.stamp_ns - self._looked_ns >= SPACING_S * 1e9:
            self.backgrounds.setdefault(view, RoadBackground()).add(image)
            self._looked_ns = seen.stamp_ns
        return shown

    @property
    def picture(self) -> NDArray[np.uint8] | None:
        """A picture of the view that lanes are from."""
        for view in (self.views.main_view, NO_VIEW):
            if view in self.pictures:
                return self.pictures[view][1]
        return None

    @property
    def road(self) -> NDArray[np.uint8] | None:
        """The same without vehicles."""
        for view in (self.views.main_view, NO_VIEW):
            if view in self.backgrounds:
                return self.backgrounds[view].image()
        return None

    def ground_tracks_again(self) -> Iterator[Frames]:
        """Frames of `TRACK_DTYPE` of all images that show the view seen longest, each as it lay."""
        self.projector = BoxProjector(self.homography, self.image_size)
        watched = self._watch_again(self.projector)
        for stamp_ns, _, tracks in self.seen:
            ground = watched.project(stamp_ns, tracks)
            if ground is not None:
                yield one_frame(stamp_ns, ground)

    def _watch_again(self, projector: BoxProjector) -> ViewProjector:
        self._watched = ViewProjector(projector, memory_s=math.inf)
        for look in self.views.motions():
            self._watched.motions.add(look)
        return self._watched

    def settle_classes(self) -> None:
        """Give each track the one class that all of its images together say."""
        tables = [tracks for _, _, tracks in self.seen]
        kinds = one_class_each(np.concatenate([np.empty(0, PIXEL_TRACK_DTYPE), *tables]))
        for rows, kind in zip(
            tables, np.split(kinds, np.cumsum([len(rows) for rows in tables])), strict=False
        ):
            rows["class_id"] = kind

    def track_frames(self) -> Frames:
        """Observed tracks, of images that have any: predictions have no place in `tracks.csv`.

        Their boxes are where they would be in the calibrated view.
        """
        tracks = [(s, t) for s, _, t in self.seen]
        if self._watched is not None:
            placed = [(s, t, self._watched.motions.at(s)) for s, t in tracks]
            tracks = [
                (s, boxes_in_reference(t, at.to_reference, self.image_size))
                for s, t, at in placed
                if at.usable and at.view == MAIN_VIEW
            ]
        kept = [(s, t[(t["flags"] & FLAG_PREDICTED) == 0]) for s, t in tracks]
        some = [(stamp_ns, rows) for stamp_ns, rows in kept if len(rows)]
        return join_frames(some)

    def _annotated(
        self, overlay: ImageOverlay, seen: TrackedImage, ground: NDArray[np.void]
    ) -> NDArray[np.uint8]:
        lane_map, time_s = self.mapper.latest, (seen.stamp_ns - self.seen[0][0]) / 1e9
        confirmed = sum(lane.status == "confirmed" for lane in lane_map.lanes) if lane_map else 0
        caption = f"{time_s:6.1f} s   {len(seen.tracks)} vehicles   {confirmed} lanes"
        return overlay.draw(seen.image, seen.tracks, ground, lane_map, caption)


@dataclass(slots=True)
class CameraJob:
    """What one camera's images are to be made into, and what has been found in them.

    Attributes:
        camera_id: Name of the camera in the files.
        calibration: Its control points.
        homography: The road plane they give.
        datum: Origin of the map frame.
        detection: Finds vehicles.
        estimator: Name of the lane estimator.
        update_period_s: Data time between two updates of the map.
        run: The images on their way to tracks; made with the job.
        lane_map: The lanes, once they have been found.
        nothing: Why there are no lanes; empty where there are.
        reports: What is to be said about the inputs, once the files have been written.
    """

    camera_id: str
    calibration: Path
    homography: Homography
    datum: Datum
    detection: DetectionRun
    estimator: str = DEFAULT_ESTIMATOR
    update_period_s: float = DEFAULT_UPDATE_PERIOD_S
    run: CameraRun = field(init=False)
    lane_map: LaneMap = field(init=False)
    nothing: str = ""
    reports: tuple[InputReport, ...] = ()
    _recording: Recording = field(init=False, default_factory=Recording)
    _road: NDArray[np.uint8] | None = field(init=False, default=None)
    _paint: InputReport = field(init=False, default_factory=lambda: InputReport("images"))

    def __post_init__(self) -> None:
        self.run = CameraRun(self.homography, self.detection, self._mapper())

    def find_lanes(
        self, images: FrameSource, duration_s: float | None, video: Path | None = None
    ) -> None:
        """Look at the images, under a progress bar; without traffic the map is empty.

        Args:
            images: Of the camera.
            duration_s: How many seconds of them; None: all.
            video: Also write the annotated video there.

        Raises:
            GeoOrbitError: Images that can't be used, or none.
        """
        shown = shown_images(images, duration_s, "finding vehicles and lanes")
        rate = self.detection.rate(images.fps or DEFAULT_FPS)
        ground = self.run.ground_tracks(shown, video, rate)
        tracks = self._recording.tee(ground)
        self.lane_map = self._lanes(tracks, images.name)
        self.homography = self.run.homography
        if self.run.views.eventful:
            self._recording, self.run.mapper = Recording(), self._mapper()
            again = self.run.ground_tracks_again()
            self.lane_map = self._lanes(self._recording.tee(again), images.name)
        self._road = self.run.road
        self._paint = InputReport(images.name, "images")
        if self._road is not None:
            self.lane_map = follow_paint(
                self.lane_map, self._road, self.homography, self.run.image_size, self._paint
            )
        if doubt_of(self.detection.detector):
            self.lane_map = unconfirmed(self.lane_map)
        view = self.run.views.note(self._time_text)
        self.lane_map = replace(with_shift_sigma(self.lane_map, self.homography), view=view)
        self.run.settle_classes()
        check_images(images, self.detection.left_out, len(self.run.seen))

    def _mapper(self) -> WatchedMapper:
        return WatchedMapper(make_estimator(self.estimator), update_period_s=self.update_period_s)

    def _lanes(self, tracks: Iterator[Frames], place: str) -> LaneMap:
        """The lanes of the tracks; an empty map without traffic."""
        run, self.nothing = self.run, ""
        try:
            return find_lanes(tracks, run.mapper, place, lambda: run.projector)
        except NoTrafficError as error:
            if not run.seen:
                raise
            blind = all(view == NO_VIEW for view in run.backgrounds)
            self.nothing = (
                f"{len(run.seen)} images that show nothing: dark, covered or blank"
                if blind
                else str(error.found)
            )
            return LaneMap(run.seen[-1][0], ())

    def _time_text(self, stamp_ns: int) -> str:
        """A stamp as seconds from the first image."""
        return f"{(stamp_ns - self.run.seen[0][0]) / 1e9:.1f} s"

    def _note_views(self, remarks: InputReport) -> None:
        """Say when the view moved or was another, and which part the lanes are from."""
        views = self.run.views
        for stretch in views.told:
            remarks.note(Treatment.NOTED, stretch.sentence(self._time_text))
        if views.other_views:
            first, last = (self._time_text(ns).removesuffix(" s") for ns in views.span_ns())
            part = f"lanes are from {first} to {last} s, the longest time with one view"
            remarks.note(Treatment.NOTED, f"{part}: the calibration must be of that view")

    def write(self, folder: Path, images: FrameSource) -> None:
        """Write tracks.csv, lanes.geojson, road.png and report.html of lanes found in images."""
        frames, tracks = self.run.track_frames(), folder / TRACKS_CSV
        write_track_csv(tracks, frames)
        write_lanes(
            folder / LANES,
            self.lane_map,
            self.datum,
            camera_id=self.camera_id,
            estimator=self.estimator,
        )
        if self._road is not None:
            write_image(folder / ROAD_IMAGE, self._road)
        remarks = InputReport(str(tracks), "boxes", len(frames.rows))
        note_other_classes(remarks, frames)
        for sentence in images.remarks.sentences():
            remarks.note(Treatment.NOTED, sentence)
        self._note_views(remarks)
        if doubt := doubt_of(self.detection.detector):
            remarks.note(Treatment.DOUBTFUL, doubt)
        if self.nothing:
            remarks.note(Treatment.NOTED, f"no lane: {self.nothing}")
        projector = self.run.projector
        assert projector is not None, "lanes have been found"
        camera = CameraInput(
            self.camera_id,
            tracks,
            self.calibration,
            frames,
            self.datum,
            remarks,
            projector,
            image_reports=[self._paint],
        )
        self.reports = camera.reports()
        method = describe_method(self.estimator, self.update_period_s)
        method = f"{self.detection.detector.name}; {method}"
        save_report(
            folder / REPORT,
            camera,
            self.lane_map,
            self._recording,
            method,
            image=self.run.picture,
        )
