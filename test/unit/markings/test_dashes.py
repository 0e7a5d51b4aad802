"""Lengths of dashes: measured, combined, and what they say about a calibration."""

from __future__ import annotations

import numpy as np
import pytest

from geoorbit_ros.markings.dashes import DashPattern, dashes_of, usual_dashes
from geoorbit_ros.markings.lines import PaintedLine
from geoorbit_ros.markings.road_image import ALONG_M, RoadStrip

STATIONS = 480
"""120 m."""


def strip(along_m: float = 0.1, sharp_m: float = 120.0) -> RoadStrip:
    """A straight road that is resolved to a distance."""
    station = np.asarray(ALONG_M * np.arange(STATIONS), dtype=np.float64)
    offset = np.linspace(-2.0, 2.0, 201)
    along = np.where(station < sharp_m, along_m, 2.0)[:, None] + np.zeros(len(offset))
    shape = (STATIONS, len(offset))
    return RoadStrip(
        station, offset, np.column_stack((station, 0 * station)),
        np.tile((0.0, 1.0), (STATIONS, 1)), np.zeros((*shape, 3), np.float32),
        np.ones(shape, np.bool_), np.full(shape, 0.05), along,
    )  # fmt: skip


def line(
    dash_m: float,
    period_m: float,
    faults: float = 0.0,
    seed: int = 1,
    kind: str = "dashed",
    offset_m: float = 0.5,
) -> PaintedLine:
    """A dashed line, a share of whose stations is wrong."""
    station = ALONG_M * np.arange(STATIONS) + 1.3
    seen = station % period_m < dash_m
    random = np.random.default_rng(seed)
    seen ^= random.uniform(size=STATIONS) < faults
    return PaintedLine(
        np.full(STATIONS, offset_m), np.full(STATIONS, 0.02), seen, 2.0, 5.0,
        kind, "white", 0.15,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("dash_m", "period_m"), [(3.0, 9.0), (3.05, 12.19), (6.0, 18.0), (2.0, 9.0), (8.0, 20.0)]
)
@pytest.mark.parametrize("faults", [0.0, 0.03])
def test_length_and_period_are_measured(dash_m: float, period_m: float, faults: float) -> None:
    found = dashes_of(strip(), line(dash_m, period_m, faults))
    assert found is not None
    assert found.period_m == pytest.approx(period_m, rel=0.01)
    assert abs(found.period_m - period_m) < 4.0 * found.sigma_m
    assert found.dash_m == pytest.approx(dash_m, abs=0.4)


def test_several_lines_are_one_pattern_and_another_one_does_not_spoil_it() -> None:
    lines = [line(3.0, 9.0, 0.03, seed, offset_m=seed - 2.0) for seed in (1, 2, 3)]
    alone = dashes_of(strip(), lines[0])
    found = usual_dashes(dashes_of(strip(), each) for each in (*lines, line(1.0, 6.0, 0.05, 4)))
    assert alone is not None
    assert found is not None
    assert found.lines == 3
    assert found.period_m == pytest.approx(9.0, rel=0.01)
    assert found.sigma_m <= alone.sigma_m * 1.01


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [line(3.0, 9.0, kind="solid")],
        [line(3.0, 40.0)],
        [line(3.0, 9.0, faults=0.5)],
    ],
    ids=["none", "solid", "too few", "spots"],
)
def test_nothing_is_claimed_where_no_period_is_seen(lines: list[PaintedLine]) -> None:
    assert usual_dashes(dashes_of(strip(), each) for each in lines) is None


def test_nothing_is_claimed_where_the_image_does_not_resolve_dashes() -> None:
    assert dashes_of(strip(along_m=1.5), line(3.0, 9.0)) is None
    assert dashes_of(strip(sharp_m=30.0), line(3.0, 9.0)) is None


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        (
            DashPattern(6.1, 18.36, 0.05),
            "6 m every 18 m is the rule here, the calibration is 2 % long",
        ),
        (
            DashPattern(3.0, 8.55, 0.05),
            "3 m every 9 m is the rule here, the calibration is 5 % short",
        ),
        (DashPattern(3.1, 12.2, 0.05), "the calibration fits along the road"),
        (DashPattern(2.4, 7.38, 0.04), "which no known rule has"),
    ],
)
def test_what_is_said(pattern: DashPattern, words: str) -> None:
    assert words.replace(" %", "%") in pattern.sentence().replace(" %", "%")


def test_what_is_not_known_well_is_not_said() -> None:
    assert DashPattern(3.0, 9.0, 0.5).sentence() == ""
