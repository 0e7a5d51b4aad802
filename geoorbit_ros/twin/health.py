"""How well the twin follows its tracks: errors and delays over a number of steps."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.vehicles import TYPES, may_drive

POSITION_LIMIT_M, HEADING_LIMIT_DEG, LANE_LIMIT = 0.05, 1.0, 0.005
"""Errors beyond these are reported as faults. Chosen: vehicles are put where their tracks are, so
that errors are about zero; a larger one is a fault of SUMO or of its network."""


RESERVED_S = 1.0
"""A vehicle is in a lane that is not for it after this time. Chosen: shorter counts vehicles that
touch the line, longer misses those that cross it."""


@dataclass(frozen=True, slots=True)
class HealthReport:
    """Figures of some steps. Errors are between SUMO's vehicles and the fused tracks.

    Attributes:
        stamp_ns: Time of the last step.
        steps: How many steps.
        vehicles: In the twin at the last step.
        vehicle_steps: Vehicles that a camera saw, summed over the steps.
        unseen_steps: The same for vehicles that no camera saw.
        position_error_m_p95, position_error_m_max: Of the middle of the footprint.
        heading_error_deg_p95, heading_error_deg_max: Of the heading.
        lane_error_share: Share of vehicle steps in another lane than the tracks say.
        beside_share: Share of vehicle steps outside all lanes.
        overlapping_steps: Vehicle pairs nearer than 1 m, summed over the steps.
        lost: Vehicles that SUMO took away and that were put back.
        step_ms_median, step_ms_p99: Time that a step took.
        steps_per_s: By the mean of that time.
        latency_ms_median, latency_ms_p99: From a frame's arrival to the twin; NaN if not
            measured.
    """

    stamp_ns: int
    steps: int
    vehicles: int
    vehicle_steps: int
    unseen_steps: int
    position_error_m_p95: float
    position_error_m_max: float
    heading_error_deg_p95: float
    heading_error_deg_max: float
    lane_error_share: float
    beside_share: float
    overlapping_steps: int
    lost: int
    step_ms_median: float
    step_ms_p99: float
    steps_per_s: float
    latency_ms_median: float
    latency_ms_p99: float

    @property
    def faults(self) -> list[str]:
        """Faults as sentences; none where all is well."""
        found = []
        if self.position_error_m_p95 > POSITION_LIMIT_M:
            found.append(f"vehicles are {self.position_error_m_p95:.2f} m from their tracks (95 %)")
        if self.heading_error_deg_p95 > HEADING_LIMIT_DEG:
            found.append(f"headings are {self.heading_error_deg_p95:.1f} degrees off (95 %)")
        if self.lane_error_share > LANE_LIMIT:
            found.append(f"{self.lane_error_share:.1%} of the vehicles are in another lane")
        if self.lost:
            found.append(f"SUMO took {self.lost} vehicles away")
        return found

    def values(self) -> dict[str, float | int]:
        """All figures by name."""
        return asdict(self) | {"coasting_steps": self.unseen_steps}  # its old name, until 0.2.0


class ReservedLanes:
    """Counts vehicles in lanes that the map keeps for others: cars on a bus lane.

    They stay where they are seen. Lanes inside junctions don't count.

    Args:
        network: The lanes.

    Attributes:
        vehicles: How many by type and lane, each vehicle once per lane.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._closed = ~may_drive(network) & ~network.internal
        self._since_ns: dict[tuple[int, int], int] = {}
        self._counted: set[tuple[int, int]] = set()
        self.vehicles: Counter[tuple[int, int]] = Counter()

    def add(self, step: TwinStep) -> None:
        """Take one step."""
        there = step.observed & (step.lane != NO_LANE)
        at = np.flatnonzero(there & self._closed[np.maximum(step.kind, 0), step.lane])
        if not len(at) and not self._since_ns and not self._counted:
            return
        now = {(int(step.vehicle_id[k]), int(step.lane[k])): int(step.kind[k]) for k in at}
        self._since_ns = {key: self._since_ns.get(key, step.stamp_ns) for key in now}
        present = set(step.vehicle_id.tolist())
        self._counted = {key for key in self._counted if key[0] in present}
        for key, begin_ns in self._since_ns.items():
            if step.stamp_ns - begin_ns >= RESERVED_S * 1e9 and key not in self._counted:
                self._counted.add(key)
                self.vehicles[now[key], key[1]] += 1

    def sentences(self) -> list[str]:
        """What was counted, a sentence per type and lane."""
        return [
            f"{count} {TYPES[kind].name if count == 1 else TYPES[kind].plural} drove along "
            f"{self._network.lane_id[lane]}, which the map keeps for {self._network.users(lane)}; "
            "the twin has them there."
            for (kind, lane), count in sorted(self.vehicles.items(), key=lambda item: item[0][::-1])
        ]

    def values(self) -> dict[str, dict[str, int]]:
        """The counts by lane and type, for JSON."""
        found: dict[str, dict[str, int]] = {}
        for (kind, lane), count in sorted(self.vehicles.items(), key=lambda item: item[0][::-1]):
            found.setdefault(self._network.lane_id[lane], {})[TYPES[kind].name] = count
        return found


class HealthWindow:
    """Collects steps until they are reported."""

    def __init__(self) -> None:
        self._steps: list[TwinStep] = []
        self._position: list[NDArray[np.float64]] = []
        self._heading: list[NDArray[np.float64]] = []
        self._latency_s: list[float] = []
        self._observed = self._unseen = self._wrong = self._known = self._beside = 0
        self._overlapping = self._lost = self._vehicles = 0
        self._cost_s: list[float] = []
        self._stamp_ns = 0

    def add(self, step: TwinStep) -> None:
        """Take one step."""
        seen = step.observed
        gone = np.isnan(step.xy[:, 0])
        kept = seen & ~gone
        error = step.xy[kept] - step.wanted_xy[kept]
        self._position.append(np.hypot(error[:, 0], error[:, 1]))
        turn = step.heading_rad[kept] - step.wanted_heading_rad[kept]
        self._heading.append(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))
        known = kept & (step.wanted_lane != NO_LANE)
        self._known += int(np.count_nonzero(known))
        self._wrong += int(np.count_nonzero(step.lane[known] != step.wanted_lane[known]))
        self._beside += int(np.count_nonzero(kept & (step.wanted_lane == NO_LANE)))
        self._observed += int(np.count_nonzero(seen))
        self._unseen += int(np.count_nonzero(~seen))
        self._overlapping += overlapping_pairs(step.xy[~gone])
        self._lost += int(np.count_nonzero(gone))
        self._vehicles, self._stamp_ns = len(step.xy), step.stamp_ns
        self._cost_s.append(step.cost_s)

    def add_latency(self, latency_s: float) -> None:
        """Take the time from the arrival of a frame to the published twin."""
        self._latency_s.append(latency_s)

    def report(self) -> HealthReport:
        """Figures of the steps since the last report."""
        position = np.concatenate([np.empty(0), *self._position])
        heading = np.degrees(np.concatenate([np.empty(0), *self._heading]))
        cost_ms = 1e3 * np.array(self._cost_s)
        latency_ms = 1e3 * np.array(self._latency_s)
        mean_ms = float(cost_ms.mean()) if len(cost_ms) else float("nan")
        report = HealthReport(
            stamp_ns=self._stamp_ns,
            steps=len(self._cost_s),
            vehicles=self._vehicles,
            vehicle_steps=self._observed,
            unseen_steps=self._unseen,
            position_error_m_p95=_quantile(position, 0.95),
            position_error_m_max=_quantile(position, 1.0),
            heading_error_deg_p95=_quantile(heading, 0.95),
            heading_error_deg_max=_quantile(heading, 1.0),
            lane_error_share=self._wrong / max(self._known, 1),
            beside_share=self._beside / max(self._observed, 1),
            overlapping_steps=self._overlapping,
            lost=self._lost,
            step_ms_median=_quantile(cost_ms, 0.5),
            step_ms_p99=_quantile(cost_ms, 0.99),
            steps_per_s=1e3 / mean_ms if mean_ms > 0 else float("nan"),
            latency_ms_median=_quantile(latency_ms, 0.5),
            latency_ms_p99=_quantile(latency_ms, 0.99),
        )
        self.__init__()  # type: ignore[misc]  # a window starts empty
        return report


def overlapping_pairs(xy: NDArray[np.float64], apart_m: float = 1.0) -> int:
    """Pairs of points (M, 2) nearer than `apart_m`: one vehicle twice, or a false track."""
    if len(xy) < 2:
        return 0
    # Sorted by one coordinate, near pairs are few steps apart: no M x M table.
    ordered = xy[np.argsort(xy[:, 0])]
    found, shift = 0, 1
    while shift < len(ordered):
        gap = ordered[shift:] - ordered[:-shift]
        close = gap[:, 0] < apart_m
        if not close.any():
            break
        found += int(np.count_nonzero(close & (np.hypot(gap[:, 0], gap[:, 1]) < apart_m)))
        shift += 1
    return found


def _quantile(values: NDArray[np.float64], share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")
