"""Noise that looks the same from every camera: random values on a lattice in the world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TILE = 256
"""Lattice points before the noise repeats; a power of two."""

Values = NDArray[np.float32]


class GroundNoise:
    """Smooth noise over the ground, at any scale.

    Args:
        seed: Another seed gives another ground.
    """

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng([seed, 21])
        self._tile = random.standard_normal((TILE, TILE)).astype(np.float32)

    def sample(self, ground_m: Values, wavelength_m: float, footprint_m: Values) -> Values:
        """Noise at points (H, W, 2), 1-sigma about 0.6.

        It fades where a pixel's footprint (H, W), in metres, averages it out.
        """
        # Each scale has its own direction, or the lattice would show.
        turn = 2.4 * np.log(wavelength_m)
        cos, sin = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        x: Values = ground_m[..., 0]
        y: Values = ground_m[..., 1]
        pitch = np.float32(0.5 * wavelength_m)
        turned = (cos * x - sin * y) / pitch, (sin * x + cos * y) / pitch
        value = self._at(*(np.asarray(axis, dtype=np.float32) for axis in turned))
        share = pitch / np.maximum(footprint_m, np.float32(1e-3))
        return value * np.minimum(share, np.float32(1.0))

    def clouds(self, width: int, height: int, across: float) -> Values:
        """(height, width) noise drawn out sideways, about `across` waves wide."""
        total = np.zeros((height, width), np.float32)
        for octave in range(5):
            x = np.linspace(0.0, across * 2.0**octave, width, dtype=np.float32)
            y = np.linspace(0.0, across * 2.0**octave, height, dtype=np.float32)
            grid_x, grid_y = np.meshgrid(x + np.float32(31.4 * octave), y)
            total += np.float32(0.5**octave) * self._at(grid_x, grid_y)
        return total

    def _at(self, x: Values, y: Values) -> Values:
        """Interpolated between lattice points with a smooth step (Perlin 1985)."""
        column, row = np.floor(x), np.floor(y)
        u, v = x - column, y - row
        u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
        i, j = column.astype(np.int32) & (TILE - 1), row.astype(np.int32) & (TILE - 1)
        i2, j2 = (i + 1) & (TILE - 1), (j + 1) & (TILE - 1)
        tile = self._tile
        above = tile[j, i] + (tile[j, i2] - tile[j, i]) * u
        below = tile[j2, i] + (tile[j2, i2] - tile[j2, i]) * u
        return np.asarray(above + (below - above) * v, dtype=np.float32)
