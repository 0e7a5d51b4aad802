"""Lane maps and scores as tables and sentences for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geoorbit_ros.cli.console import console, make_table, say
from geoorbit_ros.report.text import (
    compass,
    missing_sentence,
    number,
    score_sentences,
    summary_sentence,
)

if TYPE_CHECKING:
    from geoorbit_ros.core.lanes import LaneMap
    from geoorbit_ros.metrics.lane_score import LaneScore

_STYLE = {"confirmed": "green", "tentative": "yellow"}


def print_lanes(lane_map: LaneMap, title: str = "Lanes") -> None:
    """Print one row per lane, and what traffic tentative lanes still need."""
    table = make_table(
        title, ">lane|status|direction|>width m|>vehicles|>confidence|>length m|>± m"
    )
    for lane in lane_map.lanes:
        table.add_row(
            str(lane.lane_id),
            f"[{_STYLE[lane.status]}]{lane.status}[/]",
            f"{compass(lane.heading_deg):>2} {lane.heading_deg:3.0f}°",
            f"{number(lane.width_m)} ± {number(lane.width_sigma_m)}",
            number(lane.vehicles, 0),
            number(lane.confidence),
            number(lane.length_m, 0),
            number(lane.sigma_m),
        )
    console.print(table)
    for lane in lane_map.lanes:
        if lane.status == "tentative":
            say(missing_sentence(lane))
    say(summary_sentence(lane_map.lanes))


def print_score(score: LaneScore) -> None:
    """Print one row per true lane, and the totals as sentences."""
    table = make_table(
        "Against the truth",
        ">truth|>vehicles|>lane|status|>error m|>95 % m|>bias m|>width m|>covered",
    )
    for row in score.lanes:
        if row.lane_id is None:
            table.add_row(
                str(row.truth_id), number(row.vehicles, 0), "–", "[red]missed[/]", *["–"] * 5
            )
            continue
        table.add_row(
            str(row.truth_id),
            number(row.vehicles, 0),
            str(row.lane_id),
            f"[{_STYLE[str(row.status)]}]{row.status}[/]",
            number(row.mean_m),
            number(row.p95_m),
            number(row.bias_m, signed=True),
            number(row.width_error_m, signed=True),
            f"{row.coverage:.0%}",
        )
    console.print(table)
    for sentence in score_sentences(score):
        say(sentence)
