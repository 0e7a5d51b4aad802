"""How large a car is at each place of the image, learnt from the vehicles themselves.

Seen by a pinhole camera over flat ground, the height of an upright thing in pixels is linear in
where it stands: it vanishes at the horizon. Its width over its height varies slowly over the image.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

MEMORY_BOXES = 4000
MIN_BOXES = 120
"""Fewer boxes say nothing."""
TRIES = 150
TOLERANCE = 0.2
"""Cars are this equal in height, as a natural logarithm; other vehicles and faults are not."""
BANDS = 12
"""Heights count equally all over the image: boxes are thinned to as many of each band of rows."""
_MIN_SHARE = 0.3
"""Share of the boxes that must be cars for a fit to count."""
MIN_HEIGHT_PX = 3.0

Box = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels."""


class VehicleSizes:
    """The size of a car, by place.

    Attributes:
        known: Whether enough was seen.
    """

    def __init__(self) -> None:
        self.known = False
        self._boxes: deque[tuple[float, float, float, float]] = deque(maxlen=MEMORY_BOXES)
        self._height = np.zeros(3)
        self._shape = np.zeros(4)
        self._random = np.random.default_rng(1)
        self._scale = 1.0

    def add(self, boxes: NDArray[np.float64]) -> None:
        """Note boxes (N, 4) left, top, right, bottom, each of one whole vehicle."""
        self._boxes.extend(map(tuple, boxes.tolist()))

    def at(self, x: NDArray[np.float64], bottom: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) width and height of a car whose box ends at row `bottom`, its middle at `x`."""
        place = self._place(x, bottom)
        height = np.maximum(place[:, :3] @ self._height, MIN_HEIGHT_PX)
        shape = np.exp(np.clip(place @ self._shape, -1.0, 1.6))
        return np.column_stack([shape * height, height])

    def car(self, box: Box) -> tuple[float, float]:
        """Width and height of a car that stands where the box ends."""
        at = self.at(np.array([0.5 * (box[0] + box[2])]), np.array([float(box[3])]))[0]
        return float(at[0]), float(at[1])

    def learn(self) -> None:
        """Fit anew to the boxes noted so far."""
        if len(self._boxes) < MIN_BOXES:
            return
        boxes = np.array(self._boxes)
        self._scale = float(np.abs(boxes).max())
        x, bottom = 0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]
        size = boxes[:, 2:] - boxes[:, :2]
        kept = self._thinned(bottom)
        place = self._place(x, bottom)
        fit = self._line(place[kept, :3], size[kept, 1])
        if fit is None:
            return
        self._height = fit
        car = np.abs(np.log(size[:, 1] / np.maximum(place[:, :3] @ fit, 0.1))) < TOLERANCE
        ratio = np.log(size[car, 0] / size[car, 1])
        shape = np.array([float(np.median(ratio)), 0.0, 0.0, 0.0])
        for _ in range(5):  # least absolute deviations by reweighting
            off = np.abs(ratio - place[car] @ shape)
            weight = 1.0 / np.maximum(off, 0.05)
            weighted = place[car] * weight[:, None]
            ridge = np.diag([0.0, 1.0, 1.0, 1.0]) * 0.01 * weight.sum()
            shape = np.linalg.solve(weighted.T @ place[car] + ridge, weighted.T @ ratio)
        self._shape = shape
        self.known = True

    def _place(self, x: NDArray[np.float64], bottom: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = x / self._scale, bottom / self._scale
        return np.column_stack([np.ones_like(u), u, v, u * v])

    def _thinned(self, bottom: NDArray[np.float64]) -> NDArray[np.intp]:
        band = np.digitize(bottom, np.linspace(bottom.min(), bottom.max() + 1.0, BANDS + 1))
        most = max(len(bottom) // BANDS, 20)
        chosen = [
            self._random.permutation(np.flatnonzero(band == k))[:most] for k in range(1, BANDS + 1)
        ]
        return np.concatenate(chosen)

    def _line(
        self, place: NDArray[np.float64], height: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Heights as a linear function of place, by random samples (Fischler and Bolles 1981)."""
        best = _MIN_SHARE * len(height)
        best_fit: NDArray[np.float64] | None = None
        for _ in range(TRIES):
            three = self._random.choice(len(height), 3, replace=False)
            if abs(np.linalg.det(place[three])) < 1e-6:
                continue
            fit = np.linalg.solve(place[three], height[three])
            if fit[2] <= 0.0:  # what stands lower in the image is nearer, hence larger
                continue
            near = np.abs(np.log(height / np.maximum(place @ fit, 0.1))) < TOLERANCE
            if np.count_nonzero(near) > best:
                best = float(np.count_nonzero(near))
                weight = 1.0 / height[near]
                scaled = place[near] * weight[:, None]
                best_fit = np.asarray(np.linalg.lstsq(scaled, height[near] * weight, rcond=None)[0])
        return best_fit
