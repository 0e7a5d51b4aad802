"""Vehicle types of the twin by the detector's class, and SUMO's file of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class TwinVehicleType:
    """How SUMO imagines vehicles of a class: name, SUMO's vClass and shape, size in metres."""

    name: str
    vclass: str
    shape: str
    length_m: float
    width_m: float
    height_m: float
    coco_class: int


TYPES: tuple[TwinVehicleType, ...] = (
    # Sizes: AASHTO design vehicles and typical fleets; a track's own size goes before them.
    TwinVehicleType("car", "passenger", "passenger", 4.7, 1.85, 1.5, 2),
    TwinVehicleType("motorcycle", "motorcycle", "motorcycle", 2.2, 0.8, 1.5, 3),
    TwinVehicleType("bus", "bus", "bus", 12.0, 2.55, 3.2, 5),
    TwinVehicleType("truck", "truck", "truck", 9.0, 2.5, 3.4, 7),
    TwinVehicleType("bicycle", "bicycle", "bicycle", 1.8, 0.6, 1.6, 1),
)
CAR = 0
LENGTH_BOUNDS_M = (1.5, 25.0)
WIDTH_BOUNDS_M = (0.5, 3.0)


def type_of_class(class_id: NDArray[np.int32]) -> NDArray[np.int64]:
    """(M,) number in `TYPES` of COCO classes; what is no vehicle counts as a car."""
    number = np.full(256, CAR)
    for k, kind in enumerate(TYPES):
        number[kind.coco_class] = k
    return np.asarray(number[np.clip(class_id, 0, 255)], dtype=np.int64)


def write_types(path: Path) -> None:
    """SUMO's `additional` file with all types."""
    root = Xml.Element("additional")
    for kind in TYPES:
        add_type(root, kind.name, kind)
    Xml.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def add_type(root: Xml.Element, name: str, kind: TwinVehicleType, **values: str) -> None:
    """One `vType` of a class; `values` go before its own."""
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
            # The twin follows the road, whatever the driver does.
            "maxSpeed": "70",
            **values,
        },
    )
