"""Colours of speeds, from slow to fast, and their legend."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.svg import Canvas, nice_step

Array = NDArray[np.float64]

COLOURS = 6
"""In `page.css`, `s0` (slow) to `s5` (fast): red over yellow to blue, which people tell apart who
don't tell red from green."""
USUAL_PERCENT = (3.0, 97.0)
"""Colours change between these percentiles of the speeds. Chosen: single vehicles leave the scale,
all others use it."""

LEAST_SPAN_KMH = 20.0
"""Colours stand for at least this range together. Chosen: less shows noise as differences."""
STEADY_SHARE = 0.25
"""Chosen: a vehicle at a bound keeps its colour; more shows changes late."""


@dataclass(frozen=True, slots=True)
class SpeedScale:
    """Classes of speed.

    Attributes:
        bound_kmh: (B,) speeds at which a colour ends and the next begins, at most five.
    """

    bound_kmh: Array

    def class_of(self, speed_kmh: Array) -> NDArray[np.int64]:
        """(N,) number of the class of each speed."""
        return np.searchsorted(self.bound_kmh, speed_kmh, side="right").astype(np.int64)

    def steady_class_of(self, speed_kmh: Array) -> NDArray[np.int64]:
        """The same for the (N,) speeds of one vehicle in time order, without flicker.

        The class stays until a speed is `STEADY_SHARE` of a class beyond its bounds.
        """
        bounds = np.concatenate(([-np.inf], self.bound_kmh, [np.inf]))
        margin = STEADY_SHARE * float(np.diff(self.bound_kmh).min(initial=10.0))
        classes = self.class_of(speed_kmh)
        for k in range(1, len(classes)):
            before = classes[k - 1]
            if bounds[before] - margin <= speed_kmh[k] < bounds[before + 1] + margin:
                classes[k] = before
        return classes

    def css(self, number: int) -> str:
        """CSS class of a class of speed."""
        return f"s{round(number * (COLOURS - 1) / max(len(self.bound_kmh), 1))}"

    def texts(self) -> list[str]:
        """What each class holds."""
        bounds = [f"{b:g}" for b in self.bound_kmh]
        if not bounds:
            return ["all speeds"]
        between = [f"{a} to {b}" for a, b in pairwise(bounds)]
        return [f"below {bounds[0]}", *between, f"{bounds[-1]} and more"]

    def draw_legend(self, canvas: Canvas, left: float, base: float) -> None:
        """A row of colours with their speeds."""
        canvas.text(left, base, "speed, km/h:", "label")
        x = left + 84.0
        for number, text in enumerate(self.texts()):
            canvas.raw(
                f'<rect x="{x:.1f}" y="{base - 10:.1f}" width="22" height="11" rx="2" '
                f'class="swatch {self.css(number)}"/>'
            )
            canvas.text(x + 28, base, text, "label")
            x += 44.0 + 6.6 * len(text)


def speed_scale(speed_kmh: Array) -> SpeedScale:
    """Round classes of speed for (N,) speeds."""
    known = speed_kmh[np.isfinite(speed_kmh)]
    if not len(known):
        return SpeedScale(np.empty(0))
    low, high = np.percentile(known, USUAL_PERCENT)
    step = nice_step(max(float(high - low), LEAST_SPAN_KMH), COLOURS - 1)
    bounds = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    while len(bounds) > COLOURS - 1:
        step *= 2.0
        bounds = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    bounds = bounds[bounds > 0.0]
    return SpeedScale(bounds if len(bounds) else np.array([np.round(np.median(known))]))
