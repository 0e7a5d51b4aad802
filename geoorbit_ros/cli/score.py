"""`geoorbit score`: a lane map against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def score(
    lanes: Annotated[Path, typer.Argument(help="Detected lanes: lanes.geojson.")],
    truth: Annotated[
        Path, typer.Argument(help="True lanes: the same format; centrelines with lane_id suffice.")
    ],
    json_output: Annotated[
        bool, typer.Option("--json", help="Print the score as JSON instead of a table.")
    ] = False,
    require: Annotated[
        bool,
        typer.Option(
            "--require",
            help="Exit with 1 unless every lane with 8 vehicles or more is confirmed, every lane "
            "with 3 to 7 is there, and none is invented or in the wrong direction.",
        ),
    ] = False,
) -> None:
    """Compare a lane map with the truth: matched one to one, missed and invented lanes counted.

    A detected lane matches a true one within half a lane width (1.75 m, on average over their
    common length) and 45° of direction. Errors are distances from the true centreline, of confirmed
    lanes.

    Example: [bold]geoorbit score lanes.geojson truth.geojson --require[/bold]
    """
    from geoorbit_ros.cli.console import print_score
    from geoorbit_ros.lanes.geojson import read_lane_file, read_lanes
    from geoorbit_ros.metrics.score import score_lanes

    detected = read_lane_file(lanes)
    true = read_lanes(truth, detected.datum)
    result = score_lanes(detected.lane_map.lanes, true.lanes)
    if json_output:
        import json

        typer.echo(json.dumps(result.as_dict(), indent=2, allow_nan=False))
    else:
        print_score(result)
    if require and not result.passed:
        raise typer.Exit(1)
