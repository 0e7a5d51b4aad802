"""Vehicle types on the imagined roads: sizes, and how a detector calls them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class VehicleType:
    """Mean size in metres with its relative spread, COCO class, SUMO's vClass, relative speed."""

    length_m: float
    width_m: float
    height_m: float
    spread: float
    coco_class: int
    vclass: str
    speed_factor: float


VEHICLE_TYPES: dict[str, VehicleType] = {
    # Sizes: typical European and North American fleets (AASHTO design vehicles P, SU, WB, BUS).
    "car": VehicleType(4.5, 1.82, 1.47, 0.05, 2, "passenger", 1.0),
    "suv": VehicleType(4.8, 1.95, 1.75, 0.05, 2, "passenger", 1.0),
    "van": VehicleType(5.6, 2.0, 2.3, 0.08, 2, "delivery", 0.97),
    "truck": VehicleType(9.0, 2.5, 3.4, 0.08, 7, "truck", 0.88),
    "semitrailer": VehicleType(16.5, 2.55, 4.0, 0.03, 7, "trailer", 0.85),
    "bus": VehicleType(12.0, 2.55, 3.2, 0.04, 5, "bus", 0.9),
    "motorcycle": VehicleType(2.2, 0.8, 1.5, 0.05, 3, "motorcycle", 1.05),
}
