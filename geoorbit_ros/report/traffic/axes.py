"""Axes of diagrams: from values to pixels, ticks, grids, and time in which nobody watched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.svg import Canvas, nice_step
from geoorbit_ros.traffic.interval_clock import CLOCK_SINCE_NS, NS, IntervalClock, ObservedTime

Array = NDArray[np.float64]
Ticks = Sequence[tuple[float, str]]
"""Places on an axis and what is written there."""

WIDTH_PX = 1040.0
"""Width of all drawings. Layout of the page."""
LEFT_PX, RIGHT_PX = 64.0, 76.0
"""Margins of a diagram. Layout of the page."""
TIME_STEPS_S = (
    *(1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 900, 1800),
    *(3600, 7200, 10_800, 14_400, 21_600, 43_200, 86_400),
)
"""Distances of ticks on a clock, in seconds."""
DAY_S = 86_400


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle of a drawing with an axis along each side.

    Attributes:
        left: Pixel of its left edge.
        top: Pixel of its upper edge.
        width: Pixels.
        height: Pixels.
        x: Values at the left and right edge.
        y: Values at the lower and upper edge.
    """

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def right(self) -> float:
        """Pixel of its right edge."""
        return self.left + self.width

    @property
    def bottom(self) -> float:
        """Pixel of its lower edge."""
        return self.top + self.height

    def to_pixel(self, x: Array, y: Array) -> Array:
        """(N, 2) pixels of N pairs of values."""
        across = self.left + (np.asarray(x) - self.x[0]) / (self.x[1] - self.x[0]) * self.width
        down = self.bottom - (np.asarray(y) - self.y[0]) / (self.y[1] - self.y[0]) * self.height
        return np.column_stack((across, down))

    def x_pixel(self, value: float) -> float:
        """Pixel of one value on the axis across."""
        return float(self.to_pixel(np.array([value]), np.array([self.y[0]]))[0, 0])

    def y_pixel(self, value: float) -> float:
        """Pixel of one value on the upright axis."""
        return float(self.to_pixel(np.array([self.x[0]]), np.array([value]))[0, 1])


def limits(values: Array, parts: int = 4, *, from_zero: bool = True) -> tuple[float, float]:
    """Round ends of an axis that holds all values that are known.

    Args:
        values: Values; NaN is not known.
        parts: About how many ticks there will be.
        from_zero: Begin at 0; else only where values reach below half of the largest.
    """
    known = values[np.isfinite(values)]
    high = float(known.max(initial=0.0))
    low = float(known.min(initial=high))
    if from_zero or low < 0.5 * high:
        low = 0.0
    if high - low < 1e-3 * max(high, 1.0):
        low, high = max(low - 5.0, 0.0), high + 5.0
    step = nice_step(high - low, parts)
    return float(np.floor(low / step) * step), float(np.ceil(high / step) * step)


def value_ticks(low: float, high: float, parts: int = 4) -> list[tuple[float, str]]:
    """Round values from `low` to `high`."""
    step = nice_step(high - low, parts)
    values = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    return [(float(v), f"{v + 0.0:,.10g}") for v in values]


def time_ticks(first_ns: int, last_ns: int, zone: str, parts: int = 9) -> tuple[Ticks, str]:
    """Ticks in seconds since `first_ns`, and what the axis says of them.

    On a clock they are whole hours, minutes or seconds of the time zone, and dates at midnight.
    Times since a recording began are in seconds, minutes or hours.
    """
    span_s = max((last_ns - first_ns) / NS, 1e-3)
    step_s = next((s for s in TIME_STEPS_S if span_s / s <= parts), DAY_S)
    clocked = first_ns >= CLOCK_SINCE_NS
    edges = IntervalClock(step_s, zone).edges(first_ns, last_ns)
    stamps = [int(e) for e in edges if first_ns <= e <= last_ns]
    stamps = stamps[:: max(len(stamps) // parts, 1)]
    at = [(stamp - first_ns) / NS for stamp in stamps]
    if not clocked:
        unit, name = (1, "s") if step_s < 60 else (60, "min") if step_s < 3600 else (3600, "h")
        texts = [f"{stamp / NS / unit:.10g}" for stamp in stamps]
        return list(zip(at, texts, strict=True)), f"time in the recording, {name}"
    local = [datetime.fromtimestamp(stamp // NS, ZoneInfo(zone)) for stamp in stamps]
    texts = [_clock_text(moment, step_s) for moment in local]
    begin = datetime.fromtimestamp(first_ns // NS, ZoneInfo(zone))
    return (
        list(zip(at, texts, strict=True)),
        f"time of day, {zone}, from {begin.day} {begin:%b %Y}",
    )


def _clock_text(moment: datetime, step_s: int) -> str:
    if step_s >= DAY_S or (moment.hour == moment.minute == moment.second == 0):
        return f"{moment.day} {moment:%b}"
    return f"{moment:%H:%M:%S}" if step_s < 60 else f"{moment:%H:%M}"


def draw_y_axis(canvas: Canvas, panel: Panel, ticks: Ticks, label: str) -> None:
    """Grid lines across, values beside them, and what they are, above the panel."""
    for value, text in ticks:
        y = panel.y_pixel(value)
        canvas.line(np.array([[panel.left, y], [panel.right, y]]), "grid")
        canvas.text(panel.left - 8, y + 4, text, "label", "end")
    if label:
        canvas.text(panel.left - 44, panel.top - 12, label, "label")


def draw_x_axis(
    canvas: Canvas, panel: Panel, ticks: Ticks, label: str, *, written: bool = True
) -> None:
    """Grid lines upright and the base line; values and what they are below, where `written`."""
    base = panel.bottom
    for value, text in ticks:
        x = panel.x_pixel(value)
        canvas.line(np.array([[x, panel.top], [x, base]]), "grid")
        if written:
            canvas.line(np.array([[x, base], [x, base + 4]]), "axis")
            canvas.text(x, base + 17, text, "label", "middle")
    canvas.line(np.array([[panel.left, base], [panel.right, base]]), "axis")
    if written:
        canvas.text((panel.left + panel.right) / 2, base + 35, label, "label", "middle")


def draw_unwatched(
    canvas: Canvas, panel: Panel, spans: Sequence[tuple[float, float]], name: str
) -> None:
    """Hatch the time, in values of the axis across, in which nobody watched."""
    if not spans:
        return
    canvas.raw(
        f'<defs><pattern id="{name}" width="7" height="7" patternUnits="userSpaceOnUse" '
        'patternTransform="rotate(45)"><path d="M0 0V7" class="hatch"/></pattern></defs>'
    )
    for begin, end in spans:
        x0, x1 = panel.x_pixel(max(begin, panel.x[0])), panel.x_pixel(min(end, panel.x[1]))
        canvas.raw(
            f'<rect x="{x0:.1f}" y="{panel.top:.1f}" width="{max(x1 - x0, 0.5):.1f}" '
            f'height="{panel.height:.1f}" class="unwatched" style="fill:url(#{name})">'
            "<title>not watched</title></rect>"
        )
        if x1 - x0 > 84:
            canvas.text((x0 + x1) / 2, panel.top + panel.height / 2, "not watched", "", "middle")


def unwatched_spans(
    observed: ObservedTime, first_ns: int, last_ns: int, least_s: float
) -> list[tuple[float, float]]:
    """Stretches from one stamp to another in which nobody watched, in seconds since the first.

    Shorter ones than `least_s` are left out, and watched stretches that are shorter between two
    of them.
    """
    ends = [first_ns, *(x for span in observed.spans_ns for x in span), last_ns]
    gaps = list[tuple[float, float]]()
    for a, b in zip(ends[0::2], ends[1::2], strict=True):
        begin, end = max(a - first_ns, 0) / NS, min(b - first_ns, last_ns - first_ns) / NS
        if end - begin < least_s:
            continue
        if gaps and begin - gaps[-1][1] < least_s:
            begin = gaps.pop()[0]
        gaps.append((begin, end))
    return gaps


def spread(wanted: Sequence[float], apart: float, low: float, high: float) -> list[float]:
    """Places near the wanted ones, at least `apart` from one another where there is room.

    Labels at the ends of lines don't lie upon one another like that.
    """
    order = np.argsort(wanted, kind="stable")
    places = np.clip(np.array(wanted, float)[order], low, high)
    for k in range(1, len(places)):
        places[k] = max(places[k], places[k - 1] + apart)
    limit = high
    for k in range(len(places) - 1, -1, -1):
        places[k] = min(places[k], limit)
        limit = places[k] - apart
    out = np.empty(len(places))
    out[order] = places
    return [float(p) for p in out]
