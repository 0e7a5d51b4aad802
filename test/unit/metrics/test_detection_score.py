"""What counts as found, missed and false."""

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_TRUNCATED, PIXEL_TRACK_DTYPE
from scores.detection_score import DetectionScore

Row = tuple[float, float, float, float, float, int]
CAR: Row = (100.0, 100.0, 40.0, 20.0, 1.0, 0)


def table(*rows: Row) -> NDArray[np.void]:
    """Rows of x, y, width, height, score, flags."""
    made = np.zeros(len(rows), PIXEL_TRACK_DTYPE)
    for k, row in enumerate(rows):
        for name, value in zip(("x", "y", "width", "height", "score", "flags"), row, strict=True):
            made[name][k] = value
    return made


def counts(found: NDArray[np.void], truth: NDArray[np.void], width: int = 1280) -> tuple[int, ...]:
    score = DetectionScore()
    score.add(found, truth, width)
    return score.hits, score.missed, score.false


@pytest.mark.parametrize(
    ("found", "truth", "expected"),
    [
        (table(CAR), table(CAR), (1, 0, 0)),
        (table(), table(CAR), (0, 1, 0)),
        (table(CAR), table(), (0, 0, 1)),
        (table(CAR, CAR), table(CAR), (1, 0, 1)),  # twice the same vehicle
        (table((100, 100, 80, 20, 1, 0)), table(CAR), (1, 0, 0)),  # overlap of one half
        (table((100, 100, 82, 20, 1, 0)), table(CAR), (0, 1, 1)),
        (table(), table((100, 100, 40, 15, 1, 0)), (0, 0, 0)),  # too small to ask for
        (table(), table((100, 100, 40, 20, 0.4, 0)), (0, 0, 0)),  # too hidden
        (table((100, 100, 40, 15, 1, 0)), table(), (0, 0, 0)),  # too small to be false
        (table(CAR), table((100, 100, 40, 20, 0.4, 0)), (0, 0, 0)),  # hidden, found all the same
    ],
)
def test_counts(
    found: NDArray[np.void], truth: NDArray[np.void], expected: tuple[int, ...]
) -> None:
    assert counts(found, truth) == expected


def test_the_useful_height_grows_with_the_image() -> None:
    assert counts(table(), table(CAR), 1920) == (0, 0, 0)


def test_of_two_true_boxes_the_useful_one_takes_the_match() -> None:
    hidden: Row = (100, 100, 40, 20, 0.1, 0)
    useful: Row = (104, 100, 40, 20, 1.0, 0)
    assert counts(table(CAR), table(hidden, useful)) == (1, 0, 0)


def test_edges_are_in_heights_and_leave_out_cut_boxes() -> None:
    score = DetectionScore()
    score.add(table((101, 100, 40, 22, 1, 0)), table(CAR), 1280)
    score.add(table(CAR), table((*CAR[:5], FLAG_TRUNCATED)), 1280)
    assert score.edge_errors.tolist() == [pytest.approx([0.05, -0.05, 0.05, 0.05])]
    assert (score.recall, score.precision) == (1.0, 1.0)
