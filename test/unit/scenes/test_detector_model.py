"""The imagined camera and detector: exact without faults, and each fault as described."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_scenes import FAULTLESS, Array, pole_camera, view_of

from geoorbit_ros.scenes.camera import look_at
from geoorbit_ros.scenes.detector_model import (
    GAP_S,
    MIN_VISIBLE_SHARE,
    DetectorModel,
    View,
    exact_boxes,
    true_boxes,
)
from geoorbit_ros.scenes.scene import DetectorFaults

CAR = (4.5, 1.8, 1.5)
TRUCK = (9.0, 2.5, 3.5)
HEIGHT_M = 8.0
CAMERA = pole_camera(HEIGHT_M)


def faulty(**faults: float) -> DetectorFaults:
    return FAULTLESS.model_copy(update=faults)


def edges(rows: np.ndarray[tuple[int], np.dtype[np.void]]) -> Array:
    """(N, 4) left, top, right, bottom."""
    x, y, w, h = (rows[name].astype(float) for name in ("x", "y", "width", "height"))
    return np.column_stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2])


def by_hand(x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel of a point in `pole_camera`: it looks north and down by atan(height / 40)."""
    tilt = np.arctan2(HEIGHT_M, 40.0)
    ahead = y * np.cos(tilt) + (HEIGHT_M - z) * np.sin(tilt)
    below = (HEIGHT_M - z) * np.cos(tilt) - y * np.sin(tilt)
    focal = 500.0 / np.tan(np.radians(30.0))
    return 500.0 + focal * x / ahead, 300.0 + focal * below / ahead


def corners(x: float, y: float, heading_deg: float, size: tuple[float, float, float]) -> Array:
    """Pixels (8, 2) of the corners of a body."""
    along = np.array([np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg))])
    across = np.array([-along[1], along[0]])
    found = []
    for a in (-0.5, 0.5):
        for b in (-0.5, 0.5):
            at = np.array([x, y]) + a * size[0] * along + b * size[1] * across
            found += [by_hand(float(at[0]), float(at[1]), z) for z in (0.0, size[2])]
    return np.array(found)


def many(faults: DetectorFaults, view: View, frames: int, step_s: float = 0.1) -> list[Array]:
    """Boxes of many frames of one unchanging view."""
    model = DetectorModel(CAMERA, faults, 3)
    return [edges(model.detect(k * step_s, view)[0]) for k in range(frames)]


@settings(max_examples=30, deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(5, 30), st.floats(20, 80))
def test_the_point_looked_at_is_in_the_middle(
    x: float, y: float, height: float, fov: float
) -> None:
    target = np.array([x + 30.0, y - 7.0, 0.0])
    camera = look_at(np.array([x, y, height]), target, fov, (800, 600))
    pixel, depth = camera.project(target)
    assert np.allclose(pixel, [400.0, 300.0])
    assert depth == pytest.approx(np.hypot(np.hypot(30.0, 7.0), height))
    above, _ = camera.project(target + np.array([0.0, 0.0, 1.0]))
    assert above[0] == pytest.approx(400.0)
    assert above[1] < 300.0
    # The field of view reaches from the left to the right border.
    assert camera.focal_px * np.tan(np.radians(fov / 2)) == pytest.approx(400.0)


def test_the_ground_error_is_what_a_pixel_does() -> None:
    ground = np.array([[0.0, 20.0], [6.0, 60.0], [-10.0, 150.0]])
    sigma = CAMERA.ground_sigma_m(ground, 0.5)
    assert np.all(np.diff(sigma) > 0.0)
    pixel, _ = CAMERA.project(np.pad(ground, ((0, 0), (0, 1))))
    turn = np.linspace(0.0, 2 * np.pi, 360)
    around = pixel[:, None] + 0.5e-3 * np.column_stack([np.cos(turn), np.sin(turn)])
    back = np.linalg.inv(CAMERA.matrix[:, [0, 1, 3]])
    lifted = np.concatenate([around, np.ones((*around.shape[:2], 1))], axis=2) @ back.T
    moved = lifted[..., :2] / lifted[..., 2:] - ground[:, None]
    assert np.allclose(np.hypot(moved[..., 0], moved[..., 1]).max(axis=1) * 1e3, sigma, rtol=1e-3)


@settings(max_examples=60, deadline=None)
@given(st.floats(-4, 4), st.floats(25, 60), st.floats(-180, 180), st.sampled_from([CAR, TRUCK]))
def test_without_faults_a_box_holds_the_projected_body_exactly(
    x: float, y: float, heading: float, size: tuple[float, float, float]
) -> None:
    rows, vehicles = DetectorModel(CAMERA, FAULTLESS, 1).detect(0.0, view_of((x, y, heading, size)))
    body = corners(x, y, heading, size)
    expected = [*body.min(axis=0), *body.max(axis=0)]
    if len(rows):  # a small box may be lost even without faults
        assert vehicles.tolist() == [0]
        assert np.allclose(edges(rows)[0], expected, atol=1e-3)
    boxes, _ = exact_boxes(CAMERA, view_of((x, y, heading, size)))
    assert np.allclose(boxes[0], expected, atol=1e-9)


def test_a_vehicle_behind_the_camera_is_not_seen() -> None:
    view = view_of((0.0, -20.0, 90.0, CAR), (0.0, 0.0, 90.0, CAR))
    rows, vehicles = DetectorModel(CAMERA, FAULTLESS, 1).detect(0.0, view)
    assert len(rows) == len(vehicles) == 0


def test_cut_boxes_end_at_the_border() -> None:
    # 60 degrees wide: at 30 m the border is 17.5 m to the side.
    view = view_of((17.0, 30.0, 90.0, TRUCK), (-17.0, 30.0, 90.0, TRUCK), (0.0, 30.0, 90.0, CAR))
    model = DetectorModel(CAMERA, faulty(edge_noise_px=2.0), 1)
    for k in range(50):
        box = edges(model.detect(0.1 * k, view)[0])
        assert np.all(box[:, :2] >= -1e-3)
        assert np.all(box[:, 2:] <= np.array([1000.0, 600.0]) + 1e-3)
    exact = edges(DetectorModel(CAMERA, FAULTLESS, 1).detect(0.0, view)[0])
    assert exact[0, 2] == pytest.approx(1000.0)
    assert exact[1, 0] == pytest.approx(0.0)


def test_a_vehicle_that_is_mostly_outside_is_not_detected() -> None:
    model = DetectorModel(CAMERA, FAULTLESS, 1)
    for x in np.arange(10.0, 25.0, 0.25):
        view = view_of((float(x), 30.0, 90.0, TRUCK))
        box, _ = exact_boxes(CAMERA, view)
        inside = np.clip(box, 0.0, [1000.0, 600.0, 1000.0, 600.0])
        share = float((inside[0, 2:] - inside[0, :2]).prod() / (box[0, 2:] - box[0, :2]).prod())
        assert len(model.detect(0.0, view)[0]) == int(share >= MIN_VISIBLE_SHARE)


def test_a_truck_hides_the_car_behind_it_and_not_the_reverse() -> None:
    truck, car = (0.0, 30.0, 90.0, TRUCK), (0.0, 42.0, 90.0, CAR)
    model = DetectorModel(CAMERA, faulty(occluded_share=0.7), 1)
    assert model.detect(0.0, view_of(truck, car))[1].tolist() == [0]
    assert model.detect(0.1, view_of(car, truck))[1].tolist() == [1]
    beside = (6.0, 42.0, 90.0, CAR)
    assert sorted(model.detect(0.2, view_of(truck, beside))[1].tolist()) == [0, 1]
    # A truck behind a car is taller: enough of it shows.
    behind = view_of((0.0, 30.0, 90.0, CAR), (0.0, 42.0, 90.0, TRUCK))
    assert sorted(model.detect(0.3, behind)[1].tolist()) == [0, 1]


def test_boxes_are_lost_at_the_rate_and_small_ones_more_often() -> None:
    view = view_of((0.0, 22.0, 90.0, TRUCK), (20.0, 180.0, 90.0, CAR))
    near = far = 0
    model = DetectorModel(CAMERA, faulty(miss_rate=0.2), 5)
    for k in range(2000):
        seen = model.detect(0.1 * k, view)[1]
        near, far = near + int(0 in seen), far + int(1 in seen)
    assert 1.0 - near / 2000 == pytest.approx(0.2, abs=0.03)
    assert far < near - 100
    assert all(len(box) == 1 for box in many(faulty(min_height_px=40.0), view, 100))


def test_edges_jitter_as_much_as_they_should() -> None:
    view = view_of((0.0, 25.0, 90.0, TRUCK))
    exact = many(FAULTLESS, view, 1)[0][0]
    jitter = np.array([b[0] for b in many(faulty(edge_noise_px=1.5), view, 3000)]) - exact
    assert np.allclose(jitter.std(axis=0), 1.5, rtol=0.06)
    assert np.allclose(jitter.mean(axis=0), 0.0, atol=0.12)
    lag = np.mean(jitter[1:] * jitter[:-1], axis=0) / 1.5**2
    assert np.all(np.abs(lag) < 0.08)
    # The other part varies slowly: it is proportional to the size, and similar a frame later.
    breath = np.array([b[0] for b in many(faulty(edge_noise_share=0.03), view, 6000)]) - exact
    size = np.tile(exact[2:] - exact[:2], 2)
    assert np.allclose(breath.std(axis=0) / size, 0.03, rtol=0.15)
    lag = np.mean(breath[1:] * breath[:-1], axis=0) / breath.var(axis=0)
    assert np.all(lag > 0.75)


def test_ids_stay_until_a_gap() -> None:
    model = DetectorModel(CAMERA, FAULTLESS, 1)
    view, empty = view_of((0.0, 25.0, 90.0, TRUCK)), view_of((0.0, -50.0, 90.0, CAR))
    first = model.detect(0.0, view)[0]["track_id"].tolist()
    assert model.detect(0.9 * GAP_S, view)[0]["track_id"].tolist() == first
    model.detect(1.2 * GAP_S, empty)
    later = model.detect(0.9 * GAP_S + 1.1 * GAP_S, view)[0]["track_id"].tolist()
    assert later != first


def test_neighbours_swap_ids_now_and_then_and_never_share_one() -> None:
    view = view_of((0.0, 25.0, 90.0, TRUCK), (2.6, 26.0, 90.0, TRUCK), (-12.0, 26.0, 90.0, CAR))
    model = DetectorModel(CAMERA, faulty(id_switch_per_minute=60.0), 2)
    ids = np.array([model.detect(0.1 * k, view)[0]["track_id"] for k in range(600)])
    assert all(len(set(row)) == 3 for row in ids.tolist())
    switches = int(np.sum(ids[1:, 0] != ids[:-1, 0]))
    assert 35 <= switches <= 85  # 60 expected in a minute
    assert np.array_equal(ids[1:, 0] != ids[:-1, 0], ids[1:, 1] != ids[:-1, 1])
    assert len(set(ids[:, 2].tolist())) == 1  # the car's box touches none


def test_false_tracks_stay_on_their_spot() -> None:
    model = DetectorModel(CAMERA, faulty(false_tracks=3), 4)
    frames = [model.detect(0.1 * k, view_of((0.0, 25.0, 90.0, CAR))) for k in range(100)]
    false = [rows[vehicles < 0] for rows, vehicles in frames]
    ids = {tuple(rows["track_id"].tolist()) for rows in false}
    assert len(ids) == 1
    assert len(ids.pop()) == 3
    centre = np.array([np.column_stack([rows["x"], rows["y"]]) for rows in false])
    assert np.all(centre.std(axis=0) < 4.0)
    assert np.all(centre.std(axis=0) > 0.5)


def test_classes_are_wrong_as_often_as_they_should() -> None:
    view = view_of((0.0, 22.0, 90.0, CAR), (8.0, 22.0, 90.0, TRUCK))
    view.coco_class[1] = 7
    model = DetectorModel(CAMERA, faulty(class_error=0.1), 6)
    wrong = total = 0
    for k in range(1500):
        rows, vehicles = model.detect(0.1 * k, view)
        wrong += int(np.sum(rows["class_id"] != view.coco_class[vehicles]))
        total += len(rows)
    assert wrong / total == pytest.approx(0.1, abs=0.02)


def test_true_boxes_are_the_faultless_detections_and_the_hidden_vehicles() -> None:
    hidden = faulty(occluded_share=0.1)
    view = view_of((0.0, 40.0, 90.0, TRUCK), (0.0, 52.0, 90.0, CAR), (6.0, 30.0, 90.0, CAR))
    detected, vehicles = DetectorModel(CAMERA, hidden, 1).detect(0.0, view)
    truth = true_boxes(CAMERA, view, hidden.min_height_px)
    assert sorted(vehicles.tolist()) == [0, 2]
    assert truth["track_id"].tolist() == [1, 2, 3]
    assert np.allclose(edges(truth[vehicles]), edges(detected), atol=1e-3)
    assert len(true_boxes(CAMERA, view, 1e4)) == 0
