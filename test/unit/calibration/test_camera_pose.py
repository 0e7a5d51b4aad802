"""A pinhole camera is recovered from the road plane it sees, or the reason why not is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cameras import Camera
from hypothesis import given, settings
from hypothesis import strategies as st

from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import CalibrationError


@settings(max_examples=40, deadline=None)
@given(
    st.floats(4, 60),
    st.floats(0, 360),
    st.floats(8, 60),
    st.floats(600, 3000),
    st.sampled_from([(1920, 1080), (1280, 960), (704, 1200)]),
)
def test_exact_recovery(
    height: float, yaw: float, pitch: float, focal: float, size: tuple[int, int]
) -> None:
    camera = Camera((12.0, -7.0, height), yaw, pitch, focal, size)
    pose = recover_pose(fit_homography(camera.control_points()), size)
    assert pose.focal_px == pytest.approx(focal, rel=1e-4)
    np.testing.assert_allclose(pose.position_m, camera.position_m, atol=1e-3 * height)
    np.testing.assert_allclose(pose.rotation, camera.rotation, atol=1e-4)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    ground = camera.ground(np.array([[0.3, 0.9], [0.6, 0.7]]) * size)
    above = np.column_stack((ground, [1.5, 4.0]))
    np.testing.assert_allclose(pose.project(above), camera.project(above), atol=0.01)


def test_road_points_agree_with_the_homography_exactly() -> None:
    points = Camera().control_points()
    noise = np.random.default_rng(0).standard_normal(points.pixel.shape)
    homography = fit_homography(replace(points, pixel=points.pixel + noise))
    pose = recover_pose(homography, (1920, 1080))
    flat = np.column_stack((points.local_m, np.zeros(len(points))))
    np.testing.assert_allclose(pose.project(flat), homography.to_pixel(points.local_m), atol=1e-6)


def test_its_error_is_about_what_it_says() -> None:
    camera, errors, sigmas = Camera(), [], []
    points = camera.control_points()
    for seed in range(60):
        random = np.random.default_rng(seed)
        homography = fit_homography(
            replace(
                points,
                pixel=points.pixel + 1.5 * random.standard_normal(points.pixel.shape),
                local_m=points.local_m + 0.15 * random.standard_normal(points.local_m.shape),
            )
        )
        pose = recover_pose(homography, (1920, 1080))
        errors.append(pose.focal_px - camera.focal_px)
        sigmas.append(pose.focal_sigma_px)
    assert 0.7 < np.std(errors) / np.mean(sigmas) < 1.4


def test_points_behind_the_camera_have_no_pixel() -> None:
    pose = recover_pose(fit_homography(Camera().control_points()), (1920, 1080))
    assert np.isnan(pose.project([[0.0, -50.0, 0.0]])).all()


@pytest.mark.parametrize(
    ("camera", "size", "words"),
    [
        (Camera((0, 0, 1.2)), (1920, 1080), "1.2 m above the road"),
        (Camera((0, 0, 180.0), pitch_deg=40), (1920, 1080), "180.0 m above"),
        (Camera((0, 0, 60.0), pitch_deg=89.99), (1920, 1080), "focal length"),
        (Camera(focal_px=60000.0, pitch_deg=20), (1920, 1080), "focal length"),
    ],
)
def test_implausible_cameras_are_refused(camera: Camera, size: tuple[int, int], words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        recover_pose(fit_homography(camera.control_points()), size)


@pytest.mark.parametrize(
    ("size", "pitch", "words"),
    [
        ((1280, 720), 12.0, "distorted by 2[0-9] %.*1280x720"),
        ((720, 1080), 12.0, "distorted"),
        ((3840, 2160), 35.0, "fits no focal length.*3840x2160"),
    ],
)
def test_an_image_of_another_size_is_noticed(
    size: tuple[int, int], pitch: float, words: str
) -> None:
    homography = fit_homography(Camera(pitch_deg=pitch).control_points())
    with pytest.raises(CalibrationError, match=words):
        recover_pose(homography, size)
