"""What is drawn into the camera's image, and what is left alone."""

import numpy as np
import pytest

from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import FLAG_PREDICTED, PIXEL_TRACK_DTYPE, TRACK_DTYPE
from geoorbit_ros.report.image_overlay import ImageOverlay, id_colour

SIZE = 640, 480
NO_GROUND = np.empty(0, TRACK_DTYPE)


def to_pixel(local_m: np.ndarray) -> np.ndarray:
    """Straight down from above: 4 pixels a metre, north is up."""
    return np.asarray(np.array([100.0, 300.0]) + np.array([4.0, -4.0]) * local_m)


@pytest.fixture
def overlay() -> ImageOverlay:
    local_m = np.array([(x, y) for x in (0.0, 50.0, 100.0) for y in (-30.0, 0.0, 40.0)])
    points = ControlPoints(to_pixel(local_m), local_m, None, np.arange(len(local_m)))
    return ImageOverlay(fit_homography(points))


def image() -> np.ndarray:
    random = np.random.default_rng(5)
    return np.asarray(random.integers(60, 120, (SIZE[1], SIZE[0], 3), dtype=np.uint8))


def vehicle(x: float, y: float, track_id: int = 1, flags: int = 0) -> np.ndarray:
    rows = np.zeros(1, PIXEL_TRACK_DTYPE)
    rows["x"], rows["y"], rows["width"], rows["height"] = x, y, 60.0, 40.0
    rows["track_id"], rows["flags"], rows["class_id"] = track_id, flags, 2
    return rows


def lane(y_m: float, status: str = "confirmed") -> Lane:
    centre = np.column_stack((np.linspace(0.0, 100.0, 20), np.full(20, y_m)))
    sides = offset_line(centre, 1.75), offset_line(centre, -1.75)
    return Lane(1, centre, *sides, 3.5, 0.1, 0.9, status, 9.0)  # type: ignore[arg-type]


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.asarray(np.any(before != after, axis=2))


def test_the_image_given_stays_as_it_is_and_nothing_to_draw_changes_nothing(
    overlay: ImageOverlay,
) -> None:
    before = image()
    kept = before.copy()
    empty = np.empty(0, PIXEL_TRACK_DTYPE)
    assert np.array_equal(overlay.draw(before, empty, NO_GROUND, None, ""), kept)
    assert overlay.draw(before, vehicle(200, 200), NO_GROUND, LaneMap(0, (lane(0.0),)), "x").any()
    assert np.array_equal(before, kept)


def test_a_box_is_drawn_on_its_edges_in_its_colour(overlay: ImageOverlay) -> None:
    drawn = overlay.draw(image(), vehicle(300, 240, 7), NO_GROUND, None, "")
    for x, y in ((270, 240), (330, 240), (300, 220), (300, 260)):
        assert tuple(drawn[y, x]) == id_colour(7)
    assert np.array_equal(drawn[230:250, 285:315], image()[230:250, 285:315]), "its inside is free"


def test_a_predicted_box_has_no_colour_and_leaves_no_trail(overlay: ImageOverlay) -> None:
    for x in range(200, 300, 20):
        drawn = overlay.draw(image(), vehicle(x, 240, 7, FLAG_PREDICTED), NO_GROUND, None, "")
    assert len(set(drawn[240, 250])) == 1, "grey"
    assert not np.any(np.all(drawn == id_colour(7), axis=2))


def test_a_trail_follows_the_vehicle_and_ends_with_it(overlay: ImageOverlay) -> None:
    for x in range(200, 400, 20):
        drawn = overlay.draw(image(), vehicle(x, 240, 7), NO_GROUND, None, "")
    assert changed(image(), drawn)[260, 220:330].all(), "along the middle of the lower edge"
    empty = np.empty(0, PIXEL_TRACK_DTYPE)
    for _ in range(60):
        drawn = overlay.draw(image(), empty, NO_GROUND, None, "")
    assert np.array_equal(drawn, image())


@pytest.mark.parametrize("status", ["confirmed", "tentative"])
def test_a_confirmed_lane_is_filled_where_the_camera_sees_it(
    overlay: ImageOverlay, status: str
) -> None:
    empty = np.empty(0, PIXEL_TRACK_DTYPE)
    drawn = overlay.draw(image(), empty, NO_GROUND, LaneMap(0, (lane(-10.0, status),)), "")
    touched = changed(image(), drawn)
    left, right, top, bottom = 104, 496, 335, 345  # inside of its outline
    inside = touched[top:bottom, left:right].mean()
    assert inside > 0.99 if status == "confirmed" else inside < 0.5
    touched[top - 45 : bottom + 20, left - 20 : right + 20] = False  # outline, arrow and label
    assert not touched.any()


def test_a_lane_behind_the_camera_is_left_out(overlay: ImageOverlay) -> None:
    far = lane(0.0)
    for line in (far.centerline_m, far.left_m, far.right_m):
        line += 1e6
    empty = np.empty(0, PIXEL_TRACK_DTYPE)
    drawn = overlay.draw(image(), empty, NO_GROUND, LaneMap(0, (far,)), "")
    assert np.array_equal(drawn, image())


def test_neighbouring_ids_have_colours_that_differ() -> None:
    colours = np.array([id_colour(k) for k in range(1, 60)], dtype=int)
    assert np.abs(np.diff(colours, axis=0)).max(axis=1).min() > 60
