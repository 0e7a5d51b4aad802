"""The vehicles of the twin: their SUMO types, and a table with one slot per vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.roadnet.network_file import CARS


@dataclass(frozen=True, slots=True)
class TwinVehicleType:
    """SUMO's `vType` for vehicles of a COCO class: `vClass`, `guiShape`, size in metres."""

    name: str
    vclass: str
    shape: str
    length_m: float
    width_m: float
    height_m: float
    coco_class: int
    plural: str


TYPES: tuple[TwinVehicleType, ...] = (
    TwinVehicleType("car", "passenger", "passenger", 4.7, 1.85, 1.5, 2, "cars"),
    TwinVehicleType("motorcycle", "motorcycle", "motorcycle", 2.2, 0.8, 1.5, 3, "motorcycles"),
    TwinVehicleType("bus", "bus", "bus", 12.0, 2.55, 3.2, 5, "buses"),
    TwinVehicleType("truck", "truck", "truck", 9.0, 2.5, 3.4, 7, "trucks"),
    TwinVehicleType("bicycle", "bicycle", "bicycle", 1.8, 0.6, 1.6, 1, "bicycles"),
)
"""Sizes: AASHTO design vehicles, rounded to common ones; a track's own size is preferred."""
USED_AS = {
    "passenger": CARS,
    "motorcycle": frozenset({"motorcycle", "moped"}),
    "bus": frozenset({"bus", "coach"}),
    "truck": frozenset({"truck", "trailer", "delivery"}),
    "bicycle": frozenset({"bicycle"}),
}
"""SUMO's classes that a vehicle of a type may be: a camera does not see whether a car is full."""
CAR = 0
"""Number of the type of objects that are no vehicles."""
FREE = "_in_any_lane"
"""End of the names of types that SUMO lets drive in every lane (its class `ignoring`)."""
BICYCLE = next(k for k, kind in enumerate(TYPES) if kind.name == "bicycle")
"""Number of the type of bicycles."""
LENGTH_BOUNDS_M, WIDTH_BOUNDS_M = (1.5, 25.0), (0.5, 3.0)
"""Tracked sizes outside are replaced by the type's. Chosen: from a bicycle to a lorry with trailer;
wider passes on boxes of two vehicles."""


def type_of_class(class_id: NDArray[np.int32]) -> NDArray[np.int64]:
    """(M,) number in `TYPES` of COCO classes; other classes count as cars."""
    number = np.full(256, CAR)
    for k, kind in enumerate(TYPES):
        number[kind.coco_class] = k
    return np.asarray(number[np.clip(class_id, 0, 255)], dtype=np.int64)


def may_drive(network: RoadNetwork) -> NDArray[np.bool_]:
    """(T, L) whether vehicles of each type may drive in each lane of a network."""
    return np.array([network.may_use(USED_AS[kind.vclass]) | network.both_ways for kind in TYPES])


def add_free_type(root: Xml.Element, kind: TwinVehicleType, **values: str) -> None:
    """Add the type of vehicles that were seen in lanes that are not for them."""
    add_type(root, kind.name + FREE, kind, **{"vClass": "ignoring", **values})


def write_types(path: Path) -> None:
    """Write SUMO's `additional` file with all types of the running twin.

    There vehicles are where they are seen, whoever may use the lane (SUMO's class `ignoring`).
    """
    root = Xml.Element("additional")
    for kind in TYPES:
        add_type(root, kind.name, kind, vClass="ignoring")
    Xml.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def add_type(root: Xml.Element, name: str, kind: TwinVehicleType, **values: str) -> None:
    """Add a `vType`; `values` replace or extend its attributes."""
    Xml.SubElement(
        root,
        "vType",
        {
            "id": name,
            "vClass": kind.vclass,
            "guiShape": kind.shape,
            "length": f"{kind.length_m:g}",
            "width": f"{kind.width_m:g}",
            "height": f"{kind.height_m:g}",
            # 252 km/h: vehicles are moved by their tracks, never slowed by their type.
            "maxSpeed": "70",
            **values,
        },
    )


VEHICLE_DTYPE = np.dtype(
    [
        ("vehicle_id", "<i8"),
        ("xy", "<f8", 2),
        ("velocity", "<f8", 2),
        ("heading", "<f8"),
        ("course", "<f8"),
        ("sigma", "<f8"),
        ("length", "<f8"),
        ("width", "<f8"),
        ("kind", "<i8"),
        ("votes", "<f8", len(TYPES)),
        ("seen_ns", "<i8"),
        ("observed", "?"),
        ("predicted", "?"),
        ("cameras", "<i8"),
        ("possible_mps", "<f8"),
        ("slow_s", "<f8"),
        ("entry", "<f8", 2),
        ("entry_ns", "<i8"),
        ("anchor", "<f8", 2),
        ("anchor_ns", "<i8"),
        ("lane", "<i8"),
        ("arc", "<f8"),
        ("offset", "<f8"),
        ("within", "?"),
        ("entered", "?"),
        ("sim_kind", "<i8"),
        ("sim_length", "<f8"),
        ("sim_width", "<f8"),
        ("active", "?"),
    ]
)
"""State of a vehicle. `xy` is the middle of its footprint in the map frame, `heading` as tracked,
`course` as driven (`synchronizer.plausible_course`); `kind` is a number in `TYPES`; `observed`: a
track has it in this step, `predicted`: only as a prediction; `cameras`: how many see it;
`possible_mps`: the least speed that braking allows, `slow_s`: how long it has been far below,
`entry…`: where and when it entered, `anchor…`: where and since when it stands (`false_tracks`);
`within`: between the borders of its lane; `entered`: whether SUMO has it, `sim_…`: its type and
size there."""

_MEMORY = 0.98
"""Weight that class votes keep from step to step: half is left after 3.4 s at 10 Hz. Chosen: larger
corrects a wrong class later, smaller changes types with every few boxes."""
_LEAD = 4.0
"""Votes by which another class must lead to replace the type. Chosen: larger corrects a wrong type
later, smaller lets single wrong boxes change it."""


class Vehicles:
    """All vehicles of the twin; slots are used again, vehicle ids never.

    Attributes:
        table: (S,) `VEHICLE_DTYPE`, S slots.
    """

    def __init__(self, capacity: int = 64) -> None:
        self.table = np.zeros(capacity, VEHICLE_DTYPE)
        self._next_id = 1

    @property
    def slots(self) -> NDArray[np.int64]:
        """(M,) slots in use."""
        return np.flatnonzero(self.table["active"])

    def enter(self, count: int) -> NDArray[np.int64]:
        """Slots (count,) for new vehicles with new ids."""
        free = np.flatnonzero(~self.table["active"])
        if len(free) < count:
            size = len(self.table)
            more = np.zeros(max(size, count), VEHICLE_DTYPE)
            self.table = np.concatenate([self.table, more])
            free = np.append(free, np.arange(size, size + len(more)))
        slot = free[:count]
        fresh = np.zeros(count, VEHICLE_DTYPE)
        fresh["vehicle_id"] = np.arange(self._next_id, self._next_id + count)
        fresh["active"], fresh["lane"], fresh["kind"] = True, NO_LANE, NO_LANE
        fresh["heading"] = fresh["course"] = np.nan
        self._next_id += count
        self.table[slot] = fresh
        return slot

    def leave(self, slot: NDArray[np.int64]) -> None:
        """Free these slots."""
        self.table["active"][slot] = False

    def vote(self, slot: NDArray[np.int64], kind: NDArray[np.int64]) -> None:
        """Add one vote for the type of each vehicle; the leading type becomes its type.

        Args:
            slot: (M,) vehicles, which may repeat.
            kind: (M,) numbers in `TYPES`.
        """
        votes = self.table["votes"]
        votes[slot] *= _MEMORY
        np.add.at(votes, (slot, kind), 1.0)
        kind_now, now = self.table["kind"][slot], votes[slot]
        leader, row = np.argmax(now, axis=1), np.arange(len(slot))
        lead = now[row, leader] - now[row, np.maximum(kind_now, 0)]
        self.table["kind"][slot] = np.where((kind_now < 0) | (lead > _LEAD), leader, kind_now)


def usual_size(
    kind: NDArray[np.int64], length: NDArray[np.float64], width: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length and width (M,) as tracked, or of the type where those are impossible."""
    usual = np.array([(k.length_m, k.width_m) for k in TYPES])[kind]
    long = (length >= LENGTH_BOUNDS_M[0]) & (length <= LENGTH_BOUNDS_M[1])
    wide = (width >= WIDTH_BOUNDS_M[0]) & (width <= WIDTH_BOUNDS_M[1])
    return np.where(long, length, usual[:, 0]), np.where(wide, width, usual[:, 1])
