"""The network that ships with the package: what it finds, keeps and leaves out."""

import hashlib
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.tables import CAR, TRUCK
from geoorbit_ros.detection.detector import make_detector
from geoorbit_ros.detection.network.boxes import Boxes, decode
from geoorbit_ros.detection.network.channels import (
    COARSEST_PX,
    STRIDE_PX,
    WORK_AREA_PX,
    channels,
    work_size,
)
from geoorbit_ros.detection.network.detector import WEIGHTS, NetworkDetector
from geoorbit_ros.detection.network.driven_places import PATIENCE_S, SURE_SCORE, DrivenPlaces
from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.rendered_scene import RenderedFrame, render_scene
from geoorbit_ros.scenes.scene import load_scene
from scores.detection_score import DetectionScore, box_corners, box_iou

SIZE = (1280, 720)
S = 10**9


@lru_cache(maxsize=1)
def film() -> tuple[RenderedFrame, ...]:
    return tuple(render_scene(load_scene("s_curve"), 12.0, 7, Conditions(), 5.0, SIZE))


def busiest() -> RenderedFrame:
    return max(film(), key=lambda frame: len(frame.boxes))


def test_it_is_the_default() -> None:
    assert make_detector().name == "network"


def test_vehicles_are_found_in_the_first_image() -> None:
    frame, total = busiest(), DetectionScore()
    total.add(NetworkDetector().detect(frame.stamp_ns, frame.image), frame.boxes, SIZE[0])
    assert total.hits >= 2
    assert total.recall > 0.6


def test_a_film_is_found_as_it_comes() -> None:
    detector, total = NetworkDetector(), DetectionScore()
    for frame in film():
        rows = detector.detect(frame.stamp_ns, frame.image)
        if frame.stamp_ns - film()[0].stamp_ns > PATIENCE_S * S:
            total.add(rows, frame.boxes, SIZE[0])
    assert total.recall > 0.7
    assert total.precision > 0.85


def test_a_vehicle_that_stands_stays() -> None:
    """Vehicles that drove up and stop are all there half a minute later."""
    frames, detector = film()[:30], NetworkDetector()
    for frame in frames:
        first = detector.detect(frame.stamp_ns, frame.image)
    for k in range(1, 31):
        last = detector.detect(frames[-1].stamp_ns + k * S, frames[-1].image)
    there = box_iou(box_corners(frames[-1].boxes), box_corners(first)).max(axis=1) > 0.5
    assert there.sum() >= 3
    still = box_iou(box_corners(frames[-1].boxes[there]), box_corners(last)).max(axis=1) > 0.5
    assert still.mean() > 0.7


@pytest.mark.parametrize(("dark", "noise"), [(250, 6.0), (120, 6.0), (120, 15.0), (120, 40.0)])
def test_sky_fog_and_noise_hold_no_vehicle(dark: int, noise: float) -> None:
    random, detector, found = np.random.default_rng(1), NetworkDetector(), 0
    view = np.broadcast_to(np.linspace(250, dark, 360)[:, None, None], (360, 640, 3))
    for k in range(12):
        image = np.clip(view + random.normal(0.0, noise, view.shape), 0, 255).astype(np.uint8)
        found += len(detector.detect(S + k * S // 10, image))
    assert found <= noise // 40


def test_the_same_images_give_the_same_boxes() -> None:
    def tables() -> list[bytes]:
        detector = NetworkDetector()
        return [detector.detect(f.stamp_ns, f.image).tobytes() for f in film()[:8]]

    assert tables() == tables()


def test_another_size_starts_anew_and_boxes_lie_in_the_image() -> None:
    detector, frame = NetworkDetector(), busiest()
    for image in (frame.image, frame.image[:400, :500], frame.image[:90, :2]):
        rows = detector.detect(frame.stamp_ns, image)
        corners = box_corners(rows)
        assert (corners >= 0.0).all()
        assert (corners <= [image.shape[1], image.shape[0]] * 2).all()


def test_the_weights_are_those_of_the_model_card() -> None:
    card = WEIGHTS.with_name("MODEL_CARD.md").read_text(encoding="utf-8")
    assert hashlib.sha256(WEIGHTS.read_bytes()).hexdigest() in card
    assert WEIGHTS.stat().st_size < 3_000_000


@pytest.mark.parametrize("size", [(1920, 1080), (1280, 720), (720, 1280), (352, 288), (40, 3000)])
def test_the_work_size_has_about_the_wanted_area_and_whole_cells(size: tuple[int, int]) -> None:
    width, height = work_size(size)
    assert width % COARSEST_PX == height % COARSEST_PX == 0
    assert min(width, height) >= COARSEST_PX
    if min(size) > 200:
        assert 0.8 < width * height / min(WORK_AREA_PX, 4 * size[0] * size[1]) < 1.2
        assert abs(np.log(width / height / (size[0] / size[1]))) < 0.1


def test_what_is_not_known_leaves_its_channel_dark() -> None:
    random = np.random.default_rng(1)
    image, other = random.integers(0, 255, (2, 64, 96, 3), dtype=np.uint8)
    assert not channels(image, None, None)[..., 3:].any()
    both = channels(image, other, image)
    assert (both[..., 3] == np.abs(image.astype(int) - other).max(axis=2)).all()
    assert not both[..., 4].any()
    assert (both[..., :3] == image).all()


def output(*vehicles: tuple[int, int, float, float, int]) -> NDArray[np.float32]:
    """Network output with middles at (column, row), half sides in pixels, scores and classes."""
    found = np.zeros((10, 40, 60), np.float32)
    for column, row, half, score, name in vehicles:
        found[:5, row, column] = score, half, half, half, half
        found[5 + name, row, column] = 1.0
    return found


def test_boxes_are_around_their_middles() -> None:
    boxes = decode(output((10, 20, 8.0, 0.9, 3), (30, 5, 4.0, 0.5, 0)), 0.3, 0.6)
    middle = (np.array([[10, 20], [30, 5]]) + 0.5) * STRIDE_PX
    around = np.array([[-8, -8, 8, 8], [-4, -4, 4, 4]])
    assert np.allclose(boxes.corners, np.hstack((middle, middle)) + around)
    assert boxes.class_id.tolist() == [TRUCK, CAR]
    assert np.allclose(boxes.score, [0.9, 0.5])


def test_two_boxes_on_one_vehicle_are_one_and_bicycles_are_none() -> None:
    found = output((10, 20, 30.0, 0.9, 0), (11, 20, 30.0, 0.6, 3), (40, 20, 9.0, 0.9, 4))
    boxes = decode(found, 0.3, 0.6)
    assert boxes.class_id.tolist() == [CAR]
    assert len(decode(output((10, 20, 9.0, 0.2, 0)), 0.3, 0.6).score) == 0


def one_box(score: float) -> Boxes:
    return Boxes(np.array([[40.0, 40.0, 80.0, 70.0]]), np.array([score]), np.array([CAR]))


def seconds_kept(places: DrivenPlaces, score: float, moved: NDArray[np.uint8]) -> list[bool]:
    return [bool(places.plausible(k * S // 2, one_box(score), moved)[0]) for k in range(60)]


def test_what_stands_where_nothing_drove_goes_unless_it_is_sure() -> None:
    still = np.zeros((120, 160), np.uint8)
    kept = seconds_kept(DrivenPlaces((160, 120)), 0.4, still)
    assert kept[0]
    assert not kept[-1]
    assert 0.4 * PATIENCE_S < 0.5 * sum(kept) < 10.0
    assert all(seconds_kept(DrivenPlaces((160, 120)), SURE_SCORE, still))


def test_what_stands_where_vehicles_drove_stays() -> None:
    places = DrivenPlaces((160, 120))
    moved = np.full((120, 160), 90, np.uint8)
    for k in range(-5, 0):
        assert places.plausible(k * S, one_box(0.4), moved).all()
    assert all(seconds_kept(places, 0.4, np.zeros_like(moved)))
