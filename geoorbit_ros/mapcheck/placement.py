"""Finds where on a road network a camera's lanes lie, when their own frame has no place yet.

A calibration from traffic alone has metres, but neither a place nor a north. Its lanes are laid on
the network's: every rotation and shift near the given point is scored by how much of the lanes
lies on network lanes of the same direction (a correlation of rasters, one per direction), the best
are refined by robust least squares on the distances across (Tukey's biweight, Huber 1981), and all
that fit about as well stay as candidates. Roads look alike: on a straight one without junctions
nothing says how far along it the camera is, and beside it runs another. So the result says how sure
it is, and which other places fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError, RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.placement_fit import (
    SHAPE_M,
    RoughPlace,
    Search,
    prepare,
    refined,
    residuals,
    score_of,
    shape_left_m,
    step,
    turned,
    wrapped,
)
from geoorbit_ros.mapcheck.placement_search import find_starts
from geoorbit_ros.roadnet.network import RoadNetwork

Array = NDArray[np.float64]

SAME_M = 1.5
"""Candidates whose lanes lie closer than this are the same place."""
UNLIKELY = 6.0
"""Candidates whose log-likelihood is lower by this are dropped: one in 400."""
CLEAR_SHARE = 0.95
"""A place is taken when it is as likely as this. Chosen: one wrong camera of twenty is found by
looking at the map, more would not be looked for."""
SURE_ALONG_M, SURE_ACROSS_M = 0.75, 0.3
"""1-sigma along and across the road up to which a place is sure: half of 1.5 m, which an engineer
takes for the same place on an aerial image, and a tenth of a lane."""


@dataclass(frozen=True, slots=True)
class Place:
    """One place that fits: a point p of the lanes lies at `shift + scale R(turn) (p - centre)`.

    Attributes:
        centre_m: (2,) middle of the lanes in their own frame.
        shift_m: (2,) where it lies in the network's frame.
        turn_rad: Rotation, counter-clockwise.
        scale: Metres of the network per metre of the lanes.
        covariance: (4, 4) of shift east and north (m), turn (rad) and scale.
        share: How likely it is among all candidates, which add up to 1.
        residual_m: Median distance of the lanes from the network's.
    """

    centre_m: Array
    shift_m: Array
    turn_rad: float
    scale: float
    covariance: Array
    share: float
    residual_m: float

    def points(self, xy: Array) -> Array:
        """Points (N, 2) of the lanes' frame in the network's."""
        return np.asarray(self.shift_m + self.scale * turned(xy - self.centre_m, self.turn_rad))

    def inverse_points(self, xy: Array) -> Array:
        """Points (N, 2) of the network in the lanes' frame."""
        return np.asarray(self.centre_m + turned(xy - self.shift_m, -self.turn_rad) / self.scale)


@dataclass(frozen=True, slots=True)
class Placement:
    """Where lanes lie on a network, and how sure that is.

    Attributes:
        places: All that fit, the likeliest first.
        along: (2,) unit vector, the road's main direction at the likeliest place.
        along_sigma_m: 1-sigma of the place along it, over all candidates.
        across_sigma_m: The same across it.
    """

    places: tuple[Place, ...]
    along: Array
    along_sigma_m: float
    across_sigma_m: float

    @property
    def best(self) -> Place:
        """The likeliest place."""
        return self.places[0]

    @property
    def sure(self) -> bool:
        """Whether it is known in both directions."""
        return self.along_sigma_m <= SURE_ALONG_M and self.across_sigma_m <= SURE_ACROSS_M

    @property
    def ambiguous(self) -> bool:
        """Whether another place fits about as well: the likeliest is then a guess."""
        return self.best.share < CLEAR_SHARE

    def sentences(self) -> list[str]:
        """What a person must know before the place is used."""
        if self.sure:
            return [
                f"placed on the map to ± {self.along_sigma_m:.1f} m along and "
                f"± {self.across_sigma_m:.1f} m across the road"
            ]
        said = []
        if self.across_sigma_m > SURE_ACROSS_M:
            said.append(
                f"the place on the map is not sure: ± {self.across_sigma_m:.1f} m across the road "
                f"and ± {self.along_sigma_m:.1f} m along it"
            )
        else:
            said.append(
                f"how far along the road the camera stands is not sure: ± {self.along_sigma_m:.0f} "
                f"m; across the road it is ± {self.across_sigma_m:.1f} m"
            )
        if self.ambiguous:
            away = [float(np.hypot(*(p.shift_m - self.best.shift_m))) for p in self.places[1:]]
            far = f"{min(away):.0f} to {max(away):.0f} m" if len(away) > 1 else f"{away[0]:.0f} m"
            others = "the others are" if len(away) > 1 else "the other is"
            said.append(
                f"{len(self.places)} places fit; the likeliest has {100 * self.best.share:.0f} %, "
                f"{others} {far} away"
            )
        return said


def place_lanes(
    lanes: Sequence[Lane],
    network: RoadNetwork,
    rough: RoughPlace,
    seen_m: Array | None = None,
) -> Placement:
    """Find the places on a network where detected lanes fit.

    Args:
        lanes: In a frame of their own, metres; only confirmed ones are used.
        network: In its map frame.
        rough: Where that is, as far as it is known.
        seen_m: (K, 2) polygon in which other lanes would have been seen; default: the convex hull
            of the lanes.

    Raises:
        NoTrafficError: No confirmed lane.
        RoadNetworkError: No lane of the network fits anywhere near.
    """
    confirmed = [lane for lane in lanes if lane.status == "confirmed"]
    if not confirmed:
        found = f"{len(lanes)} lanes, none confirmed"
        raise NoTrafficError("detected lanes", found, "confirmed lanes: more traffic")
    search = prepare(confirmed, network, rough, seen_m)
    starts = find_starts(search)
    if not starts:
        raise RoadNetworkError(
            str(network.path),
            f"no lanes like the detected ones within {rough.reach_m:.0f} m of the given place",
            "a network with the road that the camera sees",
        )
    shape_m = SHAPE_M[1]
    fits = [refined(search, start, shape_m) for start in starts]
    for _ in range(2):  # what the best fit leaves is the error of the shapes
        best = max(fits, key=lambda fit: score_of(search, fit, shape_m))
        shape_m = shape_left_m(search, best)
        fits = [refined(search, fit, shape_m) for fit in fits]
    return _placement(search, fits, shape_m)


def _placement(search: Search, fits: Sequence[Array], shape_m: float) -> Placement:
    scores = np.array([score_of(search, fit, shape_m) for fit in fits])
    reach = float(np.sqrt((search.xy**2).sum(axis=1).mean()))
    kept: list[int] = []
    for k in np.argsort(-scores, kind="stable").tolist():
        if scores[k] < scores.max() - UNLIKELY:
            break
        same = (
            np.hypot(*(fits[j][:2] - fits[k][:2])) + reach * abs(wrapped(fits[j][2] - fits[k][2]))
            < SAME_M
            for j in kept
        )
        if not any(same):
            kept.append(k)
    share = np.exp(scores[kept] - scores.max())
    share /= share.sum()
    sigma = np.hypot(search.sigma_m, shape_m)
    places = tuple(
        _place(search, fits[k], float(part), sigma) for k, part in zip(kept, share, strict=True)
    )
    best = places[0]
    axis = _main_direction(search.heading + best.turn_rad)
    spread = sum(
        (p.share * (p.covariance[:2, :2] + np.outer(d, d)) for p in places
         for d in [p.shift_m - best.shift_m]), start=np.zeros((2, 2)),
    )  # fmt: skip
    normal = np.array([-axis[1], axis[0]])
    return Placement(
        places,
        axis,
        float(np.sqrt(axis @ spread @ axis)),
        float(np.sqrt(normal @ spread @ normal)),
    )


def _place(search: Search, move: Array, share: float, sigma: Array) -> Place:
    offset = np.abs(residuals(search, move)[0])
    beside = offset[np.isfinite(offset)]
    return Place(
        search.centre,
        move[:2],
        float(wrapped(move[2])),
        float(move[3]),
        step(search, move, sigma)[1],
        share,
        float(np.median(beside)) if len(beside) else float("nan"),
    )


def _main_direction(heading: Array) -> Array:
    """(2,) unit vector of the axis along which most lanes run, whichever way."""
    angle = 0.5 * float(np.angle(np.exp(2j * heading).sum()))
    return np.array([np.cos(angle), np.sin(angle)])
