"""Cars, vans, lorries, buses and motorcycles as solids."""

from __future__ import annotations

from functools import lru_cache

from geoorbit_ros.core.tables import BUS, MOTORCYCLE, TRUCK
from geoorbit_ros.rendering.solid import Material, Solid, SolidBuilder

SUV_HEIGHT_M = 1.62
"""From this height on a car is drawn as an SUV: between the two of `VEHICLE_TYPES`."""
VAN_HEIGHT_M = 2.02
"""From this height on a car is drawn as a van: between the two of `VEHICLE_TYPES`."""
SEMITRAILER_LENGTH_M = 12.5
"""From this length on a truck is drawn with a trailer: between the two of `VEHICLE_TYPES`."""

P, G, D, C = Material.PAINT, Material.GLASS, Material.DARK, Material.CARGO


@lru_cache(maxsize=4096)
def vehicle_solid(coco_class: int, length_m: float, width_m: float, height_m: float) -> Solid:
    """The solid of a vehicle; it touches all sides of its length, width and height."""
    builder = SolidBuilder(length_m, width_m, height_m)
    if coco_class == TRUCK and length_m >= SEMITRAILER_LENGTH_M:
        _lorry(builder, cab_m=2.3, gap_m=0.9, axles=(-0.43, -0.36, -0.29, 0.19, 0.41))
    elif coco_class == TRUCK:
        _lorry(builder, cab_m=2.0, gap_m=0.25, axles=(-0.30, 0.38))
    elif coco_class == BUS:
        _bus(builder)
    elif coco_class == MOTORCYCLE:
        _motorcycle(builder)
    elif height_m < SUV_HEIGHT_M:
        _car(builder, roof=(-0.27, 0.06), belt=(-0.46, 0.27), nose=0.66)
    elif height_m < VAN_HEIGHT_M:
        _car(builder, roof=(-0.44, 0.05), belt=(-0.495, 0.24), nose=0.72)
    else:
        _van(builder)
    return builder.solid()


def _car(
    b: SolidBuilder, roof: tuple[float, float], belt: tuple[float, float], nose: float
) -> None:
    """A body with a cabin on it."""
    radius = 0.33 / b.size[2]
    sill, waist = 0.42 * radius, 0.60
    b.part(0)
    b.box((-0.46, 0.46), 0.44, (0.02, 1.3 * radius), D)
    b.part(1)
    body = [
        (-0.485, sill, 0.47),
        (-0.5, 0.34, 0.485),
        (-0.485, 0.56, 0.49),
        (belt[0] - 0.005, waist, 0.495),
        (belt[1], waist, 0.495),
        (0.455, nose * waist + 0.06, 0.47),
        (0.5, 0.30, 0.455),
        (0.485, sill, 0.45),
    ]
    b.prism(body, [P, P, P, P, P, P, P], P)
    _car_ends(b)
    b.part(2)
    inner = 0.40
    cabin = [(belt[0], waist, 0.49), (roof[0], 1.0, inner), (roof[1], 1.0, inner)]
    cabin.append((belt[1], waist, 0.49))
    b.prism(cabin, [G, P, G], P)
    _side_windows(b, roof, belt, waist, inner)
    b.wheels((-0.29, 0.31), 0.33)


def _car_ends(b: SolidBuilder) -> None:
    b.end_panel(0.497, (-0.44, -0.27), (0.38, 0.46), Material.HEADLIGHT)
    b.end_panel(0.497, (0.27, 0.44), (0.38, 0.46), Material.HEADLIGHT)
    b.end_panel(0.498, (-0.22, 0.22), (0.24, 0.38), D)
    b.end_panel(-0.496, (-0.48, -0.30), (0.46, 0.56), Material.TAIL_LIGHT)
    b.end_panel(-0.496, (0.30, 0.48), (0.46, 0.56), Material.TAIL_LIGHT)
    b.end_panel(-0.498, (-0.14, 0.14), (0.34, 0.42), Material.PLATE)
    b.lamps(0.42, 0.51, 0.36)


def _side_windows(
    b: SolidBuilder,
    roof: tuple[float, float],
    belt: tuple[float, float],
    waist: float,
    inner: float,
) -> None:
    """Two panes between three pillars."""

    def point(share: float, up: float) -> tuple[float, float, float]:
        low = belt[0] + share * (belt[1] - belt[0])
        high = roof[0] + share * (roof[1] - roof[0])
        return low + up * (high - low), waist + up * (1.0 - waist), 0.49 + up * (inner - 0.49)

    for start, end in ((0.09, 0.49), (0.54, 0.94)):
        b.side_panel([point(start, 0.1), point(start, 0.86), point(end, 0.86), point(end, 0.1)], G)


def _van(b: SolidBuilder) -> None:
    """One box with a short nose."""
    low = 0.3 / b.size[2]
    b.part(0)
    b.box((-0.46, 0.46), 0.44, (0.02, 0.2), D)
    b.part(1, 0.4)
    nose = [(0.27, low, 0.49), (0.27, 0.60, 0.49), (0.44, 0.50, 0.46), (0.5, 0.32, 0.45)]
    b.prism([*nose, (0.49, low, 0.45)], [P, P, P, D], P)
    b.end_panel(0.5, (-0.42, -0.25), (0.30, 0.38), Material.HEADLIGHT)
    b.end_panel(0.5, (0.25, 0.42), (0.30, 0.38), Material.HEADLIGHT)
    b.part(2, -0.1)
    body = [(-0.495, low, 0.5), (-0.5, 0.5, 0.5), (-0.485, 0.97, 0.46), (-0.45, 1.0, 0.44)]
    body += [(0.16, 1.0, 0.44), (0.33, 0.585, 0.485), (0.29, low, 0.5)]
    b.prism(body, [P, P, P, P, G, P], P)
    window = [(0.06, 0.60, 0.49), (0.06, 0.88, 0.465), (0.19, 0.88, 0.465), (0.28, 0.60, 0.485)]
    b.side_panel(window, G)
    b.end_panel(-0.5, (-0.4, 0.4), (0.62, 0.86), G)
    b.end_panel(-0.5, (-0.48, -0.38), (0.30, 0.52), Material.TAIL_LIGHT)
    b.end_panel(-0.5, (0.38, 0.48), (0.30, 0.52), Material.TAIL_LIGHT)
    b.lamps(0.34, 0.42, 0.36)
    b.wheels((-0.30, 0.33), 0.34)


def _lorry(b: SolidBuilder, cab_m: float, gap_m: float, axles: tuple[float, ...]) -> None:
    """A cab, and a box on a frame."""
    length, _, height = b.size
    floor, cab_top = 1.05 / height, min(3.1 / height, 0.9)
    cab, gap = 0.5 - cab_m / length, 0.5 - (cab_m + gap_m) / length
    b.part(0)
    b.box((-0.49, 0.48), 0.36, (0.35 / height, floor), D)
    b.part(1, 0.5 * (cab + 0.5))
    front = 0.5 - 0.12 / length
    shape = [
        (cab, 0.5 / height, 0.47),
        (cab, cab_top, 0.45),
        (front - 0.25 / length, cab_top, 0.45),
    ]
    shape += [(front, 0.55 * cab_top, 0.47), (0.5, 0.4 * cab_top, 0.47), (0.5, 0.35 / height, 0.47)]
    b.prism(shape, [P, P, P, P, P], P)
    tilt = 0.25 / float(length) / (0.45 * cab_top)

    def windscreen(z: float) -> float:
        return float(front - tilt * (z - 0.55 * cab_top))

    low, high = 0.60 * cab_top, 0.90 * cab_top
    screen = [(windscreen(low), -0.43, low), (windscreen(low), 0.43, low)]
    screen += [(windscreen(high), 0.42, high), (windscreen(high), -0.42, high)]
    b.face(screen, G)
    door = 0.5 * (cab + front)
    b.side_panel(
        [
            (door, low, 0.472),
            (door, high, 0.46),
            (front - 0.28 / length, high, 0.46),
            (front - 0.05 / length, low, 0.472),
        ],
        G,
    )
    b.end_panel(0.501, (-0.45, -0.30), (0.6 / height, 0.8 / height), Material.HEADLIGHT)
    b.end_panel(0.501, (0.30, 0.45), (0.6 / height, 0.8 / height), Material.HEADLIGHT)
    b.end_panel(0.501, (-0.28, 0.28), (0.55 / height, 0.38 * cab_top), D)
    b.part(1, 0.5 * (gap - 0.5))
    b.box((-0.5, gap), 0.5, (floor, 1.0), C)
    b.end_panel(-0.5, (-0.48, -0.32), (0.8 * floor, 0.98 * floor), Material.TAIL_LIGHT)
    b.end_panel(-0.5, (0.32, 0.48), (0.8 * floor, 0.98 * floor), Material.TAIL_LIGHT)
    b.lamps(0.7 / height, 0.9 * floor, 0.38)
    b.wheels(axles, 0.5)


def _bus(b: SolidBuilder) -> None:
    """One long box with a row of windows."""
    low = 0.32 / b.size[2]
    b.part(0)
    b.box((-0.48, 0.48), 0.45, (0.02, 0.2), D)
    b.part(1)
    body = [(-0.495, low, 0.5), (-0.5, 0.5, 0.5), (-0.495, 0.96, 0.48), (-0.48, 1.0, 0.46)]
    body += [(0.48, 1.0, 0.46), (0.497, 0.92, 0.48), (0.5, 0.4, 0.5), (0.498, low, 0.5)]
    b.prism(body, [P, P, P, P, P, P, P], P)
    for k in range(8):
        start = -0.47 + 0.117 * k
        pane = [(start, 0.44, 0.5), (start, 0.80, 0.49), (start + 0.107, 0.80, 0.49)]
        b.side_panel([*pane, (start + 0.107, 0.44, 0.5)], G)
    b.end_panel(0.501, (-0.44, 0.44), (0.36, 0.86), G)
    b.end_panel(0.501, (-0.46, -0.30), (0.18, 0.25), Material.HEADLIGHT)
    b.end_panel(0.501, (0.30, 0.46), (0.18, 0.25), Material.HEADLIGHT)
    b.end_panel(-0.501, (-0.38, 0.38), (0.55, 0.80), G)
    b.end_panel(-0.501, (-0.47, -0.38), (0.25, 0.42), Material.TAIL_LIGHT)
    b.end_panel(-0.501, (0.38, 0.47), (0.25, 0.42), Material.TAIL_LIGHT)
    b.lamps(0.21, 0.34, 0.38)
    b.wheels((-0.28, 0.30), 0.48)


def _motorcycle(b: SolidBuilder) -> None:
    """A machine with a rider."""
    b.part(0)
    b.box((-0.5, -0.22), 0.09, (0.0, 0.42), Material.TYRE)
    b.box((0.22, 0.5), 0.08, (0.0, 0.42), Material.TYRE)
    b.part(1)
    b.prism(
        [(-0.42, 0.28, 0.14), (-0.40, 0.56, 0.17), (0.22, 0.64, 0.2), (0.30, 0.28, 0.14)],
        [P, P, P],
        P,
    )
    b.part(2)
    b.box((0.17, 0.20), 0.5, (0.64, 0.68), D)
    b.part(3)
    b.prism(
        [(-0.22, 0.50, 0.28), (-0.16, 0.86, 0.30), (0.04, 0.86, 0.30), (0.14, 0.50, 0.26)],
        [D, D, D],
        D,
    )
    b.part(4)
    b.box((-0.10, 0.03), 0.17, (0.85, 1.0), P)
    b.lamps(0.55, 0.48, 0.0)
