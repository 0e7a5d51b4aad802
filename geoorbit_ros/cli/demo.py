"""`geoorbit demo`: everything once, on a bag that ships with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DEMO_BAG = "bags/demo"
"""Folder of the share folder: `bag`, `calibration.csv`, `truth.geojson`."""


def demo(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for lanes.geojson and report.html.")
    ] = Path("geoorbit-demo"),
    rate: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Speed; 0 plays as fast as the nodes can.")
    ] = 10.0,
) -> None:
    """See it work: replay a small bundled bag through the real nodes, score it, write a report.

    The bag is a synthetic camera over a bending road, a minute long, so the true lanes are known.

    Example: [bold]geoorbit demo --out geoorbit-demo[/bold]
    """
    from geoorbit_ros.cli.console import as_typed, console
    from geoorbit_ros.cli.lanes import score
    from geoorbit_ros.cli.replay import replay
    from geoorbit_ros.cli.report import report
    from geoorbit_ros.core.resources import share_path

    folder = share_path(DEMO_BAG)
    bag, calibration, truth = (
        folder / name for name in ("bag", "calibration.csv", "truth.geojson")
    )
    lanes, page = out / "lanes.geojson", out / "report.html"
    console.print("A minute of simulated traffic goes through the nodes bag_player, homography and")
    console.print("lane_geometry. Its true lanes are known, so the result can be compared.\n")
    replay(bag=bag, calibration=calibration, out=lanes, rate=rate)
    score(lanes, truth)
    report(calibration=calibration, out=page, bag=bag, lanes=lanes, truth=truth)
    console.print(f"\nOpen {page.resolve().as_uri()}", soft_wrap=True)
    console.print(f"Next, with your own tracks and control points: {as_typed('lanes --help')}")
