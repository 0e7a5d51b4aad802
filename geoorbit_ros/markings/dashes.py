"""Lengths of painted dashes: what they say about a calibration along the road.

Rules fix the dashes' length and period to a few per cent. Where a calibration shows them longer or
shorter it is wrong along the road, which traffic alone does not show: nobody knows how fast it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.markings.lines import MAX_ALONG_M, PaintedLine
from geoorbit_ros.markings.road_image import ALONG_M, RoadStrip

Array = NDArray[np.float64]

RULES: tuple[tuple[float, float], ...] = (
    (2.0, 9.0), (3.0, 9.0), (3.0, 12.0), (3.05, 12.19), (3.0, 13.0), (3.66, 14.63), (3.81, 15.24),
    (4.0, 12.0), (4.5, 12.0), (6.0, 15.0), (6.0, 18.0), (8.0, 20.0),
)  # fmt: skip
"""Length and period in metres of lane lines that are a rule somewhere: docs/markings.md says where.
States and kinds of road differ, so that which one holds at a camera is for its owner to say."""
SAME = 0.12
"""Most that a measured period may differ from a rule's to be taken for it. Chosen: calibrations are
off by less, and rules lie farther apart where dash and period are looked at together."""
SAME_DASH = 0.35
"""The same of the dash: its ends are blurred, and worn."""
PERIODS_M = np.arange(5.0, 24.0, 0.02)
"""Periods that are looked for."""
CLEANED_M = 0.75
"""Gaps in a dash, and spots between dashes, up to this length are none. Chosen: three stations;
the shortest dashes are 1 m long."""
LEAST_DASHES = 4
"""Dashes of one line, at least, for a period. Chosen: three may be a chance."""
STEADY = 0.06
"""Most that dashes lie beside a steady period, as a share of it (1-sigma). Chosen: those of a line
whose beginning or end was taken for a dash do more."""
FITS = 0.01
"""Differences from a rule up to this share are those of the painters."""
KNOWN = 0.02
"""Largest 1-sigma of a period, as a share of it, that says something about a calibration."""


@dataclass(frozen=True, slots=True)
class DashPattern:
    """Dashes as the calibration shows them.

    Attributes:
        dash_m: Their length.
        period_m: From the beginning of one to that of the next.
        sigma_m: 1-sigma error of `period_m`.
        lines: Of so many lines.
    """

    dash_m: float
    period_m: float
    sigma_m: float
    lines: int = 1

    def sentence(self) -> str:
        """What they say; empty where nothing is known well enough."""
        if self.sigma_m > KNOWN * self.period_m:
            return ""
        shown = f"dashes are {self.dash_m:.1f} m long, every {self.period_m:.2f} ± "
        shown += f"{self.sigma_m:.2f} m"
        near = sorted(
            (abs(np.log(self.period_m / period)), dash, period)
            for dash, period in RULES
            if abs(np.log(self.period_m / period)) < SAME
            and abs(np.log(self.dash_m / dash)) < SAME_DASH
        )
        if not near:
            return f"{shown}, which no known rule has: is the calibration right along the road?"
        _, dash, period = near[0]
        off = self.period_m / period - 1.0
        fits = "fits" if abs(off) < FITS else f"is {abs(off):.0%} {'long' if off > 0 else 'short'}"
        return (
            f"{shown}: if {dash:g} m every {period:g} m is the rule here, the calibration {fits} "
            "along the road"
        )


def usual_dashes(patterns: Iterable[DashPattern | None]) -> DashPattern | None:
    """The pattern that most lines of a camera have together; None without any."""
    found = [pattern for pattern in patterns if pattern is not None]
    if not found:
        return None
    # Most lines of a road have one pattern: that of the line that is known best, and its equals.
    best = min(found, key=lambda pattern: pattern.sigma_m)
    same = [p for p in found if abs(p.period_m - best.period_m) < STEADY * best.period_m]
    weight = np.array([p.sigma_m**-2 for p in same])
    weight /= weight.sum()
    period_m, dash_m = (
        float(weight @ [getattr(p, name) for p in same]) for name in ("period_m", "dash_m")
    )
    sigma_m = float(np.sqrt(np.square(weight) @ [p.sigma_m**2 for p in same]))
    spread = float(np.sqrt(weight @ [(p.period_m - period_m) ** 2 for p in same]))
    return DashPattern(dash_m, period_m, max(sigma_m, spread / np.sqrt(len(same))), len(same))


def dashes_of(strip: RoadStrip, line: PaintedLine) -> DashPattern | None:
    """The dashes of one line; None without any, or where the image doesn't resolve them."""
    if line.kind != "dashed":
        return None
    known = np.flatnonzero(np.isfinite(line.offset_m))
    column = np.searchsorted(strip.offset_m, line.offset_m[known])
    column = np.clip(column, 0, len(strip.offset_m) - 1)
    sharp = known[strip.along_m[known, column] <= MAX_ALONG_M]
    if not len(sharp):
        return None
    painted = line.seen[sharp[0] : sharp[-1] + 1]
    begin, end = _runs(painted)
    # Those at both ends may be cut.
    inner = (begin > 0) & (end < len(painted))
    begin_m, end_m = ALONG_M * begin[inner], ALONG_M * end[inner]
    if len(begin_m) < LEAST_DASHES:
        return None
    middle_m = 0.5 * (begin_m + end_m)
    phase = np.exp(2j * np.pi * np.arange(len(painted)) * ALONG_M / PERIODS_M[:, None])
    power = np.abs(phase @ (painted - painted.mean()))
    period_m = float(PERIODS_M[int(np.argmax(power))])
    number = np.rint((middle_m - middle_m[0]) / period_m)
    slope, offset = np.polyfit(number, middle_m, 1)
    error_m = middle_m - (offset + slope * number)
    scatter_m = max(float(np.sqrt(np.mean(error_m**2))), 0.5 * ALONG_M)
    if len(np.unique(number)) < LEAST_DASHES or scatter_m > STEADY * slope:
        return None
    sigma_m = scatter_m / float(np.sqrt(np.sum((number - number.mean()) ** 2)))
    return DashPattern(float(np.median(end_m - begin_m)), float(slope), sigma_m)


def _runs(painted: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First stations of dashes, and those behind their last ones."""
    least = round(CLEANED_M / ALONG_M)
    for value in (True, False):  # gaps are closed first, then spots are left out
        edges = np.flatnonzero(np.diff(np.concatenate([[value], painted, [value]]).astype(np.int8)))
        for begin, end in edges.reshape(-1, 2):
            if end - begin <= least and begin > 0 and end < len(painted):
                painted = painted.copy()
                painted[begin:end] = value
    edges = np.flatnonzero(np.diff(np.concatenate([[False], painted, [False]]).astype(np.int8)))
    begin, end = edges.reshape(-1, 2).T
    return begin, end
