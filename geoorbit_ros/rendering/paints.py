"""Colours of vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Colour
from geoorbit_ros.rendering.solid import Material

CAR_PAINTS: tuple[tuple[float, Colour], ...] = (
    # Shares: BASF Color Report 2022, rounded.
    (0.30, (0.84, 0.85, 0.85)),
    (0.19, (0.09, 0.085, 0.08)),
    (0.16, (0.36, 0.35, 0.34)),
    (0.10, (0.62, 0.61, 0.60)),
    (0.10, (0.48, 0.25, 0.12)),
    (0.06, (0.10, 0.09, 0.52)),
    (0.03, (0.20, 0.32, 0.16)),
    (0.03, (0.40, 0.52, 0.60)),
    (0.03, (0.12, 0.34, 0.68)),
)
LARGE_PAINTS: tuple[tuple[float, Colour], ...] = (
    (0.45, (0.84, 0.84, 0.83)),
    (0.15, (0.50, 0.26, 0.10)),
    (0.15, (0.12, 0.12, 0.58)),
    (0.10, (0.14, 0.62, 0.76)),
    (0.15, (0.38, 0.38, 0.38)),
)
CARGO_PAINTS: tuple[tuple[float, Colour], ...] = (
    (0.6, (0.82, 0.82, 0.81)),
    (0.12, (0.46, 0.32, 0.16)),
    (0.12, (0.30, 0.42, 0.26)),
    (0.16, (0.55, 0.56, 0.56)),
)
_FIXED: dict[Material, Colour] = {
    Material.GLASS: (0.06, 0.055, 0.05),
    Material.DARK: (0.075, 0.075, 0.075),
    Material.TYRE: (0.085, 0.085, 0.085),
    Material.HEADLIGHT: (0.72, 0.74, 0.74),
    Material.TAIL_LIGHT: (0.10, 0.08, 0.50),
    Material.PLATE: (0.75, 0.78, 0.78),
    Material.CHROME: (0.48, 0.48, 0.48),
}
_GLOSS: dict[Material, float] = {
    Material.PAINT: 0.08,
    Material.GLASS: 0.15,
    Material.HEADLIGHT: 0.10,
    Material.CHROME: 0.05,
}
_HEADLIGHT_GLOW: Colour = (0.85, 0.95, 1.0)
_TAIL_GLOW: Colour = (0.12, 0.10, 0.75)


def material_colours(
    vehicle: int, large: bool, seed: int, headlights: float
) -> NDArray[np.float64]:
    """(3, materials, 3): colour, share of mirrored sky, and own light of each material.

    Args:
        vehicle: Its number: the same one has the same colours.
        large: A truck or a bus.
        seed: Another seed paints all vehicles anew.
        headlights: Brightness of the lamps, 0 to 1.
    """
    random = np.random.default_rng([seed, 23, abs(vehicle)])
    table = np.zeros((3, len(Material), 3))
    for material, colour in _FIXED.items():
        table[0, material] = colour
    table[0, Material.PAINT] = _pick(LARGE_PAINTS if large else CAR_PAINTS, random)
    table[0, Material.CARGO] = _pick(CARGO_PAINTS, random)
    for material, share in _GLOSS.items():
        table[1, material] = share
    if headlights > 0.0:
        table[2, Material.HEADLIGHT] = np.array(_HEADLIGHT_GLOW) * min(1.0, 0.4 + headlights)
        table[2, Material.TAIL_LIGHT] = np.array(_TAIL_GLOW) * min(1.0, 0.3 + headlights)
    return table


def _pick(
    paints: tuple[tuple[float, Colour], ...], random: np.random.Generator
) -> NDArray[np.float64]:
    shares = np.array([share for share, _ in paints])
    chosen = paints[int(random.choice(len(paints), p=shares / shares.sum()))][1]
    return np.asarray(np.clip(np.array(chosen) * random.uniform(0.85, 1.15), 0.03, 0.9))
