"""The twin from above: lanes, the ways of its vehicles, and where it stood beside the network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NONE, RoadNetwork

MARGIN_M = 15.0
_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd", "#8c564b", "#17becf")


class WayKeeper:
    """Remembers where vehicles were, for the picture.

    Attributes:
        xy: (N, 2) positions.
        lane: (N,) lane numbers, `NONE` beside the network.
    """

    def __init__(self) -> None:
        self._xy: list[NDArray[np.float64]] = []
        self._lane: list[NDArray[np.int64]] = []

    def add(self, xy: NDArray[np.float64], lane: NDArray[np.int64]) -> None:
        """Take the vehicles of one step."""
        self._xy.append(xy)
        self._lane.append(lane)

    @property
    def xy(self) -> NDArray[np.float64]:
        """All positions."""
        return np.concatenate([np.empty((0, 2)), *self._xy])

    @property
    def lane(self) -> NDArray[np.int64]:
        """All lanes."""
        return np.concatenate([np.empty(0, np.int64), *self._lane])


def save_picture(path: Path, network: RoadNetwork, ways: WayKeeper, title: str) -> None:
    """Draw the part of the network where vehicles were, the road lying along the page."""
    from matplotlib.figure import Figure

    xy, lane = ways.xy, ways.lane
    known = np.isfinite(xy).all(axis=1)
    xy, lane = xy[known], lane[known]
    centre = xy.mean(axis=0)
    _, _, axes = np.linalg.svd(xy - centre, full_matrices=False)
    if axes[0, 0] < 0:
        axes[0] *= -1.0
    turn = np.array([axes[0], [-axes[0, 1], axes[0, 0]]])
    flat = (xy - centre) @ turn.T
    low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
    span = high - low
    figure = Figure(figsize=(12.0, float(np.clip(12.0 * span[1] / span[0] * 1.5 + 1.5, 4.0, 9.0))))
    plot = figure.add_subplot()
    plot.set_aspect("auto" if span[0] > 4 * span[1] else "equal")
    for k in range(len(network)):
        line = (network.line(k) - centre) @ turn.T
        style = ":" if network.internal[k] else "-"
        plot.plot(line[:, 0], line[:, 1], style, color="0.75", linewidth=1.0, zorder=1)
    for k in np.unique(lane[lane != NONE]).tolist():
        at, colour = lane == k, _COLOURS[k % len(_COLOURS)]
        plot.plot(flat[at, 0], flat[at, 1], ",", color=colour, zorder=2, rasterized=True)
    beside = lane == NONE
    plot.plot(flat[beside, 0], flat[beside, 1], "x", color="#d62728", markersize=3, zorder=3)
    plot.set_xlim(low[0], high[0])
    plot.set_ylim(low[1], high[1])
    plot.set_xlabel("along the road, m")
    plot.set_ylabel("across, m")
    plot.set_title(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def save_map(path: Path, network: RoadNetwork) -> None:
    """Draw a whole network in the map frame, north up, with arrows along its lanes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0))
    plot = figure.add_subplot()
    plot.set_aspect("equal", adjustable="datalim")
    for k in range(len(network)):
        line = network.line(k)
        style = ":" if network.internal[k] else "-"
        colour = _COLOURS[int(network.index[k]) % len(_COLOURS)]
        plot.plot(line[:, 0], line[:, 1], style, color=colour, linewidth=0.8)
        if not network.internal[k]:
            middle = max(len(line) // 2, 1)
            begin, end = line[middle - 1], line[middle]
            plot.annotate(
                "", 0.5 * (begin + end), begin, arrowprops={"arrowstyle": "->", "color": colour}
            )
    plot.set_xlabel("east of the datum, m")
    plot.set_ylabel("north, m")
    plot.set_title(f"{network.path.name}: colours count lanes from the right", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
