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
import scipy
from numpy.typing import NDArray

from geoorbit_ros.markings.road_image import ACROSS_M, ALONG_M, RoadStrip

Array = NDArray[np.float64]
Kind = Literal["solid", "dashed", "double"]
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
MAX_SLOPE = 0.02
"""Angle between a line and the reference line. Chosen: vehicles drift by less over `WINDOW_M`."""
SLOPE_STEP = 0.005
"""Chosen: half a step is a fifth of a line's width at the ends of a window."""
MIN_SCORE = 0.7
"""Least mean contrast of a window. Measured on real motorway cameras: texture of roads stays below
0.5, dashes of a third of the length begin at 1."""
KNOT_M = 10.0
"""A line is straight, beside the reference line, for so long. Chosen: shorter follows noise."""
BEND_M = 0.24
"""Most that its offset changes from one knot to the next: lanes taper by 1 in 40 at most where
traffic drives fast (RAA, MUTCD 3B.09)."""
BAND_M = 0.8
"""Most that its offset changes along the strip. Chosen: what the reference line, by the traffic,
may wander against the paint."""
STEP_M = 0.04
"""Steps of the offset at the knots. Chosen: the position is refined afterwards."""
BEND_COST = 25.0
"""Cost of `BEND_M` between two knots, in units of a station's contrast: of two ways to go on, the
straighter one unless the other shows four more metres of paint. Chosen."""
SEEN_CONTRAST = 2.0
"""Contrast, in units of noise, from which a station shows paint."""
SOLID_SHARE = 0.85
"""Share of stations with paint from which a line is solid. Chosen: dashes of warning lines cover
up to two thirds."""
PERIOD_M = 15.0
"""Longest period of dashes that is told from a solid line: 12 m in towns and in the USA, 18 m on
German motorways, of which 6 m are paint."""
BEST_PERIODS = 3
"""So many periods of a line decide: those that are resolved best. Chosen: vehicles may hide one."""
MAX_ALONG_M = 0.6
"""Where a pixel covers more along the road, gaps between dashes are blurred. Chosen: a fifth of the
shortest usual gap."""
LEAST_SHARE = 0.1
"""Least share of stations with paint: dashes cover a quarter (MUTCD: 3 m of 12 m) to two thirds."""
LEAST_SEEN = 0.3
"""Least share of a window that is seen. Chosen."""
LEAST_STATIONS = 8
"""Least number of stations with paint: two metres. Chosen: the shortest dashes are 1 m long."""
REACH_M = 0.16
"""Distance from the path in which the line's middle is looked for. Chosen: half of the widest line
that is looked for."""
SMOOTH_M, DASHED_SMOOTH_M = 3.0, 6.0
"""1-sigma of the stretch over which the middle of solid and dashed lines is averaged. Chosen: half
the gap between two dashes of the longest period."""
OUTLIER_M = 0.04
"""Distance from which a station counts half. Chosen: a third of a narrow line."""
PROFILE_M = 0.5
"""Half width of the profile across a line. Chosen: twice that of the widest line."""
MAX_WIDTH_M = 0.65
"""Wider stripes are patches: lines are at most 0.5 m wide (RMS-1; MUTCD 3A.04), with dirt beside
them, on real motorway cameras, up to 0.6."""
TWIN_M = (0.14, 0.40)
"""Distance of the middles of two lines that are a double one: lines of 0.1 to 0.15 m, as far apart
(MUTCD 3A.04, RMS-1)."""
TWIN_SHARE = 0.6
"""Both are this bright, as a share of the brighter one, and the road between and beside them is
darker than this share. Chosen: paint that was renewed beside the old one is less alike."""
TRIED_M = 0.12
"""A path that was followed in vain is not followed again from seeds this near. Chosen: less than a
line's width."""
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
        kind: Solid, dashed, or double: two solid ones, whose common middle `offset_m` is.
        colour: White or yellow.
        width_m: Width of the paint, of both lines and their gap for a double one.
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
    if not (strip.across_m <= MAX_PIXEL_M).any():
        return []
    # Zeros on both sides: a path may leave the strip.
    padded = np.pad(_contrast(strip), ((0, 0), (_MARGIN, _MARGIN)))
    contrast = padded[:, _MARGIN:-_MARGIN]
    lines: list[PaintedLine] = []
    in_vain: list[Array] = []
    for seed in _seeds(contrast, strip):
        known = [line.offset_m[seed.station] for line in lines]
        if any(abs(offset - seed.offset_m) < PARTING_M for offset in known):
            continue
        if any(abs(path[seed.station] - seed.offset_m) < TRIED_M for path in in_vain):
            continue
        path = _path(seed, padded, strip)
        line = _trace(path, contrast, strip)
        if line is None:
            in_vain.append(path)
        elif not any(_same(line, other) for other in lines):
            lines.append(line)
            # Paint belongs to one line, the clearer one.
            beside = np.abs(strip.offset_m - line.offset_m[:, None]) < 0.5 * PARTING_M
            contrast[beside] = 0.0
    return sorted(lines, key=lambda line: float(np.nanmean(line.offset_m)))


def _same(line: PaintedLine, other: PaintedLine) -> bool:
    """Whether two lines are closer than `PARTING_M` where both are."""
    apart = np.abs(line.offset_m - other.offset_m)
    return bool(np.isfinite(apart).any() and np.nanmedian(apart) < PARTING_M)


def _contrast(strip: RoadStrip) -> Array:
    """(S, D) how much each place is brighter than both sides of it, in units of noise."""
    light = strip.bgr[..., 1:].mean(axis=2, dtype=np.float64)  # yellow is as bright as white
    best = np.full(light.shape, -np.inf)
    guard_m = float(np.clip(np.median(strip.across_m[strip.seen]), ACROSS_M, 0.1))
    usable = strip.seen & (strip.across_m <= MAX_PIXEL_M)
    for width_m in WIDTHS_M:
        best = np.maximum(best, _brighter(light, usable, width_m, guard_m))
    usable &= np.isfinite(best)
    best = np.where(usable, best, 0.0)
    # What stands out is not the road's texture: it counts for three times the median at most.
    size = np.abs(best)
    middle = _median(size, usable)
    reach = round(2.0 * NOISE_REACH_M / ACROSS_M)
    texture = scipy.ndimage.uniform_filter1d(
        np.minimum(size, 3.0 * middle), reach, axis=1, mode="nearest"
    )
    noise = np.maximum(1.25 * texture, NOISE_FLOOR)
    return np.where(usable, np.clip(best / noise, -1.0, MOST), 0.0)


def _median(size: Array, usable: NDArray[np.bool_]) -> Array:
    """(S, 1) median of each row's usable values, 0 without any."""
    masked = np.where(usable, size, np.nan)
    empty = ~usable.any(axis=1)
    masked[empty] = 0.0
    return np.asarray(np.nanmedian(masked, axis=1))[:, None]


def _brighter(light: Array, usable: NDArray[np.bool_], width_m: float, guard_m: float) -> Array:
    """Mean of a stripe less that of its brighter flank; -inf where one of them isn't seen."""
    half, guard = round(0.5 * width_m / ACROSS_M), round(guard_m / ACROSS_M)
    flank = round(FLANK_M / ACROSS_M)
    total = np.cumsum(np.pad(np.where(usable, light, 0.0), ((0, 0), (1, 0))), axis=1)
    count = np.cumsum(np.pad(usable, ((0, 0), (1, 0))), axis=1)
    n = light.shape[1]
    at = np.arange(n)

    def mean(begin: int, end: int) -> Array:
        low, high = np.clip(at + begin, 0, n), np.clip(at + end, 0, n)
        whole: NDArray[np.bool_] = np.equal(count[:, high] - count[:, low], end - begin)
        return np.where(whole, (total[:, high] - total[:, low]) / (end - begin), np.nan)

    middle = mean(-half, half + 1)
    right = mean(-half - guard - flank, -half - guard)
    left = mean(half + guard + 1, half + guard + flank + 1)
    found = middle - np.maximum(left, right)
    return np.where(np.isfinite(found), found, -np.inf)


@dataclass(frozen=True, slots=True)
class _Seed:
    """A stretch in which a stripe stands out: its middle, and its mean contrast."""

    station: int
    offset_m: float
    score: float


def _seeds(contrast: Array, strip: RoadStrip) -> list[_Seed]:
    """Where lines may be, the clearest first."""
    stations, offsets = contrast.shape
    length = min(round(WINDOW_M / ALONG_M), stations)
    half = length // 2
    middles = np.arange(half, max(stations - half, half + 1), round(HOP_M / ALONG_M))
    usable = (strip.across_m <= MAX_PIXEL_M).astype(np.float64)
    seen = scipy.ndimage.uniform_filter1d(usable, length, axis=0, mode="constant")[middles]
    columns = np.arange(offsets)
    best = np.zeros((len(middles), offsets))
    for slope in np.arange(-MAX_SLOPE, MAX_SLOPE + 1e-9, SLOPE_STEP):
        for j, middle in enumerate(middles):
            rows = np.arange(max(middle - half, 0), min(middle + half + 1, stations))
            shift = np.round(slope * (rows - middle) * ALONG_M / ACROSS_M).astype(np.int64)
            at = np.clip(columns[None, :] + shift[:, None], 0, offsets - 1)
            best[j] = np.maximum(best[j], contrast[rows[:, None], at].mean(axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.where(seen > LEAST_SEEN, best / seen, 0.0)
    smooth = scipy.ndimage.gaussian_filter1d(best, 2.0, axis=1)
    peak = (smooth == scipy.ndimage.maximum_filter1d(smooth, round(0.3 / ACROSS_M), axis=1)) & (
        best > MIN_SCORE
    )
    found = [
        _Seed(int(middles[j]), float(strip.offset_m[k]), float(best[j, k]))
        for j, k in zip(*np.nonzero(peak), strict=True)
    ]
    return sorted(found, key=lambda seed: -seed.score)


_LEVELS = np.arange(-round(BAND_M / STEP_M), round(BAND_M / STEP_M) + 1)
_BENDS = np.arange(-round(BEND_M / STEP_M), round(BEND_M / STEP_M) + 1)
_PRICE = BEND_COST * np.square(_BENDS * STEP_M / BEND_M)
_SOURCE = np.arange(len(_LEVELS)) - _BENDS[:, None]
"""(B, L) level at the piece's beginning, of each level at its end and each bend."""
_REACHABLE = (_SOURCE >= 0) & (len(_LEVELS) > _SOURCE)
_MARGIN = round((BAND_M + BEND_M) / ACROSS_M) + 1
"""Columns beside the strip that a path from inside may reach."""


def _path(seed: _Seed, padded: Array, strip: RoadStrip) -> Array:
    """(S,) offset of the line through a seed: the most contrast for the least bends.

    Dynamic programming over the offsets at knots, from the seed to both ends of the strip.

    Args:
        seed: Where it passes through.
        padded: Contrast, with `_MARGIN` columns of zeros on either side.
        strip: The strip.
    """
    stations, width = padded.shape
    step = round(KNOT_M / ALONG_M)
    first = (seed.offset_m - strip.offset_m[0]) / ACROSS_M + _MARGIN
    path = np.full(stations, seed.offset_m)
    for way in (1, -1):
        total = np.where(_LEVELS == 0, 0.0, -np.inf)
        came: list[NDArray[np.int64]] = []
        knots, columns = [seed.station], np.empty((0, 0, 0), dtype=np.int64)
        while 0 <= knots[-1] + way < stations:
            at, end = knots[-1], int(np.clip(knots[-1] + way * step, 0, stations - 1))
            rows = np.arange(at + way, end + way, way)
            if columns.shape[2] != len(rows):
                left = 1.0 - np.abs(rows - at) / abs(end - at)
                # Offsets at the end of the piece are the levels; it came from level less bend.
                offset = _LEVELS[:, None] - _BENDS[:, None, None] * left
                columns = np.rint(first + offset * (STEP_M / ACROSS_M)).astype(np.int64)
            value = padded.ravel().take(rows * width + columns).sum(axis=2)
            before = np.where(_REACHABLE, total[np.clip(_SOURCE, 0, len(_LEVELS) - 1)], -np.inf)
            score = before + value - _PRICE[:, None]
            bend = score.argmax(axis=0)
            total = score[bend, np.arange(len(_LEVELS))]
            came.append(_BENDS[bend])
            knots.append(end)
        level = int(np.argmax(total))
        reached = [float(_LEVELS[level])]
        for by in reversed(came):
            level -= int(by[level])
            reached.append(float(_LEVELS[level]))
        order = np.argsort(knots)
        rows = np.arange(min(knots), max(knots) + 1)
        offset = np.interp(rows, np.array(knots)[order], np.array(reached[::-1])[order])
        path[rows] = seed.offset_m + offset * STEP_M
    return path


def _extent(value: Array) -> tuple[int, int]:
    """The stretch whose contrast exceeds `MIN_SCORE` by the largest sum: where the line is."""
    total = np.append(0.0, np.cumsum(value - MIN_SCORE))
    lowest = np.minimum.accumulate(total)
    end = int(np.argmax(total - lowest))
    begin = int(np.argmin(total[: end + 1]))
    return begin, end


def _trace(path: Array, contrast: Array, strip: RoadStrip) -> PaintedLine | None:
    """The line along a path, station by station; None if it shows too little paint."""
    reach = np.arange(-round(REACH_M / ACROSS_M), round(REACH_M / ACROSS_M) + 1)
    rows = np.arange(len(path))
    last = contrast.shape[1] - 1
    for _ in range(2):
        column = np.round((path - strip.offset_m[0]) / ACROSS_M).astype(np.int64)
        at = column[:, None] + reach
        value = contrast[rows[:, None], np.clip(at, 0, last)]
        value = np.where((at >= 0) & (at <= last), value, 0.0)
        weight = np.square(np.maximum(value - 0.5, 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = path + (weight * reach).sum(axis=1) / weight.sum(axis=1) * ACROSS_M
        peak = value.max(axis=1)
        seen = peak >= SEEN_CONTRAST
        if np.count_nonzero(seen) < LEAST_STATIONS:
            return None
        share = float(np.mean(seen[np.flatnonzero(seen)[0] : np.flatnonzero(seen)[-1] + 1]))
        reach_m = SMOOTH_M if share >= SOLID_SHARE else DASHED_SMOOTH_M
        path = path + _smooth(middle - path, seen, reach_m)
    column = np.clip(column, 0, last)
    usable = strip.across_m[rows, column] <= MAX_PIXEL_M
    begin, end = _extent(np.where(usable, peak, MIN_SCORE))
    within = (rows >= begin) & (rows < end)
    painted = within & seen & usable
    share = float(painted.sum() / max(int((within & usable).sum()), 1))
    if share < LEAST_SHARE or np.count_nonzero(painted) < LEAST_STATIONS:
        return None
    at = rows[painted], column[painted]
    best = np.argsort(strip.across_m[at], kind="stable")[: max(len(at[0]) // 3, LEAST_STATIONS)]
    width_m = _width_m(strip, at[0][best], at[1][best])
    if width_m > MAX_WIDTH_M + float(strip.across_m[at][best].mean()):  # an image blurs by a pixel
        return None
    scatter = 1.4826 * float(np.median(np.abs((middle - path)[painted])))
    kind = _kind(painted, np.where(within & usable, strip.along_m[rows, column], np.inf), share)
    twin = _twin(strip, at[0][best], at[1][best]) if kind == "solid" else None
    path = _between_edges(path, painted, strip, reach_m) if twin is None else path
    if twin is not None:
        (right, left, width_m), kind = twin, "double"
        path = path + 0.5 * (right + left) * ACROSS_M
        column = np.clip(column + left, 0, last)
    return PaintedLine(
        offset_m=np.where(within, path, np.nan),
        sigma_m=np.where(within, max(scatter, 0.5 * ACROSS_M), np.nan),
        seen=painted,
        score=float(np.mean(peak[within & usable])),
        contrast=float(np.mean(peak[painted])),
        kind=kind,
        colour=_colour(strip, rows[painted], column[painted]),
        width_m=width_m,
    )


def _kind(painted: NDArray[np.bool_], along_m: Array, share: float) -> Kind:
    """Solid where, seen best, a whole period of a dashed line is full of paint.

    Not by the share along all of the line: vehicles, dirt and distance hide parts of solid lines.
    """
    length = round(PERIOD_M / ALONG_M)
    at = np.flatnonzero(along_m <= MAX_ALONG_M)
    if len(at) >= length:
        best = np.sort(along_m[at])[min(BEST_PERIODS * length, len(at)) - 1]
        at = at[along_m[at] <= best]
        windows = np.convolve(painted[at], np.ones(length), "valid") / length
        share = float(windows.max())
    return "solid" if share >= SOLID_SHARE else "dashed"


def _smooth(error: Array, seen: NDArray[np.bool_], reach_m: float) -> Array:
    """(S,) a steady change of the path, by the stations with paint, robust to single ones."""
    error = np.where(seen, error, 0.0)
    weight = seen.astype(np.float64)
    fit = np.zeros(len(error))
    for _ in range(3):
        total = scipy.ndimage.gaussian_filter1d(weight, reach_m / ALONG_M, mode="nearest")
        change = scipy.ndimage.gaussian_filter1d(weight * error, reach_m / ALONG_M, mode="nearest")
        fit = np.where(total > 1e-6, change / np.maximum(total, 1e-6), 0.0)
        weight = np.where(seen, 1.0 / (1.0 + np.square((error - fit) / OUTLIER_M)), 0.0)
    return fit


def _between_edges(
    path: Array, painted: NDArray[np.bool_], strip: RoadStrip, reach_m: float
) -> Array:
    """(S,) the path moved to half-way between the edges of the paint.

    The middle of what is bright is not the middle of a line that is worn or dirty on one side; its
    edges, where the light changes most, are where they were painted. They are taken from the mean
    of the stations with paint over `reach_m`, and are not farther apart than lines are wide: what
    changes more beside them is another thing, such as the end of the pavement.
    """
    rows = np.flatnonzero(painted)
    column = np.round((path[rows] - strip.offset_m[0]) / ACROSS_M).astype(np.int64)
    weight = scipy.ndimage.gaussian_filter1d(painted.astype(np.float64), reach_m / ALONG_M)
    light = np.zeros((len(path), 2 * round(PROFILE_M / ACROSS_M) + 1))
    light[rows] = _light(strip, rows, column)
    light = scipy.ndimage.gaussian_filter1d(light, reach_m / ALONG_M, axis=0)[rows]
    right, left = _edges_m(light / weight[rows, None], WIDTHS_M[-1])
    error = np.zeros(len(path))
    error[rows] = strip.offset_m[column] + 0.5 * (right + left) - path[rows]
    return path + _smooth(error, painted, reach_m)


def _width_m(strip: RoadStrip, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> float:
    """Of the paint: from its edge on one side to that on the other."""
    right, left = _edges_m(_profile(strip, rows, columns)[None], 2.0 * PROFILE_M)
    return float(left[0] - right[0])


def _edges_m(profile: Array, most_m: float) -> tuple[Array, Array]:
    """Right and left edges (N,) of lines, from the middle of their profiles (N, 2 K + 1).

    Where the light rises and falls most, not down to half of its brightness: beside many an edge
    line the shoulder is nearly as bright.

    Args:
        profile: Brightness across each line.
        most_m: Most between the two edges.
    """
    reach, rows = profile.shape[1] // 2, np.arange(len(profile))
    slope = scipy.ndimage.uniform_filter1d(np.diff(profile, axis=1), 3, axis=1)
    apart = np.arange(slope.shape[1])
    allowed = (apart[:reach, None] < apart[reach:]) & (
        apart[reach:] - apart[:reach, None] <= most_m / ACROSS_M
    )
    change = np.where(allowed, slope[:, :reach, None] - slope[:, None, reach:], -np.inf)
    right, left = np.divmod(change.reshape(len(rows), -1).argmax(axis=1), slope.shape[1] - reach)
    # A slope lies half-way between two columns.
    edges = _vertex(slope, right), _vertex(-slope, left + reach)
    return (edges[0] + 0.5 - reach) * ACROSS_M, (edges[1] + 0.5 - reach) * ACROSS_M


def _vertex(value: Array, k: NDArray[np.int64]) -> Array:
    """(N,) places of the vertices of parabolas through three samples of curves (N, K) at `k`."""
    rows, k = np.arange(len(value)), np.clip(k, 1, value.shape[1] - 2)
    before, here, after = (value[rows, k + step] for step in (-1, 0, 1))
    bend = np.minimum(before - 2.0 * here + after, -1e-9)
    return np.asarray(k + np.clip(0.5 * (before - after) / bend, -1.0, 1.0))


def _profile(strip: RoadStrip, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    """Median brightness across a line, `PROFILE_M` to both sides."""
    return np.asarray(np.median(_light(strip, rows, columns), axis=0))


def _light(strip: RoadStrip, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    """(N, 2 K + 1) brightness across a line at some stations."""
    reach = round(PROFILE_M / ACROSS_M)
    at = np.clip(columns[:, None] + np.arange(-reach, reach + 1), 0, strip.bgr.shape[1] - 1)
    return np.asarray(strip.bgr[rows[:, None], at, 1:].mean(axis=2, dtype=np.float64))


def _twin(
    strip: RoadStrip, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[int, int, float] | None:
    """Both lines of a double one, and its width in metres; None for one line.

    Lines are columns from `columns` on, positive to the left.
    """
    profile = scipy.ndimage.uniform_filter1d(_profile(strip, rows, columns), 3)
    reach = len(profile) // 2
    height = profile - np.quantile(profile, 0.2)
    is_peak = height == scipy.ndimage.maximum_filter1d(height, 7)
    peaks = np.flatnonzero(is_peak & (height >= TWIN_SHARE * height.max()))
    beside = round(FLANK_M / ACROSS_M)
    best: tuple[float, int, int] | None = None
    for k, a in enumerate(peaks.tolist()):
        for b in peaks[k + 1 :].tolist():
            low = min(height[a], height[b])
            dark = (height[a:b], height[max(a - beside, 0) : a + 1], height[b : b + beside + 1])
            apart = all(part.min() <= TWIN_SHARE * low for part in dark)
            if apart and TWIN_M[0] <= (b - a) * ACROSS_M <= TWIN_M[1]:
                best = max(best or (low, a, b), (low, a, b))
    if best is None:
        return None
    low, a, b = best
    # Dashes beside a line show in the median, too, where they cover half.
    light = _light(strip, rows, columns) - np.quantile(profile, 0.2)
    lasting = [np.mean(light[:, k] >= 0.5 * height[k]) for k in (a, b)]
    if min(lasting) < SOLID_SHARE:
        return None
    paint = np.flatnonzero(height >= 0.5 * low)
    paint = paint[(paint >= a - beside) & (paint <= b + beside)]
    return a - reach, b - reach, float(paint[-1] - paint[0] + 1) * ACROSS_M


def _colour(strip: RoadStrip, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Colour:
    """Of the paint, against the road beside it."""
    paint = np.median(strip.bgr[rows, columns], axis=0)
    beside = round(0.5 / ACROSS_M)
    sides = [np.clip(columns + k, 0, strip.bgr.shape[1] - 1) for k in (-beside, beside)]
    road = np.median(np.concatenate([strip.bgr[rows, c] for c in sides]), axis=0)
    ratio = paint / np.maximum(road, 8.0)
    return "yellow" if ratio[0] < YELLOW_RATIO * ratio[1:].mean() else "white"
