"""A camera found from boxes of made traffic: what it must find, and what it must refuse."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.control_point_writer import write_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.traffic.control_grid import control_grid, scale_sigma
from geoorbit_ros.calibration.traffic.doubts import doubts, scale_sigmas
from geoorbit_ros.calibration.traffic.estimate import TrafficCalibration, calibrate_from_traffic
from geoorbit_ros.calibration.traffic.parameters import (
    FEW,
    FOCAL,
    HEIGHT,
    ROLL,
    TILT,
    KnownPoints,
    projection_matrix,
)
from geoorbit_ros.calibration.traffic.samples import sample_traffic
from geoorbit_ros.calibration.vehicle_size import MEAN_M
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, PIXEL_TRACK_DTYPE, Frames, join_frames
from geoorbit_ros.scenes.camera import PinholeCamera, body_corners
from geoorbit_ros.scenes.detector_model import DetectorModel, View
from geoorbit_ros.scenes.scene import DetectorFaults

SIZE = (1280, 720)
FPS, SECONDS = 10.0, 40.0
HEADING = np.radians(70.0)


def true_parameters() -> NDArray[np.float64]:
    x = np.zeros(FEW)
    x[[FOCAL, TILT, ROLL, HEIGHT]] = np.log(0.9), np.radians(18.0), np.radians(0.7), np.log(10.0)
    return x


@lru_cache
def traffic(fleet: float = 1.0, vehicles: int = 40) -> Frames:
    """Cars on six lanes of a straight road, both ways, with the faults of a detector."""
    random = np.random.default_rng(3)
    matrix = projection_matrix(true_parameters(), SIZE)
    focal = 0.9 * SIZE[0]
    camera = PinholeCamera(matrix, np.array([0.0, 0.0, 10.0]), focal, SIZE)
    size = fleet * MEAN_M[0] * (1.0 + 0.06 * random.standard_normal((vehicles, 3)))
    lane = random.integers(6, size=vehicles)
    forward = lane >= 3
    speed = random.uniform(18.0, 28.0, vehicles) * np.where(forward, 1.0, -1.0)
    enters = random.uniform(0.0, SECONDS - 4.0, vehicles)
    along, aside = (
        np.array([np.cos(HEADING), np.sin(HEADING)]),
        np.array([-np.sin(HEADING), np.cos(HEADING)]),
    )
    model = DetectorModel(camera, DetectorFaults(false_tracks=1, id_switch_per_minute=0.0), 1)
    found = []
    for k in range(int(SECONDS * FPS)):
        time_s = k / FPS
        s = np.where(forward, 10.0, 110.0) + speed * (time_s - enters)
        here = (time_s >= enters) & (s > 8.0) & (s < 115.0)
        xy = s[here, None] * along + (3.6 * lane[here, None] - 14.0) * aside
        heading = np.where(forward[here], HEADING, HEADING + np.pi)
        number = np.flatnonzero(here)
        view = View(number, xy, heading, size[here], np.full(len(number), 2))
        found.append((1 + round(time_s * 1e9), model.detect(time_s, view)[0]))
    return join_frames(found)


@lru_cache
def calibrated() -> TrafficCalibration:
    return calibrate_from_traffic(traffic(), SIZE, find_lens=False)


def test_the_camera_is_found() -> None:
    found = calibrated()
    assert found.height_m[0] == pytest.approx(10.0, rel=0.08)
    assert found.focal_px[0] == pytest.approx(0.9 * SIZE[0], rel=0.2)
    assert found.degrees(TILT)[0] == pytest.approx(18.0, abs=4.0)
    assert abs(found.height_m[0] - 10.0) < 3.0 * found.height_m[1]
    assert np.tan(found.x[TILT]) * found.focal_px[0] == pytest.approx(
        np.tan(np.radians(18.0)) * 0.9 * SIZE[0], rel=0.04
    ), "the horizon is where vehicles of one size and neighbours side by side put it"


def test_a_larger_fleet_is_taken_for_a_nearer_camera_and_the_error_is_told() -> None:
    larger = calibrate_from_traffic(traffic(1.06), SIZE, find_lens=False)
    ratio = larger.height_m[0] / calibrated().height_m[0]
    assert 0.90 < ratio < 0.99, "who drives larger cars seems nearer: nothing else gives the scale"
    assert scale_sigma(larger) > 0.03, "the fleet's mean is not known better"


def test_twice_the_pixels_is_the_same_camera() -> None:
    frames = traffic()
    rows = frames.rows.copy()
    for name in ("x", "y", "width", "height"):
        rows[name] *= 2.0
    large = (2 * SIZE[0], 2 * SIZE[1])
    found = calibrate_from_traffic(replace(frames, rows=rows), large, find_lens=False)
    assert found.height_m[0] == pytest.approx(calibrated().height_m[0], rel=0.06)
    assert found.focal_px[0] == pytest.approx(2.0 * calibrated().focal_px[0], rel=0.1)


def test_the_written_file_has_the_same_plane_and_its_errors(tmp_path: Path) -> None:
    found = calibrated()
    grid = control_grid(found)
    write_control_points(tmp_path / "calibration.csv", grid)
    read = read_control_points(tmp_path / "calibration.csv", image_size=SIZE)
    plane = fit_homography(read)
    assert plane.to_ground(grid.pixel) == pytest.approx(grid.local_m, abs=0.02)
    assert read.facts.scale_sigma == pytest.approx(scale_sigma(found), rel=0.01)
    projector = BoxProjector(plane, SIZE)
    assert projector.pose is not None
    assert projector.pose.position_m[2] == pytest.approx(found.height_m[0], rel=0.02)
    assert projector.pose.focal_px == pytest.approx(found.focal_px[0], rel=0.01)


def test_two_known_points_give_the_scale() -> None:
    matrix = projection_matrix(true_parameters(), SIZE)
    local = np.array([[2.0, 25.0], [12.0, 60.0], [-3.0, 45.0]])
    uvw = matrix[:, [0, 1, 3]] @ np.vstack((local.T, np.ones(3)))
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    points = KnownPoints(
        (uvw[:2] / uvw[2]).T, local @ turn.T + [300.0, -40.0], np.full(3, 0.5), np.full(3, 0.03)
    )
    found = calibrate_from_traffic(traffic(1.06), SIZE, points=points, find_lens=False)
    assert found.height_m[0] == pytest.approx(10.0, rel=0.04)
    assert scale_sigma(found) < 0.02
    grid = control_grid(found)
    plane = fit_homography(grid)
    assert plane.to_ground(points.pixel) == pytest.approx(points.local_m, abs=0.6)


def test_boxes_at_the_border_and_behind_others_are_left_out() -> None:
    frames = traffic()
    samples = sample_traffic(frames, SIZE)
    assert (samples.edges[:2] > 0.0).all()
    assert (samples.edges[2:].T < SIZE).all()
    rows = frames.rows.copy()
    covers = rows.copy()
    covers["track_id"] += 1000
    covers["y"] += 0.3 * covers["height"]
    both = np.concatenate([rows, covers])
    order = np.argsort(np.concatenate([frames.row_stamp_ns()] * 2), kind="stable")
    twice = Frames(frames.stamp_ns, 2 * frames.offset, both[order])
    kept = sample_traffic(twice, SIZE)
    assert len(kept.group) <= len(samples.group), "only the covering boxes are left"


def test_ground_points_are_refused() -> None:
    frames = traffic()
    rows = frames.rows.copy()
    rows["width"] = rows["height"] = 0.0
    rows["flags"] |= FLAG_GROUND_POINT
    with pytest.raises(CalibrationError, match="ground points without width and height"):
        calibrate_from_traffic(replace(frames, rows=rows), SIZE, find_lens=False)


def test_few_vehicles_are_refused() -> None:
    frames = traffic()
    few = frames.part(0, 30)
    with pytest.raises(CalibrationError, match="moving vehicles with whole and free boxes"):
        calibrate_from_traffic(few, SIZE, find_lens=False)


def test_nothing_at_all_is_refused() -> None:
    nothing = join_frames([(1, np.empty(0, PIXEL_TRACK_DTYPE))])
    with pytest.raises(CalibrationError, match="0 moving vehicles"):
        calibrate_from_traffic(nothing, SIZE, find_lens=False)


def test_the_matrix_looks_down_the_road() -> None:
    matrix = projection_matrix(true_parameters(), SIZE)
    corners = body_corners(np.array([[0.0, 30.0]]), np.array([np.pi / 2]), MEAN_M[:1])
    uvw = corners[0] @ matrix[:, :3].T + matrix[:, 3]
    assert (uvw[:, 2] > 0.0).all()
    low, high = uvw[0, 1] / uvw[0, 2], uvw[1, 1] / uvw[1, 2]
    assert high < low, "what is higher above the road is higher in the image"


def changed(**columns: NDArray[np.float64]) -> Frames:
    rows = traffic().rows.copy()
    for name, values in columns.items():
        rows[name] = values
    return replace(traffic(), rows=rows)


def test_boxes_that_no_camera_at_rest_shows_are_refused() -> None:
    rows, time_s = traffic().rows, traffic().row_stamp_ns() / 1e9
    turning = changed(
        x=rows["x"] + 300.0 * np.sin(time_s / 3.0), y=rows["y"] + 60.0 * np.cos(time_s / 2.0)
    )
    with pytest.raises(CalibrationError, match="stands still"):
        calibrate_from_traffic(turning, SIZE, find_lens=False)
    fifty = np.full(len(rows), 50.0)
    with pytest.raises(
        CalibrationError, match=r"from all others|beyond its bounds|times their usual"
    ):
        calibrate_from_traffic(changed(width=fifty, height=fifty), SIZE, find_lens=False)


def test_a_camera_that_looks_straight_down_is_refused_and_not_put_at_a_bound() -> None:
    random, found = np.random.default_rng(2), []
    lane, enters = random.integers(4, size=20), random.uniform(0.0, 35.0, 20)
    for k in range(400):
        y = 200.0 * (k / 10.0 - enters)
        here = np.flatnonzero((y > 50.0) & (y < 670.0))
        rows = np.zeros(len(here), PIXEL_TRACK_DTYPE)
        rows["track_id"], rows["class_id"], rows["score"] = here, 2, 0.9
        rows["x"], rows["y"], rows["width"], rows["height"] = (
            400.0 + 120.0 * lane[here], y[here], 40.0, 90.0,
        )  # fmt: skip
        found.append((1 + k * 10**8, rows))
    with pytest.raises(CalibrationError, match=r"bounds|known to"):
        calibrate_from_traffic(join_frames(found), SIZE, find_lens=False)


def test_known_points_that_contradict_the_traffic_are_refused() -> None:
    matrix = projection_matrix(true_parameters(), SIZE)
    local = np.array([[0.0, 20.0], [5.0, 40.0]])
    uvw = matrix[:, [0, 1, 3]] @ np.vstack((local.T, np.ones(2)))
    sigma = np.full(2, 1.0), np.full(2, 0.1)
    true = KnownPoints((uvw[:2] / uvw[2]).T, local, *sigma)
    found = calibrate_from_traffic(traffic(), SIZE, points=true, find_lens=False)
    assert found.points_off < 1.5
    away = replace(true, local_m=local + np.array([[0.0, 0.0], [200.0, 0.0]]))
    with pytest.raises(CalibrationError, match=r"known points|times their usual errors|bounds"):
        calibrate_from_traffic(traffic(), SIZE, points=away, find_lens=False)


@lru_cache
def calibrated_with(focal_ratio: float) -> TrafficCalibration:
    focal = focal_ratio * 0.9 * SIZE[0]
    lens = Lens(focal, focal, SIZE[0] / 2, SIZE[1] / 2, SIZE, focal_known=True)
    return calibrate_from_traffic(traffic(), SIZE, lens=lens)


def test_a_focal_length_that_boxes_contradict_is_doubted_and_a_good_one_is_not() -> None:
    assert not any("focal length" in said for said in doubts(calibrated_with(1.0)))
    assert any("the given focal length" in said for said in doubts(calibrated_with(2.0)))


def test_a_focal_length_of_ten_times_is_not_believed() -> None:
    try:
        said = doubts(calibrated_with(10.0))
    except CalibrationError:
        return
    assert any("the given focal length" in sentence for sentence in said)


def test_a_known_focal_length_makes_distances_along_the_road_surer() -> None:
    along, across = scale_sigmas(calibrated_with(1.0))
    assert 0.02 < along < scale_sigmas(calibrated())[0]
    assert 0.02 < across < 0.1, "the fleet's mean is not known better"


def test_cars_that_are_called_buses_are_told() -> None:
    buses = changed(class_id=np.full(len(traffic().rows), 5.0))
    try:
        said = doubts(calibrate_from_traffic(buses, SIZE, find_lens=False))
    except CalibrationError:
        return
    assert any("called buses" in sentence for sentence in said)


def test_the_axis_of_a_cut_image_is_told() -> None:
    focal = 0.9 * SIZE[0]
    lens = Lens(focal, focal, SIZE[0] / 2 + 200.0, SIZE[1] / 2, SIZE, focal_known=True)
    found = replace(calibrated(), lens=lens)
    assert any("200 px from the image's middle" in said for said in doubts(found))
