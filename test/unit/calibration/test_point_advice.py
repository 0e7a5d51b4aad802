"""What is said of control points is what a fit without them, or with one more, would show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cameras import Camera

from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import GROUND_SIGMA_M, PIXEL_SIGMA, fit_homography
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.calibration.point_advice import advise, point_remarks
from geoorbit_ros.core.errors import CalibrationError

SIZE = (1920, 1080)


def measured(seed: int, keep: int = 16) -> ControlPoints:
    """Points as a person measures them."""
    points = Camera((0.0, 0.0, 10.0), 40.0, 20.0, 1400.0).control_points()
    random = np.random.default_rng(seed)
    pick = random.permutation(len(points))[:keep]
    return replace(
        points,
        pixel=points.pixel[pick] + PIXEL_SIGMA * random.standard_normal((keep, 2)),
        local_m=points.local_m[pick] + GROUND_SIGMA_M * random.standard_normal((keep, 2)),
        line_number=points.line_number[pick],
    )


def subset(points: ControlPoints, keep: np.ndarray) -> ControlPoints:
    return replace(
        points,
        pixel=points.pixel[keep],
        local_m=points.local_m[keep],
        line_number=points.line_number[keep],
    )


def sigma_without(points: ControlPoints, k: int) -> float:
    """Error of a point against the fit of all others, in the 1-sigma of both."""
    others = fit_homography(subset(points, np.arange(len(points)) != k))
    j = others.jacobian(points.pixel[k])[0]
    noise = PIXEL_SIGMA**2 * j @ j.T + GROUND_SIGMA_M**2 * np.eye(2)
    covariance = noise + others.fit_covariance(points.pixel[k])[0]
    error = others.to_ground(points.pixel[k])[0] - points.local_m[k]
    return float(np.sqrt(error @ np.linalg.solve(covariance, error)))


@pytest.mark.parametrize("seed", range(4))
def test_errors_are_those_against_a_fit_of_the_other_points(seed: int) -> None:
    points = measured(seed)
    advice = advise(fit_homography(points), SIZE)
    refitted = [sigma_without(points, k) for k in range(len(points))]
    np.testing.assert_allclose(advice.sigmas, refitted, rtol=0.35, atol=0.25)


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_point_is_the_one_that_is_named(seed: int) -> None:
    points = measured(seed, keep=10)
    pixel = points.pixel.copy()
    pixel[3] += [40.0, 25.0]
    advice = advise(fit_homography(replace(points, pixel=pixel)), SIZE)
    assert np.flatnonzero(advice.wrong).tolist() == [3]
    named = f"wrong against the others: line {points.line_number[3]} "
    assert any(sentence.startswith(named) for sentence in advice.sentences(points.line_number))


def test_right_points_are_seldom_called_wrong() -> None:
    wrong = [advise(fit_homography(measured(seed)), SIZE).wrong.sum() for seed in range(30)]
    assert sum(wrong) <= 0.01 * 30 * 16


def test_four_points_fit_exactly_and_say_nothing_about_themselves() -> None:
    camera = Camera((0.0, 0.0, 10.0), 40.0, 20.0, 1400.0)
    points = subset(camera.control_points(), np.array([0, 3, -4, -1]))
    advice = advise(fit_homography(points), SIZE)
    assert not advice.told
    assert not advice.wrong.any()


@pytest.mark.parametrize("seed", range(3))
def test_the_point_that_is_asked_for_helps_as_much_as_is_said(seed: int) -> None:
    points = measured(seed, keep=6)
    plane = fit_homography(points)
    advice = advise(plane, SIZE)
    assert advice.next_sigma_m < 0.95 * advice.sigma_m
    with_it = fit_homography(added(points, plane, advice.next_pixel))
    after = advise(with_it, SIZE, where=None)
    # The level of the noise is estimated anew with each point.
    assert after.sigma_m == pytest.approx(advice.next_sigma_m, rel=0.3)
    # No place of a coarse grid helps more by much.
    for pixel in np.stack(np.meshgrid([400.0, 1000.0, 1500.0], [500.0, 800.0]), -1).reshape(-1, 2):
        other = advise(fit_homography(added(points, plane, pixel)), SIZE)
        assert other.sigma_m > 0.9 * after.sigma_m


def added(points: ControlPoints, plane: Homography, pixel: np.ndarray) -> ControlPoints:
    """The points and one that lies where the plane says."""
    return replace(
        points,
        pixel=np.vstack((points.pixel, pixel)),
        local_m=np.vstack((points.local_m, plane.to_ground(pixel))),
        line_number=np.append(points.line_number, 99),
    )


def test_a_place_above_the_horizon_is_no_road() -> None:
    plane = fit_homography(measured(0))
    with pytest.raises(CalibrationError, match="no road near the camera"):
        advise(plane, SIZE, where=np.array([[960.0, -400.0]]))


def test_people_are_told_only_where_there_is_something_to_say() -> None:
    """Points as good as they should be: nothing. One of five is wrong: that, and what helps."""
    assert point_remarks(fit_homography(measured(1)), SIZE) == []
    few = measured(0, keep=5)
    assert point_remarks(fit_homography(few), SIZE) == []
    pixel = few.pixel.copy()
    pixel[2] += 40.0
    wrong = replace(few, pixel=pixel)
    (remark,) = point_remarks(fit_homography(wrong), SIZE)
    assert "times what is expected of them; which one is wrong can be told from 6" in remark.text
    assert "a further point near pixel" in remark.text
    computed = replace(wrong, facts=CameraFacts(scale_sigma=0.03))
    assert point_remarks(fit_homography(computed), SIZE) == [], "nobody clicked them"


def test_four_points_close_together_are_told_to_leave_the_road_unsure() -> None:
    points = measured(1)
    u, v = points.pixel.T
    near = (v > 600.0) & (u < 1000.0)
    plane = fit_homography(subset(points, near))
    advice = advise(plane, SIZE)
    assert advice.sigma_m > 0.5
    (remark,) = point_remarks(plane, SIZE)
    assert f"the road in view is known to ± {advice.sigma_m:.2f} m" in remark.text


def test_a_point_that_was_left_out_is_not_told_twice() -> None:
    points = measured(2)
    pixel = points.pixel.copy()
    pixel[4, 0] += 60.0
    plane = fit_homography(replace(points, pixel=pixel))
    assert not plane.residual.inlier[4]
    assert point_remarks(plane, SIZE) == []
