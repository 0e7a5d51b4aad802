"""What a map adds to lanes that too few vehicles have driven along.

The map may be wrong, so it is used only where it agrees with what was measured. A tentative lane is
moved towards the map's lane where a confirmed lane beside it lies where the map has it, and the map
counts with the error that it has there. A lane without neighbours, whose width is only typical of
the road's speed, takes the map's width where the map agrees with the widths that were measured.
Confirmed lanes stay where they are, and no lane gains confidence.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import Projection, offset_line, project

GATE_M = 1.75
"""Half a lane width of 3.5 m: farther away is another lane of the map."""
BESIDE_M = (2.3, 5.2)
"""Middles of neighbouring lanes are this far apart. Chosen: lanes are 2.7 to 4.5 m wide (AASHTO
Green Book; UK CD 127), both off by their errors; wider takes in lanes beyond a shoulder."""
FITS_M = 0.4
"""A map whose lanes are farther from the neighbours' measured places is not used. Chosen: larger
uses wrong maps, smaller leaves good maps unused where lanes have been seen by few vehicles."""
WIDTH_FITS_M = 0.25
"""The same for measured widths. Chosen: larger uses wrong widths, smaller leaves good ones
unused."""
FLOOR_M = 0.15
"""A map never counts as more exact than this. Chosen: larger lets the map move less, smaller lets
it override lanes that were seen by many vehicles."""
GUESS_M = 0.25
"""Widths with a larger error have not been measured: a lane without a neighbour has 0.3 m."""
SIGMAS = 2.0
"""A lane is moved to the map where both agree within so many sigma. Chosen: larger moves lanes to
the wrong place, smaller moves few."""
MIN_MEASURED = 2
"""Measured widths that a map's widths are compared with. Chosen: more use the map more rarely, one
may agree by chance."""
PARALLEL = float(np.cos(np.radians(25.0)))
"""Cosine of the largest angle between lanes that are one. Chosen: larger angles take ramps for the
road beside them, smaller ones miss lanes in bends."""


@dataclass(frozen=True, slots=True)
class MapPrior:
    """The map's lanes, laid where the camera sees them.

    Attributes:
        lanes: In the camera's map frame.
    """

    lanes: Sequence[Lane]

    @staticmethod
    def as_seen(lanes: Iterable[Lane], shift_m: NDArray[np.float64], turn_rad: float) -> MapPrior:
        """Lay the map's lanes where the camera sees them.

        Args:
            lanes: In the map's own place.
            shift_m: (2,) What is added to the camera's tracks, after the turn about the origin of
                its frame, so that they lie on the map.
            turn_rad: That turn, counter-clockwise.
        """
        cos, sin = np.cos(turn_rad), np.sin(turn_rad)
        back = np.array([[cos, -sin], [sin, cos]])  # row vectors: the transpose turns back

        def seen(line: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((line - shift_m) @ back)

        return MapPrior(
            [
                replace(
                    lane,
                    centerline_m=seen(lane.centerline_m),
                    left_m=seen(lane.left_m),
                    right_m=seen(lane.right_m),
                )
                for lane in lanes
            ]
        )

    def refine(self, lane_map: LaneMap) -> LaneMap:
        """The lane map with sparse lanes refined where the map agrees with measured lanes."""
        if all(_is_known(lane) for lane in lane_map.lanes):
            return lane_map
        places = [self._of(lane) for lane in lane_map.lanes]
        sure = [
            (lane, *place)
            for lane, place in zip(lane_map.lanes, places, strict=True)
            if place is not None and lane.status == "confirmed"
        ]
        errors = [_median(foot) for _, _, foot in sure]
        wide = [
            lane.width_m - there.width_m for lane, there, _ in sure if lane.width_sigma_m < GUESS_M
        ]
        widths_fit = len(wide) >= MIN_MEASURED and max(map(abs, wide)) <= WIDTH_FITS_M
        lanes = []
        for lane, place in zip(lane_map.lanes, places, strict=True):
            refined = lane
            if place is not None and lane.status == "tentative":
                beside = [
                    error
                    for (other, *_), error in zip(sure, errors, strict=True)
                    if _beside(lane, other)
                ]
                refined = _drawn(lane, place[1], beside)
            if place is not None and widths_fit and not lane.width_sigma_m < GUESS_M:
                refined = _widened(refined, place[0].width_m)
            lanes.append(refined)
        return replace(lane_map, lanes=tuple(lanes))

    def _of(self, lane: Lane) -> tuple[Lane, Projection] | None:
        """The map's lane that a lane lies in over most of its length, in its direction."""
        best, least = None, GATE_M
        x, y, heading = lane.middle
        for there in self.lanes:
            middle = project(np.array([[x, y]]), there.centerline_m, 1.0)
            if middle.tangent[0] @ [np.cos(heading), np.sin(heading)] <= PARALLEL:
                continue
            foot = project(lane.centerline_m, there.centerline_m, 1.0)
            if foot.inside.mean() > 0.5 and abs(_median(foot)) < least:
                best, least = (there, foot), abs(_median(foot))
        return best


def _is_known(lane: Lane) -> bool:
    """Whether a map can add nothing: confirmed, and its width was measured."""
    return lane.status == "confirmed" and lane.width_sigma_m < GUESS_M


def _median(foot: Projection) -> float:
    return float(np.median(foot.offset_m[foot.inside]))


def _beside(lane: Lane, other: Lane) -> bool:
    foot = project(lane.centerline_m, other.centerline_m, 1.0)
    return bool(
        foot.inside.mean() > 0.5
        and BESIDE_M[0] <= abs(_median(foot)) <= BESIDE_M[1]
        and np.cos(lane.middle[2] - other.middle[2]) > PARALLEL
    )


def _drawn(lane: Lane, foot: Projection, beside: Sequence[float]) -> Lane:
    """A lane between where it was seen and where the map has it, by the errors of both."""
    if not beside or max(map(abs, beside)) > FITS_M:
        return lane
    sigma_m = max(FLOOR_M, *map(abs, beside))
    own_m = lane.sigma_m if np.isfinite(lane.sigma_m) else GATE_M
    offset_m = _median(foot)
    if abs(offset_m) > SIGMAS * np.hypot(sigma_m, own_m):
        return lane
    weight = own_m**2 / (own_m**2 + sigma_m**2)
    move = -weight * offset_m
    return replace(
        lane,
        centerline_m=offset_line(lane.centerline_m, move),
        left_m=offset_line(lane.left_m, move),
        right_m=offset_line(lane.right_m, move),
        sigma_m=float(own_m * sigma_m / np.hypot(own_m, sigma_m)),
    )


def _widened(lane: Lane, width_m: float) -> Lane:
    """A lane whose width is that of the map as far as its own is less certain."""
    own_m = lane.width_sigma_m if np.isfinite(lane.width_sigma_m) else 1.0
    weight = own_m**2 / (own_m**2 + FLOOR_M**2)
    width = lane.width_m + weight * (width_m - lane.width_m)
    return replace(
        lane,
        left_m=offset_line(lane.centerline_m, 0.5 * width),
        right_m=offset_line(lane.centerline_m, -0.5 * width),
        width_m=float(width),
        width_sigma_m=float(own_m * FLOOR_M / np.hypot(own_m, FLOOR_M)),
    )
