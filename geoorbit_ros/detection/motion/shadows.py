"""Cast shadows, learnt from the scene itself.

All shadows of a scene at one time have the same colour: sky light over sky light plus sun light.
Ratios of vehicles to the road spread widely, those of shadows are all alike; and a shadow keeps the
pattern of the ground below it (grain, grass, markings), which a vehicle hides. Both together tell
a shadow from a dark car, without a threshold for how dark shadows are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.detector import Image

BINS = 48
"""Bins of the histogram of ratios. Chosen: 0.015 each; wider ones blur the peak, narrower ones are
noisier."""
LOWEST = 0.2
"""Least share of green light that a shadow leaves. Chosen: darker ones show no pattern of the
ground."""
HIGHEST = 0.92
"""Largest share of green light that a shadow leaves. Chosen: lighter ones are within
`MIN_CONTRAST` of the road in any case."""
MAX_SPREAD = 0.10
"""How far channels may disagree on how deep a shadow is. Chosen: larger removes parts of dark
vehicles, smaller leaves shadows."""
MAX_EXCESS = 0.06
"""How much deeper than its core a shadow may be. Chosen: as `MAX_SPREAD`."""
NOISE_LEVELS = 3.0
"""Grey levels that noise and compression add to both. Chosen: as `MAX_SPREAD`."""
HUE = 0.2
"""Channels of a shadow may differ in ratio this much, because the sky is bluer than the sun.
Chosen: larger learns from coloured vehicles, smaller from no shadow on a clear day."""
MEMORY_PIXELS = 300_000.0
"""Evidence fades so that about as many pixels count. Chosen: more follow the sun later, fewer are
noisier."""
MIN_PIXELS = 800.0
"""Fewer pixels with a shadow's colour don't show that there are shadows. Chosen: more learn shadows
later, fewer take one dark car for a shadow."""
MIN_PATTERN = 0.45
"""Share of the ground's pattern that must show through a shadow. Chosen: larger finds no shadow in
compressed video, smaller takes dark vehicles for shadows."""
HIGH_PEAK = 0.8
"""Peaks of the histogram this high relative to the highest count as much. Chosen: larger takes the
soft edge for the core, smaller takes noise for it."""
_SPREAD = 3
"""Bins of one peak on either side of its top: with `BINS`, the spread of a shadow's ratios. Chosen:
larger mixes core and edge, smaller is noisier."""
_STEP = 5
"""Every fifth pixel is learnt from, to save time. Chosen: larger learns later."""


class ShadowModel:
    """Learns how dark shadows are, and tells them from vehicles.

    Attributes:
        ratio: (3,) share of blue, green, red that shadows leave; None while there are none.
    """

    def __init__(self) -> None:
        self._count = np.zeros(BINS)
        self._sum = np.zeros((BINS, 3))
        self._pattern = np.zeros((BINS, 2))
        self.ratio: NDArray[np.float64] | None = None

    def learn(self, image: Image, road: Image, mask: NDArray[np.uint8]) -> None:
        """Learn from the pixels where image and road (H, W, 3) differ, 255 in the mask (H, W)."""
        where = np.flatnonzero(mask)[::_STEP]
        base, ratio = _ratios(image, road, where)
        middle = ratio[1]
        sound = (np.abs(ratio - middle) < HUE).all(axis=0)
        sound &= (middle > LOWEST) & (middle < HIGHEST) & (base.min(axis=0) > 30.0)
        where, ratio = where[sound], ratio[:, sound]
        bins = ((ratio[1] - LOWEST) * (BINS / (HIGHEST - LOWEST))).astype(np.intp)
        bins = np.clip(bins, 0, BINS - 1)
        seen, ground = _pattern(image, where), _pattern(road, where)
        fade = MEMORY_PIXELS / (MEMORY_PIXELS + len(where))
        self._count = fade * self._count + np.bincount(bins, minlength=BINS)
        columns = (*ratio, seen * ground, ground * ground)
        added = np.column_stack([np.bincount(bins, w, BINS) for w in columns])
        self._sum = fade * self._sum + added[:, :3]
        self._pattern = fade * self._pattern + added[:, 3:]
        self._find_peak()

    def remove(self, image: Image, road: Image, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The mask (H, W), 255 where image and road differ, without shadows.

        Between road and core of a shadow its soft edge takes all mixtures of both.
        """
        if self.ratio is None:
            return mask
        where = np.flatnonzero(mask)
        base, ratio = _ratios(image, road, where)
        missing = (1.0 - self.ratio).astype(np.float32)[:, None]
        depth = (1.0 - ratio) / missing
        least = np.minimum(np.minimum(base[0], base[1]), base[2])
        noise = NOISE_LEVELS / missing.min() / np.maximum(least, 8.0)
        high = np.maximum(np.maximum(depth[0], depth[1]), depth[2])
        low = np.minimum(np.minimum(depth[0], depth[1]), depth[2])
        dark = (depth[0] + depth[1] + depth[2]) * np.float32(1.0 / 3.0)
        shadow = (high - low < MAX_SPREAD + noise) & (dark > 0.0)
        shadow &= dark < 1.0 + MAX_EXCESS + noise
        left = mask.copy()
        left.reshape(-1)[where[shadow]] = 0
        return left

    def _find_peak(self) -> None:
        """The darkest of the high peaks of ratios through which the ground's pattern shows."""
        kernel = np.ones(2 * _SPREAD + 1)
        count = np.convolve(self._count, kernel, mode="same")
        seen, ground = (np.convolve(column, kernel, mode="same") for column in self._pattern.T)
        level = np.convolve(self._sum[:, 1], kernel, mode="same") / np.maximum(count, 1e-9)
        shown = seen / np.maximum(ground * level, 1e-9)
        likely = np.where((count > MIN_PIXELS) & (shown > MIN_PATTERN), count, 0.0)
        if likely.max() <= 0.0:
            self.ratio = None
            return
        # Soft edges make peaks too, at lighter ratios: the darkest of the high ones is the core.
        best = int(np.flatnonzero(likely >= HIGH_PEAK * likely.max())[0])
        near = slice(max(best - _SPREAD, 0), best + _SPREAD + 1)
        self.ratio = self._sum[near].sum(axis=0) / self._count[near].sum()


def _ratios(
    image: Image, road: Image, where: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(3, N) the road's channels at the pixels `where`, and the image's over them."""
    base = np.take(road.reshape(-1, 3), where, axis=0).T.astype(np.float32, order="C")
    seen = np.take(image.reshape(-1, 3), where, axis=0).T.astype(np.float32, order="C")
    return base, np.divide(seen, np.maximum(base, np.float32(1.0)), dtype=np.float32)


def _pattern(image: Image, where: NDArray[np.intp]) -> NDArray[np.float32]:
    """(N,) how much the green of each pixel at `where` exceeds that of its neighbours."""
    width = image.shape[1]
    green = image.reshape(-1, 3)[:, 1]
    inside = np.clip(where, 2 * width, len(green) - 2 * width - 1)
    steps = (-2, 2, -2 * width, 2 * width)
    around = np.sum([green[inside + step] for step in steps], axis=0, dtype=np.float32)
    return np.asarray(green[inside].astype(np.float32) - 0.25 * around)
