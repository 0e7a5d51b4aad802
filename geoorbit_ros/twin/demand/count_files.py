"""Writes counted vehicles as SUMO's tools read them: counts, turns, detectors, vehicles.

Formats: SUMO user documentation, "routeSampler", "flowrouter", "Lane/Edge-based Traffic Measures",
and the schemas that SUMO ships (`datamode_file.xsd`, `meandata_file.xsd`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.mapcheck.lane_edges import LaneEdges
from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.traffic.interval_clock import NS
from geoorbit_ros.traffic.measures import COUNT_SIGMA
from geoorbit_ros.twin.demand.counted_ways import CountedVehicles, Detector
from geoorbit_ros.twin.demand.vehicle_types import (
    add_types,
    departure,
    speed_factors,
    type_names,
)
from geoorbit_ros.twin.demand.whole_counts import WholeCounts
from geoorbit_ros.twin.vehicles import TYPES

EDGE_DATA, LANE_DATA, TURNS, RELATIONS = "edgedata.xml", "lanedata.xml", "turns.xml", "od.xml"
DETECTORS, FLOWS = "detectors.add.xml", "flows.csv"
ROUTES, LANES = "routes.rou.xml", "lanes.csv"
BOUND_SIGMAS = 2.0
"""Bounds are so many sigma from the count: 95 % lie between them (normal distribution)."""
HEAVY = frozenset({"bus", "truck"})
"""Types that count as `LKW` in detector files."""


@dataclass(frozen=True, slots=True)
class SumoCounts:
    """What the files are made of.

    Attributes:
        edges: The camera's lanes on the network.
        vehicles: Who was counted.
        counts: How many per interval and way.
        detectors: Where.
        lane_sigma: (K, D) 1-sigma of the vehicles seen per interval and detector.
        zero_ns: Stamp of the simulation's time 0.
    """

    edges: LaneEdges
    vehicles: CountedVehicles
    counts: WholeCounts
    detectors: tuple[Detector, ...]
    lane_sigma: NDArray[np.float64]
    zero_ns: int

    @property
    def network(self) -> RoadNetwork:
        """The roads."""
        return self.edges.network

    def seconds(self, stamp_ns: int) -> float:
        """A stamp as the simulation's time."""
        return (stamp_ns - self.zero_ns) / NS

    def intervals(self) -> Iterator[tuple[int, float, float]]:
        """Number, beginning and end of each interval."""
        edges = [self.seconds(int(stamp)) for stamp in self.counts.edges_ns]
        yield from ((k, a, b) for k, (a, b) in enumerate(pairwise(edges)))


def write_counts(folder: Path, counts: SumoCounts) -> None:
    """Write all files into a folder.

    | file | |
    |---|---|
    | `edgedata.xml` | vehicles and speed per edge, with bounds: `routeSampler -d` |
    | `lanedata.xml` | the same per lane |
    | `turns.xml` | from edge to next edge: `routeSampler -t` |
    | `od.xml` | from the first edge to the last: `routeSampler -O` |
    | `detectors.add.xml`, `flows.csv` | counting places and flows: `flowrouter`, `dfrouter` |
    | `routes.rou.xml` | routes, types, lanes: `routeSampler -r`, with `--keep-attributes` |
    | `lanes.csv` | which lane of the camera is which of the network |
    """
    folder.mkdir(parents=True, exist_ok=True)
    places = _Places(counts)
    _save(_edge_data(counts, places), folder / EDGE_DATA)
    _save(_lane_data(counts, places), folder / LANE_DATA)
    ways = counts.vehicles.ways
    _save(_relations(counts, [list(pairwise(way.edges)) for way in ways]), folder / TURNS)
    ends = [[(way.edges[0], way.edges[-1])] for way in ways]
    _save(_relations(counts, ends), folder / RELATIONS)
    _save(_detector_file(counts), folder / DETECTORS)
    (folder / FLOWS).write_text(_flow_table(counts, places), encoding="utf-8")
    _save(_route_file(counts), folder / ROUTES)
    lines = ["lane_id,station_id,sumo_lane,position_m"]
    lines += [
        f"{d.lane_id},{d.station_id},{counts.network.lane_id[d.lane]},{d.position_m:.1f}"
        for d in counts.detectors
    ]
    (folder / LANES).write_text("\n".join([*lines, ""]), encoding="utf-8")


class _Places:
    """Counts, bounds and speeds per interval at the network's lanes that are counted.

    Attributes:
        lanes: The network's lanes with a detector, ordered.
        edges: Their edges, with the places of their lanes in `lanes`.
    """

    def __init__(self, source: SumoCounts) -> None:
        self._source = source
        self.lanes = sorted({d.lane for d in source.detectors})
        self.edges: dict[str, list[int]] = {}
        for place, lane in enumerate(self.lanes):
            self.edges.setdefault(source.network.edge_id[lane], []).append(place)
        at = {lane: place for place, lane in enumerate(self.lanes)}
        vehicles, counts = source.vehicles, source.counts
        self.uses = np.zeros((len(vehicles.ways), len(self.lanes)), np.int64)
        for k, way in enumerate(vehicles.ways):
            for lane in way.counted:
                self.uses[k, at[lane]] += 1
        self._seen, self._count = counts.seen @ self.uses, counts.count @ self.uses
        # A vehicle that crosses two stations on one edge is on it once.
        self._on_edge = {
            edge: self.uses[:, places].any(axis=1).astype(np.int64)
            for edge, places in self.edges.items()
        }
        variance = np.zeros(self._seen.shape)
        for d, detector in enumerate(source.detectors):
            variance[:, at[detector.lane]] += source.lane_sigma[:, d] ** 2
        unseen = self._count - self._seen
        self._variance = variance + unseen * counts.unseen_sigma[:, None] ** 2
        self._pace = self._slowness()

    def _slowness(self) -> NDArray[np.float64]:
        """(K, L, 2) sum of seconds per metre of the vehicles seen, and their number."""
        vehicles, counts = self._source.vehicles, self._source.counts
        found = np.zeros((*self._seen.shape, 2))
        interval = np.searchsorted(counts.edges_ns, vehicles.stamp_ns, side="right") - 1
        at = {lane: place for place, lane in enumerate(self.lanes)}
        first = np.array([at[way.counted[0]] for way in vehicles.ways], np.int64)[vehicles.way]
        kept = (interval >= 0) & (interval < len(found))
        cell = (interval[kept], first[kept])
        np.add.at(found[:, :, 0], cell, 1.0 / np.maximum(vehicles.speed_mps[kept], 0.1))
        np.add.at(found[:, :, 1], cell, 1.0)
        return found

    def of_edge(self, k: int, edge: str) -> dict[str, str]:
        """Attributes of SUMO's files for an edge in interval k."""
        counts, uses = self._source.counts, self._on_edge[edge]
        return self._values(
            k, self.edges[edge], int(counts.seen[k] @ uses), int(counts.count[k] @ uses)
        )

    def of_lane(self, k: int, place: int) -> dict[str, str]:
        """The same for a lane: vehicles and speed."""
        seen, count = int(self._seen[k, place]), int(self._count[k, place])
        values = self._values(k, [place], seen, count)
        return {name: values[name] for name in ("entered", "speed") if name in values}

    def _values(self, k: int, at: list[int], seen: int, entered: int) -> dict[str, str]:
        sigma = max(float(np.sqrt(self._variance[k, at].sum())), COUNT_SIGMA * entered)
        pace, vehicles = self._pace[k, at].sum(axis=0)
        found = {
            "entered": str(entered),
            "entered_low": str(int(np.ceil(max(entered - BOUND_SIGMAS * sigma, 0.0) - 1e-9))),
            "entered_high": str(int(np.floor(entered + BOUND_SIGMAS * sigma + 1e-9))),
            "seen": str(seen),
            "observed": f"{self._source.counts.observed[k]:.4f}",
        }
        return found | ({"speed": f"{vehicles / pace:.2f}"} if vehicles else {})

    def speed_kmh(self, k: int, place: int) -> float:
        """Space mean speed of the vehicles seen in one lane; 0 where none was, as SUMO has it."""
        pace, vehicles = self._pace[k, place]
        return 3.6 * float(vehicles / pace) if vehicles else 0.0


def _edge_data(source: SumoCounts, places: _Places) -> Xml.Element:
    root = Xml.Element("data")
    for k, begin, end in source.intervals():
        interval = _interval(root, "counted", begin, end)
        for edge in places.edges:
            Xml.SubElement(interval, "edge", {"id": edge, **places.of_edge(k, edge)})
    return root


def _lane_data(source: SumoCounts, places: _Places) -> Xml.Element:
    """Per lane: only what SUMO's schema of measured lanes has."""
    root, names = Xml.Element("meandata"), source.network.lane_id
    for k, begin, end in source.intervals():
        interval = _interval(root, "counted", begin, end)
        for edge, at in places.edges.items():
            element = Xml.SubElement(interval, "edge", id=edge)
            for place in at:
                values = places.of_lane(k, place)
                Xml.SubElement(element, "lane", {"id": names[places.lanes[place]], **values})
    return root


def _relations(source: SumoCounts, pairs: Sequence[list[tuple[str, str]]]) -> Xml.Element:
    """Vehicles from edge to edge.

    Args:
        source: The counts.
        pairs: Of each way, the pairs of edges that it counts for.
    """
    root = Xml.Element("data")
    every = sorted({pair for found in pairs for pair in found})
    for k, begin, end in source.intervals():
        interval, total = _interval(root, "counted", begin, end), Counter[tuple[str, str]]()
        for number, found in zip(source.counts.count[k].tolist(), pairs, strict=True):
            for pair in found:
                total[pair] += number
        for start, to in every:
            values = {"from": start, "to": to, "count": str(total[start, to])}
            Xml.SubElement(interval, "edgeRelation", values)
    return root


def _detector_file(source: SumoCounts) -> Xml.Element:
    root, edges = Xml.Element("additional"), source.counts.edges_ns
    period_s = int(np.diff(edges).min()) / NS
    for detector in source.detectors:
        Xml.SubElement(
            root,
            "e1Detector",
            id=_detector_name(source, detector),
            lane=source.network.lane_id[detector.lane],
            pos=f"{detector.position_m:.2f}",
            period=f"{period_s:g}",
            file="detected.xml",
            friendlyPos="true",
        )
    return root


def _detector_name(source: SumoCounts, detector: Detector) -> str:
    return f"station{detector.station_id}_{source.network.lane_id[detector.lane]}"


def _flow_table(source: SumoCounts, places: _Places) -> str:
    """SUMO's detector flows: minutes, cars and lorries per interval, km/h."""
    heavy = np.array([TYPES[way.kind].name in HEAVY for way in source.vehicles.ways], np.bool_)
    count = source.counts.count
    lorries = (count * heavy) @ places.uses
    cars = (count * ~heavy) @ places.uses
    lines, at = ["Detector;Time;qPKW;qLKW;vPKW;vLKW"], {k: p for p, k in enumerate(places.lanes)}
    for k, begin, _ in source.intervals():
        for detector in source.detectors:
            place = at[detector.lane]
            speed = f"{places.speed_kmh(k, place):.1f}"
            lines.append(
                f"{_detector_name(source, detector)};{begin / 60:g};{cars[k, place]};"
                f"{lorries[k, place]};{speed};{speed}"
            )
    return "\n".join([*lines, ""])


def _route_file(source: SumoCounts) -> Xml.Element:
    """Routes, types and lanes to sample from, one row per vehicle that was seen.

    They are flows without times, as routeSampler keeps the times of vehicles: it would draw one of
    the morning for the evening, and let it depart in the morning.
    """
    root, vehicles, network = Xml.Element("routes"), source.vehicles, source.network
    add_types(root, network, vehicles)
    names, factors = type_names(network, vehicles), speed_factors(vehicles)
    for k, number in enumerate(vehicles.way.tolist()):
        way = vehicles.ways[number]
        values = {"id": f"v{k + 1}", "type": names[number], "speedFactor": f"{factors[k]:.3f}"}
        flow = Xml.SubElement(root, "flow", values | departure(source.edges, way))
        Xml.SubElement(flow, "route", edges=" ".join(way.edges))
    return root


def _interval(root: Xml.Element, name: str, begin_s: float, end_s: float) -> Xml.Element:
    return Xml.SubElement(root, "interval", id=name, begin=f"{begin_s:.2f}", end=f"{end_s:.2f}")


def _save(root: Xml.Element, path: Path) -> None:
    Xml.indent(root)
    Xml.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
