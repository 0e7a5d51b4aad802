"""Draws a map, the lanes that a camera sees, and where they differ."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.mapcheck.findings import Finding, Kind
from geoorbit_ros.mapcheck.offsets import lanes_near
from geoorbit_ros.mapcheck.validation import Validation, say_alignment
from geoorbit_ros.roadnet.network import RoadNetwork

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: dict[Kind, str] = {
    "offset": "#444444",
    "missing": "#d62728",
    "extra": "#9467bd",
    "shifted": "#e07b00",
    "width": "#1f77b4",
    "direction": "#c2185b",
}
MARGIN_M = np.array([12.0, 5.0])
"""Around the lanes, along and across the road. Layout of the page."""
MAX_LINES, WRAP = 30, 125
"""Findings listed below the drawing, and characters per line. Layout of the page."""


def save_validation(
    path: Path, lanes: Sequence[Lane], network: RoadNetwork, found: Validation, title: str
) -> None:
    """Draw network and detected lanes along the page, each finding with its number, listed below.

    Args:
        path: Image to write.
        lanes: Detected, in the camera's map frame.
        network: In the same frame.
        found: What differs.
        title: Above the drawing.
    """
    from matplotlib.figure import Figure

    laid = [found.alignment.applied.points(lane.centerline_m) for lane in lanes]
    frame = _Frame(laid)
    lines = _lines(found)
    wide = frame.span[1] / frame.span[0]
    height = float(np.clip(12.5 * wide * 2.5, 3.5, 8.0))
    figure = Figure(figsize=(13.0, height + 0.19 * len(lines) + 1.2), layout="constrained")
    plot, text = figure.subplots(2, 1, height_ratios=[height, 0.19 * len(lines) + 0.3])
    plot.set_aspect("auto" if wide < 0.4 else "equal")
    for k in lanes_near(network, lanes).tolist():
        _draw_network_lane(plot, frame, network, k)
    for lane, line in zip(lanes, laid, strict=True):
        _draw_detected(plot, frame, lane, line)
    for number, finding in enumerate(found.findings, 1):
        _draw_finding(plot, frame, number, finding)
    plot.set_xlim(frame.low[0], frame.high[0])
    plot.set_ylim(frame.low[1], frame.high[1])
    plot.set_xlabel("along the road, m")
    plot.set_ylabel("across, m")
    plot.set_title(
        f"{title}\ngrey: lanes of the map; green: lanes as driven, dotted where tentative",
        fontsize=10,
    )
    text.axis("off")
    for row, (colour, sentence) in enumerate(lines):
        text.text(
            0.0, 1.0 - row / len(lines), sentence, color=colour, fontsize=9, va="top",
            transform=text.transAxes,
        )  # fmt: skip
    figure.savefig(path, dpi=110)


class _Frame:
    """Turns the road so that it lies along the page."""

    def __init__(self, lines: Sequence[NDArray[np.float64]]) -> None:
        points = np.concatenate(lines)
        self._middle = points.mean(axis=0)
        _, _, axes = np.linalg.svd(points - self._middle, full_matrices=False)
        along = axes[0] if axes[0, 0] >= 0 else -axes[0]
        self._turn = np.array([along, [-along[1], along[0]]])
        flat = self.flat(points)
        self.low, self.high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
        self.span = self.high - self.low

    def flat(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 2) on the page."""
        return np.asarray((xy - self._middle) @ self._turn.T)


def _draw_network_lane(plot: Axes, frame: _Frame, network: RoadNetwork, k: int) -> None:
    line, half = network.line(k), 0.5 * float(network.width_m[k])
    border = np.concatenate([offset_line(line, half), offset_line(line, -half)[::-1]])
    shade = "0.93" if network.internal[k] else "0.86"
    plot.fill(*frame.flat(border).T, color=shade, linewidth=0, zorder=1)
    for side in (half, -half):
        plot.plot(*frame.flat(offset_line(line, side)).T, color="0.6", linewidth=0.6, zorder=2)
    if not network.internal[k]:
        flat = frame.flat(line)
        inside = np.all((flat > frame.low) & (flat < frame.high), axis=1)
        if inside.sum() > 1:
            _arrow(plot, flat[inside], "0.55")
            at = flat[inside][int(inside.sum()) // 5]
            plot.text(
                at[0], at[1], network.lane_id[k], fontsize=6, color="0.35", zorder=3, clip_on=True
            )


def _draw_detected(plot: Axes, frame: _Frame, lane: Lane, line: NDArray[np.float64]) -> None:
    flat = frame.flat(line)
    style = "-" if lane.status == "confirmed" else ":"
    plot.plot(*flat.T, style, color="#2ca02c", linewidth=1.3, zorder=4)
    _arrow(plot, flat, "#2ca02c", 0.75)


def _draw_finding(plot: Axes, frame: _Frame, number: int, finding: Finding) -> None:
    if finding.kind == "offset":
        return
    colour, flat = COLOURS[finding.kind], frame.flat(finding.line_m)
    plot.plot(*flat.T, color=colour, linewidth=5, alpha=0.45, zorder=5, solid_capstyle="butt")
    at = flat[(len(flat) * (1 + number % 5)) // 7]
    plot.annotate(
        str(number), at, color="white", fontsize=8, ha="center", va="center", zorder=7,
        bbox={"boxstyle": "circle", "facecolor": colour, "edgecolor": "none", "pad": 0.25},
    )  # fmt: skip


def _arrow(plot: Axes, line: NDArray[np.float64], colour: str, share: float = 0.5) -> None:
    k = min(max(int(share * len(line)), 1), len(line) - 1)
    plot.annotate(
        "", line[k], line[k - 1], arrowprops={"arrowstyle": "-|>", "color": colour}, zorder=4
    )


def _lines(found: Validation) -> list[tuple[str, str]]:
    lines = [("black", say_alignment(found.alignment))]
    for number, finding in enumerate(found.findings[:MAX_LINES], 1):
        if finding.kind == "offset":
            continue
        text = f"{number}  {finding.sentence} (± {finding.tolerance:.2f} m allowed)"
        if finding.kind in ("missing", "extra", "direction"):
            text = f"{number}  {finding.sentence} ({finding.confidence:.0%} sure)"
        lines += [(COLOURS[finding.kind], part) for part in textwrap.wrap(text, WRAP)]
    if len(found.findings) > MAX_LINES:
        lines.append(("black", f"… and {len(found.findings) - MAX_LINES} more"))
    lines += [
        ("0.4", part)
        for u in found.discrepancies.unseen
        for part in textwrap.wrap(u.sentence, WRAP)
    ]
    if not found.findings:
        lines.append(("black", "No findings."))
    return lines
