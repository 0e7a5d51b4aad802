"""One camera's images to lanes and files, for `geoorbit process` and `geoorbit camera add`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.cli.inputs import DEFAULT_ESTIMATOR, CameraInput
from geoorbit_ros.cli.report import describe_method, save_report
from geoorbit_ros.core.errors import NoTrafficError, ParameterError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.tables import FLAG_PREDICTED, PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.detection.detector import Detector
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.geojson import write_lanes
from geoorbit_ros.lanes.mapping.mapper import DEFAULT_UPDATE_PERIOD_S, LaneMapper
from geoorbit_ros.lanes.pipeline import StampedRows, map_lanes, note_other_classes
from geoorbit_ros.report.image_overlay import ImageOverlay
from geoorbit_ros.report.recording import Recording
from geoorbit_ros.storage.frames.source import FrameSource, StampedImage
from geoorbit_ros.storage.frames.video_writer import VideoWriter
from geoorbit_ros.storage.track_csv import write_track_csv
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.tracker import VehicleTracker, make_tracker

TRACKS_CSV, LANES, REPORT = "tracks.csv", "lanes.geojson", "report.html"

SPACING_S = 0.25
"""Time between the images of a warm-up. Chosen: smaller, the warm-up takes longer; larger, a
vehicle that stops for a moment looks like the road."""
LONGEST_S = 120.0
"""Length of a warm-up; of a longer recording, the beginning is used. Chosen: larger, the command
starts later; smaller, a queue that stands the whole time looks like the road."""
DEFAULT_FPS = 25.0
"""Frame rate where a source has none of its own: of the annotated video, and to estimate how far a
command is. It has no influence on tracks and lanes, which go by the stamps."""


def open_images(source: str, fps: float | None, duration_s: float | None) -> FrameSource:
    """A source as a user names it, scenes included.

    Raises:
        GeoOrbitError: It can't be opened, or is a stream and no duration is given.
    """
    from geoorbit_ros.cli.console import error_console, status
    from geoorbit_ros.rendering.frame_source import SCENES
    from geoorbit_ros.storage.frames.open_source import open_frame_source
    from geoorbit_ros.storage.frames.source import SourceOptions

    options = SourceOptions(fps=fps, report=lambda text: error_console.print(text, style="dim"))
    with status("opening"):
        images = open_frame_source(source, options, SCENES)
    if images.live and duration_s is None:
        raise ParameterError("option --duration", "none for a stream", "how many seconds to take")
    return images


def open_camera(source: str, fps: float | None, duration_s: float | None) -> FrameSource:
    """As `open_images`; a stream is read in a thread, so that none of its images waits in it."""
    from geoorbit_ros.storage.frames.feed import LiveFrames

    images = open_images(source, fps, duration_s)
    return LiveFrames(images) if images.live else images


def shown_images(
    images: FrameSource, duration_s: float | None, what: str
) -> Iterator[StampedImage]:
    """The images of the first `duration_s` under a progress bar that says `what` is done."""
    from geoorbit_ros.cli.console import track

    counts = [images.frame_count] if images.frame_count else []
    if duration_s is not None and (images.fps or images.live):
        counts.append(round(duration_s * (images.fps or DEFAULT_FPS)))
    first_ns: int | None = None
    for stamp_ns, image in track(images, what, min(counts, default=None)):
        first_ns = stamp_ns if first_ns is None else first_ns
        if duration_s is not None and stamp_ns - first_ns >= duration_s * 1e9:
            return
        yield stamp_ns, image


def warm_up_detector(detector: Detector, images: FrameSource, duration_s: float | None) -> None:
    """Let the detector see a recording once, under a progress bar; a stream can't be seen twice.

    A detector that learns nothing takes no image, so that nothing is read.
    """
    if not images.live:
        detector.warm_up(_some(images, min(duration_s or LONGEST_S, LONGEST_S)))


def _some(images: FrameSource, duration_s: float) -> Iterator[StampedImage]:
    from geoorbit_ros.cli.console import track

    count = images.frame_count
    if images.fps:
        count = min(count or 10**9, round(duration_s * images.fps))
    first_ns = last_ns = None
    for stamp_ns, image in track(images, "learning the road", count):
        first_ns = stamp_ns if first_ns is None else first_ns
        if stamp_ns - first_ns >= duration_s * 1e9:
            return
        if last_ns is None or stamp_ns - last_ns >= SPACING_S * 1e9:
            last_ns = stamp_ns
            yield stamp_ns, image


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


def track_images(
    frames: Iterable[tuple[int, NDArray[np.uint8]]], detector: Detector, tracker: VehicleTracker
) -> Iterator[TrackedImage]:
    """Detect and track frame by frame.

    Args:
        frames: Capture time and image, in time order.
        detector: One that has seen no image yet.
        tracker: One that has seen no frame yet.
    """
    for stamp_ns, image in frames:
        detections = detector.detect(stamp_ns, image)
        yield TrackedImage(stamp_ns, image, detections, tracker.update(stamp_ns, detections))


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


@dataclass(slots=True)
class CameraRun:
    """One camera's images on their way to lanes.

    Attributes:
        homography: The road plane.
        detector: Finds vehicles.
        mapper: Is given the ground tracks by the caller; its latest map is drawn into the video.
        image_size: (width, height) of the images, (0, 0) before the first.
        seen: Stamp, detections and tracks of every image so far.
    """

    homography: Homography
    detector: Detector
    mapper: WatchedMapper
    image_size: tuple[int, int] = (0, 0)
    seen: list[tuple[int, NDArray[np.void], NDArray[np.void]]] = field(default_factory=list)

    def ground_tracks(
        self, images: Iterable[StampedImage], video: Path | None = None, fps: float = 25.0
    ) -> Iterator[StampedRows]:
        """Stamp and `TRACK_DTYPE` rows of every image.

        Args:
            images: In time order.
            video: Also write the annotated video there.
            fps: Its frame rate.

        Raises:
            GeoOrbitError: No image, one that can't be used, or control points outside of it.
        """
        images = iter(images)
        first = next(images, None)
        if first is None:
            raise NoTrafficError("images", "none", "at least one")
        width, height = self.image_size = (first[1].shape[1], first[1].shape[0])
        projector = BoxProjector(self.homography, self.image_size)
        parameters = TrackerParameters(image_width=width, image_height=height)
        tracker = make_tracker(parameters=parameters)
        with ExitStack() as files:
            writer = None
            if video:
                writer = files.enter_context(closing(VideoWriter(video, fps, self.image_size)))
            overlay = ImageOverlay(self.homography)
            for seen in track_images(chain([first], images), self.detector, tracker):
                self.seen.append((seen.stamp_ns, seen.detections, seen.tracks))
                ground = projector.project(seen.stamp_ns, seen.tracks)
                if writer:
                    writer.write(self._annotated(overlay, seen, ground))
                yield seen.stamp_ns, ground

    def track_frames(self) -> Frames:
        """Observed tracks, of images that have any: predictions have no place in `tracks.csv`."""
        kept = [(s, t[(t["flags"] & FLAG_PREDICTED) == 0]) for s, _, t in self.seen]
        kept = [(stamp_ns, rows) for stamp_ns, rows in kept if len(rows)]
        offset = np.cumsum([0, *(len(rows) for _, rows in kept)], dtype=np.int64)
        rows = np.concatenate([np.empty(0, PIXEL_TRACK_DTYPE), *(rows for _, rows in kept)])
        return Frames(np.array([s for s, _ in kept], dtype=np.int64), offset, rows)

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
        detector: Finds vehicles.
        estimator: Name of the lane estimator.
        update_period_s: Data time between two updates of the map.
        run: The images on their way to tracks; made with the job.
        lane_map: The lanes, once they have been found.
    """

    camera_id: str
    calibration: Path
    homography: Homography
    datum: Datum
    detector: Detector
    estimator: str = DEFAULT_ESTIMATOR
    update_period_s: float = DEFAULT_UPDATE_PERIOD_S
    run: CameraRun = field(init=False)
    lane_map: LaneMap = field(init=False)
    _recording: Recording = field(init=False, default_factory=Recording)

    def __post_init__(self) -> None:
        mapper = WatchedMapper(make_estimator(self.estimator), update_period_s=self.update_period_s)
        self.run = CameraRun(self.homography, self.detector, mapper)

    def find_lanes(
        self, images: FrameSource, duration_s: float | None, video: Path | None = None
    ) -> None:
        """Look at the images, under a progress bar.

        Args:
            images: Of the camera.
            duration_s: How many seconds of them; None: all.
            video: Also write the annotated video there.

        Raises:
            GeoOrbitError: Images that can't be used, or none.
        """
        shown = shown_images(images, duration_s, "finding vehicles and lanes")
        ground = self.run.ground_tracks(shown, video, images.fps or DEFAULT_FPS)
        self.lane_map = map_lanes(self._recording.tee(ground), self.run.mapper, images.name)

    def write(self, folder: Path) -> None:
        """Write tracks.csv, lanes.geojson and report.html of lanes that have been found."""
        frames, tracks = self.run.track_frames(), folder / TRACKS_CSV
        write_track_csv(tracks, frames)
        write_lanes(
            folder / LANES,
            self.lane_map,
            self.datum,
            camera_id=self.camera_id,
            estimator=self.estimator,
        )
        remarks = InputReport(str(tracks), "boxes", len(frames.rows))
        note_other_classes(remarks, frames)
        camera = CameraInput(
            self.camera_id,
            tracks,
            self.calibration,
            frames,
            self.homography,
            self.datum,
            self.run.image_size,
            remarks,
        )
        method = describe_method(self.estimator, self.update_period_s)
        method = f"{self.detector.name}; {method}"
        save_report(folder / REPORT, camera, self.lane_map, self._recording, method)
