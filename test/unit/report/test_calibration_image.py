"""The drawing of a calibration shows the points, which of them are bad, and how far one sees."""

import numpy as np
import pytest
from made_up_camera import MadeUpCamera

from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.report.calibration_image import (
    REACH_M,
    draw_calibration,
    ground_error_m,
    reach,
)
from geoorbit_ros.report.image_overlay import text_width

SIZE = (1920, 1080)


@pytest.fixture
def plane(camera: MadeUpCamera) -> Homography:
    return fit_homography(read_control_points(camera.calibration))


def test_the_ground_error_grows_towards_the_horizon_and_is_infinite_above(
    plane: Homography,
) -> None:
    error = ground_error_m(plane, SIZE)
    column = error[::-1, error.shape[1] // 2]  # from the bottom upwards
    finite = np.isfinite(column)
    far = column[finite][finite.sum() // 2 :]  # near by, the control points' own error prevails
    assert np.all(np.diff(far) > 0.0)
    assert np.all(finite[: finite.sum()]), "sky lies above the road"


def test_the_reach_ends_where_a_pixel_is_too_much_ground(plane: Homography) -> None:
    far = reach(plane, SIZE)
    assert far.farthest_m > 10.0
    assert far.share == pytest.approx(np.mean(ground_error_m(plane, SIZE) <= REACH_M))


def test_every_point_is_marked_where_it_was_clicked(plane: Homography) -> None:
    grey = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    drawn = draw_calibration(grey, plane)
    assert np.all(grey == 90), "the image itself stays"
    changed = np.any(drawn != grey, axis=2)
    for x, y in plane.points.pixel:
        ring = changed[max(round(y) - 12, 0) : round(y) + 13, max(round(x) - 12, 0) : round(x) + 13]
        assert ring.sum() > 30


def test_labels_of_points_at_the_right_border_are_not_cut(
    plane: Homography, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[int] = []

    def note(_: object, text: str, at: tuple[int, int], size: float, *_rest: object) -> None:
        ends.append(at[0] + text_width(text, size))

    monkeypatch.setattr("geoorbit_ros.report.calibration_image.write_text", note)
    width = int(plane.points.pixel[:, 0].max()) + 20
    draw_calibration(np.full((SIZE[1], width, 3), 90, np.uint8), plane)
    assert len(ends) > len(plane.points)
    assert max(ends) <= width
