"""What the camera sees when no vehicle is there: sky, land, road."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Colour, Illumination, channels
from geoorbit_ros.rendering.raster import coverage
from geoorbit_ros.rendering.surface import RoadSurface, Strip, shifted
from geoorbit_ros.rendering.texture import GroundNoise
from geoorbit_ros.rendering.trees import add_trees
from geoorbit_ros.scenes.camera import PinholeCamera

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


LINE_WIDTH_M = 0.18
HORIZON_M = 4000.0
"""Points further away than this are sky."""
VERGE_M = 0.7
"""Gravel beside the pavement."""

Picture = NDArray[np.float32]
"""(H, W, 3) blue, green, red; 1 is white."""

GRASS: Colour = (0.20, 0.40, 0.33)
DRY_GRASS: Colour = (0.30, 0.47, 0.50)
GRAVEL: Colour = (0.45, 0.50, 0.53)
ASPHALT: Colour = (0.405, 0.40, 0.395)
PAINT: Colour = (0.90, 0.91, 0.91)


@dataclass(frozen=True)
class Background:
    """The empty scene.

    Attributes:
        albedo: Colours of the ground without light; 0 where the sky or a tree is.
        lit: The picture.
    """

    albedo: Picture
    lit: Picture


def make_background(
    camera: PinholeCamera, surface: RoadSurface, light: Illumination, wet: bool, seed: int
) -> Background:
    """Paint the empty scene once; it takes about a second."""
    noise = GroundNoise(seed)
    ground_m, distance, footprint = _ground_points(camera)
    ground = (distance < HORIZON_M).astype(np.float32)
    land = _land(noise, ground_m, footprint)
    verge = [_widened(strip, VERGE_M) for strip in surface.paved]
    pavement = coverage(camera, surface.paved)
    _blend(land, _tinted(GRAVEL, noise, ground_m, footprint, 0.35, 0.05), coverage(camera, verge))
    _blend(land, _asphalt(camera, surface, noise, ground_m, footprint), pavement)
    worn = 0.80 + 0.10 * noise.sample(ground_m, 0.6, footprint)
    paint = coverage(camera, surface.paint(LINE_WIDTH_M)) * np.clip(worn, 0.5, 1.0)
    _blend(land, np.broadcast_to(channels(PAINT), land.shape), paint)
    if wet:
        land *= (1.0 - 0.28 * pavement)[..., None]
    clear = np.exp(-distance / light.haze_m)[..., None]
    sun = channels(light.sun) * np.float32(max(light.sun_direction[2], 0.0))
    picture = land * (channels(light.ambient) + sun) * clear
    picture += channels(light.horizon) * (1.0 - clear)
    if wet:
        picture += _mirror(camera, light, distance, pavement)
    sky = _sky(camera, light, noise)
    picture = picture * ground[..., None] + sky * (1.0 - ground[..., None])
    add_skyline(picture, camera, light, seed)
    hidden = add_trees(picture, camera, light, surface, pavement, seed)
    bare = ground * (1.0 - hidden)
    return Background(
        np.asarray(land * bare[..., None], dtype=np.float32),
        np.asarray(np.clip(picture, 0.0, 1.0), dtype=np.float32),
    )


def _ground_points(
    camera: PinholeCamera,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Ground point (H, W, 2), distance (H, W) and footprint (H, W) of every pixel's middle."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([u, v, np.ones_like(u)], axis=2) @ np.linalg.inv(camera.matrix[:, :3]).T
    down = -ray[..., 2]
    reach = camera.centre_m[2] / np.where(down > 1e-9, down, np.nan)
    ground = camera.centre_m[:2] + reach[..., None] * ray[..., :2]
    distance = reach * np.linalg.norm(ray, axis=2)
    far = ~(distance < HORIZON_M)
    distance[far] = HORIZON_M
    ground[far] = 0.0
    # Along the line of sight a pixel covers distance / height times what it covers across.
    across = distance / camera.focal_px
    footprint = across * np.sqrt(np.maximum(distance / camera.centre_m[2], 1.0))
    return ground.astype(np.float32), distance.astype(np.float32), footprint.astype(np.float32)


def _land(
    noise: GroundNoise, ground_m: NDArray[np.float32], footprint: NDArray[np.float32]
) -> Picture:
    patches = noise.sample(ground_m, 38.0, footprint) + 0.6 * noise.sample(ground_m, 9.0, footprint)
    dry = np.clip(0.35 + 0.28 * patches, 0.0, 1.0)[..., None]
    colour = channels(GRASS) * (1.0 - dry) + channels(DRY_GRASS) * dry
    grain = 0.11 * noise.sample(ground_m, 2.3, footprint)
    grain += 0.12 * noise.sample(ground_m, 0.7, footprint)
    grain += 0.14 * noise.sample(ground_m, 0.22, footprint)
    return np.asarray(colour * np.clip(1.0 + grain, 0.4, 1.7)[..., None], dtype=np.float32)


def _asphalt(
    camera: PinholeCamera,
    surface: RoadSurface,
    noise: GroundNoise,
    ground_m: NDArray[np.float32],
    footprint: NDArray[np.float32],
) -> Picture:
    colour = _tinted(ASPHALT, noise, ground_m, footprint, 0.12, 0.05)
    patches = 0.035 * noise.sample(ground_m, 14.0, footprint)
    patches += 0.03 * noise.sample(ground_m, 3.0, footprint)
    # Wheels polish two tracks per lane; oil drips between them.
    tracks = sum(coverage(camera, surface.lane_wear(side, 0.65)) for side in (-0.85, 0.85))
    oil = coverage(camera, surface.lane_wear(0.0, 0.7))
    wear = 0.05 * cv2.GaussianBlur(np.asarray(tracks, np.float32), (0, 0), 1.2)
    wear -= 0.07 * cv2.GaussianBlur(oil, (0, 0), 1.2)
    lanes = coverage(camera, surface.lanes)
    return np.asarray(colour * (1.0 + patches + wear - 0.04 * lanes)[..., None], dtype=np.float32)


def _tinted(
    colour: Colour,
    noise: GroundNoise,
    ground_m: NDArray[np.float32],
    footprint: NDArray[np.float32],
    wavelength_m: float,
    amount: float,
) -> Picture:
    grain = 1.0 + amount * noise.sample(ground_m, wavelength_m, footprint)
    return np.asarray(channels(colour) * grain[..., None], dtype=np.float32)


def _blend(below: Picture, above: Picture, share: NDArray[np.float32]) -> None:
    below += (above - below) * share[..., None]


def _widened(strip: Strip, by_m: float) -> Strip:
    return Strip(shifted(strip.left_m, by_m), shifted(strip.right_m, -by_m))


def _elevation(camera: PinholeCamera) -> NDArray[np.float32]:
    """(H, W) sine of each pixel's angle above the horizon."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([u, v, np.ones_like(u)], axis=2) @ np.linalg.inv(camera.matrix[:, :3]).T
    return np.asarray(ray[..., 2] / np.linalg.norm(ray, axis=2), dtype=np.float32)


def _sky(camera: PinholeCamera, light: Illumination, noise: GroundNoise) -> Picture:
    width, height = camera.image_size
    up = np.clip(_elevation(camera), 0.0, 1.0) / 0.30
    share = np.clip(up, 0.0, 1.0)[..., None] ** 0.7
    sky = channels(light.horizon) * (1.0 - share) + channels(light.zenith) * share
    clouds = np.clip(0.30 * noise.clouds(width, height, 4.0), 0.0, 0.55)[..., None]
    white = np.minimum(channels(light.horizon) * np.float32(1.06), np.float32(1.0))
    return np.asarray(sky + (white - sky) * clouds, dtype=np.float32)


def _mirror(
    camera: PinholeCamera,
    light: Illumination,
    distance: NDArray[np.float32],
    pavement: NDArray[np.float32],
) -> Picture:
    """The sky in the wet road: Schlick's share of reflected light, water's at normal incidence."""
    sine = np.clip(camera.centre_m[2] / distance, 0.0, 1.0)
    share = (0.02 + 0.98 * (1.0 - sine) ** 5) * 0.55 * pavement
    return np.asarray(channels(light.horizon) * share[..., None], dtype=np.float32)
