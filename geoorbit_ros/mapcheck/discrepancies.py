"""Compares aligned lanes with a network: missing, extra, shifted, other width, other direction.

Each detected lane is compared with its partner in the network (`mapcheck/offsets.py`). A detected
lane without partner is missing in the map; a network lane without one is extra, or was not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.mapcheck.alignment import Alignment
from geoorbit_ros.mapcheck.driven_lanes import DrivenLane
from geoorbit_ros.mapcheck.findings import Finding, Unseen
from geoorbit_ros.mapcheck.offsets import Partners, find_partners, lanes_near, offsets, sample_lines
from geoorbit_ros.roadnet.network import RoadNetwork

MIN_LENGTH_M = 20.0
"""Lanes are compared over at least this length. Chosen: shorter pieces say little (two car lengths
and a gap); larger leaves short edges unchecked."""
EMPTY_SHARE = 0.7
"""An extra lane is empty over this share of the length over which its edge is in use. Chosen:
larger misses extra lanes that a vehicle touched, smaller reports lanes that are seldom used."""
CELL_M = 4.0
"""Cells in which use is counted: two samples (`offsets.STEP_M`). Chosen: smaller leaves gaps
between samples."""
EXTRA_CONFIDENCE = 0.9
"""Least probability that an empty lane is extra. With 0.8, lanes with two vehicles a minute were
called extra in random scenes (ADR 0029)."""
LEAVES_S = 5.0
"""Drivers leave a lane that ends at least this long before its end: a change of lane takes 4.6 s on
average (Toledo and Zohar 2007)."""


def find_extra(
    lanes: Sequence[Lane], network: RoadNetwork, number: NDArray[np.int64], partners: Partners
) -> tuple[list[Finding], list[Unseen]]:
    """Empty lanes of edges in use: extra ones, and those about which too little is known.

    One vehicle that drove `MIN_LENGTH_M` in a lane proves it, however empty the rest is: beside
    ramps and before their ends, lanes are left early and entered late.
    """
    found: list[Finding] = []
    unseen: list[Unseen] = []
    normal = [int(k) for k in number if not network.internal[k]]
    for edge in dict.fromkeys(network.edge_id[k] for k in normal):
        group = [k for k in normal if network.edge_id[k] == edge]
        used = np.isin(partners.lane, group)
        users = sorted(set(partners.detected[used].tolist()))
        if not users:
            continue
        vehicles = float(np.nansum([lanes[d].vehicles for d in users]))
        for k in group:
            foot = project(partners.xy[used], network.line(k), 1.0)
            arc = foot.arc_m[foot.inside]
            own = partners.arc_m[partners.lane == k]
            seen_m = float(np.ptp(arc)) if len(arc) else 0.0
            used_m = _covered_m(own)
            is_used = used_m >= MIN_LENGTH_M or used_m > (1.0 - EMPTY_SHARE) * _covered_m(arc)
            if seen_m < MIN_LENGTH_M or is_used:
                continue
            name = network.lane_id[k]
            if not network.for_cars[k]:
                text = f"no traffic seen on {name}, which is for {network.users(k)}"
                unseen.append(Unseen(name, f"{text}: the traffic beside it says nothing about it"))
                continue
            if must_be_left(network, k):
                leaves_m = float(network.length_m[k] - LEAVES_S * network.speed_mps[k])
                if leaves_m - arc.min() < MIN_LENGTH_M:
                    text = f"no traffic seen on {name}, which ends: drivers leave it before its end"
                    unseen.append(Unseen(name, text))
                    continue
                seen_m = min(seen_m, leaves_m - float(arc.min()))
            others = sum(bool(network.for_cars[j]) for j in group) - 1
            confidence = vehicles / (vehicles + max(others, 1))
            line = _stretch(network, k, arc)
            if confidence < EXTRA_CONFIDENCE:
                needed = EXTRA_CONFIDENCE / (1.0 - EXTRA_CONFIDENCE) * max(others, 1) - vehicles
                text = (
                    f"no traffic seen on {name}; {ceil(needed - 1e-6)} more vehicles beside it "
                    "are needed to say that it isn't there"
                )
                unseen.append(Unseen(name, text))
                continue
            text = (
                f"no traffic on {name} over {seen_m:.0f} m, while {vehicles:.0f} vehicles "
                "drove beside it"
            )
            found.append(Finding("extra", name, None, line, 0.0, 1.0, 0.0, "", confidence, text))
    return found, unseen


def must_be_left(network: RoadNetwork, k: int) -> bool:
    """Whether lane k ends while the road goes on with fewer lanes.

    Where the lanes beside it lead to several roads (a junction), each lane leads to one of them: a
    lane without connection there is wrong. So is a lane that can't be entered either, where the
    others can.
    """
    group = [j for j, edge in enumerate(network.edge_id) if edge == network.edge_id[k]]
    narrows = len(set().union(*(_onward(network, j) for j in group))) == 1
    begins = not network.predecessors[k] and any(network.predecessors[j] for j in group)
    return narrows and not network.successors[k] and not begins


def _onward(network: RoadNetwork, k: int) -> set[str]:
    """Edges that lane k leads to, across the junction at its end."""
    found, waiting = set[str](), list(network.successors[k])
    while waiting:
        j = waiting.pop()
        if network.internal[j]:
            waiting += network.successors[j]
        else:
            found.add(network.edge_id[j])
    return found


def _stretch(network: RoadNetwork, k: int, arc: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of a lane between the least and the greatest arc."""
    at = np.linspace(arc.min(), arc.max(), 20)
    line, along = network.line(k), network.arc(k)
    return np.column_stack([np.interp(at, along, line[:, j]) for j in range(2)])


def _covered_m(arc: NDArray[np.float64]) -> float:
    """Metres along a lane at which there are samples, in cells of `CELL_M`."""
    return CELL_M * len(np.unique(np.round(arc / CELL_M)))


BESIDE_M = 6.0
"""A missing lane belongs to the edge of a lane within this distance. Chosen: not quite two lanes;
farther lanes are of another road."""
BESIDE_SHARE = 0.6
"""A lane is missing where its middle is farther from every lane of the map than this share of that
lane's width. Chosen: half a lane and a little; smaller calls displaced lanes missing, larger the
other way round."""
SHIFT_M, WIDTH_M = 0.35, 0.25
"""Differences in place and width that are never reported. Chosen: drivers don't keep to the middle,
whatever the error of the detected lane; smaller reports their habits, larger hides small errors."""
SIGMAS = 2.5
"""A difference must also exceed so many times the error of the detected lane: 1 % by chance (normal
distribution, two-sided)."""


@dataclass(frozen=True, slots=True)
class Discrepancies:
    """All that was found.

    Attributes:
        findings: In the order of certainty.
        unseen: Lanes of the network without enough traffic to compare them.
        compared: Lanes of the network that were compared, and over how many metres.
        driven: Where those are driven whose edge has lanes out of place or of another width.
        reserved: Detected lanes on lanes of the map that not all cars may use, in sentences.
    """

    findings: tuple[Finding, ...]
    unseen: tuple[Unseen, ...]
    compared: Mapping[str, float]
    driven: Mapping[str, DrivenLane]
    reserved: tuple[str, ...] = ()


def compare(lanes: Sequence[Lane], network: RoadNetwork, alignment: Alignment) -> Discrepancies:
    """Differences between detected lanes and a network.

    Args:
        lanes: In the camera's map frame; tentative ones show that a lane is used, no more.
        network: In the same frame.
        alignment: Lays the ones on the other.
    """
    number = lanes_near(network, lanes)
    lines = [alignment.points(lane.centerline_m) for lane in lanes]
    partners = find_partners(lines, network, number)
    beside = _Beside(lines, network, number)
    found: list[Finding] = []
    compared: dict[str, float] = {}
    driven: dict[str, DrivenLane] = {}
    reserved: list[str] = []
    for k in sorted(set(partners.lane[partners.lane >= 0].tolist())):
        if network.internal[k]:
            continue
        at = partners.lane == k
        d = int(np.bincount(partners.detected[at]).argmax())
        at &= partners.detected == d
        length_m = _length(partners.arc_m[at])
        if lanes[d].status != "confirmed" or length_m < MIN_LENGTH_M:
            continue
        compared[network.lane_id[k]] = length_m
        if users := network.users(k):
            reserved.append(
                f"lane {lanes[d].lane_id}{_vehicles(lanes[d])} runs on {network.lane_id[k]}, which "
                f"is for {users}; lanes do not tell which vehicles drive along them"
            )
        found += _of_pair(lanes[d], network, k, partners, at)
        if np.median(partners.along[at]) > 0.0:
            order = np.argsort(partners.arc_m[at])
            wide = lanes[d].width_m if np.isfinite(lanes[d].width_m) else float(network.width_m[k])
            driven[network.lane_id[k]] = DrivenLane(
                partners.arc_m[at][order], partners.offset_m[at][order], wide
            )
    for d, lane in enumerate(lanes):
        if lane.status == "confirmed":
            found += _missing(lane, d, network, beside, partners)
    extra, unseen = find_extra(lanes, network, number, partners)
    found += extra
    found.sort(key=lambda f: -f.confidence)
    wrong = {_edge(f.lane_id) for f in found if f.kind in ("shifted", "width")}
    driven = {name: lane for name, lane in driven.items() if _edge(name) in wrong}
    return Discrepancies(tuple(found), tuple(unseen), compared, driven, tuple(reserved))


def _of_pair(
    lane: Lane, network: RoadNetwork, k: int, partners: Partners, at: NDArray[np.bool_]
) -> list[Finding]:
    """Direction, place and width of a network lane against its partner's."""
    name, line = network.lane_id[k], partners.xy[at]
    if np.median(partners.along[at]) < 0.0:
        measured = lane.heading_deg
        expected = (measured + 180.0) % 360.0
        text = f"traffic on {name} runs towards {measured:.0f}°, the map's lane the other way"
        return [
            Finding(
                "direction", name, lane.lane_id, line, measured, expected, 90.0, "",
                lane.confidence, text,
            )
        ]  # fmt: skip
    found = []
    shift = float(np.median(partners.offset_m[at]))
    sigma = lane.sigma_m if np.isfinite(lane.sigma_m) else SHIFT_M
    tolerance = float(np.hypot(SHIFT_M, SIGMAS * sigma))
    if abs(shift) > tolerance and _all_along(network, k, partners, at, shift):
        side = "left" if shift > 0 else "right"
        text = f"{name} lies {abs(shift):.2f} m too far to the {_other(side)}"
        confidence = lane.confidence * float(
            scipy.special.ndtr((abs(shift) - SHIFT_M) / max(sigma, 1e-3))
        )
        found.append(
            Finding(
                "shifted", name, lane.lane_id, line, shift, 0.0, tolerance, "m", confidence, text
            )
        )
    expected = float(network.width_m[k])
    sigma = lane.width_sigma_m if np.isfinite(lane.width_sigma_m) else WIDTH_M
    tolerance = float(np.hypot(WIDTH_M, SIGMAS * sigma))
    if np.isfinite(lane.width_m) and abs(lane.width_m - expected) > tolerance:
        text = f"{name} is {lane.width_m:.2f} m wide, by the map {expected:.2f} m"
        confidence = lane.confidence * float(
            scipy.special.ndtr((abs(lane.width_m - expected) - WIDTH_M) / max(sigma, 1e-3))
        )
        found.append(
            Finding(
                "width", name, lane.lane_id, line, lane.width_m, expected, tolerance, "m",
                confidence, text,
            )
        )  # fmt: skip
    return found


def _all_along(
    network: RoadNetwork, k: int, partners: Partners, at: NDArray[np.bool_], shift_m: float
) -> bool:
    """Whether lane k is displaced over its whole length; asked only where that matters.

    Where a lane ends or begins beside others that go on, vehicles change lanes over most of it: the
    traffic lies beside its middle, but not everywhere. So it must be displaced in every third.
    """
    group = [j for j, edge in enumerate(network.edge_id) if edge == network.edge_id[k]]
    links = (network.successors, network.predecessors)
    if not any(not link[k] and any(link[j] for j in group) for link in links):
        return True
    order = np.argsort(partners.arc_m[at])
    thirds = np.array_split(partners.offset_m[at][order], 3)
    return all(float(np.median(third)) * np.sign(shift_m) > SHIFT_M for third in thirds)


def _vehicles(lane: Lane) -> str:
    return f" ({lane.vehicles:.0f} vehicles)" if np.isfinite(lane.vehicles) else ""


def _edge(lane_id: str) -> str:
    return lane_id.rpartition("_")[0]


def _other(side: str) -> str:
    return "right" if side == "left" else "left"


def _missing(
    lane: Lane, d: int, network: RoadNetwork, beside: _Beside, partners: Partners
) -> list[Finding]:
    """Parts of a detected lane where the map has none, one finding for each edge beside it."""
    mine = np.flatnonzero(partners.detected == d)
    alone = (partners.lane[mine] < 0) & (partners.gap_m[mine] > BESIDE_SHARE)
    found = []
    for run in _runs(alone):
        neighbour = beside.neighbours(mine[run], network)
        edge = [network.edge_id[k] if k >= 0 else "" for k in neighbour.tolist()]
        for name in dict.fromkeys(edge):
            here = np.array([e == name for e in edge])
            xy = partners.xy[mine[run][here]]
            length_m = _length_of(xy)
            if length_m < MIN_LENGTH_M:
                continue
            lane_id = network.lane_id[int(np.bincount(neighbour[here]).argmax())] if name else ""
            where = f"beside {lane_id}" if name else "where it has no road"
            text = (
                f"lane {lane.lane_id}{_vehicles(lane)} is not in the map, {where}, "
                f"over {length_m:.0f} m"
            )
            found.append(
                Finding(
                    "missing", lane_id, lane.lane_id, xy, 1.0, 0.0, 0.0, "", lane.confidence, text
                )
            )  # fmt: skip
    return found


class _Beside:
    """Which lanes of the map run beside detected ones, in the same direction.

    Args:
        lines: Detected centre lines, aligned.
        network: The network.
        number: Which of its lanes to look at.
    """

    def __init__(
        self,
        lines: Sequence[NDArray[np.float64]],
        network: RoadNetwork,
        number: NDArray[np.int64],
    ) -> None:
        near = offsets(sample_lines(lines), [network.line(int(k)) for k in number])
        self._number = number
        self._away = np.where(near.along > 0.0, np.abs(near.offset_m), np.inf)
        self._away[:, network.internal[number]] = np.inf

    def neighbours(self, samples: NDArray[np.int64], network: RoadNetwork) -> NDArray[np.int64]:
        """(N,) for each of these samples the nearest lane within `BESIDE_M`, -1 for none.

        Where edges part, lanes of both are near: the edge beside most of the samples is taken.
        """
        away = self._away[samples]
        edge = np.array([network.edge_id[int(k)] for k in self._number])
        beside = away < BESIDE_M
        often = {e: int(beside[:, edge == e].any(axis=1).sum()) for e in dict.fromkeys(edge)}
        share = np.array([often[e] for e in edge]) / (len(samples) + 1.0)
        cost = np.where(beside, away / BESIDE_M - 2.0 * share, np.inf)
        best = np.argmin(cost, axis=1)
        rows = np.arange(len(best))
        return np.where(np.isfinite(cost[rows, best]), self._number[best], -1)


def _length(arc: NDArray[np.float64]) -> float:
    return float(np.ptp(arc)) if len(arc) else 0.0


def _length_of(xy: NDArray[np.float64]) -> float:
    return float(np.hypot(*np.diff(xy, axis=0).T).sum())


def _runs(flag: NDArray[np.bool_]) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(np.int8), [0]])))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
