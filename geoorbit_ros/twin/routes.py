"""Writes the traffic that was seen as SUMO's demand: route and type files for plain `sumo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.polylines import project
from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.roadnet.routing import RouteFinder
from geoorbit_ros.twin.placement import TwinStep
from geoorbit_ros.twin.vehicles import FREE, TYPES, add_free_type, add_type, may_drive

ROUTES, TYPE_FILE, CONFIG = "traffic.rou.xml", "traffic.add.xml", "traffic.sumocfg"
MIN_DRIVEN_M = 20.0
"""Vehicles seen over less are left out. Chosen: neither lane nor speed of such a vehicle is known,
and it may be a false track; larger loses vehicles at the border of the view."""
SPEED_FACTOR_BOUNDS = (0.2, 2.0)
"""Of speed over limit. Chosen: slower is a queue, faster a wrong track or a wrong limit; wider
passes them on to SUMO's drivers."""
SPEED_S = 1.0
"""A vehicle departs with its mean speed over this time, and is measured in such steps. Chosen:
shorter adds up the noise of positions, longer hides that it brakes."""


@dataclass(slots=True)
class _Seen:
    """What is kept of a vehicle: where it began, and what it drove up to `end_s`."""

    begin_s: float
    lane: int
    xy: NDArray[np.float64]
    edges: list[str]
    end_s: float
    last_s: float
    last_xy: NDArray[np.float64]
    kind: int = 0
    length_m: float = 0.0
    speed_mps: float = 0.0
    driven_m: float = 0.0
    limit_m: float = 0.0
    measured_m: float = 0.0


@dataclass(frozen=True, slots=True)
class RouteCounts:
    """Vehicles written, and those left out: seen too short, or without a route between edges."""

    written: int
    too_short: int
    no_route: int


class RouteWriter:
    """Collects the twin's steps, then writes their traffic as demand.

    A vehicle departs when and where it entered the twin, in its lane, at its speed, and drives the
    edges on which it was seen. Its `speedFactor` is its own mean speed over that of the limits.

    Args:
        network: The roads.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self._network = network
        self._seen: dict[int, _Seen] = {}
        self._start_ns: int | None = None

    def add(self, step: TwinStep) -> None:
        """Take one step; vehicles that no camera sees are left out."""
        if self._start_ns is None:
            self._start_ns = step.stamp_ns
        time_s = (step.stamp_ns - self._start_ns) * 1e-9
        network = self._network
        for vehicle, since_ns in step.false_since_ns.items():
            seen = self._seen.get(vehicle)
            # One that drove before is a vehicle: its track went on with something else.
            if seen is not None and (since_ns - self._start_ns) * 1e-9 <= seen.begin_s:
                del self._seen[vehicle]
        kept = step.observed & (step.lane != NO_LANE) & np.isfinite(step.xy[:, 0])
        for k in np.flatnonzero(kept).tolist():
            lane, xy = int(step.lane[k]), step.xy[k]
            seen = self._seen.get(int(step.vehicle_id[k]))
            if seen is None:
                if network.internal[lane]:
                    continue  # it departs from the edge after the junction
                edges = [network.edge_id[lane]]
                seen = _Seen(time_s, lane, xy, edges, time_s, time_s, xy)
                self._seen[int(step.vehicle_id[k])] = seen
            elif not network.internal[lane] and network.edge_id[lane] != seen.edges[-1]:
                seen.edges.append(network.edge_id[lane])
            seen.limit_m += float(network.speed_mps[lane]) * (time_s - seen.last_s)
            seen.last_s = time_s
            if time_s >= seen.end_s + SPEED_S:
                # Second by second: step by step, the noise of positions would add up.
                driven = float(np.hypot(*(xy - seen.last_xy)))
                if seen.driven_m == 0.0:
                    seen.speed_mps = driven / (time_s - seen.end_s)
                seen.driven_m += driven
                seen.measured_m = seen.limit_m
                seen.end_s, seen.last_xy = time_s, xy
            seen.kind, seen.length_m = int(step.kind[k]), float(step.size_m[k, 0])

    def write(self, folder: Path, network_file: str) -> RouteCounts:
        """Write `traffic.rou.xml`, `traffic.add.xml` and `traffic.sumocfg` into a folder.

        Args:
            folder: Where the files go.
            network_file: Path of the network, as the configuration shall name it.
        """
        routes, finder = Xml.Element("routes"), RouteFinder(self._network)
        factors: dict[int, list[float]] = {}
        may, lanes_of = may_drive(self._network), self._network.lanes_of
        too_short = no_route = written = 0
        for number, seen in sorted(self._seen.items(), key=lambda item: item[1].begin_s):
            if seen.driven_m < MIN_DRIVEN_M:
                too_short += 1
                continue
            edges = finder.complete(seen.edges)
            if edges is None:
                no_route += 1
                continue
            factor = float(np.clip(seen.driven_m / max(seen.measured_m, 1.0), *SPEED_FACTOR_BOUNDS))
            factors.setdefault(seen.kind, []).append(factor)
            able = may[seen.kind]
            inside = able[seen.lane] and all(able[list(lanes_of[edge])].any() for edge in edges)
            name = TYPES[seen.kind].name + ("" if inside else FREE)
            _add_vehicle(routes, number, seen, edges, factor, name, self._network)
            written += 1
        additional = Xml.Element("additional")
        for kind, values in sorted(factors.items()):
            mean, spread = float(np.mean(values)), float(np.std(values))
            text = f"normc({mean:.3f},{spread:.3f},{min(values):.3f},{max(values):.3f})"
            add_type(additional, TYPES[kind].name, TYPES[kind], speedFactor=text)
            add_free_type(additional, TYPES[kind], speedFactor=text)
        _save(routes, folder / ROUTES)
        _save(additional, folder / TYPE_FILE)
        _save(_config(network_file), folder / CONFIG)
        return RouteCounts(written, too_short, no_route)


def _add_vehicle(
    routes: Xml.Element,
    number: int,
    seen: _Seen,
    edges: list[str],
    factor: float,
    type_name: str,
    network: RoadNetwork,
) -> None:
    arc = float(project(seen.xy[None], network.line(seen.lane)).arc_m[0]) + 0.5 * seen.length_m
    position = min(arc, float(network.length_m[seen.lane]) - 0.1)
    vehicle = Xml.SubElement(
        routes,
        "vehicle",
        id=f"v{number}",
        type=type_name,
        depart=f"{seen.begin_s:.2f}",
        departLane=str(network.index[seen.lane]),
        departPos=f"{position:.2f}",
        departSpeed=f"{seen.speed_mps:.2f}",
        speedFactor=f"{factor:.3f}",
        insertionChecks="collision",
    )
    Xml.SubElement(vehicle, "route", edges=" ".join(edges))


def _config(network_file: str) -> Xml.Element:
    root = Xml.Element("configuration")
    files = Xml.SubElement(root, "input")
    for name, value in (
        ("net-file", network_file),
        ("route-files", ROUTES),
        ("additional-files", TYPE_FILE),
    ):
        Xml.SubElement(files, name, value=value)
    Xml.SubElement(Xml.SubElement(root, "time"), "step-length", value="0.1")
    return root


def _save(root: Xml.Element, path: Path) -> None:
    Xml.indent(root)
    Xml.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
