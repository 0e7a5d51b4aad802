"""The motion detector on rendered scenes, whose boxes are known, and on what disturbs it."""

from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_TRUNCATED
from geoorbit_ros.detection.detector import ImageError
from geoorbit_ros.detection.motion import MotionDetector
from geoorbit_ros.scenes.render.conditions import Conditions
from geoorbit_ros.scenes.render.rendered_scene import RenderedFrame, render_scene
from geoorbit_ros.scenes.scene import load_scene

MIN_HEIGHT_PX, MIN_VISIBLE = 16.0, 0.5
"""The useful range: boxes at least this high, of vehicles visible at least so much."""
SIZE, FPS, DURATION_S = (1280, 720), 6.0, 24.0


@lru_cache(maxsize=1)
def film() -> tuple[RenderedFrame, ...]:
    scene = load_scene("s_curve")
    return tuple(render_scene(scene, DURATION_S, 2, Conditions(), FPS, SIZE))


@lru_cache(maxsize=1)
def primed() -> tuple[MotionDetector, list[NDArray[np.void]]]:
    """A detector that has seen the film twice, and its boxes the second time."""
    detector = MotionDetector()
    detector.prime((frame.stamp_ns, frame.image) for frame in film()[::2])
    return detector, [detector.detect(frame.stamp_ns, frame.image) for frame in film()]


def corners(rows: NDArray[np.void]) -> NDArray[np.float64]:
    x, y, w, h = (rows[name].astype(np.float64) for name in ("x", "y", "width", "height"))
    return np.column_stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2])


def overlaps(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=2)
    areas = [(box[:, 2:] - box[:, :2]).prod(axis=1) for box in (a, b)]
    return np.asarray(shared / (areas[0][:, None] + areas[1][None] - shared))


def compare(
    frames: tuple[RenderedFrame, ...], tables: list[NDArray[np.void]]
) -> tuple[float, float, NDArray[np.float64]]:
    """Recall, precision, and the error of each edge (M, 4) over the box's height."""
    hits = misses = false = 0
    errors = []
    for frame, rows in zip(frames, tables, strict=True):
        truth = frame.boxes
        useful = (truth["height"] >= MIN_HEIGHT_PX) & (truth["score"] >= MIN_VISIBLE)
        found, true = corners(rows), corners(truth)
        matched = set()
        table = overlaps(found, true)
        for k in np.argsort(-rows["score"], kind="stable"):
            best = int(np.argmax(table[k])) if len(true) else -1
            if best >= 0 and table[k, best] >= 0.5 and best not in matched:
                matched.add(best)
                hits += int(useful[best])
                if useful[best] and not truth["flags"][best] & FLAG_TRUNCATED:
                    errors.append((found[k] - true[best]) / truth["height"][best])
            elif rows["height"][k] >= MIN_HEIGHT_PX:
                false += 1
        misses += len(set(np.flatnonzero(useful).tolist()) - matched)
    return hits / (hits + misses), hits / (hits + false), np.array(errors)


def test_recall_and_precision_on_a_rendered_day() -> None:
    recall, precision, _ = compare(film(), primed()[1])
    assert recall >= 0.9
    assert precision >= 0.9


def test_edges_are_where_they_are_in_the_middle() -> None:
    """A shadow that is left over, or a soft edge, would move lanes all in one direction."""
    _, _, errors = compare(film(), primed()[1])
    assert np.abs(np.median(errors, axis=0)).max() < 0.06


def test_trucks_and_cars_are_told_apart_by_size() -> None:
    right = total = 0
    for frame, rows in zip(film(), primed()[1], strict=True):
        table = overlaps(corners(rows), corners(frame.boxes))
        for k, best in enumerate(table.argmax(axis=1) if len(frame.boxes) else []):
            if table[k, best] > 0.6:
                total += 1
                right += int(rows["class_id"][k] == frame.boxes["class_id"][best])
    assert right / total > 0.85


def empty_road() -> NDArray[np.uint8]:
    """The road as the film shows it most of the time."""
    return np.median([frame.image for frame in film()[::8]], axis=0).astype(np.uint8)


def noisy(picture: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0.0, 2.0, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def run(
    detector: MotionDetector, picture: NDArray[np.uint8], start_s: float, count: int
) -> list[int]:
    """Boxes in each of `count` noisy pictures of the same thing, 10 a second."""
    found = []
    for k in range(count):
        stamp_ns = round((1.0 + start_s + 0.1 * k) * 1e9)
        found.append(len(detector.detect(stamp_ns, noisy(picture, k))))
    return found


def small(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA), np.uint8)


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
    parked = road.copy()
    parked[200:240, 300:360] = (30, 30, 200)
    rows = [detector.detect(round((117.0 + k) * 1e9), noisy(parked, k)) for k in range(28)]
    assert min(len(table) for table in rows) >= 1
    assert rows[-1]["x"][0] == pytest.approx(330, abs=2)
    # The shadow model takes nothing from it, the darkness that it expects beneath is 3.5 %.
    assert rows[-1]["y"][0] == pytest.approx(220, abs=2)


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
    detector, _ = primed()
    again = [detector.detect(frame.stamp_ns, frame.image) for frame in film()[:30]]
    recall, precision, _ = compare(film()[:30], again)
    assert min(recall, precision) >= 0.85
