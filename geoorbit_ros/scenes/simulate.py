"""A scene run: traffic, wander, camera, faults, and the truth that the camera could have seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_facts import NO_FACTS, CameraFacts
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, TRACK_DTYPE, Frames
from geoorbit_ros.scenes.camera import PinholeCamera, look_at
from geoorbit_ros.scenes.detector_model import DetectorModel, View, true_boxes
from geoorbit_ros.scenes.moving_traffic import MovingTraffic
from geoorbit_ros.scenes.roads import PlacedRoad, place_roads
from geoorbit_ros.scenes.scene import Scene
from geoorbit_ros.scenes.traffic import TrafficRecord, simulate_traffic
from geoorbit_ros.scenes.truth import TruthCounter, visible_lanes

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is."""

CLEAN_SIGMA_M = 0.02
"""Ground error that exact tracks claim. Chosen: not 0, because estimators weigh by it."""
START_NS = 1_000_000_000
"""Stamp of the first frame; zero stamps mean 'unset' in ROS."""
MIN_DURATION_S = 1.0
"""Shortest run. Chosen: in less, no vehicle moves."""
MAX_DURATION_S = 21600.0
"""Longest run: all frames are held in memory. Chosen: six hours."""
CONTROL_POINTS = 16
"""Control points of a camera. Chosen: more make the calibration more exact than a person's."""
SURVEY_SIGMA_M = 0.02
"""1-sigma of a surveyed coordinate. Chosen: that of satellite positioning with corrections
(RTK)."""
CLICK_SIGMA_PX = 0.5
"""1-sigma of a clicked pixel coordinate. Chosen: a careful person's."""
MARGIN_PX = 20.0
"""No point is nearer to the image border. Chosen: in a real camera lens distortion is largest
there."""
MAX_GROUND_SIGMA_M = 0.5
"""No point is taken where a pixel is more than this on the ground. Chosen: larger makes the
homography inexact."""
MAX_SEED = 2**31 - 1
"""SUMO's seed is an int32."""


@dataclass(frozen=True)
class SceneRun:
    """What one run of a scene gives.

    Attributes:
        scene: The scene.
        frames: `PIXEL_TRACK_DTYPE` boxes as the camera's tracker reports them.
        clean: `TRACK_DTYPE` true ground points of the vehicles in the camera's view.
        truth: Lanes, cut to what the camera sees, in the map frame at `datum`.
        datum: Origin of the map frame.
        control_points: Surveyed points with their pixels.
        camera: The true camera.
        boxes: `PIXEL_TRACK_DTYPE` true boxes of all vehicles in the image that are large enough
            to detect, hidden ones included, with true ids: what a tracker is scored against.
    """

    scene: Scene
    frames: Frames
    clean: Frames
    truth: tuple[Lane, ...]
    datum: Datum
    control_points: ControlPoints
    camera: PinholeCamera
    boxes: Frames

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.camera.image_size

    @property
    def lane_vehicles(self) -> dict[int, int]:
        """Vehicles that the camera saw drive along each lane, by lane id."""
        return {lane.lane_id: round(lane.vehicles) for lane in self.truth}


def simulate(
    scene: Scene,
    duration_s: float,
    seed: int,
    progress: Progress | None = None,
    traffic_record: TrafficRecord | None = None,
) -> SceneRun:
    """Run a scene. The same scene, duration, seed and record give the same bits.

    Args:
        scene: The scene.
        duration_s: How long it is watched.
        seed: Of all chances.
        progress: Told how far it is.
        traffic_record: Traffic to watch in place of SUMO's (`scenes.traffic.simulate_traffic`).

    Raises:
        ParameterError: A duration or a seed out of range.
        RoadNetworkError, TrafficError: SUMO is not installed, or refuses the scene.
    """
    check_range("duration", duration_s, MIN_DURATION_S, MAX_DURATION_S, "s")
    check_range("seed", seed, 0, MAX_SEED)
    report, placed = progress or (lambda _what, _share: None), place_roads(scene)
    camera = scene_camera(scene, placed)
    report("traffic", 0.0)
    record = traffic_record or simulate_traffic(scene, placed, duration_s, seed)
    report("traffic", 1.0)
    traffic = MovingTraffic(record, scene, seed)
    lanes = visible_lanes(placed, camera)
    counter = TruthCounter(lanes, record.lane_names)
    model = DetectorModel(camera, scene.detector, seed)
    random = np.random.default_rng([seed, 3])
    stamps, noisy, clean, boxes = [], [], [], []
    for k in range(frame_count := int(duration_s * scene.camera.fps)):
        ideal_s = k / scene.camera.fps
        jitter = scene.detector.time_jitter_s * float(np.clip(random.standard_normal(), -3.0, 3.0))
        time_s = max(ideal_s + min(jitter, 0.3 / scene.camera.fps), 0.0)
        view, lane, velocity = traffic.at(time_s)
        rows, vehicles = model.detect(time_s, view)
        counter.count(vehicles, view, lane)
        stamps.append(START_NS + round(time_s * 1e9))
        noisy.append(rows)
        clean.append(_clean_rows(view, velocity, vehicles))
        boxes.append(true_boxes(camera, view, scene.detector.min_height_px))
        if k % 50 == 0:
            report("camera", k / frame_count)
    report("camera", 1.0)
    datum = Datum(scene.place.latitude_deg, scene.place.longitude_deg)
    stamp_ns = np.array(stamps, dtype=np.int64)
    return SceneRun(
        scene,
        _frames(stamp_ns, noisy, PIXEL_TRACK_DTYPE),
        _frames(stamp_ns, clean, TRACK_DTYPE),
        counter.lanes(),
        datum,
        survey_control_points(placed, camera, datum, seed, lens_known=scene.camera.lens_known),
        camera,
        _frames(stamp_ns, boxes, PIXEL_TRACK_DTYPE),
    )


def check_range(name: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Refuse a number that a run can't be made with.

    Raises:
        ParameterError: `value` is not between `low` and `high`.
    """
    if not low <= value <= high:
        raise ParameterError(
            name, f"{value:g} {unit}".strip(), f"{low:.3g} to {high:.10g} {unit}".strip()
        )


def scene_camera(scene: Scene, placed: dict[str, PlacedRoad]) -> PinholeCamera:
    """The scene's camera over its roads, which are in the map frame."""
    pole, target = scene.camera.pole, scene.camera.look_at
    centre = np.append(placed[pole.road].point(pole.along_m, pole.right_m), scene.camera.height_m)
    middle = np.append(placed[target.road].point(target.along_m, target.right_m), 0.0)
    seen = scene.camera
    return look_at(centre, middle, seen.horizontal_fov_deg, seen.image_size, seen.k1, seen.k2)


def _clean_rows(
    view: View, velocity: NDArray[np.float64], seen: NDArray[np.int64]
) -> NDArray[np.void]:
    """True ground points of the vehicles that the camera saw."""
    keep = np.isin(view.vehicle, seen)
    rows = np.zeros(int(keep.sum()), TRACK_DTYPE)
    rows["x"], rows["y"] = view.xy[keep].T
    rows["vx"], rows["vy"] = velocity[keep].T
    rows["heading"] = view.heading[keep]
    rows["length"], rows["width"] = view.size[keep, 0], view.size[keep, 1]
    rows["score"], rows["sigma"] = 1.0, CLEAN_SIGMA_M
    rows["class_id"], rows["track_id"] = view.coco_class[keep], view.vehicle[keep] + 1
    return rows


def _frames(
    stamp_ns: NDArray[np.int64], tables: list[NDArray[np.void]], dtype: np.dtype[np.void]
) -> Frames:
    offset = np.append(0, np.cumsum([len(t) for t in tables])).astype(np.int64)
    data = b"".join(t.tobytes() for t in tables)
    return Frames(stamp_ns, offset, np.frombuffer(data, dtype))


def survey_control_points(
    placed: dict[str, PlacedRoad],
    camera: PinholeCamera,
    datum: Datum,
    seed: int,
    *,
    lens_known: bool = True,
) -> ControlPoints:
    """Control points as a surveyor takes them: on the roads' borders, with small errors.

    The facts above them say the image's size and, if `lens_known`, the lens, where there is one.
    """
    random = np.random.default_rng([seed, 5])
    lines = [p.offset(right) for p in placed.values() for right in (0.0, p.road.lanes * p.width_m)]
    ground = np.concatenate(lines)
    pixel, depth = camera.project(np.column_stack([ground, np.zeros(len(ground))]))
    size = np.array(camera.image_size)
    inside = (depth > 1.0) & np.all((pixel > MARGIN_PX) & (pixel < size - MARGIN_PX), axis=1)
    ground, pixel = ground[inside], pixel[inside]
    sharp = camera.ground_sigma_m(ground, 1.0) <= MAX_GROUND_SIGMA_M
    ground, pixel = ground[sharp], pixel[sharp]
    chosen = _spread(pixel, CONTROL_POINTS)
    surveyed = ground[chosen] + SURVEY_SIGMA_M * random.standard_normal((len(chosen), 2))
    clicked = pixel[chosen] + CLICK_SIGMA_PX * random.standard_normal((len(chosen), 2))
    facts = NO_FACTS
    if camera.lens is not None:
        facts = CameraFacts(camera.image_size, camera.lens if lens_known else None)
    return ControlPoints(
        clicked,
        surveyed,
        datum,
        np.arange(len(chosen)) + 2,
        facts=facts,
        image_size=camera.image_size,
    )


def _spread(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Farthest-point sampling: well spread, the same for the same points."""
    chosen = [int(np.argmax(points[:, 1]))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, np.hypot(*(points - points[chosen[-1]]).T))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)
