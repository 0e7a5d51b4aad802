"""Finds painted lines in a rectified image of a road.

A line is a stripe along the road that is brighter than the road on both of its sides, of the width
that rules allow, at nearly the same offset over many metres: solid, or dashed at a steady period.
What is bright on one side only (the edge of the pavement, a kerb's shadow) or lies across the road
(a stop line, the shadow of a pole) is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, uniform_filter1d

from geoorbit_ros.markings.strip import ACROSS_M, ALONG_M, RoadStrip

Array = NDArray[np.float64]
Kind = Literal["solid", "dashed"]
Colour = Literal["white", "yellow"]

WIDTHS_M = (0.10, 0.15, 0.25, 0.35)
"""Widths of lines that are looked for: 0.10 to 0.15 m in towns and between lanes, 0.25 to 0.30 m at
the edges of motorways (RMS-1, Germany; MUTCD 3A.04, USA)."""
FLANK_M = 0.20
"""Road beside a line with which it is compared. Chosen: larger reaches the next line of a double
one, smaller is noisier."""
MAX_PIXEL_M = 0.20
"""Where a pixel covers more across the road nothing is claimed: a line of 0.12 m then is half as
bright as it should be, and may be anything."""
NOISE_REACH_M = 1.5
"""Half width of the neighbourhood in which the road's own texture is measured. Chosen: half a
lane."""
NOISE_FLOOR = 2.5
"""Least noise, in grey levels: below it are rounding and compression."""
MOST = 6.0
"""Contrast, in units of noise, above which a station says no more for a line. Chosen: smaller makes
worn lines equal to fresh ones, larger lets one bright spot count as much as a line."""
WINDOW_M = 18.0
"""Length over which a line's stations are added up: longer than the period of most dashed lines (9
to 18 m), so that each window has a dash."""
HOP_M = 4.0
"""Distance of two windows. Chosen."""
MAX_SLOPE = 0.04
"""Angle between a line and the reference line. Chosen: tapers of lanes are 1 in 25 and flatter."""
SLOPE_STEP = 0.0025
"""Chosen: over half a window that is an offset of one line's width at its ends."""
MIN_SCORE = 0.7
"""Least mean contrast of a window. Measured on real motorway cameras: texture of roads stays below
0.5, dashes of a third of the length begin at 1."""
LINK_M = 0.20
"""Windows that follow one another belong to one line if it goes on within this distance."""
SEEN_CONTRAST = 2.0
"""Contrast, in units of noise, from which a station shows paint."""
SOLID_SHARE = 0.8
"""Share of stations with paint from which a line is solid. Chosen: dashes of warning lines cover
up to two thirds."""
LEAST_SHARE = 0.1
"""Least share of stations with paint: dashes cover a quarter (MUTCD: 3 m of 12 m) to two thirds."""
PARTING_M = 0.45
"""Lines nearer to each other are one line, the stronger one, or a double one. Chosen: the two of a
double line are 0.1 to 0.3 m apart."""
YELLOW_RATIO = 0.72
"""Blue against red and green, relative to the road beside it, below which a line is yellow."""


@dataclass(frozen=True, slots=True)
class PaintedLine:
    """One line along the road, by the stations of its strip.

    Attributes:
        offset_m: (S,) its middle; NaN before it begins and after it ends.
        sigma_m: (S,) 1-sigma of `offset_m`.
        seen: (S,) whether there is paint at the station.
        score: Mean contrast in units of noise.
        contrast: The same over the stations with paint.
        kind: Solid or dashed.
        colour: White or yellow.
        width_m: Width of the paint.
    """

    offset_m: Array
    sigma_m: Array
    seen: NDArray[np.bool_]
    score: float
    contrast: float
    kind: Kind
    colour: Colour
    width_m: float

    @property
    def length_m(self) -> float:
        """From its first station to its last."""
        return float(np.count_nonzero(np.isfinite(self.offset_m)) * ALONG_M)


def find_lines(strip: RoadStrip) -> list[PaintedLine]:
    """All painted lines along a strip, from right to left."""
    contrast, width = _contrast(strip)
    windows = _windows(contrast, strip)
    lines = [_trace(chain, contrast, width, strip) for chain in _chains(windows)]
    kept = _without_doubles([line for line in lines if line is not None])
    return sorted(kept, key=lambda line: float(np.nanmean(line.offset_m)))


def _contrast(strip: RoadStrip) -> tuple[Array, Array]:
    """How much each place is brighter than both sides, in units of noise, and for which width."""
    light = strip.bgr[..., 1:].mean(axis=2, dtype=np.float64)  # yellow is as bright as white
    best = np.full(light.shape, -np.inf)
    width = np.zeros(light.shape)
    guard_m = float(np.clip(np.median(strip.across_m[strip.seen]), ACROSS_M, 0.1))
    usable = strip.seen & (strip.across_m <= MAX_PIXEL_M)
    for width_m in WIDTHS_M:
        found = _brighter(light, usable, width_m, guard_m)
        better = found > best
        best[better], width[better] = found[better], width_m
    usable &= np.isfinite(best)
    best = np.where(usable, best, 0.0)
    # What stands out is not the road's texture: it counts for three times the median at most.
    size = np.abs(best)
    middle = _median(size, usable)
    reach = round(2.0 * NOISE_REACH_M / ACROSS_M)
    texture = uniform_filter1d(np.minimum(size, 3.0 * middle), reach, axis=1, mode="nearest")
    noise = np.maximum(1.25 * texture, NOISE_FLOOR)
    return np.where(usable, np.clip(best / noise, -1.0, MOST), 0.0), width


def _median(size: Array, usable: NDArray[np.bool_]) -> Array:
    """(S, 1) median of each row's usable values, 0 without any."""
    masked = np.where(usable, size, np.nan)
    empty = ~usable.any(axis=1)
    masked[empty] = 0.0
    return np.asarray(np.nanmedian(masked, axis=1))[:, None]


def _brighter(
    light: Array, usable: NDArray[np.bool_], width_m: float, guard_m: float
) -> Array:
    """Mean of a stripe less that of its brighter flank; -inf where one of them isn't seen."""
    half, guard = round(0.5 * width_m / ACROSS_M), round(guard_m / ACROSS_M)
    flank = round(FLANK_M / ACROSS_M)
    total = np.cumsum(np.pad(np.where(usable, light, 0.0), ((0, 0), (1, 0))), axis=1)
    count = np.cumsum(np.pad(usable, ((0, 0), (1, 0))), axis=1)
    n = light.shape[1]
    at = np.arange(n)

    def mean(begin: int, end: int) -> Array:
        low, high = np.clip(at + begin, 0, n), np.clip(at + end, 0, n)
        whole = count[:, high] - count[:, low] == end - begin
        return np.where(whole, (total[:, high] - total[:, low]) / (end - begin), np.nan)

    middle = mean(-half, half + 1)
    right = mean(-half - guard - flank, -half - guard)
    left = mean(half + guard + 1, half + guard + flank + 1)
    found = middle - np.maximum(left, right)
    return np.where(np.isfinite(found), found, -np.inf)


@dataclass(frozen=True, slots=True)
class _Window:
    """A candidate: a stretch in which a stripe stands out.

    Attributes:
        index: Number of the window along the road.
        offset_m: Offset at the window's middle.
        slope: Change of the offset per metre.
        score: Mean contrast.
    """

    index: int
    offset_m: float
    slope: float
    score: float


def _windows(contrast: Array, strip: RoadStrip) -> list[list[_Window]]:
    """Candidates of each window along the road."""
    stations, offsets = contrast.shape
    length = min(round(WINDOW_M / ALONG_M), stations)
    hop = round(HOP_M / ALONG_M)
    middles = np.arange(length // 2, max(stations - length // 2, length // 2 + 1), hop)
    seen = uniform_filter1d(
        (strip.across_m <= MAX_PIXEL_M).astype(np.float64), length, axis=0, mode="constant"
    )[middles]
    slopes = np.arange(-MAX_SLOPE, MAX_SLOPE + 1e-9, SLOPE_STEP)
    sums = np.empty((len(slopes), len(middles), offsets))
    columns = np.arange(offsets)
    half = length // 2
    for i, slope in enumerate(slopes):
        for j, middle in enumerate(middles):
            rows = np.arange(max(middle - half, 0), min(middle + half + 1, stations))
            shift = np.round(slope * (rows - middle) * ALONG_M / ACROSS_M).astype(np.int64)
            at = np.clip(columns[None, :] + shift[:, None], 0, offsets - 1)
            sums[i, j] = contrast[rows[:, None], at].mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sums = np.where(seen > 0.3, sums / seen, 0.0)
    best, of_slope = sums.max(axis=0), sums.argmax(axis=0)
    smooth = gaussian_filter1d(best, 2.0, axis=1)
    peak = (smooth == maximum_filter1d(smooth, round(0.3 / ACROSS_M), axis=1)) & (best > MIN_SCORE)
    found: list[list[_Window]] = [[] for _ in middles]
    for j, k in zip(*np.nonzero(peak), strict=True):
        slope = float(slopes[of_slope[j, k]])
        found[j].append(
            _Window(int(middles[j]), float(strip.offset_m[k]), slope, float(best[j, k]))
        )
    return found


def _chains(windows: list[list[_Window]]) -> list[list[_Window]]:
    """Windows that follow one another along one line, the strongest lines first."""
    free = {(j, k) for j, row in enumerate(windows) for k in range(len(row))}
    chains = []
    for j, k in sorted(free, key=lambda jk: -windows[jk[0]][jk[1]].score):
        if (j, k) not in free:
            continue
        free.discard((j, k))
        chain = [windows[j][k]]
        for step in (1, -1):
            last, gap, row = windows[j][k], 0, j + step
            while 0 <= row < len(windows) and gap < 3:
                near = [
                    (abs(w.offset_m - _expected(last, w)), i)
                    for i, w in enumerate(windows[row])
                    if (row, i) in free
                ]
                distance, i = min(near, default=(np.inf, -1))
                if distance <= LINK_M:
                    last, gap = windows[row][i], 0
                    free.discard((row, i))
                    chain.append(last)
                else:
                    gap += 1
                row += step
        chains.append(sorted(chain, key=lambda w: w.index))
    return chains


def _expected(last: _Window, other: _Window) -> float:
    """Offset at which the line of one window is in the middle of another."""
    slope = 0.5 * (last.slope + other.slope)
    return last.offset_m + slope * (other.index - last.index) * ALONG_M


def _trace(
    chain: list[_Window], contrast: Array, width: Array, strip: RoadStrip
) -> PaintedLine | None:
    """The line of a chain of windows, station by station; None if it shows too little paint."""
    stations = len(strip.station_m)
    half = round(0.5 * WINDOW_M / ALONG_M)
    index = np.array([w.index for w in chain])
    begin, end = max(index[0] - half, 0), min(index[-1] + half + 1, stations)
    rows = np.arange(begin, end)
    guess = np.interp(rows, index, [w.offset_m for w in chain])
    outer = np.where(
        rows < index[0], (rows - index[0]) * chain[0].slope,
        np.where(rows > index[-1], (rows - index[-1]) * chain[-1].slope, 0.0),
    )  # fmt: skip
    guess = guess + outer * ALONG_M
    reach = np.arange(-round(0.16 / ACROSS_M), round(0.16 / ACROSS_M) + 1)
    for _ in range(2):
        column = np.round((guess - strip.offset_m[0]) / ACROSS_M).astype(np.int64)
        at = column[:, None] + reach
        inside = (at >= 0) & (at < contrast.shape[1])
        value = np.where(inside, contrast[rows[:, None], np.clip(at, 0, contrast.shape[1] - 1)], 0)
        weight = np.square(np.maximum(value - 0.5, 0.0))
        total = weight.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = guess + (weight * reach).sum(axis=1) / total * ACROSS_M
        peak = value.max(axis=1)
        seen = peak >= SEEN_CONTRAST
        if np.count_nonzero(seen) < 4:
            return None
        guess = _smooth(rows, np.where(seen, middle, np.nan), seen, guess)
    usable = strip.across_m[rows, np.clip(column, 0, contrast.shape[1] - 1)] <= MAX_PIXEL_M
    rows_seen = rows[seen]
    first, last = rows_seen[0], rows_seen[-1]
    within = (rows >= first) & (rows <= last) & usable
    share = float(np.count_nonzero(seen & within) / max(np.count_nonzero(within), 1))
    if share < LEAST_SHARE:
        return None
    error = np.where(seen, middle - guess, np.nan)
    scatter = 1.4826 * float(np.nanmedian(np.abs(error)))
    offset, sigma = np.full(stations, np.nan), np.full(stations, np.nan)
    painted = np.zeros(stations, dtype=np.bool_)
    keep = (rows >= first) & (rows <= last)
    offset[rows[keep]] = guess[keep]
    sigma[rows[keep]] = max(scatter, 0.01)
    painted[rows[seen & keep]] = True
    columns = np.clip(column, 0, contrast.shape[1] - 1)
    return PaintedLine(
        offset, sigma, painted, float(np.mean(np.clip(peak[within], 0, MOST))),
        float(np.mean(peak[seen & within])),
        "solid" if share >= SOLID_SHARE else "dashed",
        _colour(strip, rows[seen], columns[seen]),
        float(np.median(width[rows[seen], columns[seen]])),
    )  # fmt: skip


def _smooth(
    rows: NDArray[np.int64], middle: Array, seen: NDArray[np.bool_], guess: Array
) -> Array:
    """The line through the stations with paint: local straight lines, robust to single stations."""
    error = np.where(seen, middle - guess, 0.0)
    weight = seen.astype(np.float64)
    for _ in range(3):
        total = gaussian_filter1d(weight, 3.0 / ALONG_M, mode="nearest")
        change = gaussian_filter1d(weight * error, 3.0 / ALONG_M, mode="nearest")
        fit = np.where(total > 1e-6, change / np.maximum(total, 1e-6), 0.0)
        apart = np.abs(error - fit)
        weight = np.where(seen, 1.0 / (1.0 + np.square(apart / 0.04)), 0.0)
    return guess + fit


def _colour(
    strip: RoadStrip, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> Colour:
    """Of the paint, against the road beside it."""
    paint = np.median(strip.bgr[rows, columns], axis=0)
    beside = round(0.5 / ACROSS_M)
    sides = [np.clip(columns + k, 0, strip.bgr.shape[1] - 1) for k in (-beside, beside)]
    road = np.median(np.concatenate([strip.bgr[rows, c] for c in sides]), axis=0)
    ratio = paint / np.maximum(road, 8.0)
    return "yellow" if ratio[0] < YELLOW_RATIO * ratio[1:].mean() else "white"


def _without_doubles(lines: list[PaintedLine]) -> list[PaintedLine]:
    """Of lines closer than `PARTING_M` along most of the shorter one, the one with more paint."""
    kept: list[PaintedLine] = []
    for line in sorted(lines, key=lambda one: -one.score * one.length_m):
        apart = [np.abs(line.offset_m - other.offset_m) for other in kept]
        if not any(np.nanmedian(a) < PARTING_M for a in apart if np.isfinite(a).any()):
            kept.append(line)
    return kept
