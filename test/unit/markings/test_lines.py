"""Painted lines are found where they are, and nothing else is taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from made_markings import WHITE, YELLOW, Stripe, bend, road_image, road_plane

from geoorbit_ros.markings.lines import PaintedLine, find_lines
from geoorbit_ros.markings.road_image import RoadStrip, rectify

REFERENCE_M = np.column_stack(
    [3.5 + bend(np.arange(20.0, 111.0, 2.0)), np.arange(20.0, 111.0, 2.0)]
)
"""Along the middle of the road; offsets are positive to its left, which is west."""


def strip_of(*stripes: Stripe) -> RoadStrip:
    return rectify(road_image(stripes), road_plane(), REFERENCE_M, -9.0, 9.0)


def lines_of(*stripes: Stripe) -> list[PaintedLine]:
    return find_lines(strip_of(*stripes))


def east_m(line: PaintedLine) -> float:
    return 3.5 - float(np.nanmean(line.offset_m))


@pytest.fixture(scope="module")
def motorway() -> list[PaintedLine]:
    return lines_of(
        Stripe(0.0, 0.25, colour=YELLOW),
        Stripe(3.6, 0.12, 3.0, 12.0),
        Stripe(7.1, 0.15, 6.0, 12.0),
        Stripe(10.6, 0.30),
    )


def test_every_line_is_found_where_it_is(motorway: list[PaintedLine]) -> None:
    # The pavement's edges are brighter than the grass, but on one side only.
    assert [round(east_m(line), 1) for line in motorway] == [10.6, 7.1, 3.6, 0.0]
    for line, true_m in zip(motorway, (10.6, 7.1, 3.6, 0.0), strict=True):
        error = 3.5 - line.offset_m - true_m
        assert np.nanmax(np.abs(error)) < 0.1
        assert abs(float(np.nanmean(error))) < 0.04


def test_what_a_line_is_like(motorway: list[PaintedLine]) -> None:
    assert [line.kind for line in motorway] == ["solid", "dashed", "dashed", "solid"]
    assert [line.colour for line in motorway] == ["white", "white", "white", "yellow"]
    assert [line.width_m for line in motorway] == pytest.approx([0.3, 0.15, 0.12, 0.25], abs=0.06)
    for line in motorway:
        assert line.length_m > 60.0


@pytest.mark.parametrize("gap_m", [0.12, 0.18, 0.25])
def test_a_double_line_is_one_line_in_the_middle_of_both(gap_m: float) -> None:
    half = 0.5 * (gap_m + 0.12)
    lines = lines_of(
        Stripe(0.0, 0.25),
        Stripe(3.6 - half, 0.12, colour=YELLOW),
        Stripe(3.6 + half, 0.12, colour=YELLOW),
        Stripe(7.2, 0.15),
    )
    assert [(line.kind, line.colour) for line in lines] == [
        ("solid", "white"), ("double", "yellow"), ("solid", "white"),
    ]  # fmt: skip
    assert east_m(lines[1]) == pytest.approx(3.6, abs=0.03)
    assert lines[1].width_m == pytest.approx(gap_m + 0.24, abs=0.07)


@pytest.mark.parametrize(
    "beside",
    [
        Stripe(3.85, 0.15, colour=(150.0, 150.0, 150.0)),  # what is left of an older line
        Stripe(3.85, 0.2, colour=(30.0, 30.0, 30.0)),  # tar
        Stripe(4.3, 0.12),  # a line of its own
        Stripe(3.85, 0.15, 3.0, 12.0),  # dashes
        Stripe(3.85, 0.12, 4.0, 6.0),  # dashes with short gaps
    ],
)
def test_what_lies_beside_a_line_does_not_make_it_double(beside: Stripe) -> None:
    lines = lines_of(Stripe(0.0, 0.25), Stripe(3.6, 0.15), beside)
    line = min(lines, key=lambda each: abs(east_m(each) - 3.6))
    assert line.kind == "solid"
    assert east_m(line) == pytest.approx(3.6, abs=0.09)


@pytest.mark.parametrize("worn", [165.0, 190.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_line_that_is_worn_on_one_side_is_where_it_was_painted(side: float, worn: float) -> None:
    lines = lines_of(
        Stripe(0.0, 0.25),
        Stripe(7.0 - side * 0.07, 0.14),
        Stripe(7.0 + side * 0.07, 0.14, colour=(worn, worn, worn)),
    )
    assert len(lines) == 2
    assert east_m(lines[0]) == pytest.approx(7.0, abs=0.017)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_bright_shoulder_beside_a_line_does_not_move_it(side: float) -> None:
    shoulder = Stripe(7.0 + side * 0.5, 0.6, colour=(140.0, 140.0, 140.0))
    paint = Stripe(7.0, 0.28, colour=(200.0, 200.0, 200.0))
    line = min(lines_of(paint, shoulder, paint), key=lambda line: abs(east_m(line) - 7.0))
    assert east_m(line) == pytest.approx(7.0, abs=0.017)


def test_a_station_is_seen_where_there_is_paint(motorway: list[PaintedLine]) -> None:
    strip = strip_of()
    dashes = motorway[2]
    y_m = strip.point_m[:, 1]
    inside = y_m % 12.0 < 3.0
    near_m = np.minimum(np.abs(y_m % 12.0 - 3.0), np.minimum(y_m % 12.0, 12.0 - y_m % 12.0))
    clear = np.isfinite(dashes.offset_m) & (near_m > 0.5) & (y_m < 70.0)
    assert np.mean(dashes.seen[clear] == inside[clear]) > 0.95


@pytest.mark.parametrize(
    "stripe",
    [
        Stripe(3.5, 0.8, colour=WHITE),  # a patch of concrete, wider than any line
        Stripe(3.5, 0.6, colour=(70.0, 68.0, 66.0)),  # the dark trail of tyres
        Stripe(3.5, 0.1, colour=(40.0, 40.0, 40.0)),  # a seam filled with tar
        Stripe(3.5, 7.0, y_m=(50.0, 50.5)),  # a stop line
        Stripe(3.5, 7.0, colour=(50.0, 50.0, 50.0), y_m=(60.0, 61.0)),  # a pole's shadow
    ],
)
def test_what_is_no_line(stripe: Stripe) -> None:
    assert lines_of(stripe) == []


@pytest.mark.parametrize("y_m", [(400.0, 500.0), (-100.0, -20.0)])
def test_nothing_is_claimed_where_the_camera_sees_or_resolves_nothing(
    y_m: tuple[float, float],
) -> None:
    away = np.column_stack([np.full(40, 60.0), np.linspace(*y_m, 40)])
    strip = rectify(road_image([Stripe(0.0, 0.3)]), road_plane(), away, -9.0, 9.0)
    assert find_lines(strip) == []
