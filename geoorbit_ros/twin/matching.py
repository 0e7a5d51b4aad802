"""Which lane each vehicle is in: a hidden Markov filter over lanes, updated with every step.

States are the lanes near the vehicle. The observation is its distance from the lane's middle and
its heading against the lane's. Transitions follow the network: to stay and to drive on costs
nothing, a lane change some, a jump much (Newson and Krumm 2009, "Hidden Markov map matching through
noise and sparseness"; here with lanes in place of roads, and as a filter, which does not wait for
later observations). The distance changes no faster than a vehicle can cross the road
(`lane_changes.CrossingLimit`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.mapcheck.driven_lanes import DrivenNetwork
from geoorbit_ros.roadnet.lane_index import CANDIDATES, Candidates, LaneIndex
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.twin.lane_changes import CrossingLimit, LaneLinks
from geoorbit_ros.twin.vehicles import BICYCLE

LATERAL_SIGMA_M = 0.7
"""1-sigma of a vehicle's distance from its lane's middle. Chosen on the shipped scenes (ADR 0018):
drivers, maps and cameras err by less, but for seconds, so that one observation must not count for
much; smaller follows lane changes sooner and changes lanes on a line more often."""
SIGMA_SHARE = 0.15
"""Share of the track's ground error, which lies along the line of sight, that is lateral. Chosen:
larger lets far vehicles stay in wrong lanes and made ramps worse (ADR 0018)."""
HEADING_SIGMA_RAD = np.radians(12.0)
"""1-sigma of a vehicle's heading against its lane's. Chosen: smaller lets noisy headings of slow
vehicles choose the lane, larger does not tell a ramp from the road."""
MAX_TURN_RAD = np.radians(80.0)
"""Lanes at a larger angle to the vehicle are of another road or direction. Chosen: larger admits
crossing roads, smaller loses vehicles that turn."""
ENTRY_M = 4.0
"""Vehicles enter only this near to the middle of a lane. Chosen: half a lane and a shoulder; larger
admits what moves beside the road."""
END_SLACK_M = 1.0
"""A vehicle counts as between a lane's ends up to this beyond them. Chosen: lanes that follow each
other may leave a gap."""
CYCLE_LANE = 3.0
"""Cost of a lane for bicycles alone, for other vehicles. Chosen: beside a lane of 3.5 m a cycle
lane of 1.5 m then begins where it is painted; less counts cars to it that keep to the side."""
IMPOSSIBLE = -1e6
"""Log likelihood of a lane that a vehicle can't be in: less than any sum of others."""
FORGET = 12.0
"""Cost of the worst hypothesis that is kept. Chosen: more than an unconnected move
(`lane_changes.UNRELATED`), so that a lane that was excluded can come back; larger takes longer."""


@dataclass(frozen=True, slots=True)
class Matches:
    """Lanes of M vehicles.

    Attributes:
        lane: (M,) lane number, `NO_LANE` outside the network.
        arc_m: (M,) metres along the lane.
        offset_m: (M,) distance from the lane's middle, positive to the left.
        within: (M,) whether the vehicle's middle can be between the borders of a lane, and between
            the ends of this one.
        heading_rad: (M,) the lane's direction there; NaN beside the network.
    """

    lane: NDArray[np.int64]
    arc_m: NDArray[np.float64]
    offset_m: NDArray[np.float64]
    within: NDArray[np.bool_]
    heading_rad: NDArray[np.float64]


class LaneMatcher:
    """Finds each vehicle's lane; remembers for each slot the lanes that it may be in.

    Args:
        network: Whose lanes.
        step_s: Time between two updates.
        capacity: Vehicles that can be remembered at first; it grows by itself.
    """

    def __init__(self, network: RoadNetwork, step_s: float = 0.1, capacity: int = 64) -> None:
        self._index = LaneIndex(network)
        self._links = LaneLinks(network)
        self._half_m = 0.5 * network.width_m
        self._cycles = ~network.for_motors
        self._step_s, self._crossing = step_s, CrossingLimit(capacity)
        self._lane = np.full((capacity, CANDIDATES), NO_LANE, dtype=np.int64)
        self._score = np.zeros((capacity, CANDIDATES))
        self._cost = np.zeros((capacity, CANDIDATES, CANDIDATES))
        # Whether `_cost` is that of staying among the same lanes, and so can be used again.
        self._steady = np.zeros(capacity, dtype=np.bool_)

    def follow(self, driven: DrivenNetwork) -> None:
        """Use from now on the lanes where they are driven; their numbers stay the same."""
        self._index, self._half_m = driven.index, 0.5 * driven.network.width_m

    def forget(self, slot: NDArray[np.int64]) -> None:
        """Start again for these slots: they hold new vehicles."""
        self._reserve(int(slot.max(initial=-1)) + 1)
        self._lane[slot] = NO_LANE
        self._steady[slot] = False
        self._crossing.forget(slot)

    def on_road(self, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(M,) whether points (M, 2) are near enough to a lane to enter there."""
        if not len(xy):
            return np.zeros(0, dtype=np.bool_)
        return np.asarray((self._index.near(xy, ENTRY_M).lane != NO_LANE).any(axis=1))

    def update(
        self,
        slot: NDArray[np.int64],
        xy: NDArray[np.float64],
        heading_rad: NDArray[np.float64],
        sigma_m: NDArray[np.float64],
        observed: NDArray[np.bool_] | None = None,
        kind: NDArray[np.int64] | None = None,
    ) -> Matches:
        """Observe vehicles once.

        Args:
            slot: (M,) which vehicles, each once.
            xy: (M, 2) map frame.
            heading_rad: (M,) NaN where not known.
            sigma_m: (M,) 1-sigma ground errors.
            observed: (M,) whether a camera sees them now; all, if not given.
            kind: (M,) numbers in `vehicles.TYPES`; motor vehicles, if not given.
        """
        near = self._index.near(xy)
        seen = np.ones(len(slot), dtype=np.bool_) if observed is None else observed
        excess = self._crossing.excess(slot, xy, near.heading_rad, seen, self._step_s)
        possible = replace(near, offset_m=near.offset_m - excess)
        score = _observation(possible, heading_rad, sigma_m)
        if self._cycles.any():
            motor = np.ones(len(slot), np.bool_) if kind is None else kind != BICYCLE
            score[self._cycles[near.lane] & motor[:, None]] -= CYCLE_LANE
        inside = np.abs(possible.offset_m) <= self._half_m[near.lane]
        on_lane = (inside & (score > 0.5 * IMPOSSIBLE)).any(axis=1)
        known = (self._lane[slot] != NO_LANE).any(axis=1)
        prior = self._prior(slot[known], near.lane[known])
        score[known] += prior
        lost = score.max(axis=1) <= 0.5 * IMPOSSIBLE
        score -= score.max(axis=1, keepdims=True)
        best = np.argmax(score, axis=1)
        rows = np.arange(len(slot))
        lane = np.where(lost, NO_LANE, near.lane[rows, best])
        self._lane[slot], self._score[slot] = near.lane, score
        self._lane[slot[lost]] = NO_LANE  # where it comes back, it starts again
        self._crossing.keep(slot, xy, near.heading_rad[rows, best], excess[rows, best])
        offset = near.offset_m[rows, best]
        return Matches(
            lane,
            near.arc_m[rows, best],
            offset,
            ~lost & on_lane & (near.past_m[rows, best] < END_SLACK_M),
            np.where(lost, np.nan, near.heading_rad[rows, best]),
        )

    def _prior(self, slot: NDArray[np.int64], lane: NDArray[np.int64]) -> NDArray[np.float64]:
        """(M, C) log likelihood of lanes (M, C) by the steps before."""
        same = (self._lane[slot] == lane).all(axis=1)
        outdated = ~(same & self._steady[slot])
        if outdated.any():
            at = slot[outdated]
            self._cost[at] = self._links.cost(self._lane[at], lane[outdated])
            self._steady[slot] = same
        return np.asarray(
            np.max(np.maximum(self._score[slot], -FORGET)[:, :, None] - self._cost[slot], axis=1)
        )

    def _reserve(self, capacity: int) -> None:
        more = max(capacity, 2 * len(self._steady)) - len(self._steady)
        if capacity <= len(self._steady):
            return
        self._lane = np.concatenate([self._lane, np.full((more, CANDIDATES), NO_LANE)])
        self._score = np.concatenate([self._score, np.zeros((more, CANDIDATES))])
        self._cost = np.concatenate([self._cost, np.zeros((more, CANDIDATES, CANDIDATES))])
        self._steady = np.append(self._steady, np.zeros(more, dtype=np.bool_))
        self._crossing.reserve(len(self._steady))


def _observation(
    near: Candidates, heading: NDArray[np.float64], sigma_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(M, C) log likelihoods."""
    lateral = np.hypot(LATERAL_SIGMA_M, SIGMA_SHARE * sigma_m)[:, None]
    turn = heading[:, None] - near.heading_rad
    turn = np.nan_to_num((turn + np.pi) % (2 * np.pi) - np.pi)
    score = -0.5 * (near.offset_m**2 + near.past_m**2) / lateral**2
    score -= 0.5 * (turn / HEADING_SIGMA_RAD) ** 2
    score[(np.abs(turn) > MAX_TURN_RAD) | (near.lane == NO_LANE)] = IMPOSSIBLE
    return np.asarray(score, dtype=np.float64)
