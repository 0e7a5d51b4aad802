"""Counted traffic laid on a network: what all files of demand are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import NoTrafficError
from geoorbit_ros.mapcheck.lane_edges import LaneEdges, match_edges
from geoorbit_ros.roadnet.network import RoadNetwork, join_words
from geoorbit_ros.traffic.class_schemes import SCHEMES
from geoorbit_ros.traffic.count import Recorded, all_measures
from geoorbit_ros.traffic.interval_clock import CLOCK_SINCE_NS, DAY_S, NS, IntervalClock
from geoorbit_ros.twin.demand.count_files import SumoCounts
from geoorbit_ros.twin.demand.counted_ways import Detector, find_ways, place_detectors
from geoorbit_ros.twin.demand.whole_counts import whole_counts

LEAST_SHARE, HALF = 0.1, 0.5
"""Of intervals at either end of a recording of which one was watched by half, those that were
watched by less than a tenth are left out. Chosen: less makes whole intervals of single vehicles,
more leaves out minutes that were watched."""


@dataclass(frozen=True, slots=True)
class MeasuredDemand:
    """Counted traffic in a network.

    Attributes:
        counts: What the files are made of.
        edges: How the camera's lanes lie on the network.
        clock: The intervals.
    """

    counts: SumoCounts
    edges: LaneEdges
    clock: IntervalClock

    def sentences(self) -> list[str]:
        """What a user should know: lanes that the network lacks, time that was not watched."""
        found, vehicles = list[str](), self.counts.vehicles
        lanes = len(self.edges.stretches)
        found.append(
            f"{lanes - len(self.edges.missing)} of {lanes} lanes lie on lanes of the network; "
            f"{len(vehicles)} vehicles on {len({way.edges for way in vehicles.ways})} ways."
        )
        if self.edges.missing:
            names = join_words([str(lane) for lane in self.edges.missing])
            found.append(
                f"The network has no lane for lane {names}: {vehicles.beside_map} vehicles counted "
                "there are in no file (geoorbit twin patch adds lanes)."
            )
        elif vehicles.beside_map:
            found.append(f"{vehicles.beside_map} vehicles were counted beside the network's lanes.")
        return found + self._unwatched()

    def _unwatched(self) -> list[str]:
        counts = self.counts.counts
        filled = np.flatnonzero(counts.filled)
        if not len(filled):
            return []
        added = int(counts.count.sum() - counts.seen.sum())
        lines = [
            f"{added} of {counts.count.sum()} vehicles of the demand were not seen: the traffic "
            f"around fills {len(filled)} of {len(counts.observed)} intervals that were not watched "
            "to the end."
        ]
        dark = [k for k in filled.tolist() if counts.observed[k] == 0.0]
        if dark:
            runs = np.split(np.array(dark), np.flatnonzero(np.diff(dark) > 1) + 1)
            texts = [
                f"{self.clock.text(int(counts.edges_ns[run[0]]))} to "
                f"{self.clock.text(int(counts.edges_ns[run[-1] + 1]))}"
                for run in runs
            ]
            lines.append(f"Not watched at all: {join_words(texts)}.")
        return lines


def measure_demand(
    recorded: Recorded, network: RoadNetwork, clock: IntervalClock
) -> MeasuredDemand:
    """Lay counted traffic on a network.

    Args:
        recorded: The vehicles; counting is finished.
        network: In the map frame of their lanes.
        clock: The intervals.

    Raises:
        RoadNetworkError: The network lies elsewhere.
        NoTrafficError: No vehicle was counted in a lane of the network.
    """
    counter = recorded.counter
    edges = match_edges(counter.lanes, network)
    detectors = place_detectors(counter.lanes, counter.stations, edges)
    vehicles = find_ways(recorded.passages, recorded.crossings, detectors, edges)
    if not len(vehicles):
        found = f"{recorded.vehicles} vehicles, none counted in a lane of the network"
        raise NoTrafficError(str(network.path), found, "a network that covers what the camera sees")
    edges_ns = _worth_counting(clock.edges(recorded.first_ns, recorded.last_ns), recorded)
    counts = whole_counts(vehicles, recorded.observed, edges_ns)
    first_ns = int(edges_ns[0])
    zero_ns = 0
    if first_ns >= CLOCK_SINCE_NS:
        zero_ns = IntervalClock(DAY_S, clock.zone).start_of(first_ns)
    sigma = _lane_sigma(recorded, clock, detectors, edges_ns)
    return MeasuredDemand(
        SumoCounts(edges, vehicles, counts, detectors, sigma, zero_ns), edges, clock
    )


def _worth_counting(edges_ns: NDArray[np.int64], recorded: Recorded) -> NDArray[np.int64]:
    """Intervals without those at either end of which hardly anything was watched."""
    share = recorded.observed.seconds(edges_ns) * NS / np.diff(edges_ns)
    if share.max() < HALF:
        return edges_ns
    good = np.flatnonzero(share >= LEAST_SHARE)
    return edges_ns[good[0] : good[-1] + 2]


def _lane_sigma(
    recorded: Recorded,
    clock: IntervalClock,
    detectors: tuple[Detector, ...],
    edges_ns: NDArray[np.int64],
) -> NDArray[np.float64]:
    """(K, D) 1-sigma error of each lane's count."""
    found = np.zeros((len(edges_ns) - 1, len(detectors)))
    column = {detector.lane_id: d for d, detector in enumerate(detectors)}
    for table in all_measures(recorded, SCHEMES["coco"], clock):
        rows = table[(table["category"] == -1) & np.isin(table["lane_id"], list(column))]
        rows = rows[(rows["start_ns"] >= edges_ns[0]) & (rows["start_ns"] < edges_ns[-1])]
        interval = np.searchsorted(edges_ns, rows["start_ns"])
        found[interval, [column[lane] for lane in rows["lane_id"].tolist()]] = rows["volume_sigma"]
    return found
