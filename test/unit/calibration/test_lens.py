"""Laws of the lens: it is OpenCV's, both ways undo each other, and slopes are slopes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from cameras import Camera
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.calibration.plane_fit import fit_plane
from geoorbit_ros.core.errors import CalibrationError

SIZE = (1920, 1080)
LENSES = {
    "barrel": Lens(1700.0, 1700.0, 960.0, 540.0, SIZE, -0.35),
    "wide": Lens(1150.0, 1155.0, 970.0, 530.0, SIZE, -0.32, 0.11, 1e-3, -8e-4, -0.015),
    "pincushion": Lens(2500.0, 2500.0, 960.0, 540.0, SIZE, 0.2),
    "slight": Lens(1400.0, 1400.0, 960.0, 540.0, SIZE, -0.05),
}


def image(step: float = 60.0) -> NDArray[np.float64]:
    u, v = np.meshgrid(np.arange(0.0, 1921.0, step), np.arange(0.0, 1081.0, step))
    return np.column_stack((u.ravel(), v.ravel()))


def seen_through(lens: Lens, points: ControlPoints) -> ControlPoints:
    return replace(points, pixel=lens.distort(points.pixel), image_size=lens.image_size)


@pytest.mark.parametrize("name", LENSES)
def test_both_ways_undo_each_other_in_the_whole_image(name: str) -> None:
    lens, pixel = LENSES[name], image()
    ideal = lens.undistort(pixel)
    assert np.isfinite(ideal).all()
    np.testing.assert_allclose(lens.distort(ideal), pixel, atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_it_is_the_lens_of_opencv(name: str) -> None:
    lens = LENSES[name]
    fx, fy, cx, cy, *coefficients = lens.numbers
    rays = np.column_stack(((image() - [cx, cy]) / [fx, fy], np.ones(len(image()))))
    expected, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), lens.camera_matrix, np.array(coefficients)
    )
    inside = np.hypot(*rays[:, :2].T) < lens.radius
    found = lens.distort(image())
    np.testing.assert_allclose(found[inside], expected[inside, 0], atol=1e-8)
    assert np.isnan(found[~inside]).all()


def test_where_the_model_folds_nothing_is_seen() -> None:
    lens = Lens(1000.0, 1000.0, 960.0, 540.0, SIZE, -0.35)
    assert lens.radius == pytest.approx((3 * 0.35) ** -0.5)
    edge = 960.0 + 1000.0 * lens.radius * (1 - 0.35 * lens.radius**2)
    pixel = np.array([[edge - 1.0, 540.0], [edge + 1.0, 540.0], [0.0, 0.0]])
    assert np.isfinite(lens.undistort(pixel)).all(axis=1).tolist() == [True, False, False]


@pytest.mark.parametrize("name", LENSES)
def test_slopes_are_slopes(name: str) -> None:
    lens, ideal, step = LENSES[name], LENSES[name].undistort(image(200.0)), 1e-3
    for axis in (0, 1):
        move = step * np.eye(2)[axis]
        change = (lens.distort(ideal + move) - lens.distort(ideal - move)) / (2 * step)
        np.testing.assert_allclose(lens.slope(ideal)[:, :, axis], change, atol=1e-6)
    more, less = (replace(lens, k1=lens.k1 + d) for d in (1e-6, -1e-6))
    change = (more.distort(ideal) - less.distort(ideal)) / 2e-6
    np.testing.assert_allclose(lens.slope_of_k1(ideal), change, atol=1e-3)


def test_a_pixel_has_the_same_numbers_in_any_company() -> None:
    lens, pixel = LENSES["wide"], image(37.0)
    together = lens.undistort(pixel)
    for k in (0, 17, 400, len(pixel) - 1):
        assert lens.undistort(pixel[k]).tobytes() == together[k].tobytes()
        assert lens.undistort(pixel[k : k + 3])[0].tobytes() == together[k].tobytes()


def test_a_lens_for_a_smaller_image_is_the_same_lens() -> None:
    lens, pixel = LENSES["wide"], image()
    half = lens.scaled((960, 540))
    np.testing.assert_allclose(half.undistort(pixel / 2), lens.undistort(pixel) / 2, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"fx": 2.0}, "fx"), ({"cy": -3.0}, "cy"), ({"k1": float("nan")}, "k1"), ({"p1": 1.0}, "p1")],
)
def test_numbers_that_no_lens_has_are_refused(change: dict[str, float], words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        replace(LENSES["barrel"], **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", LENSES)
def test_a_plane_behind_a_known_lens_is_that_of_a_pinhole(name: str) -> None:
    lens = LENSES[name]
    camera = Camera(focal_px=lens.fx)
    ideal = camera.control_points()
    plain = fit_homography(ideal)
    given = replace(seen_through(lens, ideal), facts=CameraFacts(SIZE, lens))
    plane = fit_homography(given)
    pixel = np.array([[300.0, 900.0], [1500.0, 1000.0], [960.0, 700.0]])
    real = lens.distort(pixel)
    np.testing.assert_allclose(plane.to_ground(real), plain.to_ground(pixel), atol=1e-3)
    np.testing.assert_allclose(plane.to_pixel(plane.to_ground(real)), real, atol=1e-6)
    assert plane.residual.pixel_error.max() < 1e-4
    step = 1e-3
    for axis in (0, 1):
        move = step * np.eye(2)[axis]
        change = (plane.to_ground(real + move) - plane.to_ground(real - move)) / (2 * step)
        np.testing.assert_allclose(plane.jacobian(real)[:, :, axis], change, rtol=1e-4, atol=1e-7)


def test_the_pose_behind_a_lens_has_its_focal_length_and_sees_through_it() -> None:
    lens = LENSES["barrel"]
    camera = Camera(focal_px=lens.fx)
    points = seen_through(lens, camera.control_points())
    pose = recover_pose(fit_homography(replace(points, facts=CameraFacts(SIZE, lens))), SIZE)
    assert pose.focal_px == lens.fx
    assert pose.focal_sigma_px == 0.0
    np.testing.assert_allclose(pose.position_m, camera.position_m, atol=0.02)
    roof = np.array([[3.0, 40.0, 3.5]])
    np.testing.assert_allclose(pose.project(roof), lens.distort(camera.project(roof)), atol=0.05)


@pytest.mark.parametrize("k1", [-0.35, -0.2, -0.1, -0.05, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_control_points_show_their_lens(k1: float, seed: int) -> None:
    camera = Camera(pitch_deg=20.0)
    lens = Lens(1400.0, 1400.0, 960.0, 540.0, SIZE, k1)
    ideal = camera.control_points(columns=6, rows=4)
    points = seen_through(lens, ideal)
    random = np.random.default_rng(seed)
    points = replace(points, pixel=points.pixel + 0.5 * random.standard_normal(points.pixel.shape))
    plane = fit_homography(points)
    assert plane.lens is not None
    assert plane.k1_spread is not None
    sigma = float(np.linalg.norm(plane.k1_spread))
    focal_free = plane.lens.k1 / plane.lens.fx**2 * lens.fx**2
    assert abs(focal_free - k1) < 4 * max(sigma, 0.002)
    error = plane.to_ground(points.pixel) - ideal.local_m
    assert np.median(np.hypot(*error.T)) < 0.1
    assert any("lens" in remark.text for remark in plane.remarks)


@pytest.mark.parametrize("seed", range(12))
def test_no_lens_is_seen_in_noise(seed: int) -> None:
    points = replace(Camera().control_points(), image_size=SIZE)
    random = np.random.default_rng(seed)
    pixel = points.pixel + 1.5 * random.standard_normal(points.pixel.shape)
    plane = fit_homography(replace(points, pixel=pixel))
    assert plane.lens is None
    assert not plane.remarks


def test_a_wrong_point_is_no_lens() -> None:
    points = replace(Camera().control_points(), image_size=SIZE)
    pixel = points.pixel.copy()
    pixel[7] += [60.0, -40.0]
    plane = fit_homography(replace(points, pixel=pixel))
    assert plane.lens is None
    assert np.flatnonzero(~plane.residual.inlier).tolist() == [7]


def test_a_wrong_point_is_told_behind_a_lens() -> None:
    lens = Lens(1400.0, 1400.0, 960.0, 540.0, SIZE, -0.2)
    points = seen_through(lens, Camera().control_points())
    pixel = points.pixel.copy()
    pixel[7] += [60.0, -40.0]
    plane = fit_homography(replace(points, pixel=pixel))
    assert plane.lens is not None
    assert plane.lens.k1 * (1400.0 / plane.lens.fx) ** 2 == pytest.approx(-0.2, abs=0.01)
    assert np.flatnonzero(~plane.residual.inlier).tolist() == [7]


def test_an_error_of_the_lens_moves_the_ground_as_the_spread_says() -> None:
    lens = Lens(1400.0, 1400.0, 960.0, 540.0, SIZE, -0.2)
    ideal = Camera().control_points()
    plane = fit_plane(seen_through(lens, ideal), lens, k1_fitted=True).homography
    assert plane.k1_spread is not None
    pixel = lens.distort(np.array([[150.0, 980.0], [1700.0, 700.0], [960.0, 560.0]]))
    step = 1e-4
    for k, told in enumerate(plane.fit_shifts(pixel).transpose(1, 0, 2)):
        moved = [
            RoadPlane(
                plane.matrix + way * plane.spread[k],
                plane.spread,
                lens=replace(lens, k1=lens.k1 + way * plane.k1_spread[k]),
            ).to_ground(pixel)
            for way in (step, -step)
        ]
        change = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(told, change, rtol=1e-3, atol=1e-5)
