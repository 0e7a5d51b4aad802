"""Lanes that are painted beside those of the traffic, and that nobody used.

Paint does not say which way a lane leads, nor that it is a lane: behind a solid line there is a
shoulder, a gore or a verge. So one is claimed only beside two and more lanes that all lead one way,
behind the same dashes as between these, where a line follows one lane's width beyond them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.markings.assignment import ONE_LANE_M, Choice, is_clear, worth
from geoorbit_ros.markings.dashes import SAME, DashPattern, usual_dashes
from geoorbit_ros.markings.lines import PaintedLine

Array = NDArray[np.float64]

LEAST_ALONG = 0.7
"""Share of the neighbouring lane that both lines accompany. Chosen: less is a lay-by, or a lane
that begins."""
SPREAD_M = 0.5
"""Most by which the lane's width changes along it. Chosen: more is a taper."""
BESIDE_M, REACH_M = 1.0, 5.5
"""Road on this side of the dashes, and beyond them, that is looked at: the widest lane, and what
its line is compared with."""


@dataclass(frozen=True, slots=True)
class Unused:
    """A painted lane without traffic.

    Attributes:
        neighbour: Number of the lane beside it.
        side: -1 right of it, 1 left of it, as the road's reference line leads.
        inner: The dashes between both.
        outer: Its other line.
    """

    neighbour: int
    side: int
    inner: PaintedLine
    outer: PaintedLine


def unused_lanes(
    lines: Sequence[PaintedLine],
    dashes: Sequence[DashPattern | None],
    beyond: Sequence[PaintedLine],
    choice: Sequence[Choice],
    centre_m: Array,
) -> list[Unused]:
    """The painted lanes beside the outermost lanes of a road whose traffic leads one way.

    Args:
        lines: Along the road; `choice` counts in them.
        dashes: The pattern of each line.
        beyond: Lines that were found beside the road.
        choice: The lines right and left of each lane, from right to left.
        centre_m: (N, S) offsets of the lanes' centrelines.
    """
    between = {left for (_, left), (right, _) in pairwise(choice) if left == right} - {None}
    usual = usual_dashes(dashes[i] for i in between if i is not None and is_clear(lines[i]))
    if usual is None:
        return []
    found = []
    for neighbour, side, chosen in ((0, -1, choice[0][0]), (len(choice) - 1, 1, choice[-1][1])):
        if chosen is None or not is_clear(lines[chosen]) or (own := dashes[chosen]) is None:
            continue
        if abs(own.period_m / usual.period_m - 1.0) > SAME:
            continue
        known = np.isfinite(centre_m[neighbour])
        outer = _next(lines[chosen], beyond, side, known)
        if outer is not None:
            found.append(Unused(neighbour, side, lines[chosen], outer))
    return found


def _next(
    inner: PaintedLine, beyond: Sequence[PaintedLine], side: int, known: NDArray[np.bool_]
) -> PaintedLine | None:
    """The line next to `inner` on one side, where it is one lane's width away along all of it."""
    nearest: tuple[float, PaintedLine | None] = (np.inf, None)
    narrowest, widest = ONE_LANE_M
    for line in beyond:
        apart = side * (line.offset_m - inner.offset_m)[known]
        both = np.isfinite(apart)
        if worth(line) == 0.0 or not both.any() or np.median(apart[both]) < 0.5 * narrowest:
            continue
        width_m = float(np.median(apart[both]))
        steady = both.mean() >= LEAST_ALONG and np.ptp(apart[both]) <= SPREAD_M
        fits = narrowest <= width_m <= widest and steady and is_clear(line)
        # What is nearer and doesn't fit stands in the way: an island, a kerb, an arrow.
        nearest = min(nearest, (width_m, line if fits else None), key=lambda pair: pair[0])
    return nearest[1]
