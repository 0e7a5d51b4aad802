"""Laws of the true boxes: what is drawn is in them, and hidden vehicles are known as hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_images import (
    BUS,
    CAR,
    CLASSES,
    MOTORCYCLE,
    SEMITRAILER,
    SUV,
    TRUCK,
    VAN,
    difference,
    extent,
    nothing,
    on_road,
    renderer,
    road_and_camera,
    vehicles,
)
from made_scenes import Array

from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.core.tables import FLAG_TRUNCATED
from geoorbit_ros.rendering.conditions import LIGHTS, Conditions, illumination
from geoorbit_ros.rendering.occlusion import draw_order
from geoorbit_ros.rendering.painter import Painter, outlines_of
from geoorbit_ros.rendering.rendered_scene import box_rows
from geoorbit_ros.rendering.renderer import SceneRenderer
from geoorbit_ros.rendering.vehicle_solids import vehicle_solid
from geoorbit_ros.scenes.camera import body_corners
from geoorbit_ros.scenes.detector_model import View, exact_boxes

SIZES = (CAR, SUV, VAN, TRUCK, SEMITRAILER, BUS, MOTORCYCLE)


@pytest.mark.parametrize("size", SIZES)
def test_a_solid_fills_its_length_width_and_height(size: tuple[float, float, float]) -> None:
    solid = vehicle_solid(CLASSES[size], *size)
    length, width, height = size
    assert solid.corners.min(axis=0) == pytest.approx([-length / 2, -width / 2, 0.0], abs=1e-9)
    assert solid.corners.max(axis=0) == pytest.approx([length / 2, width / 2, height], abs=1e-9)
    assert len(set(solid.materials.tolist())) >= 3
    for face, normal in zip(solid.faces, solid.normals, strict=True):
        corners = solid.corners[face]
        assert np.ptp(corners @ normal) < 0.12, "a face is flat"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("turn_deg", [0.0, 115.0])
def test_a_box_holds_the_whole_vehicle_and_no_more(
    size: tuple[float, float, float], turn_deg: float
) -> None:
    _, camera = road_and_camera()
    painter = Painter(camera, illumination(Conditions(), 0.0), seed=1)
    view = vehicles(on_road(240.0, 4.0, size, turn_deg))
    body = painter.place(view)[0]
    assert body is not None
    canvas = np.full((360, 640, 3), (255, 0, 255), np.uint8)
    painter.paint(canvas, body)
    drawn = extent(np.any(canvas != (255, 0, 255), axis=2))
    box = outlines_of([body], (640, 360)).boxes[0]
    # Whole pixels: half a subpixel more where an edge lies.
    assert np.all(drawn[:2] >= np.floor(box[:2] - 0.3))
    assert np.all(drawn[2:] <= np.ceil(box[2:] + 0.3))
    assert np.abs(drawn - box).max() < 1.3


@pytest.mark.parametrize("size", SIZES)
def test_paint_never_leaves_the_box(size: tuple[float, float, float]) -> None:
    # The same vehicle under other numbers has other colours, but the same shadow.
    camera = renderer()
    place = on_road(222.0, 4.0, size, 20.0)
    images = [camera.render(vehicles(place, first=k), 0.0) for k in range(6)]
    painted = np.any([difference(a, images[0]) > 4 for a in images[1:]], axis=0)
    box = camera.render_with_boxes(vehicles(place), 0.0)[1].boxes[0]
    left, top, right, bottom = extent(painted)
    assert left >= box[0] - 2.0
    assert top >= box[1] - 2.0
    assert right <= box[2] + 2.0
    assert bottom <= box[3] + 2.0
    if size != MOTORCYCLE:  # mostly rider and tyres
        assert painted.sum() > 0.25 * np.prod(box[2:] - box[:2])


def test_a_box_lies_in_the_projected_upright_box() -> None:
    _, camera = road_and_camera()
    random = np.random.default_rng(5)
    those = [
        on_road(random.uniform(215, 400), random.uniform(-10, 10), SIZES[k % 7], 40.0 * k)
        for k in range(21)
    ]
    view = vehicles(*those)
    whole, _ = exact_boxes(camera, view)
    boxes = renderer().render_with_boxes(view, 0.0)[1].boxes
    assert np.all(boxes[:, :2] >= whole[:, :2] - 1e-6)
    assert np.all(boxes[:, 2:] <= whole[:, 2:] + 1e-6)
    # A vehicle stands on the road with its wheels: few pixels of the upright box are missing.
    assert np.median((boxes[:, 3] - whole[:, 3]) / (whole[:, 3] - whole[:, 1])) > -0.06


def test_behind_a_lens_a_box_holds_what_is_painted() -> None:
    roads, camera = road_and_camera()
    width, height = camera.image_size
    lens = Lens(camera.focal_px, camera.focal_px, width / 2, height / 2, camera.image_size, -0.25)
    bent = SceneRenderer(replace(camera, lens=lens), roads)
    place = on_road(222.0, 4.0, TRUCK, 20.0)
    images = [bent.render(vehicles(place, first=k), 0.0) for k in range(6)]
    assert images[0].shape == (height, width, 3)
    painted = extent(np.any([difference(a, images[0]) > 4 for a in images[1:]], axis=0))
    box = bent.render_with_boxes(vehicles(place), 0.0)[1].boxes[0]
    whole, _ = exact_boxes(replace(camera, lens=lens), vehicles(place))
    assert np.all(painted[:2] >= box[:2] - 2.0)
    assert np.all(painted[2:] <= box[2:] + 2.0)
    assert np.abs(painted - box)[:3].max() < 2.0  # the wheels have one colour
    assert np.all(box[:2] >= whole[0, :2] - 0.5)
    assert np.all(box[2:] <= whole[0, 2:] + 0.5)
    straight = renderer().render_with_boxes(vehicles(place), 0.0)[1].boxes[0]
    assert np.abs(box - straight).max() > 3.0


def test_neither_light_nor_weather_moves_a_box() -> None:
    view = vehicles(on_road(226.0, 4.0, TRUCK), on_road(240.0, 8.0))
    reference = renderer().render_with_boxes(view, 0.0)[1]
    for light in LIGHTS[1:]:
        other = renderer(light).render_with_boxes(view, 0.0)[1]
        assert np.array_equal(other.boxes, reference.boxes)
        assert np.array_equal(other.visible, reference.visible)


def test_the_shadow_lies_outside_of_the_box() -> None:
    camera = renderer()
    view = vehicles(on_road(226.0, 4.0, VAN))
    with_it, truth = camera.render_with_boxes(view, 0.0)
    without = camera.render(nothing(), 0.0)
    left, top, right, bottom = truth.boxes[0].astype(int)
    darker = without.astype(int).sum(axis=2) - with_it.astype(int).sum(axis=2) > 60
    darker[top - 1 : bottom + 2, left - 1 : right + 2] = False
    assert darker.sum() > 60


def test_a_nearer_vehicle_is_drawn_over_a_farther_one() -> None:
    camera = renderer()
    far, near = on_road(240.0, 4.0), on_road(230.0, 9.0, TRUCK)
    for order in ((far, near), (near, far)):
        view = vehicles(*order)
        both, truth = camera.render_with_boxes(view, 0.0)
        nearer = order.index(near)
        alone = camera.render(
            View(*(getattr(view, name)[[nearer]] for name in View.__slots__)), 0.0
        )
        assert truth.visible[nearer] == 1.0
        assert truth.visible[1 - nearer] < 0.8
        overlap = np.concatenate(
            [truth.boxes[:, :2].max(axis=0), truth.boxes[:, 2:].min(axis=0)]
        ).astype(int)
        middle = (overlap[:2] + overlap[2:]) // 2
        assert difference(both, alone)[middle[1], middle[0]] < 25


def test_the_middle_of_a_long_trailer_does_not_decide_who_hides_whom() -> None:
    # The car is farther from the camera than the trailer's middle, and still in front of it.
    camera_m = np.array([0.0, 0.0, 8.0])
    trailer, car = (12.0, 20.0, 90.0, SEMITRAILER), (9.0, 27.0, 90.0, CAR)
    for order in ((trailer, car), (car, trailer)):
        view = vehicles(*order)
        assert np.hypot(*view.xy[order.index(car)]) > np.hypot(*view.xy[order.index(trailer)])
        assert draw_order(view, camera_m)[-1] == order.index(car)


def _crossing(corners: Array, ray: Array) -> float:
    """Distance at which a ray from the origin meets a convex ring (4, 2); infinite if never."""
    best = np.inf
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        matrix = np.column_stack([ray, a - b])
        if abs(np.linalg.det(matrix)) > 1e-9:
            distance, share = np.linalg.solve(matrix, a)
            if distance > 0 and 0 <= share <= 1:
                best = min(best, distance)
    return best


def test_along_every_line_of_sight_the_first_vehicle_is_drawn_last() -> None:
    random = np.random.default_rng(8)
    checked = 0
    for _ in range(12):
        places = random.permutation(24)[:12]
        those = [
            (
                -24.0 + 16.0 * (k % 4) + random.uniform(-2, 2),
                20.0 + 18.0 * (k // 4),
                random.uniform(70, 110),
                SIZES[int(random.integers(7))],
            )
            for k in places.tolist()
        ]
        view = vehicles(*those)
        rank = np.argsort(draw_order(view, np.array([0.0, 0.0, 6.0])))
        rings = body_corners(view.xy, view.heading, view.size)[:, [0, 4, 6, 2], :2]
        for angle in np.radians(np.arange(40.0, 140.0, 1.5)):
            ray = np.array([np.cos(angle), np.sin(angle)])
            met = np.array([_crossing(ring, ray) for ring in rings])
            hit = np.flatnonzero(np.isfinite(met))
            along = hit[np.argsort(met[hit])]
            assert np.all(np.diff(rank[along]) < 0)
            checked += len(hit) > 1
    assert checked > 50


def test_visible_shares_are_those_of_the_image() -> None:
    camera = renderer()
    alone = vehicles(on_road(245.0, 4.0))
    assert camera.render_with_boxes(alone, 0.0)[1].visible == pytest.approx([1.0])
    behind = vehicles(on_road(239.0, 4.0), on_road(230.0, 4.0, SEMITRAILER))
    shares = camera.render_with_boxes(behind, 0.0)[1].visible
    assert shares[0] < 0.35
    assert shares[1] == 1.0


def test_a_vehicle_cut_by_the_border_is_flagged_and_counted_by_what_is_left() -> None:
    camera = renderer()
    size = camera.camera.image_size
    for along in np.arange(195.0, 225.0, 1.0):
        view = vehicles(on_road(float(along), 4.0))
        truth = camera.render_with_boxes(view, 0.0)[1]
        rows = box_rows(view, truth, size)
        left, top, right, bottom = truth.boxes[0]
        if not (left < -3 < 3 < right or top < size[1] - 3 < size[1] + 3 < bottom):
            continue
        assert rows["flags"] == [FLAG_TRUNCATED]
        assert 0.0 <= rows["score"][0] < 1.0
        assert rows["x"][0] + rows["width"][0] / 2 <= size[0] + 1e-3
        assert rows["y"][0] + rows["height"][0] / 2 <= size[1] + 1e-3
        return
    raise AssertionError("no vehicle was cut")


def test_what_is_behind_the_camera_has_no_box() -> None:
    _, camera = road_and_camera()
    view = vehicles(on_road(60.0, 4.0), on_road(226.0, 4.0))
    image, truth = renderer().render_with_boxes(view, 0.0)
    assert np.isnan(truth.boxes[0]).all()
    assert truth.visible[0] == 0.0
    assert box_rows(view, truth, camera.image_size)["track_id"].tolist() == [2]
    assert image.shape == (360, 640, 3)


def test_the_boxes_sway_with_the_camera() -> None:
    placed, camera = road_and_camera()
    swaying = SceneRenderer(camera, placed, Conditions(shake_px=6.0, clouds=0.0))
    view = vehicles(on_road(226.0, 4.0, TRUCK))
    moved = 0.0
    for time_s in (0.0, 0.4, 0.8, 1.2):
        image, truth = swaying.render_with_boxes(view, time_s)
        steady, still = renderer().render_with_boxes(view, time_s)
        shift = (truth.boxes - still.boxes)[0]
        assert np.allclose(shift[:2], shift[2:])
        columns, rows = np.rint(shift[:2]).astype(int).tolist()
        middle = slice(120, 240), slice(200, 440)
        back = np.roll(image, (-rows, -columns), (0, 1))[middle]
        assert difference(back, steady[middle]).mean() < 8.0
        moved = max(moved, float(np.abs(shift).max()))
    assert moved > 3.0
