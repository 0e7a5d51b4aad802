"""GeoLane, the paper's method (section III-B), as the baseline that every table compares against.

Histogram of mean lateral positions, Gaussian smoothing, peaks, KMeans, spline x = f(y),
w = 2 sigma, normals. Its coordinates are the paper's: y is longitude (east), x is latitude
(north), hence it suits roads that run east-west.

Where the paper leaves a number open, its published configuration fills it in: 50 bins, a five-tap
Gaussian of sigma 2, peaks at least three bins apart, at least 1 high and 1 prominent, 30 points.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray
from sklearn.cluster import KMeans

from geoorbit_ros.core.lanes import CrossSection, Lane, LaneMap
from geoorbit_ros.core.plugins import register
from geoorbit_ros.core.tables import TRACK_DTYPE
from geoorbit_ros.lanes.parameters import LaneParameters

BINS = 50
"""Of the histogram, from the published configuration."""
REFERENCE_SMOOTHING = 10.0
"""theta_smoothing at which the histogram has `BINS` bins."""
KERNEL_SIGMA_BINS = 2.0
"""Of the Gaussian that smooths the histogram, from the published configuration."""
PEAK_DISTANCE_BINS = 3
"""Least distance between peaks, from the published configuration."""
CENTERLINE_POINTS = 30
"""Points per lane, from the published configuration."""
MIN_POINTS = 5
"""A lane needs so many rows. A cubic spline needs four; chosen: more lose short tracks."""
SPLINE_TRIES = 8
"""How often the smoothing is doubled, up to 128 times the first. Chosen: more cost time, fewer lose
lanes at the corners of theta."""
MEMORY_S = 60.0
"""The paper's observation period."""


@register("estimator", "geolane")
class GeoLaneEstimator:
    """`LaneEstimator` that runs the paper's method on the last `MEMORY_S` of tracks."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._frames: list[bytes] = []

    def add(self, stamp_ns: int, rows: NDArray[np.void]) -> None:
        """Take one frame of `TRACK_DTYPE` rows; stamps increase from call to call."""
        self._stamps.append(stamp_ns)
        self._frames.append(rows.tobytes())

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        """Lanes of the observation period. Every lane is `confirmed`: the paper has no others."""
        if not self._stamps:
            return LaneMap(0, ())
        stamp_ns = self._stamps[-1]
        first = int(np.searchsorted(self._stamps, stamp_ns - MEMORY_S * 1e9))
        self._stamps, self._frames = self._stamps[first:], self._frames[first:]
        rows = np.frombuffer(b"".join(self._frames), TRACK_DTYPE)
        lanes, sections = detect(rows, parameters)
        return LaneMap(stamp_ns, tuple(lanes), tuple(sections))


def detect(
    rows: NDArray[np.void], parameters: LaneParameters
) -> tuple[list[Lane], list[CrossSection]]:
    """The paper's four stages on a set of track rows.

    Args:
        rows: (N,) `TRACK_DTYPE`, frames in time order.
        parameters: Theta.
    """
    rows = rows[np.isfinite(rows["x"]) & np.isfinite(rows["y"])]
    x, y = rows["y"].astype(np.float64), rows["x"].astype(np.float64)
    ids, owner = np.unique(rows["track_id"], return_inverse=True)
    if len(ids) == 0:
        return [], []
    count = np.bincount(owner)
    x_mean = np.bincount(owner, x) / count
    lanes: list[Lane] = []
    sections: list[CrossSection] = []
    for eastward, group in _lane_groups(owner, y, len(ids)):
        centers, section = _lane_centers(x_mean[group], parameters, eastward)
        sections.append(section)
        if len(centers) == 0:
            continue
        # "KMeans clustering is applied to the set of x-coordinates": one per trajectory.
        labels = KMeans(len(centers), random_state=0).fit_predict(x_mean[group][:, None])
        label_of_track = np.full(len(ids), -1)
        label_of_track[group] = labels
        label = label_of_track[owner]
        for k in range(len(centers)):
            mine = label == k
            lane = _lane(x[mine], y[mine], int((labels == k).sum()), eastward, parameters)
            if lane is not None:
                lanes.append(lane)
    return lanes, sections


def _lane_groups(
    owner: NDArray[np.int64], y: NDArray[np.float64], tracks: int
) -> list[tuple[bool, NDArray[np.int64]]]:
    """Tracks by direction of travel along y, for the carriageways of the paper's contours."""
    first = np.full(tracks, -1)
    order = np.arange(len(owner))
    first[owner[::-1]] = order[::-1]
    last = np.full(tracks, -1)
    last[owner] = order
    eastward = y[last] > y[first]
    groups = [(True, np.flatnonzero(eastward)), (False, np.flatnonzero(~eastward))]
    return [(e, g) for e, g in groups if len(g)]


def _lane_centers(
    x_mean: NDArray[np.float64], parameters: LaneParameters, eastward: bool
) -> tuple[NDArray[np.float64], CrossSection]:
    """Peaks of the smoothed histogram of mean lateral positions."""
    bins = max(2, round(BINS * REFERENCE_SMOOTHING / parameters.smoothing))
    histogram, edges = np.histogram(x_mean, bins=bins)
    smooth = scipy.ndimage.gaussian_filter1d(
        histogram.astype(np.float64), KERNEL_SIGMA_BINS, mode="constant", truncate=1.0
    )
    peaks, _ = scipy.signal.find_peaks(
        smooth, height=1.0, distance=PEAK_DISTANCE_BINS, prominence=2.0 * parameters.angle
    )
    middle = 0.5 * (edges[1:] + edges[:-1])
    sense = 1.0 if eastward else -1.0
    section = CrossSection(
        90.0 if eastward else 270.0, sense * middle, smooth / np.diff(edges), sense * middle[peaks]
    )
    return middle[peaks], section


def _lane(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    vehicles: int,
    eastward: bool,
    parameters: LaneParameters,
) -> Lane | None:
    """Spline x(y; s), width 2 sigma, boundaries along the normals."""
    if len(x) < MIN_POINTS:
        return None
    order = np.argsort(y, kind="stable")
    x, y = x[order], y[order]
    sigma = max(float(np.std(x)), 1e-6)
    if y[-1] - y[0] <= 0.0:
        return None
    y_fit = np.linspace(y[0], y[-1], CENTERLINE_POINTS)
    x_fit = _spline(x, y, y_fit, sigma, parameters.smoothing)
    if x_fit is None:
        return None
    dx, dy = np.gradient(x_fit), np.gradient(y_fit)
    norm = np.hypot(dx, dy)
    # n = (-dy, dx) / |.| in the paper's (x, y) order.
    n_x, n_y = -dy / norm, dx / norm
    width = 2.0 * sigma * parameters.width_scale
    sides = {
        side: np.column_stack([y_fit + side * 0.5 * width * n_y, x_fit + side * 0.5 * width * n_x])
        for side in (0.0, 1.0, -1.0)
    }
    # In (east, north) the paper's normal points to the right of +y travel.
    left, right = (sides[-1.0], sides[1.0]) if eastward else (sides[1.0], sides[-1.0])
    sense = 1 if eastward else -1
    return Lane(
        0,
        sides[0.0][::sense],
        left[::sense],
        right[::sense],
        width,
        float("nan"),
        1.0,
        "confirmed",
        float(vehicles),
    )


def _spline(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    y_fit: NDArray[np.float64],
    sigma: float,
    smoothing: float,
) -> NDArray[np.float64] | None:
    """x(y; s) at `y_fit`; None where FITPACK finds none.

    Asked for too little smoothing, FITPACK gives up and returns a curve that is not finite or
    swings far away from its points. Then s is doubled, as its manual advises, until the curve
    stays within one spread of them.
    """
    # FITPACK's s bounds sum((w r)^2); with w = 1/sigma its neutral value is the number of points.
    bound = smoothing / REFERENCE_SMOOTHING * len(x)
    low, high = float(x.min()), float(x.max())
    for _ in range(SPLINE_TRIES):
        spline = scipy.interpolate.UnivariateSpline(y, x, w=np.full(len(x), 1.0 / sigma), s=bound)
        x_fit = np.asarray(spline(y_fit), dtype=np.float64)
        if np.all((x_fit > 2.0 * low - high - sigma) & (x_fit < 2.0 * high - low + sigma)):
            return x_fit
        bound *= 2.0
    return None
