"""Every rotation and shift of lanes near a given place, scored against a network at once."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.mapcheck.placement_fit import SEARCH_SIGMAS, Search, turned, wrapped

Array = NDArray[np.float64]

CELL_M = 1.5
"""Cells of the rasters. Chosen: larger ones hold two lanes, smaller cost time."""
TURN_STEP_RAD = np.radians(2.0)
"""Between rotations tried. Chosen: half of it moves the end of 100 m of lane by a cell."""
DIRECTIONS = 36
"""Rasters, one for each 10 degrees of direction. Chosen: more cost time, with fewer a lane lies on
lanes that cross it."""
PEAKS_PER_TURN, PEAKS = 12, 96
"""Places that are refined, of each rotation and of all. Chosen: more cost time, fewer can miss the
right one in a grid of streets."""
PEAK_GAP_M = 4.5
"""Between two of them. Chosen: nearer ones end in the same fit."""


def find_starts(search: Search) -> list[Array]:
    """Moves (x, y, turn, scale) after which much of the lanes lies on network lanes."""
    reach = search.rough.reach_m
    half = reach + float(np.hypot(*search.camera) + np.hypot(*search.xy.T).max())
    side = scipy.fft.next_fast_len(int(np.ceil(2.0 * half / CELL_M)) + 2, real=True)
    origin = search.rough.near_m - 0.5 * side * CELL_M
    rasters = _rasters(search, origin, side)
    found: list[tuple[float, Array]] = []
    total = float(search.weight.sum())
    for turn in np.arange(0.0, 2.0 * np.pi - 1e-9, TURN_STEP_RAD):
        if search.rough.turn_rad is not None:
            apart = abs(wrapped(turn - search.rough.turn_rad))
            if apart > SEARCH_SIGMAS * search.rough.turn_sigma_rad:
                continue
        score = _correlation(search, rasters, turn, side)
        if score is None:
            continue
        # Cell (i, j) is a shift of the lanes' middle; the camera must come to lie near.
        cells = (np.arange(side) + 0.5) * CELL_M
        camera = turned(search.camera[None], turn)[0]
        dx, dy = (origin[k] + cells + camera[k] - search.rough.near_m[k] for k in (0, 1))
        square = (dx[:, None] ** 2 + dy[None, :] ** 2) / search.rough.near_sigma_m**2
        score = np.where(square <= SEARCH_SIGMAS**2, score - 0.01 * total * square, -np.inf)
        size = 2 * int(PEAK_GAP_M / CELL_M) + 1
        peak = (score == scipy.ndimage.maximum_filter(score, size)) & (score > 0.2 * total)
        at = np.argwhere(peak)
        order = np.argsort(-score[peak], kind="stable")[:PEAKS_PER_TURN]
        for i, j in at[order].tolist():
            move = np.array([origin[0] + cells[i], origin[1] + cells[j], turn, 1.0])
            found.append((float(score[i, j]), move))
    found.sort(key=lambda item: -item[0])
    kept: list[Array] = []
    for _, move in found:
        near = (np.hypot(*(k[:2] - move[:2])) < PEAK_GAP_M and
                abs(wrapped(k[2] - move[2])) < 2.5 * TURN_STEP_RAD for k in kept)  # fmt: skip
        if not any(near):
            kept.append(move)
        if len(kept) == PEAKS:
            break
    return kept


def _rasters(search: Search, origin: Array, side: int) -> dict[int, NDArray[np.complex64]]:
    """Transforms of where the network has lanes, by direction, each with its neighbours."""
    cell = ((search.net.xy - origin) / CELL_M).astype(np.int64)
    inside = np.all((cell >= 0) & (cell < side), axis=1)
    cell, direction = cell[inside], _direction(search.net_heading[inside])
    rasters = {}
    for k in range(DIRECTIONS):
        apart = (direction - k + DIRECTIONS // 2) % DIRECTIONS - DIRECTIONS // 2
        mine = cell[np.abs(apart) <= 1]
        if not len(mine):
            continue
        image = np.zeros((side, side), dtype=np.float32)
        image[mine[:, 0], mine[:, 1]] = 1.0
        soft = scipy.ndimage.gaussian_filter(image, 1.0)
        soft = np.minimum(soft / 0.4, 1.0)  # 0.4: a straight line's own peak
        rasters[k] = np.asarray(scipy.fft.rfft2(soft), dtype=np.complex64)
    return rasters


def _correlation(
    search: Search, rasters: dict[int, NDArray[np.complex64]], turn: float, side: int
) -> Array | None:
    """(side, side) how much of the turned lanes lies on network lanes, by shift; None: nothing."""
    xy = np.rint(turned(search.xy, turn) / CELL_M).astype(np.int64) % side
    direction = _direction(search.heading + turn)
    total = None
    for k in np.unique(direction).tolist():
        if k not in rasters:
            continue
        mine = direction == k
        image = np.zeros((side, side), dtype=np.float32)
        np.add.at(image, (xy[mine, 0], xy[mine, 1]), search.weight[mine])
        part = rasters[k] * np.conj(scipy.fft.rfft2(image))
        total = part if total is None else total + part
    if total is None:
        return None
    return np.asarray(scipy.fft.irfft2(total, (side, side)), dtype=np.float64)


def _direction(heading: Array) -> NDArray[np.int64]:
    return np.asarray(np.floor(heading / (2.0 * np.pi) * DIRECTIONS).astype(np.int64) % DIRECTIONS)
