"""Drawings: the twin's vehicles over their lanes, a whole network, forecasts by mean speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.roadnet.network import NO_LANE, RoadNetwork
from geoorbit_ros.twin.forecast.runs import Forecast

MARGIN_M = 15.0
"""Around the vehicles. Layout of the page."""
_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd", "#8c564b", "#17becf")


class VehiclePaths:
    """Collects where vehicles were, for the drawing.

    Attributes:
        xy: (N, 2) positions.
        lane: (N,) lane numbers, `NO_LANE` beside the network.
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


def save_twin_figure(path: Path, network: RoadNetwork, paths: VehiclePaths, title: str) -> None:
    """Draw the part of the network where vehicles were, with the road along the page."""
    from matplotlib.figure import Figure

    xy, lane = paths.xy, paths.lane
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
    for k in np.unique(lane[lane != NO_LANE]).tolist():
        at, colour = lane == k, _COLOURS[k % len(_COLOURS)]
        plot.plot(flat[at, 0], flat[at, 1], ",", color=colour, zorder=2, rasterized=True)
    beside = lane == NO_LANE
    plot.plot(flat[beside, 0], flat[beside, 1], "x", color="#d62728", markersize=3, zorder=3)
    plot.set_xlim(low[0], high[0])
    plot.set_ylim(low[1], high[1])
    plot.set_xlabel("along the road, m")
    plot.set_ylabel("across, m")
    plot.set_title(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def save_network_figure(path: Path, network: RoadNetwork) -> None:
    """Draw a whole network in the map frame, north up, with arrows along its lanes.

    Lanes inside junctions are dotted, those that not all cars may use dashed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.0))
    plot = figure.add_subplot()
    plot.set_aspect("equal", adjustable="datalim")
    for k in range(len(network)):
        line = network.line(k)
        style = ":" if network.internal[k] else "-" if network.for_cars[k] else "--"
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
    side = "left" if network.left_hand else "right"
    plot.set_title(
        f"{network.path.name}: traffic drives on the {side}, colours count lanes from the {side}; "
        "dashed: not for all cars",
        fontsize=10,
    )
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def save_forecast_figure(path: Path, network: RoadNetwork, forecasts: Sequence[Forecast]) -> None:
    """Lanes coloured by mean speed, their distances across the road stretched; queues in black."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    points = network.point_m
    centre = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    along = axes[0] * (1.0 if axes[0, 0] >= 0 else -1.0)
    turn = np.array([along, [-along[1], along[0]]])
    fastest = max([80.0, *(k.speed_kmh or 0.0 for one in forecasts for k in one.lanes)])
    colours = colormaps["RdYlGn"]
    figure = Figure(figsize=(11.0, 1.2 + 3.0 * len(forecasts)), layout="constrained")
    plots = figure.subplots(len(forecasts), 1, sharex=True, squeeze=False)[:, 0]
    for plot, one in zip(plots, forecasts, strict=True):
        for lane in one.lanes:
            number = network.number[lane.lane]
            line = (network.line(number) - centre) @ turn.T
            empty = lane.speed_kmh is None
            plot.plot(
                *line.T,
                color="0.6" if empty else colours((lane.speed_kmh or 0.0) / fastest),
                linestyle=":" if empty else "-",
                linewidth=1.5 if empty else 4.0,
                solid_capstyle="butt",
            )
            if lane.queue_m_max >= 1.0:
                arc = network.arc(number)
                queued = np.linspace(max(arc[-1] - lane.queue_m_max, 0.0), arc[-1], 30)
                x, y = (np.interp(queued, arc, line[:, k]) for k in range(2))
                plot.plot(x, y, color="black", linewidth=1.0)
        title = f"{one.scenario}: {one.changes}" if one.changes != one.scenario else one.scenario
        plot.set_title(f"{title}; {one.left_per_h:.0f} vehicles per hour", fontsize=10)
        plot.set_ylabel("across, m")
    plots[-1].set_xlabel("along the road, m; dotted: no vehicle; black: the longest queue")
    scale = ScalarMappable(Normalize(0.0, fastest), colours)
    figure.colorbar(scale, ax=list(plots), label="mean speed, km/h")
    figure.savefig(path, dpi=130)
