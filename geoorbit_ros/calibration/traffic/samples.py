"""Boxes of vehicles at a few places along their way, made smooth, for a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BORDER_RATIO
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.vehicle_size import GROUP
from geoorbit_ros.core.tables import (
    FLAG_GROUND_POINT,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    VEHICLE_CLASSES,
    Frames,
)

Array = NDArray[np.float64]

SAMPLES = 10
"""Places per vehicle, evenly along its way in the image. Chosen: more cost time, and say little
more, as neighbouring boxes have the same errors; fewer miss how its box changes."""
SPACING_S = 0.24
"""Least time between two places. Chosen: larger leaves too few of fast vehicles."""
WINDOW_S = 0.3
"""A place's box is a smooth curve's, through the boxes of this time before and after. Chosen:
longer flattens boxes that grow fast, shorter keeps more of their noise."""
WAY_STEP, WAY_STEP_S, WAY_POINTS = 0.2, 0.12, 60
"""Between two boxes of a vehicle's way: at least so many sizes of its box and seconds, and so many
boxes at most. Chosen: more say the same again, fewer lose where a bend begins."""
MIN_BOXES = 4
"""Vehicles with fewer good boxes are left out: no curve goes through less."""
MIN_WAY = 1.5
"""Vehicles that move less, in sizes of their boxes, are left out: parked ones, false boxes."""
COVERED = 0.1
"""Boxes are left out of which more is covered by the box of a nearer vehicle: detectors draw what
they see. Chosen: larger takes cut boxes for small vehicles, smaller leaves too few."""
MIN_SIDE_PX = 4.0
"""Narrower and lower boxes are left out: rounding to pixels is more than a tenth of them."""


@dataclass(frozen=True, slots=True)
class TrafficSamples:
    """Boxes of K vehicles at N places, ordered by vehicle and time.

    Attributes:
        vehicle: (N,) 0 to K - 1.
        group: (K,) size group (`vehicle_size`).
        time_s: (N,) since the first frame.
        edges: (4, N) left, top, right, bottom; ideal pixels where a lens is known.
        vehicles_seen: How many tracks of vehicles there were, usable or not.
        ground_points: Share of the rows that are ground points, without width and height.
        way_vehicle: (M,) of boxes along the ways, more of them and as they were seen.
        way_time_s: (M,) of these.
        way_edges: (4, M) of these.
    """

    vehicle: NDArray[np.intp]
    group: NDArray[np.intp]
    time_s: Array
    edges: Array
    vehicles_seen: int
    ground_points: float
    way_vehicle: NDArray[np.intp]
    way_time_s: Array
    way_edges: Array

    def take(self, vehicles: NDArray[np.intp]) -> TrafficSamples:
        """Those of some vehicles, renumbered in their old order."""
        kept = np.isin(self.vehicle, vehicles)
        number = np.unique(self.vehicle[kept], return_inverse=True)[1]
        group = self.group[np.unique(self.vehicle[kept])]
        way = np.isin(self.way_vehicle, vehicles)
        return TrafficSamples(
            number,
            group,
            self.time_s[kept],
            self.edges[:, kept],
            self.vehicles_seen,
            self.ground_points,
            np.unique(self.way_vehicle[way], return_inverse=True)[1],
            self.way_time_s[way],
            self.way_edges[:, way],
        )


def sample_traffic(
    frames: Frames, image_size: tuple[int, int], lens: Lens | None = None
) -> TrafficSamples:
    """Places along the way of every vehicle whose boxes are whole and free.

    Args:
        frames: `PIXEL_TRACK_DTYPE`.
        image_size: (width, height) in pixels.
        lens: Distortion to take out of the boxes.
    """
    rows, time_s = frames.rows, (frames.row_stamp_ns() - frames.stamp_ns[:1]) / 1e9
    vehicle = np.isin(rows["class_id"], VEHICLE_CLASSES) | (rows["class_id"] < 0)
    x, y, w, h = (rows[name].astype(np.float64) for name in ("x", "y", "width", "height"))
    edges = np.stack((x - w / 2, y - h / 2, x + w / 2, y + h / 2))
    good = vehicle & whole(frames, edges, image_size) & ~covered(frames, edges)
    ideal = edges if lens is None else _without_lens(edges, lens)
    good &= np.isfinite(ideal).all(axis=0)
    order = np.argsort(rows["track_id"], kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(rows["track_id"][order])) + 1)
    found: list[Array] = []
    ways: list[Array] = []
    groups: list[int] = []
    for part in parts:
        use = part[good[part]]
        if len(use) < MIN_BOXES:
            continue
        places = _places(time_s[use], ideal[:, use])
        if len(places) >= 2:
            votes = np.bincount(GROUP[rows["class_id"][use] & 255], rows["score"][use] + 1e-3)
            found.append(np.column_stack((np.full(len(places), len(groups)), places)))
            way = use[_along_way(time_s[use], ideal[:, use])]
            number = np.full(len(way), len(groups))
            ways.append(np.column_stack((number, time_s[way], ideal[:, way].T)))
            groups.append(int(votes.argmax()))
    table, boxes = (np.concatenate([np.empty((0, 6)), *rows]) for rows in (found, ways))
    points = (rows["flags"] & FLAG_GROUND_POINT) != 0
    return TrafficSamples(
        table[:, 0].astype(np.intp),
        np.array(groups, dtype=np.intp),
        table[:, 1],
        table[:, 2:].T,
        len(np.unique(rows["track_id"][vehicle])),
        float(points.mean()) if len(points) else 0.0,
        boxes[:, 0].astype(np.intp),
        boxes[:, 1],
        boxes[:, 2:].T,
    )


def _along_way(time_s: Array, edges: Array) -> NDArray[np.intp]:
    """Which boxes of a vehicle are far enough from each other, by way and by time."""
    centre = (edges[:2] + edges[2:]) / 2
    size = np.sqrt((edges[2:] - edges[:2]).prod(axis=0))
    step = np.hypot(*np.diff(centre)) / (0.5 * (size[1:] + size[:-1])) / WAY_STEP
    every = np.minimum(step, np.diff(time_s) / WAY_STEP_S)
    gone = np.append(0.0, np.cumsum(every))
    stride = max(1.0, gone[-1] / WAY_POINTS)
    return np.flatnonzero(np.diff(np.floor(gone / stride), prepend=-1.0) > 0)


def whole(frames: Frames, edges: Array, image_size: tuple[int, int]) -> NDArray[np.bool_]:
    """(N,) rows that are observed and not cut by the image's border."""
    size = np.array(image_size, dtype=np.float64)[:, None]
    border = BORDER_RATIO * size
    bad = FLAG_PREDICTED | FLAG_TRUNCATED | FLAG_GROUND_POINT
    good = (frames.rows["flags"] & np.uint32(bad)) == 0
    good &= ((edges[:2] > border) & (edges[2:] < size - border)).all(axis=0)
    return np.asarray(good & (edges[2:] - edges[:2] >= MIN_SIDE_PX).all(axis=0))


def covered(frames: Frames, edges: Array) -> NDArray[np.bool_]:
    """(N,) rows covered by another box of the frame that ends lower, and so is nearer."""
    found = np.zeros(len(frames.rows), dtype=bool)
    for begin, end in zip(frames.offset[:-1].tolist(), frames.offset[1:].tolist(), strict=True):
        if end - begin < 2:
            continue
        low, high = edges[:2, begin:end], edges[2:, begin:end]
        shared = np.minimum(high[:, :, None], high[:, None])
        shared = np.clip(shared - np.maximum(low[:, :, None], low[:, None]), 0.0, None).prod(axis=0)
        shared *= high[1][None] > high[1][:, None]
        found[begin:end] = shared.max(axis=1) > COVERED * (high - low).prod(axis=0)
    return found


def _without_lens(edges: Array, lens: Lens) -> Array:
    """Edges (4, N) of the boxes that a pinhole would show: of the middles of the four sides."""
    middle = (edges[:2] + edges[2:]) / 2
    left, right = (lens.undistort(np.stack((edges[k], middle[1]), axis=-1)) for k in (0, 2))
    top, bottom = (lens.undistort(np.stack((middle[0], edges[k]), axis=-1)) for k in (1, 3))
    return np.stack((left[:, 0], top[:, 1], right[:, 0], bottom[:, 1]))


def _places(time_s: Array, edges: Array) -> Array:
    """(M, 5) times and smooth edges at even places of one vehicle's way; (0, 5) where it stands."""
    centre = (edges[:2] + edges[2:]) / 2
    size = float(np.sqrt(np.median((edges[2:] - edges[:2]).prod(axis=0))))
    if np.ptp(centre, axis=1).max() < MIN_WAY * size:
        return np.empty((0, 5))
    lasts = time_s[-1] - time_s[0]
    every = max(1, round(len(time_s) * WINDOW_S / max(lasts, WINDOW_S)))
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(centre[:, ::every]))))
    way = np.interp(time_s, time_s[::every], way) + 1e-6 * np.arange(len(time_s))
    count = int(np.clip(lasts / SPACING_S, 2, SAMPLES))
    found: list[Array] = []
    for at in np.interp(np.linspace(0.03, 0.97, count) * way[-1], way, time_s):
        if found and at - found[-1][0] < SPACING_S:
            continue
        near = np.abs(time_s - at) <= WINDOW_S
        if (count := int(near.sum())) < 2:
            continue
        powers = np.vander(time_s[near] - at, 3 if count >= 6 else 2, increasing=True)
        smooth = np.linalg.lstsq(powers, edges[:, near].T, rcond=None)[0][0]
        if (smooth[2:] - smooth[:2] >= MIN_SIDE_PX).all():
            found.append(np.append(at, smooth))
    return np.array(found).reshape(-1, 5)
