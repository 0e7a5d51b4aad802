"""Which line bounds which lane."""

from __future__ import annotations

import numpy as np
import pytest

from geoorbit_ros.markings.assignment import CLEAR_CONTRAST, choose_lines
from geoorbit_ros.markings.lines import PaintedLine

STATIONS = 200


def line(offset_m: float, contrast: float) -> PaintedLine:
    flat = np.full(STATIONS, offset_m)
    sigma = np.full(STATIONS, 0.03)
    seen = np.ones(STATIONS, np.bool_)
    return PaintedLine(flat, sigma, seen, contrast, contrast, "solid", "yellow", 0.15)


def lanes(*middle_m: float) -> np.ndarray:
    return np.array([np.full(STATIONS, m) for m in middle_m])


@pytest.mark.parametrize("contrast", [3.3, 3.8, 6.0])
def test_each_direction_of_a_road_has_its_own_centre_line(contrast: float) -> None:
    """As clear as one another, though in shadow and less clear than the edge lines."""
    edge = 1.5 * CLEAR_CONTRAST
    lines = [line(-1.75, edge), line(1.75, contrast), line(2.6, contrast), line(6.1, edge)]
    assert choose_lines(lines, lanes(0.0, 4.5), [True]) == [(0, 1), (2, 3)]


def test_two_lanes_of_one_direction_share_their_line_and_a_seam_beside_it_is_none() -> None:
    clear = 1.5 * CLEAR_CONTRAST
    lines = [line(-1.75, clear), line(1.75, clear), line(2.3, 2.8), line(5.25, clear)]
    for oncoming in ([False], [True]):
        assert choose_lines(lines, lanes(0.0, 3.5), oncoming) == [(0, 1), (1, 3)]
