"""The motion detector on rendered scenes, whose boxes are known, and on what disturbs it."""

from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import ImageError
from geoorbit_ros.detection.motion.detector import MotionDetector
from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.rendered_scene import RenderedFrame, render_scene
from geoorbit_ros.scenes.scene import load_scene
from scores.detection_score import DetectionScore, box_corners, box_iou

SIZE, FPS, DURATION_S = (1280, 720), 6.0, 24.0


@lru_cache(maxsize=1)
def film() -> tuple[RenderedFrame, ...]:
    scene = load_scene("s_curve")
    return tuple(render_scene(scene, DURATION_S, 2, Conditions(), FPS, SIZE))


@lru_cache(maxsize=1)
def warmed_up() -> tuple[MotionDetector, list[NDArray[np.void]]]:
    """A detector that has seen the film twice, and its boxes the second time."""
    detector = MotionDetector()
    detector.warm_up((frame.stamp_ns, frame.image) for frame in film()[::2])
    return detector, [detector.detect(frame.stamp_ns, frame.image) for frame in film()]


def score(frames: tuple[RenderedFrame, ...], tables: list[NDArray[np.void]]) -> DetectionScore:
    total = DetectionScore()
    for frame, rows in zip(frames, tables, strict=True):
        total.add(rows, frame.boxes, SIZE[0])
    return total


def test_recall_and_precision_on_a_rendered_day() -> None:
    found = score(film(), warmed_up()[1])
    assert found.recall >= 0.9
    assert found.precision >= 0.9


def test_edges_are_where_they_are_in_the_middle() -> None:
    """A shadow that is left over, or a soft edge, would move lanes all in one direction."""
    errors = score(film(), warmed_up()[1]).edge_errors
    assert np.abs(np.median(errors, axis=0)).max() < 0.06


def test_trucks_and_cars_are_told_apart_by_size() -> None:
    right = total = 0
    for frame, rows in zip(film(), warmed_up()[1], strict=True):
        table = box_iou(box_corners(rows), box_corners(frame.boxes))
        for k, best in enumerate(table.argmax(axis=1) if len(frame.boxes) else []):
            if table[k, best] > 0.6:
                total += 1
                right += int(rows["class_id"][k] == frame.boxes["class_id"][best])
    assert right / total > 0.85


def empty_road() -> NDArray[np.uint8]:
    """The road as the film shows it most of the time."""
    return np.median([frame.image for frame in film()[::8]], axis=0).astype(np.uint8)


def noisy(image: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def run(
    detector: MotionDetector, image: NDArray[np.uint8], start_s: float, count: int
) -> list[int]:
    """Boxes in each of `count` noisy images of the same thing, 10 a second."""
    found = []
    for k in range(count):
        stamp_ns = round((1.0 + start_s + 0.1 * k) * 1e9)
        found.append(len(detector.detect(stamp_ns, noisy(image, k))))
    return found


def small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, (640, 360), interpolation=cv2.INTER_AREA), np.uint8)


def test_an_empty_road_has_no_vehicles() -> None:
    assert sum(run(MotionDetector(), small(empty_road()), 0.0, 40)) == 0


@pytest.mark.parametrize("brightness", [0.8, 1.25])
def test_light_that_changes_at_once_is_no_vehicle(brightness: float) -> None:
    detector, road = MotionDetector(), small(empty_road())
    run(detector, road, 0.0, 30)
    changed = np.clip(road * brightness, 0, 255).astype(np.uint8)
    assert sum(run(detector, changed, 3.0, 30)) <= 3


def test_a_bumped_camera_learns_the_road_anew() -> None:
    detector, road = MotionDetector(), empty_road()[60:480, 100:860]
    run(detector, road, 0.0, 30)
    bumped = empty_road()[70:490, 83:843]
    after = run(detector, bumped, 3.0, 40)
    assert detector.relearned >= 1
    assert sum(after[30:]) == 0, "three seconds after the bump the road is known again"


def test_a_vehicle_that_stops_is_seen_for_half_a_minute() -> None:
    detector, road = MotionDetector(), small(empty_road())
    for k in range(36):
        detector.detect(round((1.0 + 3.2 * k) * 1e9), noisy(road, k))
    rows = []
    for k in range(300):  # drives in, and stands from x = 330 on
        image, left = road.copy(), min(40 + 13 * k, 300)
        image[200:240, left : left + 60] = (30, 30, 200)
        rows.append(detector.detect(round((117.0 + 0.1 * k) * 1e9), noisy(image, k)))
    assert min(len(table) for table in rows) >= 1
    assert rows[-1]["x"][0] == pytest.approx(330, abs=2)
    # The shadow model takes nothing from it, the darkness that it expects beneath is 3.5 %.
    assert rows[-1]["y"][0] == pytest.approx(220, abs=2)


@pytest.mark.parametrize("sway_px", [0.5, 1.0])
def test_a_camera_that_sways_finds_nothing_on_an_empty_road(sway_px: float) -> None:
    """Edges of paint then differ by all of their contrast."""
    detector, road = MotionDetector(), empty_road()[60:480, 100:860]
    cv2.line(road, (80, 400), (700, 60), (255, 255, 255), 4)
    cv2.line(road, (200, 400), (720, 60), (20, 20, 20), 6)
    found = []
    for k in range(160):
        at = sway_px * np.sin(0.9 * k), sway_px * np.cos(0.7 * k)
        matrix = np.array([[1.0, 0.0, at[0]], [0.0, 1.0, at[1]]])
        image = cv2.warpAffine(road, matrix, (760, 420), borderMode=cv2.BORDER_REPLICATE)
        found.append(len(detector.detect(round(1e9 + 1e8 * k), noisy(np.asarray(image), k))))
    assert sum(found[80:]) <= 2, found


def test_what_sways_beside_the_road_is_no_vehicle() -> None:
    detector, road = MotionDetector(), small(empty_road())
    found = []
    for k in range(300):
        image, x = road.copy(), 300 + round(9.0 * np.sin(0.6 * k))
        if k >= 20:
            image[60:84, x : x + 30] = (30, 90, 40)
        found.append(len(detector.detect(round(1e9 + 1e8 * k), noisy(image, k))))
    assert sum(found[100:]) == 0


def test_boxes_of_what_never_travels_are_doubted() -> None:
    """Snow, a flock of birds, headlights on a wet road: there is much, and no vehicle in it."""
    detector, road = MotionDetector(), small(empty_road())
    places = np.random.default_rng(4).integers((10, 10), (600, 330), (160, 25, 2))
    for k, spots in enumerate(places):
        image = road.copy()
        for x, y in spots if k >= 15 else ():
            image[y : y + 14, x : x + 18] = 255
        detector.detect(round(1e9 + 1e8 * k), image)
        if k == 20:
            assert detector.doubt == "", "a few boxes are no doubt"
    assert "no size of vehicles is known after" in detector.doubt
    assert warmed_up()[0].doubt == ""


def test_grey_and_alpha_images_are_taken_and_deep_ones_refused() -> None:
    road = small(empty_road())
    for convert in (cv2.COLOR_BGR2GRAY, cv2.COLOR_BGR2BGRA):
        detector = MotionDetector()
        changed = np.asarray(cv2.cvtColor(road, convert), dtype=np.uint8)
        assert sum(run(detector, changed, 0.0, 12)) == 0
        changed[100:140, 200:260] = 255
        assert run(detector, changed, 1.2, 1) == [1]
    with pytest.raises(ImageError, match=r"360 x 640 of uint16.*8-bit"):
        detector.detect(3_300_000_000, np.zeros((360, 640), np.uint16))


def test_an_image_of_another_size_starts_anew() -> None:
    detector, road = MotionDetector(), small(empty_road())
    run(detector, road, 0.0, 10)
    assert sum(run(detector, road[:200, :300].copy(), 1.0, 12)) == 0


def test_time_may_start_again() -> None:
    """A recording that is looped: the road stays known, boxes come as before."""
    detector, _ = warmed_up()
    again = [detector.detect(frame.stamp_ns, frame.image) for frame in film()[:30]]
    found = score(film()[:30], again)
    assert min(found.recall, found.precision) >= 0.85
