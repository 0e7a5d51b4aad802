"""A forecast as a picture: the road by mean speed, once per scenario."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geoorbit_ros.roadnet.network import RoadNetwork
from geoorbit_ros.twin.forecast.runs import Forecast


def save_forecast_picture(path: Path, network: RoadNetwork, forecasts: Sequence[Forecast]) -> None:
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
        words = f"{one.scenario}: {one.changes}" if one.changes != one.scenario else one.scenario
        plot.set_title(f"{words}; {one.left_per_h:.0f} vehicles per hour", fontsize=10)
        plot.set_ylabel("across, m")
    plots[-1].set_xlabel("along the road, m; dotted: no vehicle; black: the longest queue")
    scale = ScalarMappable(Normalize(0.0, fastest), colours)
    figure.colorbar(scale, ax=list(plots), label="mean speed, km/h")
    figure.savefig(path, dpi=130)
