"""What a detector and a tracker would have made of the traffic, with the faults of real ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_TRUNCATED, PIXEL_TRACK_DTYPE
from geoorbit_ros.scenes.camera import PinholeCamera, body_corners
from geoorbit_ros.scenes.scene import DetectorFaults

GAP_S = 0.5
"""A tracker that loses a vehicle for longer gives it a new id. Chosen: less than this package's
tracker needs (`max_gap_s`), as a poorer tracker would."""
BIAS_TIME_S = 0.7
"""Correlation time of a box's slowly varying error. Chosen: longer than a frame, shorter than a
passage."""
MIN_VISIBLE_SHARE = 0.3
"""A box cut by the image border to less than this is not detected. Chosen: detectors trained on
whole vehicles miss small parts."""
FALSE_BOX_SIZE_PX = np.array([60.0, 40.0])
"""Width and height of a false box. Chosen: a car's at middle distance."""
FALSE_BOX_JITTER_PX = 2.0
"""1-sigma of a false box's edges. Chosen: more than `edge_noise_px`, so that it seems to move."""


@dataclass(frozen=True, slots=True)
class View:
    """Vehicles in one frame.

    Attributes:
        vehicle: (N,) vehicle numbers.
        xy: (N, 2) middle of the footprint.
        heading: (N,) radians.
        size: (N, 3) length, width, height.
        coco_class: (N,) true class.
    """

    vehicle: NDArray[np.int64]
    xy: NDArray[np.float64]
    heading: NDArray[np.float64]
    size: NDArray[np.float64]
    coco_class: NDArray[np.int64]


def exact_boxes(
    camera: PinholeCamera, view: View
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Boxes (N, 4) left, top, right, bottom, unclipped, NaN when not in front; depths (N,)."""
    pixel, depth = camera.project(body_corners(view.xy, view.heading, view.size))
    in_front = depth.min(axis=1) > 1.0
    boxes = np.column_stack([pixel.min(axis=1), pixel.max(axis=1)])
    boxes[~in_front] = np.nan
    return boxes, depth.mean(axis=1)


def true_boxes(camera: PinholeCamera, view: View, min_height_px: float) -> NDArray[np.void]:
    """Rows (M,) `PIXEL_TRACK_DTYPE`: the exact boxes in the image, id = vehicle number + 1.

    Left out are those below `min_height_px` and those cut by the border to less than
    `MIN_VISIBLE_SHARE`; cut ones are flagged, hidden ones are there.
    """
    boxes, _ = exact_boxes(camera, view)
    width, height = camera.image_size
    clipped = np.clip(boxes, 0.0, [width, height, width, height])
    size, full = clipped[:, 2:] - clipped[:, :2], boxes[:, 2:] - boxes[:, :2]
    area, whole = size.prod(axis=1), full.prod(axis=1)
    tall = np.nan_to_num(size[:, 1])
    keep = (tall >= min_height_px) & (area >= MIN_VISIBLE_SHARE * whole)
    rows = np.zeros(int(keep.sum()), PIXEL_TRACK_DTYPE)
    _fill(rows, clipped[keep])
    rows["score"], rows["class_id"] = 1.0, view.coco_class[keep]
    rows["track_id"] = view.vehicle[keep] + 1
    rows["flags"] = np.where(area[keep] < whole[keep], FLAG_TRUNCATED, 0)
    return rows


class DetectorModel:
    """Turns views into `tracks_px` rows, frame by frame."""

    def __init__(self, camera: PinholeCamera, faults: DetectorFaults, seed: int) -> None:
        self._camera = camera
        self._faults = faults
        self._random = np.random.default_rng([seed, 2])
        self._track: dict[int, int] = {}
        self._seen_s: dict[int, float] = {}
        self._bias: dict[int, NDArray[np.float64]] = {}
        self._last_s = 0.0
        self._next_id = 1
        width, height = camera.image_size
        count = faults.false_tracks
        self._false_places = self._random.uniform([0, 0], [0.9 * width, 0.9 * height], (count, 2))
        self._false_ids = [self._new_id() for _ in range(count)]

    def detect(self, time_s: float, view: View) -> tuple[NDArray[np.void], NDArray[np.int64]]:
        """Rows (M,) `PIXEL_TRACK_DTYPE` and the vehicle (M,) behind each, -1 behind a false one."""
        boxes, depth = exact_boxes(self._camera, view)
        clipped = self._clip(boxes)
        keep = self._detected(boxes, clipped, depth)
        kept = np.flatnonzero(keep)
        noisy = self._clip(clipped[kept] + self._noise(time_s, view.vehicle[kept], clipped[kept]))
        rows = np.zeros(len(kept) + len(self._false_places), PIXEL_TRACK_DTYPE)
        real = rows[: len(kept)]
        _fill(real, noisy)
        real["class_id"] = self._classes(view.coco_class[kept])
        real["score"] = np.clip(
            0.9 - 0.02 * depth[kept] / 10 + 0.05 * self._random.standard_normal(len(kept)),
            0.25,
            0.97,
        )
        real["track_id"] = [self._id(time_s, int(v)) for v in view.vehicle[kept]]
        self._switch(time_s, view.vehicle[kept], noisy)
        self._add_false_boxes(rows[len(kept) :])
        self._last_s = time_s
        sound = (rows["width"] > 1.0) & (rows["height"] > 1.0)
        vehicles = np.append(view.vehicle[kept], np.full(len(self._false_places), -1))
        return rows[sound], vehicles[sound]

    def _clip(self, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        width, height = self._camera.image_size
        return np.asarray(np.clip(boxes, 0.0, [width, height, width, height]))

    def _detected(
        self,
        boxes: NDArray[np.float64],
        clipped: NDArray[np.float64],
        depth: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        faults = self._faults
        size, full = clipped[:, 2:] - clipped[:, :2], boxes[:, 2:] - boxes[:, :2]
        area, whole = size.prod(axis=1), full.prod(axis=1)
        tall = np.nan_to_num(size[:, 1])
        keep = (tall >= faults.min_height_px) & (area >= MIN_VISIBLE_SHARE * whole)
        keep &= _covered(clipped, depth) <= faults.occluded_share
        lost = faults.miss_rate + 0.5 * np.exp(-(tall - faults.min_height_px) / 6.0)
        return np.asarray(keep & (self._random.uniform(size=len(boxes)) >= lost))

    def _noise(
        self, time_s: float, vehicles: NDArray[np.int64], boxes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        fade = np.exp(-max(time_s - self._last_s, 0.0) / BIAS_TIME_S)
        fresh = self._random.standard_normal((len(vehicles), 4))
        for k, vehicle in enumerate(vehicles.tolist()):
            old = self._bias.get(vehicle)
            if old is not None:
                fresh[k] = fade * old + np.sqrt(1.0 - fade**2) * fresh[k]
            self._bias[vehicle] = fresh[k].copy()
        size = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        independent = self._random.standard_normal((len(vehicles), 4))
        return np.asarray(
            self._faults.edge_noise_share * size * fresh + self._faults.edge_noise_px * independent
        )

    def _classes(self, true: NDArray[np.int64]) -> NDArray[np.int64]:
        wrong = self._random.uniform(size=len(true)) < self._faults.class_error
        return np.where(wrong, np.where(true == 2, 7, 2), true)

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1

    def _id(self, time_s: float, vehicle: int) -> int:
        if time_s - self._seen_s.get(vehicle, -np.inf) > GAP_S:
            self._track[vehicle] = self._new_id()
        self._seen_s[vehicle] = time_s
        return self._track[vehicle]

    def _switch(
        self, time_s: float, vehicles: NDArray[np.int64], boxes: NDArray[np.float64]
    ) -> None:
        """Now and then two tracks whose boxes touch swap vehicles from the next frame on."""
        chance = self._faults.id_switch_per_minute * (time_s - self._last_s) / 60.0
        if len(vehicles) < 2 or self._random.uniform() >= chance:
            return
        overlap = _overlap(boxes)
        np.fill_diagonal(overlap, 0.0)
        a, b = np.unravel_index(int(np.argmax(overlap)), overlap.shape)
        if overlap[a, b] > 0.0:
            one, two = int(vehicles[a]), int(vehicles[b])
            self._track[one], self._track[two] = self._track[two], self._track[one]

    def _add_false_boxes(self, rows: NDArray[np.void]) -> None:
        jitter = self._random.normal(0.0, FALSE_BOX_JITTER_PX, (len(rows), 4))
        boxes = (
            np.column_stack([self._false_places, self._false_places + FALSE_BOX_SIZE_PX]) + jitter
        )
        _fill(rows, self._clip(boxes))
        rows["class_id"], rows["score"] = 2, 0.4
        rows["track_id"] = self._false_ids


def _fill(rows: NDArray[np.void], boxes: NDArray[np.float64]) -> None:
    rows["x"], rows["y"] = 0.5 * (boxes[:, 0] + boxes[:, 2]), 0.5 * (boxes[:, 1] + boxes[:, 3])
    rows["width"], rows["height"] = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]


def _overlap(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, N) area that each pair of boxes shares."""
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    return np.asarray(np.clip(high - low, 0.0, None).prod(axis=2))


def _covered(boxes: NDArray[np.float64], depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) share of each box covered by the boxes of nearer vehicles (at most their sum)."""
    area = np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1e-9)
    shared = np.nan_to_num(_overlap(boxes))
    nearer = depth[None, :] < depth[:, None]
    return np.asarray((shared * nearer).sum(axis=1) / area)
