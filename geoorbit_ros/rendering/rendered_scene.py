"""A scene as a camera's images: the traffic of `simulate`, seen instead of detected."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import FLAG_TRUNCATED, PIXEL_TRACK_DTYPE
from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.renderer import SceneRenderer, TrueBoxes
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View
from geoorbit_ros.scenes.moving_traffic import MovingTraffic
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.simulate import (
    MAX_DURATION_S,
    MAX_SEED,
    MIN_DURATION_S,
    START_NS,
    Progress,
    check_range,
    scene_camera,
    survey_control_points,
)
from geoorbit_ros.scenes.traffic import simulate_traffic
from geoorbit_ros.scenes.truth import TruthCounter, visible_lanes

MIN_SIDE_PX = 160
"""Least width and height, as in a scene file. Chosen: in smaller images nothing is found."""
MAX_SIDE_PX = 8192
"""Largest width and height, as in a scene file. Chosen: larger images take gigabytes."""
MIN_FPS = 1.0
"""Least frame rate. Chosen: below, no vehicle is followed from frame to frame."""
MAX_FPS = 120.0
"""Largest frame rate. Chosen: no camera on a pole is faster."""
MIN_BOX_PX = 1.0
"""A vehicle of which less than this is in the image, in either direction, has no box. Chosen: less
can not be drawn."""
SEEN_SHARE = 0.3
"""From this visible share on a vehicle counts for its lane: `MIN_VISIBLE_SHARE` of `simulate`."""
SEEN_HEIGHT_PX = 12.0
"""From this height on a vehicle counts for its lane: a scene's default `detector.min_height_px`."""


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """One image with its truth.

    Attributes:
        stamp_ns: Capture time.
        image: (H, W, 3) uint8 blue, green, red.
        boxes: `PIXEL_TRACK_DTYPE`, one row per vehicle with a part in the image: the box round the
            whole vehicle, hidden parts included, cut at the image border (`FLAG_TRUNCATED`).
            `track_id` is the vehicle's number + 1; `score` the share of it that is visible, 0 to 1.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    boxes: NDArray[np.void]


class RenderedScene(Iterator[RenderedFrame]):
    """Iterates over a scene's frames; made by `render_scene`.

    The same scene, duration, seed, conditions, rate and size give the same bits.

    Attributes:
        scene: The scene, with the image size and the rate that are rendered.
        camera: The true camera.
        datum: Origin of the map frame.
        control_points: Surveyed points with their pixels.
        fps: Frames per second.
        frame_count: Number of frames.
    """

    def __init__(
        self,
        scene: Scene,
        duration_s: float,
        seed: int,
        conditions: Conditions,
        progress: Progress | None = None,
    ) -> None:
        check_settings(duration_s, seed, None, None)
        self._report = progress or (lambda _what, _share: None)
        self.scene = scene
        placed = place_roads(scene)
        self.camera: PinholeCamera = scene_camera(scene, placed)
        self.datum = Datum(scene.place.latitude_deg, scene.place.longitude_deg)
        self.control_points: ControlPoints = survey_control_points(
            placed, self.camera, self.datum, seed, lens_known=scene.camera.lens_known
        )
        self.fps = scene.camera.fps
        self.frame_count = int(duration_s * self.fps)
        self._report("traffic", 0.0)
        record = simulate_traffic(scene, placed, duration_s, seed)
        self._report("traffic", 1.0)
        self._traffic = MovingTraffic(record, scene, seed)
        self._counter = TruthCounter(visible_lanes(placed, self.camera), record.lane_names)
        self._renderer = SceneRenderer(self.camera, placed, conditions, seed)
        self._next = 0

    def __next__(self) -> RenderedFrame:
        k = self._next
        if k >= self.frame_count:
            self._report("camera", 1.0)
            raise StopIteration
        self._next += 1
        if k % 10 == 0:
            self._report("camera", k / self.frame_count)
        time_s = k / self.fps
        view, lane, _ = self._traffic.at(time_s)
        image, truth = self._renderer.render_with_boxes(view, time_s)
        rows = box_rows(view, truth, self.camera.image_size)
        seen = (rows["score"] >= SEEN_SHARE) & (rows["height"] >= SEEN_HEIGHT_PX)
        self._counter.count(rows["track_id"][seen].astype(np.int64) - 1, view, lane)
        return RenderedFrame(START_NS + round(time_s * 1e9), image, rows)

    @property
    def truth(self) -> tuple[Lane, ...]:
        """True lanes as far as the camera sees them; `vehicles` counts the frames so far."""
        return self._counter.lanes()

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.camera.image_size


def check_settings(
    duration_s: float, seed: int, fps: float | None, image_size: tuple[int, int] | None
) -> None:
    """Refuse what no scene can be rendered with.

    Raises:
        ParameterError: A duration, seed, rate or size out of range.
    """
    check_range("duration", duration_s, MIN_DURATION_S, MAX_DURATION_S, "s")
    check_range("seed", seed, 0, MAX_SEED)
    if fps is not None:
        check_range("fps", fps, MIN_FPS, MAX_FPS, "frames/s")
    for name, value in zip(("image width", "image height"), image_size or (), strict=False):
        check_range(name, value, MIN_SIDE_PX, MAX_SIDE_PX, "px")


def render_scene(
    scene: Scene,
    duration_s: float,
    seed: int,
    conditions: Conditions | None = None,
    fps: float | None = None,
    image_size: tuple[int, int] | None = None,
    progress: Progress | None = None,
) -> RenderedScene:
    """The images of a scene's camera; vehicles are where `simulate` has them at the same times.

    Args:
        scene: The scene.
        duration_s: Seconds that the camera watches.
        seed: Of traffic and image.
        conditions: Light and weather; default: a dry day.
        fps: Frames per second; default: the scene's.
        image_size: Width and height; default: the scene's. The field of view stays.
        progress: Called with what is being done.

    Raises:
        ParameterError: A duration, seed, rate or size out of range.
        RoadNetworkError, TrafficError: SUMO is not installed, or refuses the scene.
    """
    check_settings(duration_s, seed, fps, image_size)
    camera = scene.camera
    if fps is not None:
        camera = camera.model_copy(update={"fps": float(fps)})
    if image_size is not None:
        camera = camera.model_copy(update={"image_size": tuple(image_size)})
    scene = scene.model_copy(update={"camera": camera})
    return RenderedScene(scene, duration_s, seed, conditions or Conditions(), progress)


def box_rows(view: View, truth: TrueBoxes, image_size: tuple[int, int]) -> NDArray[np.void]:
    """The true boxes in the image as `PIXEL_TRACK_DTYPE`."""
    width, height = image_size
    whole = truth.boxes
    cut = np.clip(whole, 0.0, [width, height, width, height])
    size = cut[:, 2:] - cut[:, :2]
    keep = np.all(size >= MIN_BOX_PX, axis=1)  # NaN: not in front
    rows = np.zeros(int(keep.sum()), PIXEL_TRACK_DTYPE)
    cut, size = cut[keep], size[keep]
    rows["x"], rows["y"] = (cut[:, :2] + 0.5 * size).T
    rows["width"], rows["height"] = size.T
    rows["score"] = truth.visible[keep]
    rows["class_id"] = view.coco_class[keep]
    rows["track_id"] = view.vehicle[keep] + 1
    rows["flags"] = np.where(np.any(cut != whole[keep], axis=1), FLAG_TRUNCATED, 0)
    return rows
