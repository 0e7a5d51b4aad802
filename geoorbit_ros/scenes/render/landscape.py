"""What stands at the horizon."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.render.conditions import Colour, Illumination, channels

TREES_M = 900.0
"""Distance of the wood at the horizon."""
TREE_HEIGHT_M = (9.0, 26.0)
TREE: Colour = (0.20, 0.30, 0.25)


def add_skyline(
    picture: NDArray[np.float32], camera: PinholeCamera, light: Illumination, seed: int
) -> None:
    """Draw a wood across the horizon into a picture (H, W, 3)."""
    width, height = camera.image_size
    column = np.arange(width, dtype=np.float64) + 0.5
    base, top = (_row_at(camera, column, z) for z in (0.0, 1.0))
    per_metre = base - top
    random = np.random.default_rng([seed, 22])
    heights = _ridge(random, width)
    low, high = TREE_HEIGHT_M
    tree = base - per_metre * (low + (high - low) * heights)
    first, last = np.clip([np.floor(tree.min()), np.ceil(base.max()) + 1], 0, height).astype(int)
    row = np.arange(first, last)[:, None] + 0.5
    share = np.clip(row - tree[None, :], 0.0, 1.0) * np.clip(base[None, :] - row, 0.0, 1.0)
    clear = np.exp(-TREES_M / light.haze_m)
    leaves = channels(TREE) * (channels(light.ambient) + 0.35 * channels(light.sun))
    grain = 1.0 + 0.16 * random.standard_normal((last - first, width)).astype(np.float32)
    colour = (leaves * grain[..., None]) * clear + channels(light.horizon) * (1.0 - clear)
    part = picture[first:last]
    part += (colour.astype(np.float32) - part) * share[..., None].astype(np.float32)


def _row_at(
    camera: PinholeCamera, column: NDArray[np.float64], height_m: float
) -> NDArray[np.float64]:
    """(W,) row at which a point `height_m` high in the wood is seen, for each column."""
    inverse = np.linalg.inv(camera.matrix[:, :3])
    middle = np.full_like(column, 0.5 * camera.image_size[1])
    ray = np.stack([column, middle, np.ones_like(column)], axis=1) @ inverse.T
    flat = ray[:, :2] / np.hypot(*ray[:, :2].T)[:, None]
    place = np.column_stack([camera.centre_m[:2] + TREES_M * flat, np.full(len(column), height_m)])
    pixel, _ = camera.project(place)
    return np.asarray(pixel[:, 1])


def _ridge(random: np.random.Generator, width: int) -> NDArray[np.float64]:
    """(width,) heights in [0, 1] of crowns beside each other."""
    x = np.linspace(0.0, 1.0, width)
    ridge = np.zeros(width)
    for octave, share in ((5, 0.5), (17, 0.3), (60, 0.22), (190, 0.14)):
        knots = random.uniform(size=octave + 2)
        ridge += share * np.interp(x, np.linspace(0.0, 1.0, octave + 2), knots)
    return np.clip(ridge / 1.1, 0.0, 1.0)
