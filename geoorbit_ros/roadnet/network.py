"""A road network as typed arrays in the map frame."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import CalibrationError, RoadNetworkError
from geoorbit_ros.roadnet.network_file import MOTOR_CLASSES, NetworkContent, read_network_file
from geoorbit_ros.roadnet.plane import NetworkPlane

NO_LANE = -1
"""No lane, where a lane's number is expected."""
USERS = {
    "hov": "full cars",
    "bus": "buses",
    "taxi": "taxis",
    "truck": "lorries",
    "delivery": "deliveries",
    "motorcycle": "motorcycles",
    "bicycle": "bicycles",
    "tram": "trams",
}
"""SUMO's classes in words."""


@dataclass(frozen=True)
class RoadNetwork:
    """All lanes of a network that road vehicles or bicycles may use, numbered in the file's order.

    Attributes:
        path: The network file.
        datum: Origin of the map frame.
        plane: Converts between the map frame and the network's own coordinates.
        lane_id: (L,) SUMO's ids.
        edge_id: (L,) of the edge of each lane.
        index: (L,) index in the edge, 0 the outermost: the rightmost, where traffic drives on the
            right.
        internal: (L,) whether the lane crosses a junction.
        width_m: (L,).
        speed_mps: (L,) speed limits.
        length_m: (L,) length of the centre line in the map frame.
        left: (L,) next lane to the left in the same edge, or `NO_LANE`.
        right: (L,) next lane to the right.
        start: (L + 1,) points of lane k are `point_m[start[k]:start[k + 1]]`.
        point_m: (P, 2) centre lines in travel order, map frame.
        successors: (L,) lanes that each lane leads into, internal ones included, but not those of
            turnarounds.
        turnarounds: (L,) lanes that each lane leads into only by turning round. netconvert lets
            traffic turn round at every dead end, so at every end of an extract.
        allowed: (L,) SUMO's vehicle classes that may use each lane.
        both_ways: (L,) whether a lane is the middle of the road, for turns from both sides; the
            other direction has one at the same place.
        left_hand: Whether traffic drives on the left.
    """

    path: Path
    datum: Datum
    plane: NetworkPlane
    lane_id: tuple[str, ...]
    edge_id: tuple[str, ...]
    index: NDArray[np.int64]
    internal: NDArray[np.bool_]
    width_m: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    length_m: NDArray[np.float64]
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    start: NDArray[np.int64]
    point_m: NDArray[np.float64]
    successors: tuple[tuple[int, ...], ...]
    turnarounds: tuple[tuple[int, ...], ...]
    allowed: tuple[frozenset[str], ...]
    both_ways: NDArray[np.bool_]
    left_hand: bool = False

    def __len__(self) -> int:
        return len(self.lane_id)

    def arc(self, lane: int) -> NDArray[np.float64]:
        """(K,) distance of each point of a lane from its beginning, along the lane; a view."""
        return self._arc_m[self.start[lane] : self.start[lane + 1]]

    def line(self, lane: int) -> NDArray[np.float64]:
        """(K, 2) centre line of one lane, a view."""
        return self.point_m[self.start[lane] : self.start[lane + 1]]

    def place_on(self, lane: int, xy: NDArray[np.float64]) -> float:
        """Metres along a lane's centre line to the point of it nearest to `xy` (2,)."""
        line, arc = self.line(lane), self.arc(lane)
        step = np.diff(line, axis=0)
        length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        along = np.clip(((xy - line[:-1]) * step).sum(axis=1) / length, 0.0, length)
        away = np.hypot(*(line[:-1] + (along / length)[:, None] * step - xy).T)
        k = int(np.argmin(away))
        return float(arc[k] + along[k])

    @cached_property
    def _arc_m(self) -> NDArray[np.float64]:
        step = np.hypot(*np.diff(self.point_m, axis=0).T)
        arc = np.append(0.0, np.cumsum(step))
        return np.asarray(arc - np.repeat(arc[self.start[:-1]], np.diff(self.start)))

    @cached_property
    def number(self) -> dict[str, int]:
        """Lane number by SUMO's lane id."""
        return {name: k for k, name in enumerate(self.lane_id)}

    def may_use(self, classes: Collection[str]) -> NDArray[np.bool_]:
        """(L,) whether vehicles of any of these SUMO classes may use each lane."""
        wanted = frozenset(classes)
        return np.array([not wanted.isdisjoint(allowed) for allowed in self.allowed])

    @cached_property
    def for_cars(self) -> NDArray[np.bool_]:
        """(L,) whether all cars may drive along each lane: not on bus lanes or in the middle."""
        return self.may_use({"passenger"}) & ~self.both_ways

    @cached_property
    def for_motors(self) -> NDArray[np.bool_]:
        """(L,) whether some motor vehicles may use each lane: not on cycle lanes."""
        return self.may_use(MOTOR_CLASSES) | self.both_ways

    def users(self, lane: int) -> str:
        """Who may use a lane, in words, e.g. `buses and taxis`; empty where all cars may."""
        if self.for_cars[lane]:
            return ""
        if self.both_ways[lane]:
            return "turns from both sides"
        named = [text for name, text in USERS.items() if name in self.allowed[lane]]
        return join_words(named) or "emergency vehicles"

    @cached_property
    def turns_round(self) -> NDArray[np.bool_]:
        """(L,) whether a lane is that of a turnaround inside a junction."""
        inside = {k for nexts in self.turnarounds for k in nexts if self.internal[k]}
        entered = {k for nexts in self.successors for k in nexts}
        return np.array([k in inside - entered for k in range(len(self))], dtype=np.bool_)

    @cached_property
    def straight_on(self) -> tuple[int, ...]:
        """(L,) of the lanes after each lane the one straight ahead; `NO_LANE` where none comes."""
        begin, end = (np.array([self._heading(k, at) for k in range(len(self))]) for at in (0, -1))
        ahead = np.where(self.internal, end, begin)  # a turn begins straight, and then turns

        def turn(lane: int, after: int) -> tuple[bool, float]:
            apart = (ahead[after] - end[lane] + np.pi) % (2.0 * np.pi) - np.pi
            return not self.for_motors[after], abs(float(apart))

        return tuple(
            min(nexts, key=partial(turn, lane), default=NO_LANE)
            for lane, nexts in enumerate(self.successors)
        )

    def _heading(self, lane: int, at: int) -> float:
        """Direction of a lane's first (0) or last (-1) piece, counter-clockwise from east."""
        x, y = np.diff(self.line(lane), axis=0)[at]
        return float(np.arctan2(y, x))

    @cached_property
    def lanes_of(self) -> Mapping[str, tuple[int, ...]]:
        """Lane numbers by edge."""
        found: dict[str, list[int]] = {}
        for lane, edge in enumerate(self.edge_id):
            found.setdefault(edge, []).append(lane)
        return {edge: tuple(lanes) for edge, lanes in found.items()}

    @cached_property
    def predecessors(self) -> tuple[tuple[int, ...], ...]:
        """(L,) lanes that lead into each lane."""
        before: list[list[int]] = [[] for _ in self.lane_id]
        for lane, nexts in enumerate(self.successors):
            for after in nexts:
                before[after].append(lane)
        return tuple(tuple(lanes) for lanes in before)


def load_network(path: str | Path, datum: Datum | None = None) -> RoadNetwork:
    """Read a SUMO network and lay it into the map frame.

    Args:
        path: A `.net.xml` or `.net.xml.gz` file with a projection.
        datum: Origin of the map frame; default: where the network's own coordinates are zero, if
            they are such a frame (`geoorbit map build` makes them so), else its middle.

    Raises:
        RoadNetworkError: A file that can't be used; in particular one without projection, whose
            location on earth is not known.
    """
    content = read_network_file(path)
    if not content.projection:
        raise RoadNetworkError(
            str(path),
            "a network without projection, anywhere on earth",
            "one with projParameter in its location (geoorbit map build makes it)",
        )
    points = np.concatenate([lane.shape for lane in content.lanes])
    low, high = points.min(axis=0), points.max(axis=0)
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    if datum is None and content.net_offset == (0.0, 0.0):
        datum = _own_datum(content.projection)
    if datum is None:
        datum = _middle(content.projection, content.net_offset, 0.5 * (low + high), str(path))
    plane = NetworkPlane(content.projection, content.net_offset, bounds, datum, str(path))
    return _assemble(Path(path), datum, plane, content)


def join_words(words: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def _own_datum(projection: str) -> Datum | None:
    """The datum whose map frame a projection is; None for any other projection."""
    values = dict(re.findall(r"\+(lat_0|lon_0)=(\S+)", projection))
    try:
        datum = Datum(float(values["lat_0"]), float(values["lon_0"]))
    except (KeyError, ValueError, CalibrationError):
        return None
    return datum if datum.proj_string == projection else None


def _middle(
    projection: str, net_offset: tuple[float, float], xy: NDArray[np.float64], place: str
) -> Datum:
    try:
        projected = Transformer.from_crs(CRS(projection), "EPSG:4326", always_xy=True)
        longitude, latitude = projected.transform(
            xy[0] - net_offset[0], xy[1] - net_offset[1], errcheck=True
        )
    except ProjError as error:
        expected = "a PROJ definition such as +proj=utm +zone=16"
        raise RoadNetworkError(place, f"projection '{projection}'", expected) from error
    # Seven decimals are a centimetre: a datum that can be written down.
    return Datum(round(float(latitude), 7), round(float(longitude), 7))


def _connections(
    pairs: Mapping[tuple[int, int], bool], internal: Sequence[bool]
) -> tuple[tuple[tuple[int, ...], ...], tuple[tuple[int, ...], ...]]:
    """Successors and turnarounds of each lane.

    A lane inside a junction that is entered by turnarounds only is a part of them.

    Args:
        pairs: By lane numbers (from, to), whether the file calls the connection a turnaround.
        internal: Of each lane.
    """
    ways: tuple[list[list[int]], list[list[int]]] = ([[] for _ in internal], [[] for _ in internal])
    entered = {b for (_, b), turns in pairs.items() if not turns}
    around = {b for (_, b), turns in pairs.items() if turns and internal[b]} - entered
    for (a, b), turns in pairs.items():
        ways[turns or a in around][a].append(b)
    successors, turnarounds = (tuple(map(tuple, way)) for way in ways)
    return successors, turnarounds


def _assemble(
    path: Path,
    datum: Datum,
    plane: NetworkPlane,
    content: NetworkContent,
) -> RoadNetwork:
    lanes = content.lanes
    number = {lane.lane_id: k for k, lane in enumerate(lanes)}
    by_place = {(lane.edge_id, lane.index): k for k, lane in enumerate(lanes)}
    pairs = {(number[k.source], number[k.target]): k.turns_round for k in content.links}
    successors, turnarounds = _connections(pairs, [lane.internal for lane in lanes])
    start = np.append(0, np.cumsum([len(lane.shape) for lane in lanes])).astype(np.int64)
    point_m = plane.to_map.points(np.concatenate([lane.shape for lane in lanes]))
    step = np.hypot(*np.diff(point_m, axis=0).T)
    arc = np.append(0.0, np.cumsum(step))
    length = arc[start[1:] - 1] - arc[start[:-1]]

    inwards = -1 if content.left_hand else 1

    def beside(shift: int) -> NDArray[np.int64]:
        return np.array([by_place.get((e.edge_id, e.index + shift), NO_LANE) for e in lanes])

    return RoadNetwork(
        path=path,
        datum=datum,
        plane=plane,
        lane_id=tuple(lane.lane_id for lane in lanes),
        edge_id=tuple(lane.edge_id for lane in lanes),
        index=np.array([lane.index for lane in lanes], dtype=np.int64),
        internal=np.array([lane.internal for lane in lanes]),
        width_m=np.array([lane.width_m for lane in lanes]),
        speed_mps=np.array([lane.speed_mps for lane in lanes]),
        length_m=length,
        left=beside(inwards),
        right=beside(-inwards),
        start=start,
        point_m=point_m,
        successors=successors,
        turnarounds=turnarounds,
        allowed=tuple(lane.allowed for lane in lanes),
        both_ways=np.array([lane.both_ways for lane in lanes], dtype=np.bool_),
        left_hand=content.left_hand,
    )
