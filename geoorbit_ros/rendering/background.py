"""What the camera sees when no vehicle is there: sky, land, road."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.rendering.conditions import Colour, Conditions, Illumination, channels
from geoorbit_ros.rendering.surface import RoadSurface, Strip, shifted
from geoorbit_ros.rendering.trees import add_skyline, add_trees
from geoorbit_ros.scenes.camera import PinholeCamera

LINE_WIDTH_M = 0.18
"""Width of painted lines. Chosen: between 0.12 and 0.30 m of German roads (RMS-1)."""
HORIZON_M = 4000.0
"""Points farther away than this are sky. Chosen: haze hides them."""
VERGE_M = 0.7
"""Width of the gravel beside the pavement. Chosen by appearance."""
SAMPLES = 4
"""Subpixels per pixel and axis. Chosen: more take time and memory at the start, fewer leave lines
jagged."""
NEAR_M = 0.5
"""What reaches nearer to the camera is not drawn: its projection is unbounded."""
TILE = 256
"""Lattice points before the noise repeats; a power of two. Chosen: more take memory."""
_SHIFT = 4
"""Fractional bits of OpenCV's polygon corners."""

FloatImage = NDArray[np.float32]
"""(H, W, 3) blue, green, red; 1 is white."""

GRASS: Colour = (0.20, 0.40, 0.33)
"""Chosen by appearance, as the colours below."""
DRY_GRASS: Colour = (0.30, 0.47, 0.50)
"""Of patches in the land."""
GRAVEL: Colour = (0.45, 0.50, 0.53)
"""Of the verge."""
ASPHALT: Colour = (0.405, 0.40, 0.395)
"""Dry; darker where it is worn or wet."""
PAINT: Colour = (0.90, 0.91, 0.91)
"""Of lines, before wear."""
YELLOW_PAINT: Colour = (0.22, 0.66, 0.86)
"""Of yellow lines, before wear."""
WEAR_M = 4.0
"""Length of the patches in which paint wears. Chosen: wheels cross a line over some metres."""
GANTRY_EVERY_M, GANTRY_M = 70.0, 1.6
"""Spacing of gantries' shadows along the road, and their length. Chosen: several are in view."""
RAIL_M = 0.3
"""Width of a guard rail's shadow beside the edge line. Chosen: as wide as a broad line."""


@dataclass(frozen=True)
class Background:
    """The empty scene.

    Attributes:
        albedo: Colours of the ground without light; 0 where the sky or a tree is.
        lit: The image.
    """

    albedo: FloatImage
    lit: FloatImage


def make_background(
    camera: PinholeCamera,
    surface: RoadSurface,
    light: Illumination,
    conditions: Conditions,
    seed: int,
) -> Background:
    """Paint the empty scene once; it takes about a second."""
    wet = conditions.rain
    noise = GroundNoise(seed)
    ground_m, distance, footprint = _ground_points(camera)
    ground = (distance < HORIZON_M).astype(np.float32)
    land = _land(noise, ground_m, footprint)
    verge = [_widened(strip, VERGE_M) for strip in surface.paved]
    pavement = coverage(camera, surface.paved)
    _blend(land, _tinted(GRAVEL, noise, ground_m, footprint, 0.35, 0.05), coverage(camera, verge))
    _blend(land, _asphalt(camera, surface, noise, ground_m, footprint), pavement)
    left = _left_of_paint(noise, ground_m, footprint, conditions.worn)
    for colour, bands in (
        (PAINT, surface.paint(LINE_WIDTH_M)),
        (YELLOW_PAINT, surface.yellow_paint(LINE_WIDTH_M)),
    ):
        if bands:
            paint = coverage(camera, bands) * left
            _blend(land, np.broadcast_to(channels(colour), land.shape), paint)
    if wet:
        land *= (1.0 - 0.28 * pavement)[..., None]
    clear = np.exp(-distance / light.haze_m)[..., None]
    sun = channels(light.sun) * np.float32(max(light.sun_direction[2], 0.0))
    sunny = np.ones_like(distance)
    if conditions.shadows:
        sunny -= coverage(camera, surface.shaded(GANTRY_EVERY_M, GANTRY_M, RAIL_M))
    image = land * (channels(light.ambient) + sun * sunny[..., None]) * clear
    image += channels(light.horizon) * (1.0 - clear)
    if wet:
        image += _mirror(camera, light, distance, pavement)
    sky = _sky(camera, light, noise)
    image = image * ground[..., None] + sky * (1.0 - ground[..., None])
    add_skyline(image, camera, light, seed)
    hidden = add_trees(image, camera, light, surface, pavement, seed)
    bare = ground * (1.0 - hidden)
    return Background(
        np.asarray(land * bare[..., None], dtype=np.float32),
        np.asarray(np.clip(image, 0.0, 1.0), dtype=np.float32),
    )


def _left_of_paint(
    noise: GroundNoise,
    ground_m: NDArray[np.float32],
    footprint: NDArray[np.float32],
    gone: float,
) -> NDArray[np.float32]:
    """(H, W) how much of the paint is left: all of it is a little pale, and a share is gone."""
    pale = np.clip(0.80 + 0.10 * noise.sample(ground_m, 0.6, footprint), 0.5, 1.0)
    if not gone:
        return np.asarray(pale, dtype=np.float32)
    patches = noise.sample(ground_m, WEAR_M, footprint)
    patches += 0.5 * noise.sample(ground_m, 0.1 * WEAR_M, footprint)
    sigma = 0.6 * np.hypot(1.0, 0.5)  # of the two together
    kept = np.clip(0.5 + (patches / sigma - scipy.special.ndtri(gone)) / 0.5, 0.0, 1.0)
    return np.asarray(pale * kept * (1.0 - 0.3 * gone), dtype=np.float32)


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
) -> FloatImage:
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
) -> FloatImage:
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
) -> FloatImage:
    grain = 1.0 + amount * noise.sample(ground_m, wavelength_m, footprint)
    return np.asarray(channels(colour) * grain[..., None], dtype=np.float32)


def _blend(below: FloatImage, above: FloatImage, share: NDArray[np.float32]) -> None:
    below += (above - below) * share[..., None]


def _widened(strip: Strip, by_m: float) -> Strip:
    return Strip(shifted(strip.left_m, by_m), shifted(strip.right_m, -by_m))


def _elevation(camera: PinholeCamera) -> NDArray[np.float32]:
    """(H, W) sine of each pixel's angle above the horizon."""
    width, height = camera.image_size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([u, v, np.ones_like(u)], axis=2) @ np.linalg.inv(camera.matrix[:, :3]).T
    return np.asarray(ray[..., 2] / np.linalg.norm(ray, axis=2), dtype=np.float32)


def _sky(camera: PinholeCamera, light: Illumination, noise: GroundNoise) -> FloatImage:
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
) -> FloatImage:
    """The sky in the wet road: Schlick's share of reflected light, water's at normal incidence."""
    sine = np.clip(camera.centre_m[2] / distance, 0.0, 1.0)
    share = (0.02 + 0.98 * (1.0 - sine) ** 5) * 0.55 * pavement
    return np.asarray(channels(light.horizon) * share[..., None], dtype=np.float32)


def coverage(camera: PinholeCamera, strips: Iterable[Strip]) -> NDArray[np.float32]:
    """(H, W) share of each pixel that the strips cover.

    A band thinner than a subpixel is drawn one subpixel wide and as much fainter.
    """
    width, height = camera.image_size
    mask = np.zeros((height * SAMPLES, width * SAMPLES), np.uint8)
    quads = [strip.quads() for strip in strips]
    if not quads:
        return np.zeros((height, width), np.float32)
    ground = np.concatenate(quads)
    pixel, depth = camera.project(np.concatenate([ground, np.zeros((*ground.shape[:2], 1))], 2))
    low, high = pixel.min(axis=1), pixel.max(axis=1)
    limit = 3.0 * max(width, height)
    with np.errstate(invalid="ignore"):
        shown = (depth.min(axis=1) > NEAR_M) & np.all(high > 0.0, axis=1)
        shown &= np.all(low < [width, height], axis=1)
        shown &= np.all(high < limit, axis=1) & np.all(low > -limit, axis=1)
    # Coordinates of pixel centres: a subpixel's middle lies half a subpixel inside.
    fine = pixel[shown] * SAMPLES - 0.5
    thin = _thickness(fine)
    levels = np.where(thin > 8.0, 255, np.rint(255 * thin / (thin + 1.0))).astype(np.int64)
    corners = np.rint(fine * (1 << _SHIFT)).astype(np.int32)
    # The brightest last: none darkens another.
    for k in np.argsort(levels, kind="stable").tolist():
        cv2.fillConvexPoly(mask, corners[k], int(levels[k]), cv2.LINE_8, _SHIFT)
    small = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
    return small.astype(np.float32) / np.float32(255.0)


def _thickness(quads: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) the smaller extent of quadrilaterals (N, 4, 2): area over longest side."""
    following = np.roll(quads, -1, axis=1)
    cross = quads[..., 0] * following[..., 1] - quads[..., 1] * following[..., 0]
    longest = np.hypot(*np.moveaxis(quads - following, 2, 0)).max(axis=1)
    return np.asarray(0.5 * np.abs(cross.sum(axis=1)) / np.maximum(longest, 1e-9))


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
