"""`geoorbit twin forecast`: ten minutes ahead of a recording, with and without changes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geoorbit_ros.cli.inputs import DatumOption, ForceOption, ImageSizeOption
from geoorbit_ros.cli.twin.replay import (
    BagsArgument,
    CalibrationsOption,
    CameraIdsOption,
    NetOption,
    open_streams,
    print_stream_remarks,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from geoorbit_ros.roadnet.network import RoadNetwork
    from geoorbit_ros.twin.forecast.files import ForecastStart
    from geoorbit_ros.twin.forecast.observed_traffic import Demand
    from geoorbit_ros.twin.forecast.runs import Forecast
    from geoorbit_ros.twin.placement import TwinStep
    from geoorbit_ros.twin.replay import TrackStream

WHOLE_RECORDING_S = 1e6
"""A window longer than any recording: all of it counts."""


def forecast(
    bags: BagsArgument,
    net: NetOption,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; new or empty.")],
    calibration: CalibrationsOption,
    close_lane: Annotated[
        list[str] | None,
        typer.Option("--close-lane", help="A lane, or an edge with all its lanes."),
    ] = None,
    speed_limit: Annotated[
        list[str] | None, typer.Option("--speed-limit", help="LANE=KMH or EDGE=KMH.")
    ] = None,
    minutes: Annotated[
        float, typer.Option("--minutes", min=0.5, max=120.0, help="How far ahead.")
    ] = 10.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of arrivals and drivers.")] = 1,
    limit_s: Annotated[
        float, typer.Option("--limit-s", min=1.0, help="Give up after this long.")
    ] = 300.0,
    image_size: ImageSizeOption = None,
    datum: DatumOption = None,
    camera_id: CameraIdsOption = None,
    force: ForceOption = False,
) -> None:
    """Run the traffic of a recording ahead: speeds and queues per lane, with and without changes.

    The forecast begins with the vehicles at the recording's end, and goes on with the flows, turns
    and drivers that it shows. Into the folder go forecast.json and forecast.png.

    Example: [bold]geoorbit twin forecast north_bag --net area/network.net.xml --calibration
    north.csv --close-lane east_0 --speed-limit east=60 --out ahead[/bold]
    """
    from geoorbit_ros.cli.console import console, say, status
    from geoorbit_ros.roadnet.network import load_network
    from geoorbit_ros.storage.atomic import atomic_output
    from geoorbit_ros.twin.forecast.files import ForecastStart
    from geoorbit_ros.twin.forecast.runs import ForecastRun
    from geoorbit_ros.twin.scenario import parse_scenario

    with atomic_output(out, overwrite=force) as folder:
        streams = open_streams(bags, calibration, image_size, datum, camera_id)
        network = load_network(net, streams[0].datum)
        place = "options --close-lane, --speed-limit"
        scenario = parse_scenario(close_lane or (), speed_limit or (), network, place)
        step, demand = _observe(streams, network, net)
        start = ForecastStart(step, demand, 60.0 * minutes, seed)
        run = ForecastRun(network, start, scenario, limit_s)
        try:
            with status(f"{minutes:g} minutes ahead"):
                forecasts = run.wait()
        finally:
            run.close()
        _write(folder, start, network, forecasts)
    _print(forecasts, streams)
    say(_seen(demand))
    _say_what_gets_through(forecasts)
    console.print(f" Wrote {out}", soft_wrap=True)


def _say_what_gets_through(forecasts: Sequence[Forecast]) -> None:
    from geoorbit_ros.cli.console import say

    for one in forecasts:
        say(
            f"{one.scenario.capitalize()} ({one.changes}): {one.left_per_h:.0f} vehicles per hour "
            f"get through; {one.waiting} could not enter."
        )


def _observe(
    streams: list[TrackStream], network: RoadNetwork, net: Path
) -> tuple[TwinStep, Demand]:
    """The vehicles at the recordings' end, and the traffic that they show.

    Raises:
        NoTrafficError: Too little of it.
    """
    from geoorbit_ros.core.errors import NoTrafficError
    from geoorbit_ros.twin.forecast.observed_traffic import ObservedTraffic
    from geoorbit_ros.twin.replay import STEP_S, replay_tracks
    from geoorbit_ros.twin.sumo_simulation import SumoSimulation

    traffic = ObservedTraffic(network, WHOLE_RECORDING_S)
    simulation = SumoSimulation(net, STEP_S)
    try:
        replay_tracks(network, simulation, streams, traffic.add)
    finally:
        simulation.close()
    demand = traffic.demand()
    if demand is None or traffic.last is None:
        found = "too little traffic to know its flows"
        raise NoTrafficError(str(net), found, "a longer recording on this network's lanes")
    return traffic.last, demand


def _write(
    folder: Path, start: ForecastStart, network: RoadNetwork, forecasts: list[Forecast]
) -> None:
    """Write forecast.json and forecast.png into a new folder."""
    import json

    from geoorbit_ros.twin.figures import save_forecast_figure

    folder.mkdir()
    values = {
        "observed_s": start.demand.time_s,
        "observed_flow_per_h": start.demand.edge_flow_per_h,
        "horizon_s": start.horizon_s,
        "forecasts": [one.values() for one in forecasts],
    }
    text = json.dumps(values, indent=2, allow_nan=False)
    (folder / "forecast.json").write_text(text + "\n", encoding="utf-8")
    save_forecast_figure(folder / "forecast.png", network, forecasts)


def _seen(demand: Demand) -> str:
    """The flows that the forecast goes on with, in one sentence."""
    flows = ", ".join(f"{edge} {flow:.0f}" for edge, flow in demand.edge_flow_per_h.items())
    return f"Seen in {demand.time_s:.0f} s, vehicles per hour: {flows}."


def _print(forecasts: list[Forecast], streams: list[TrackStream]) -> None:
    from geoorbit_ros.cli.console import console, make_table

    columns = "".join(
        f"|>{name}" for name in ("seen km/h", "km/h", "veh/h", "veh/km", "s", "queue m", "max m")
    )
    for one in forecasts:
        table = make_table(f"Forecast: {one.scenario}", f"lane{columns}")
        for lane in one.lanes:
            table.add_row(
                lane.lane,
                "–" if lane.seen_kmh is None else f"{lane.seen_kmh:.0f}",
                "–" if lane.speed_kmh is None else f"{lane.speed_kmh:.0f}",
                f"{lane.flow_per_h:.0f}",
                f"{lane.density_per_km:.1f}",
                "–" if lane.travel_time_s is None else f"{lane.travel_time_s:.0f}",
                f"{lane.queue_m_mean:.0f}",
                f"{lane.queue_m_max:.0f}",
            )
        console.print(table)
    print_stream_remarks(streams)
