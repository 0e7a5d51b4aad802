"""Road segments: where boxes pile up, and nothing is lost without being counted."""

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.detection.road_segments import LEARNING_S, RoadSegments
from geoorbit_ros.report.image_overlay import draw_segments

SIZE = (640, 360)


def vehicles(*feet: tuple[float, float]) -> NDArray[np.void]:
    """Boxes of 40 x 30 pixels whose lower edges have these middles."""
    rows = np.zeros(len(feet), DETECTION_DTYPE)
    for row, (x, bottom) in zip(rows, feet, strict=True):
        row["x"], row["y"], row["width"], row["height"] = x, bottom - 15, 40, 30
    rows["score"], rows["class_id"] = 0.9, 2
    return rows


def drive(segments: RoadSegments, seconds: float, *rows_y: float, start_s: float = 0.0) -> None:
    """One vehicle in each of these image rows drives from left to right, again and again."""
    for k in range(round(seconds * 10)):
        time_s = start_s + k / 10
        x = (100.0 * time_s) % 600 + 20
        segments.add(round((1.0 + time_s) * 1e9), vehicles(*((x, y) for y in rows_y)))


def holds(contour: NDArray[np.float32], x: float, y: float) -> bool:
    """Whether a point is inside a polygon, by counting crossings."""
    ax, ay = contour.T
    bx, by = np.roll(contour, -1, axis=0).T
    crosses = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = x < ax + (y - ay) / (by - ay) * (bx - ax)
    return bool(np.count_nonzero(crosses & left) % 2)


def test_two_roads_become_two_segments() -> None:
    segments = RoadSegments(SIZE)
    drive(segments, 60.0, 120.0, 300.0)
    assert len(segments.contours) == 2
    for y in (118.0, 298.0):
        assert any(holds(contour, 320.0, y) for contour in segments.contours)
    assert not any(holds(contour, 320.0, 210.0) for contour in segments.contours)
    for contour in segments.contours:
        assert (contour >= 0).all()
        assert (contour <= SIZE).all()


def test_nothing_is_outside_before_the_road_is_known() -> None:
    segments = RoadSegments(SIZE)
    drive(segments, LEARNING_S - 6.0, 120.0)
    assert segments.contours == ()
    assert segments.add(round(LEARNING_S * 1e9), vehicles((300, 340))).all()
    assert segments.outside == 0


def test_what_stands_elsewhere_is_counted() -> None:
    segments = RoadSegments(SIZE)
    drive(segments, 60.0, 120.0)
    inside = segments.add(62_000_000_000, vehicles((300, 120), (300, 330), (100, 118)))
    assert inside.tolist() == [True, False, True]
    assert segments.outside == 1


def test_a_new_road_is_learnt_from_what_was_outside() -> None:
    segments = RoadSegments(SIZE)
    drive(segments, 60.0, 120.0)
    drive(segments, 60.0, 120.0, 300.0, start_s=60.0)
    assert segments.outside > 0
    before = segments.outside
    drive(segments, 6.0, 300.0, start_s=120.0)
    assert segments.outside == before


def test_boxes_at_and_beyond_the_border_do_no_harm() -> None:
    segments = RoadSegments(SIZE)
    rows = vehicles((0, 0), (640, 360), (-500, 200), (9000, 9000), (320, 359.9))
    for k in range(400):
        assert len(segments.add((1 + k) * 10**9 // 5, rows)) == len(rows)


@pytest.mark.parametrize("seconds", [0.0, 60.0])
def test_the_drawing_has_the_size_of_the_image(seconds: float) -> None:
    segments = RoadSegments(SIZE)
    drive(segments, seconds, 120.0)
    image = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    drawn = draw_segments(image, segments)
    assert drawn.shape == image.shape
    assert bool((drawn[100:120] != image[100:120]).any()) == bool(seconds)
    assert (drawn[250:] == image[250:]).all()
