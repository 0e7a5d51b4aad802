"""Laws of the road plane: exact, robust, independent of order and of where east is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cameras import Camera
from hypothesis import given, settings
from hypothesis import strategies as st

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.calibration.homography import Homography, fit_homography
from geoorbit_ros.core.errors import CalibrationError

CAMERAS = st.builds(
    Camera,
    st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(5, 30)),
    st.floats(0, 360),
    st.floats(8, 50),
    st.floats(700, 3000),
)


def noisy(camera: Camera, seed: int, sigma_px: float = 1.5, **grid: int) -> ControlPoints:
    points = camera.control_points(**grid)
    shift = sigma_px * np.random.default_rng(seed).standard_normal(points.pixel.shape)
    return replace(points, pixel=points.pixel + shift)


def shuffled(points: ControlPoints, order: np.ndarray) -> ControlPoints:
    return replace(
        points,
        pixel=points.pixel[order],
        local_m=points.local_m[order],
        line_number=points.line_number[order],
    )


@settings(max_examples=40, deadline=None)
@given(CAMERAS)
def test_exact_points_are_recovered_anywhere_in_the_image(camera: Camera) -> None:
    homography = fit_homography(camera.control_points())
    assert homography.residual.inlier.all()
    assert homography.residual.pixel_error.max() < 1e-5
    pixel = np.array([[300.0, 900.0], [1500.0, 1000.0], [960.0, 700.0]])
    truth = camera.ground(pixel)
    near = np.hypot(*(truth - camera.position_m[:2]).T) < 500
    np.testing.assert_allclose(homography.to_ground(pixel)[near], truth[near], atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(CAMERAS)
def test_to_pixel_undoes_to_ground(camera: Camera) -> None:
    points = camera.control_points()
    homography = fit_homography(points)
    identity = homography.matrix @ homography.inverse
    np.testing.assert_allclose(identity, np.eye(3), atol=1e-6)
    back = homography.to_pixel(homography.to_ground(points.pixel))
    np.testing.assert_allclose(back, points.pixel, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_order_of_the_points_changes_nothing(seed: int) -> None:
    points = noisy(Camera(), seed)
    order = np.random.default_rng(seed).permutation(len(points))
    a, b = fit_homography(points), fit_homography(shuffled(points, order))
    np.testing.assert_array_equal(a.matrix, b.matrix)
    np.testing.assert_array_equal(a.residual.pixel_error[order], b.residual.pixel_error)


@settings(max_examples=20, deadline=None)
@given(st.floats(0, 2 * np.pi), st.floats(-3000, 3000), st.floats(-3000, 3000))
def test_turning_and_moving_the_world_turns_and_moves_the_result(
    angle: float, east: float, north: float
) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points = noisy(Camera(), 1)
    moved = replace(points, local_m=points.local_m @ turn.T + [east, north])
    a, b = fit_homography(points), fit_homography(moved)
    expected = a.to_ground(points.pixel) @ turn.T + [east, north]
    np.testing.assert_allclose(b.to_ground(points.pixel), expected, atol=1e-4)
    np.testing.assert_allclose(
        b.sigma_m(points.pixel, 1.0), a.sigma_m(points.pixel, 1.0), rtol=1e-3
    )


@pytest.mark.parametrize("count", [1, 4, 8])
def test_wrong_points_are_rejected_and_named(count: int) -> None:
    camera = Camera()
    points = noisy(camera, 2)
    wrong = np.random.default_rng(count).permutation(len(points))[:count]
    pixel = points.pixel.copy()
    pixel[wrong] += [90.0, -70.0]
    homography = fit_homography(replace(points, pixel=pixel))
    assert set(np.flatnonzero(~homography.residual.inlier)) == set(wrong)
    assert homography.residual.pixel_error[wrong].min() > 30
    sentences = homography.describe_residuals()
    for k in range(len(points)):
        assert f"line {points.line_number[k]}:" in sentences[k]
        assert ("REJECTED" in sentences[k]) == (k in wrong)
    clean = np.delete(np.arange(len(points)), wrong)
    np.testing.assert_allclose(
        homography.matrix, fit_homography(shuffled(points, clean)).matrix, atol=1e-9
    )


def test_a_swapped_pair_of_rows_is_found() -> None:
    points = Camera().control_points()
    ground = points.local_m.copy()
    ground[[3, 11]] = ground[[11, 3]]
    homography = fit_homography(replace(points, local_m=ground))
    assert np.flatnonzero(~homography.residual.inlier).tolist() == [3, 11]


def test_four_points_fit_exactly() -> None:
    points = Camera().control_points(columns=2, rows=2)
    homography = fit_homography(points)
    np.testing.assert_allclose(homography.to_ground(points.pixel), points.local_m, atol=1e-6)


def sweep(trials: int, **grid: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ground errors (T, N, 2) of fits to noisy points, predicted covariances, the pixels."""
    camera = Camera()
    pixel = np.array([[960.0, 500.0], [400.0, 600.0], [1500.0, 900.0]])
    truth = camera.ground(pixel)
    errors, covariances = [], []
    for seed in range(trials):
        points = noisy(camera, seed, **grid)
        random = np.random.default_rng(1000 + seed)
        points = replace(
            points, local_m=points.local_m + 0.15 * random.standard_normal(points.local_m.shape)
        )
        homography = fit_homography(points)
        errors.append(homography.to_ground(pixel) - truth)
        covariances.append(homography.fit_covariance(pixel))
    return np.array(errors), np.array(covariances), pixel


@pytest.mark.parametrize("grid", [{"columns": 2, "rows": 2}, {"columns": 5, "rows": 4}])
def test_the_predicted_error_of_the_fit_is_the_error_it_has(grid: dict[str, int]) -> None:
    errors, covariances, _ = sweep(150, **grid)
    for k in range(errors.shape[1]):
        square = np.einsum(
            "ti,tij,tj->t", errors[:, k], np.linalg.inv(covariances[:, k]), errors[:, k]
        )
        assert 0.7 < np.mean(square) / 2 < 1.4


def test_sigma_is_the_worst_axis_of_propagated_pixel_noise() -> None:
    camera = Camera()
    homography = fit_homography(camera.control_points())
    pixel = np.array([[700.0, 450.0], [960.0, 900.0]])
    random = np.random.default_rng(0)
    for k in range(2):
        sample = camera.ground(pixel[k] + 1.2 * random.standard_normal((4000, 2)))
        covariance = homography.covariance(pixel, 1.2)[k] - homography.fit_covariance(pixel)[k]
        np.testing.assert_allclose(np.cov(sample.T), covariance, rtol=0.15, atol=1e-4)
    sigma = homography.sigma_m(pixel, 1.2)
    expected = np.sqrt(np.linalg.eigvalsh(homography.covariance(pixel, 1.2))[:, 1])
    np.testing.assert_allclose(sigma, expected)
    assert sigma[0] > 3 * sigma[1], "one pixel is more metres near the horizon"


def test_nothing_above_the_horizon_is_on_the_road() -> None:
    camera = Camera(pitch_deg=10.0)
    homography = fit_homography(camera.control_points())
    horizon = 540 - 1400 * np.tan(np.radians(10))
    pixel = np.array([[960.0, horizon + 5], [960.0, horizon - 5], [100.0, 50.0]])
    assert homography.visible(pixel).tolist() == [True, False, False]
    assert np.isnan(homography.to_ground(pixel)[1:]).all()
    assert np.isinf(homography.sigma_m(pixel, 1.0)[1:]).all()


def mirrored(points: ControlPoints) -> list[ControlPoints]:
    return [
        replace(points, local_m=points.local_m[:, ::-1]),
        replace(points, pixel=points.pixel[:, ::-1]),
    ]


@settings(max_examples=30, deadline=None)
@given(CAMERAS, st.integers(0, 1))
def test_swapped_columns_are_called_swapped(camera: Camera, which: int) -> None:
    with pytest.raises(CalibrationError, match=r"grid\.csv: found a mirrored .* swapped"):
        fit_homography(mirrored(camera.control_points())[which])


@pytest.mark.parametrize(("latitude", "longitude"), [(43.04, -89.34), (48.1, 11.6), (-33.9, 18.4)])
def test_latitude_and_longitude_swapped_within_range_are_called_swapped(
    latitude: float, longitude: float
) -> None:
    points = Camera().control_points()
    geodetic = Datum(latitude, longitude).to_geodetic(points.local_m)
    wrong = Datum(longitude, latitude)
    swapped = replace(points, local_m=wrong.to_local(geodetic[:, 1], geodetic[:, 0]), datum=wrong)
    with pytest.raises(CalibrationError, match="latitude and longitude"):
        fit_homography(swapped)


def test_rows_that_belong_to_other_rows_are_refused() -> None:
    points = Camera().control_points()
    order = np.random.default_rng(3).permutation(len(points))
    with pytest.raises(CalibrationError, match=r"grid\.csv"):
        fit_homography(replace(points, local_m=points.local_m[order]))


def test_three_of_four_points_on_a_line_are_refused() -> None:
    camera = Camera()
    pixel = np.array([[200.0, 600], [600.0, 700], [1000.0, 800], [1500.0, 500]])
    points = ControlPoints(pixel, camera.ground(pixel), None, np.arange(2, 6), "four.csv")
    with pytest.raises(CalibrationError, match=r"four\.csv: found no four points"):
        fit_homography(points)


def test_the_type_is_the_one_that_is_returned() -> None:
    assert isinstance(fit_homography(Camera().control_points()), Homography)


def test_a_narrow_field_of_good_points_makes_no_wild_plane() -> None:
    """Points along the borders of a bend: half of them also fit a plane seen edge-on."""
    table = np.array(
        [
            [1241.87, 581.31, -342.708, -232.573],
            [583.82, 401.60, -317.797, -189.354],
            [936.98, 421.38, -314.717, -221.063],
            [1143.41, 428.79, -311.654, -236.679],
            [753.46, 447.90, -328.781, -208.410],
            [1044.78, 526.99, -338.702, -225.633],
            [1235.25, 476.25, -324.635, -238.340],
            [1039.67, 411.90, -307.675, -229.720],
            [846.62, 472.74, -332.755, -215.250],
            [1134.52, 551.83, -340.728, -229.097],
            [664.95, 423.38, -323.804, -199.745],
            [969.20, 506.87, -336.729, -222.200],
            [837.47, 402.59, -309.759, -212.425],
            [903.98, 488.23, -334.738, -218.738],
            [1095.01, 450.73, -320.625, -231.456],
            [1186.08, 565.01, -341.711, -230.848],
        ]
    )
    points = ControlPoints(table[:, :2], table[:, 2:], None, np.arange(2, 18), "bend.csv")
    residual = fit_homography(points).residual
    assert residual.inlier.all()
    assert residual.pixel_error.max() < 1.5
    assert residual.ground_error_m.max() < 0.25
