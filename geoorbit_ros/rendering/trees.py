"""Trees and bushes beside the road, where they hide no vehicle, and the wood at the horizon."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Colour, Illumination, channels
from geoorbit_ros.rendering.surface import RoadSurface
from geoorbit_ros.scenes.camera import PinholeCamera

TRIES = 420
"""Places that are tried. Chosen: most hide the road and are left out; more take seconds at the
start."""
CLEAR_M = 7.0
"""No tree stands nearer to the pavement. Chosen: a usual clear zone beside a road."""
TRAFFIC_M = 4.6
"""Vehicles are no higher: a trailer of 4 m, 15 % higher at most (`scenes.traffic`)."""
RANGE_M = (25.0, 420.0)
"""Distances of trees from the camera. Chosen: nearer ones fill the image, farther ones are the
wood."""
_MAX_SPRITE_PX = 260
"""Larger trees are left out: their leaves would look blurred. Chosen by appearance."""
_KINDS = 12
"""Different bushes, and as many different trees. Chosen: more take time at the start."""
_TREE_PX = 170
"""Height at which trees are painted before they are scaled. Chosen: as `_MAX_SPRITE_PX`."""
_BUSH_PX = 60
"""Height at which bushes are painted. Chosen: as `_TREE_PX`."""
_BUSH_M = 4.0
"""What is smaller is a bush. Chosen by appearance."""
WOOD_M = 900.0
"""Distance of the wood at the horizon. Chosen: farther is lost in haze, nearer moves above the
road."""
WOOD_HEIGHT_M = (9.0, 26.0)
"""Least and most height of its trees. Chosen by appearance."""
LEAVES: Colour = (0.20, 0.30, 0.25)
"""Colour of its leaves. Chosen by appearance."""


def add_trees(
    image: NDArray[np.float32],
    camera: PinholeCamera,
    light: Illumination,
    surface: RoadSurface,
    pavement: NDArray[np.float32],
    seed: int,
) -> NDArray[np.float32]:
    """Draw trees into an image (H, W, 3), the farthest first.

    A tree is left out when it would cover the road or the space that vehicles take up above it:
    the true boxes then need not know of trees.

    Returns:
        (H, W) share of each pixel that trees cover.
    """
    width, height = camera.image_size
    covered = np.zeros((height, width), np.float32)
    random = np.random.default_rng([seed, 28])
    traffic = _traffic_space(camera, surface) | (pavement > 0.0)
    crowns = {bush: [_crown(bush, random) for _ in range(_KINDS)] for bush in (True, False)}
    for place, tall in _places(camera, surface, random):
        foot, depth = camera.project(np.append(place, 0.0))
        top, _ = camera.project(np.append(place, tall))
        size = float(foot[1] - top[1]) if depth > 1.0 else np.nan
        if not 4.0 < size < _MAX_SPRITE_PX:
            continue
        crown = crowns[tall < _BUSH_M][int(random.integers(_KINDS))]
        colour, share = _tree(size, crown, light, random)
        rows, columns = share.shape
        left, bottom = round(float(foot[0]) - 0.5 * columns), round(float(foot[1]))
        low = max(left, 0), max(bottom - rows, 0)
        high = min(left + columns, width), min(bottom, height)
        if low[0] >= high[0] or low[1] >= high[1]:
            continue
        at = slice(low[1], high[1]), slice(low[0], high[0])
        behind_road = not pavement[: low[1], low[0] : high[0]].any()
        if (pavement[at] > 0.0).any() if behind_road else traffic[at].any():
            continue
        cut = (
            slice(low[1] - bottom + rows, high[1] - bottom + rows),
            slice(low[0] - left, high[0] - left),
        )
        _ground_shadow(image, pavement, foot, columns)
        clear = np.float32(np.exp(-float(depth) / light.haze_m))
        seen = clear * colour[cut] + (1 - clear) * channels(light.horizon)
        image[at] += (seen - image[at]) * share[cut][..., None]
        covered[at] += (1.0 - covered[at]) * share[cut]
    return covered


def _places(
    camera: PinholeCamera, surface: RoadSurface, random: np.random.Generator
) -> list[tuple[NDArray[np.float64], float]]:
    """Feet and heights of trees in groups, the farthest first."""
    edges = [line for strip in surface.paved for line in (strip.left_m, strip.right_m)]
    road = np.concatenate([*edges, np.empty((0, 2))])
    ahead = np.linalg.inv(camera.matrix[:, :3])
    found = []
    group = np.zeros(2)
    for k in range(TRIES):
        if k % 6 == 0:
            column = random.uniform(0.0, camera.image_size[0])
            ray = ahead @ np.array([column, 0.5 * camera.image_size[1], 1.0])
            flat = ray[:2] / np.hypot(*ray[:2])
            # As many per metre of distance, or the far ones would make a wall.
            group = camera.centre_m[:2] + random.uniform(*RANGE_M) * flat
        place = group + random.normal(0.0, 9.0, 2)
        bush = random.uniform() < 0.45
        tall = float(random.uniform(1.2, 3.0) if bush else random.uniform(5.0, 14.0))
        if len(road) and np.hypot(*(road - place).T).min() < CLEAR_M:
            continue
        found.append((place, tall))
    return sorted(found, key=lambda tree: -float(np.hypot(*(tree[0] - camera.centre_m[:2]))))


def _traffic_space(camera: PinholeCamera, surface: RoadSurface) -> NDArray[np.bool_]:
    """(H, W) whether a vehicle on a lane can be seen in a pixel."""
    width, height = camera.image_size
    mask = np.zeros((height, width), np.uint8)
    for strip in surface.lanes:
        for quad in strip.quads():
            height_m = np.repeat([0.0, TRAFFIC_M], 4)
            pixel, depth = camera.project(np.column_stack([np.tile(quad, (2, 1)), height_m]))
            if depth.min() > 0.5 and np.abs(pixel).max() < 20000.0:
                hull = cv2.convexHull(pixel.astype(np.float32))
                cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    return mask > 0


@dataclass(frozen=True, slots=True)
class _Crown:
    """A tree or bush to be scaled.

    Attributes:
        shade: (h, w) brightness of its leaves, 1 on the side of the light.
        cover: (h, w) share of each pixel that it covers.
    """

    shade: NDArray[np.float32]
    cover: NDArray[np.float32]


def _crown(bush: bool, random: np.random.Generator) -> _Crown:
    """A crown of boughs and leaves, with a trunk under a tree."""
    rows = _BUSH_PX if bush else _TREE_PX
    columns = round(rows * (1.5 if bush else random.uniform(0.5, 0.75)))
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    x, y = (x + 0.5) / columns - 0.5, (y + 0.5) / rows  # 0 is the top of the tree
    middle, half = (0.58, 0.42) if bush else (0.42, 0.41)
    inside, light_side = np.full(x.shape, -1.0, np.float32), np.zeros(x.shape, np.float32)
    for _ in range(9):  # boughs: overlapping balls
        angle, reach = random.uniform(0.0, 2.0 * np.pi), 0.62 * np.sqrt(random.uniform())
        centre_x, centre_y = 0.5 * reach * np.cos(angle), middle + half * reach * np.sin(angle)
        u, v = (x - centre_x) / (0.5 * 0.42), (y - centre_y) / (half * 0.42)
        ball = 1.0 - np.hypot(u, v)
        nearer = ball > inside
        inside = np.where(nearer, ball, inside)
        light_side = np.where(nearer, np.clip(-0.35 * u - 0.75 * v, -1.0, 1.0), light_side)
    ragged = _grain(random, x.shape, 2.6) + 0.6 * _grain(random, x.shape, 6.0)
    cover = np.clip((inside + 0.22 * ragged) * 0.25 * min(rows, columns) + 0.5, 0.0, 1.0)
    shade = 0.66 + 0.24 * light_side + 0.10 * ragged + 0.16 * _grain(random, x.shape, 0.9)
    if not bush:
        trunk = (np.abs(x) * columns < 0.018 * rows) & (y > middle)
        shade = np.where(trunk & (cover < 0.5), np.float32(0.35), shade)
        cover = np.maximum(cover, 0.9 * trunk)
    return _Crown(np.clip(shade, 0.15, 1.3).astype(np.float32), np.asarray(cover, dtype=np.float32))


def _tree(
    size_px: float, crown: _Crown, light: Illumination, random: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colours (h, w, 3) and coverage (h, w) of a crown `size_px` high."""
    rows = max(round(size_px), 4)
    columns = max(round(size_px * crown.cover.shape[1] / crown.cover.shape[0]), 4)
    way = cv2.INTER_AREA if rows < crown.cover.shape[0] else cv2.INTER_LINEAR
    shade = cv2.resize(crown.shade, (columns, rows), interpolation=way)
    cover = cv2.resize(crown.cover, (columns, rows), interpolation=way)
    if random.uniform() < 0.5:
        shade, cover = shade[:, ::-1], cover[:, ::-1]
    leaves = np.array([0.15, 0.31, 0.24]) * random.uniform(0.85, 1.2)
    leaves *= random.uniform(0.92, 1.08, 3)
    lit = channels(light.ambient) + np.float32(0.55) * channels(light.sun)
    colour = shade[..., None] * (leaves * lit)
    return np.asarray(colour, dtype=np.float32), np.asarray(cover, dtype=np.float32)


def _ground_shadow(
    image: NDArray[np.float32],
    pavement: NDArray[np.float32],
    foot: NDArray[np.float64],
    columns: int,
) -> None:
    """Darken the grass under a crown."""
    height, width = pavement.shape
    half = 0.5 * columns, 0.11 * columns
    low = [max(int(c - h), 0) for c, h in zip(foot, half, strict=True)]
    high = [min(int(c + h) + 1, n) for c, h, n in zip(foot, half, (width, height), strict=True)]
    if low[0] >= high[0] or low[1] >= high[1]:
        return
    y, x = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    r = np.hypot((x + 0.5 - foot[0]) / half[0], (y + 0.5 - foot[1]) / half[1])
    at = slice(low[1], high[1]), slice(low[0], high[0])
    dark = 0.5 * np.clip(1.0 - r, 0.0, 0.6) * (1.0 - pavement[at])
    image[at] *= (1.0 - dark.astype(np.float32))[..., None]


def _grain(
    random: np.random.Generator, shape: tuple[int, ...], size_px: float
) -> NDArray[np.float32]:
    """Noise of unit variance with spots about `size_px` large."""
    noise = random.standard_normal(shape).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), size_px)
    return np.asarray(soft / max(float(soft.std()), 1e-6), dtype=np.float32)


def add_skyline(
    image: NDArray[np.float32], camera: PinholeCamera, light: Illumination, seed: int
) -> None:
    """Draw a wood across the horizon into an image (H, W, 3)."""
    width, height = camera.image_size
    column = np.arange(width, dtype=np.float64) + 0.5
    base, top = (_row_at(camera, column, z) for z in (0.0, 1.0))
    per_metre = base - top
    random = np.random.default_rng([seed, 22])
    heights = _ridge(random, width)
    low, high = WOOD_HEIGHT_M
    tree = base - per_metre * (low + (high - low) * heights)
    first, last = np.clip([np.floor(tree.min()), np.ceil(base.max()) + 1], 0, height).astype(int)
    row = np.arange(first, last)[:, None] + 0.5
    share = np.clip(row - tree[None, :], 0.0, 1.0) * np.clip(base[None, :] - row, 0.0, 1.0)
    clear = np.exp(-WOOD_M / light.haze_m)
    leaves = channels(LEAVES) * (channels(light.ambient) + 0.35 * channels(light.sun))
    grain = 1.0 + 0.16 * random.standard_normal((last - first, width)).astype(np.float32)
    colour = (leaves * grain[..., None]) * clear + channels(light.horizon) * (1.0 - clear)
    part = image[first:last]
    part += (colour.astype(np.float32) - part) * share[..., None].astype(np.float32)


def _row_at(
    camera: PinholeCamera, column: NDArray[np.float64], height_m: float
) -> NDArray[np.float64]:
    """(W,) row at which a point `height_m` high in the wood is seen, for each column."""
    inverse = np.linalg.inv(camera.matrix[:, :3])
    middle = np.full_like(column, 0.5 * camera.image_size[1])
    ray = np.stack([column, middle, np.ones_like(column)], axis=1) @ inverse.T
    flat = ray[:, :2] / np.hypot(*ray[:, :2].T)[:, None]
    place = np.column_stack([camera.centre_m[:2] + WOOD_M * flat, np.full(len(column), height_m)])
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
