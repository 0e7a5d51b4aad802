"""The twin rendered at a camera's calibration lies where the camera saw the vehicles."""

from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.network import write_network
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import scene_camera, survey_control_points
from geoorbit_ros.twin.side_by_side import TwinCamera, compare_boxes, side_by_side

DATUM = Datum(43.05, -89.35)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[TwinCamera, PinholeCamera, RoadNetwork]:
    scene = load_scene("straight_3x3")
    placed = place_roads(scene)
    camera = scene_camera(scene, placed)
    net: Path = write_network(placed, tmp_path_factory.mktemp("net"), DATUM)
    homography = fit_homography(survey_control_points(placed, camera, DATUM, 1))
    return (
        TwinCamera(homography, camera.image_size, net, DATUM),
        camera,
        load_network(net, DATUM),
    )


def in_view(camera: PinholeCamera, network: RoadNetwork) -> np.ndarray:
    """A car in the middle of each lane, where the camera sees it best."""
    rows = np.zeros(len(network), TRACK_DTYPE)
    rows["length"], rows["width"], rows["class_id"] = 4.6, 1.8, 2
    kept = []
    for lane in np.flatnonzero(~network.internal).tolist():
        line = network.line(lane)
        share = np.linspace(0.0, 1.0, 200)[:, None]
        points = line[0] + share * (line[-1] - line[0])
        pixel, depth = camera.project(np.column_stack((points, np.zeros(len(points)))))
        near = (depth > 30.0) & (pixel[:, 1] < 0.8 * camera.image_size[1])
        near &= (pixel[:, 0] > 100) & (pixel[:, 0] < camera.image_size[0] - 100)
        if near.any():
            k = int(np.flatnonzero(near)[np.argmin(depth[near])])
            rows["x"][lane], rows["y"][lane] = points[k]
            step = line[-1] - line[0]
            rows["heading"][lane] = np.arctan2(step[1], step[0])
            kept.append(lane)
    rows["track_id"] = np.arange(len(rows)) + 1
    assert len(kept) >= 3
    return rows[kept]


def test_vehicles_are_rendered_where_the_camera_has_them(
    made: tuple[TwinCamera, PinholeCamera, RoadNetwork],
) -> None:
    twin, camera, network = made
    rows = in_view(camera, network)
    empty, _ = twin.render(rows[:0], DATUM)
    image, boxes = twin.render(rows, DATUM)
    assert image.shape == (360, 640, 3)
    ground = np.column_stack((rows["x"], rows["y"], np.zeros(len(rows)))).astype(float)
    pixel = twin.scale * camera.project(ground)[0]
    for (u, v), (left, top, right, bottom) in zip(pixel, boxes, strict=True):
        assert left - 2.0 < u < right + 2.0
        assert top - 2.0 < v < bottom + 2.0
        inside = np.s_[int(top) + 1 : int(bottom), int(left) + 1 : int(right)]
        change = np.abs(image[inside].astype(int) - empty[inside]).max(axis=2)
        assert np.mean(change > 20) > 0.3
    moved, _ = twin.render(rows, Datum(43.0505, -89.35))  # its frame lies 55 m north
    assert np.abs(moved.astype(int) - image).max() > 50


def test_what_the_tracks_were_moved_by_is_undone(
    made: tuple[TwinCamera, PinholeCamera, RoadNetwork],
) -> None:
    twin, camera, network = made
    rows = in_view(camera, network)
    _, boxes = twin.render(rows, DATUM)
    moved = rows.copy()
    unknown = np.zeros(2)
    move = Alignment(np.array([5.0, -3.0]), np.array([1.5, 0.7]), 0.02, np.eye(3), unknown, 0.1, 6)
    xy = move.points(np.column_stack((rows["x"], rows["y"])).astype(float))
    moved["x"], moved["y"] = xy.T
    moved["heading"] += 0.02
    _, back = twin.render(moved, DATUM, move)
    assert np.nanmax(np.abs(back - boxes)) < 0.1
    _, away = twin.render(moved, DATUM)
    assert np.nanmax(np.abs(away - boxes)) > 3.0


def test_the_difference_counts_and_measures() -> None:
    seen = np.array([(10.0, 10.0, 30.0, 30.0), (100.0, 10.0, 120.0, 30.0)])
    twin = np.array([(12.0, 10.0, 32.0, 30.0), (300.0, 10.0, 320.0, 30.0), [np.nan] * 4])
    found = compare_boxes(seen, twin, 0.5)
    assert (found.matched, found.seen_only, found.twin_only) == (1, 1, 1)
    assert found.overlap == pytest.approx(18.0 / 22.0)
    assert found.apart_px == pytest.approx(4.0)
    same = compare_boxes(seen, seen, 1.0)
    assert (same.matched, same.overlap, same.apart_px) == (2, 1.0, 0.0)
    nothing = compare_boxes(seen[:0], twin, 1.0)
    assert (nothing.matched, nothing.twin_only) == (0, 2)


def test_one_image_has_all_three() -> None:
    rendered = np.full((60, 100, 3), 120, np.uint8)
    boxes = np.array([(20.0, 30.0, 40.0, 50.0)])
    shown, found = side_by_side(None, boxes, rendered, boxes + 1.0, 0.5)
    assert shown.shape == (60, 300, 3)
    assert found.matched == 1
    image = np.full((120, 200, 3), 200, np.uint8)
    shown, _ = side_by_side(image, boxes, rendered, boxes, 0.5)
    assert shown[5, 90].tolist() == [200, 200, 200]
    assert shown[55, 150].tolist() == [120, 120, 120]
