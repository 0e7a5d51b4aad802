"""The tables of the traffic pages as HTML, with headers for rows and columns."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from geoorbit_ros.core.lane_order import lane_numbers
from geoorbit_ros.report.text import number
from geoorbit_ros.report.traffic.content import TrafficContent, category_rows
from geoorbit_ros.traffic.class_schemes import UNKNOWN
from geoorbit_ros.traffic.measures import ALL
from geoorbit_ros.traffic.records import NO_LANE
from geoorbit_ros.traffic.stations import Station

UNKNOWN_NUMBER = "–"


def lane_table(content: TrafficContent, station: Station) -> str:
    """One row per lane of a station, and one for all of them, over the whole recording."""
    numbers = lane_numbers(content.lanes)
    head = (
        *("Lane", "Lane no.", "Vehicles", "Flow, veh/h", "Mean speed, km/h", "85 %, km/h"),
        *("Headway, s", "In platoon, %", "Heavy, %", "Share of all, %"),
    )
    rows = list[tuple[str, list[str]]]()
    for lane_id in _with_total(content.lane_ids(station)):
        row = content.whole_row(station, lane_id)
        total = lane_id == NO_LANE
        cells = ["" if total else str(numbers[lane_id]), *_measures(row)]
        cells[-2] = heavy_text(content, station, lane_id)
        rows.append((_lane_name(content, lane_id), cells))
    return grid(head, rows, last_is_total=len(rows) > 1)


def _with_total(lane_ids: list[int]) -> list[int]:
    """The lanes and all of them together, where there are several."""
    return lane_ids if len(lane_ids) == 1 else [*lane_ids, NO_LANE]


def _measures(row: np.void) -> list[str]:
    sigma = float(row["volume_sigma"])
    error = f" ± {number(sigma, 1 if sigma < 9.5 else 0)}" if sigma >= 0.05 else ""
    return [
        f"{row['volume']:,}{error}",
        f"{row['flow_veh_per_h']:,.0f}" if np.isfinite(row["flow_veh_per_h"]) else UNKNOWN_NUMBER,
        with_error(row["time_mean_speed_kmh"], row["time_mean_speed_sigma_kmh"]),
        number(row["speed_p85_kmh"], 1),
        number(row["headway_mean_s"], 1),
        number(100.0 * row["platoon_share"], 0),
        number(100.0 * row["heavy_share"], 0),
        number(100.0 * row["lane_share"], 0),
    ]


def with_error(value: float, sigma: float) -> str:
    """`83.7 ± 0.9`, or a dash."""
    return f"{number(value, 1)} ± {number(sigma, 1)}" if np.isfinite(value) else UNKNOWN_NUMBER


def heavy_text(content: TrafficContent, station: Station, lane_id: int) -> str:
    """Share of heavy vehicles in percent; a dash where no vehicle's class is known."""
    row = content.whole_row(station, lane_id)
    if not classes_known(content, station, lane_id):
        return UNKNOWN_NUMBER
    return number(100.0 * row["heavy_share"], 0)


def classes_known(content: TrafficContent, station: Station, lane_id: int) -> bool:
    """Whether the class of any vehicle is known."""
    classes = category_rows(content, station, lane_id)
    return classes.get(UNKNOWN, 0) < classes.get(ALL, 0)


def class_table(content: TrafficContent, station: Station) -> str:
    """Vehicles of each class that occurs, per lane, with their share of the lane's vehicles."""
    scheme = content.traffic.scheme
    total = category_rows(content, station, NO_LANE)
    names = [name for name in scheme.categories if total.get(name, 0)]
    rows = []
    for lane_id in _with_total(content.lane_ids(station)):
        counted = category_rows(content, station, lane_id)
        cells = [_share(counted.get(name, 0), counted[ALL]) for name in names]
        rows.append((_lane_name(content, lane_id), [*cells, f"{counted[ALL]:,}"]))
    words = [name.replace("_", " ").capitalize() for name in names]
    return grid(("Lane", *words, "All"), rows, last_is_total=len(rows) > 1)


def movement_groups(content: TrafficContent) -> list[list[int]]:
    """Lanes between which vehicles went, together with lanes of their station; in table order."""
    group = {k: g for g, s in enumerate(content.stations) for k in content.lane_ids(s)}
    for row in content.movements:
        a, b = group[int(row["from_lane"])], group[int(row["to_lane"])]
        group = {k: min(a, b) if g in (a, b) else g for k, g in group.items()}
    return [[k for k, g in group.items() if g == one] for one in sorted(set(group.values()))]


def movement_table(content: TrafficContent, lanes: Sequence[int]) -> str:
    """From which lane (rows) to which (columns) vehicles went, and their share of the row."""
    volume = {
        (int(row["from_lane"]), int(row["to_lane"])): int(row["volume"])
        for row in content.movements
    }
    rows = list[tuple[str, list[str]]]()
    for first in lanes:
        total = sum(volume.get((first, last), 0) for last in lanes)
        cells = [_share(volume.get((first, last), 0), total) for last in lanes]
        rows.append((f"from {_lane_name(content, first)}", [*cells, f"{total:,}"]))
    sums = [sum(volume.get((first, last), 0) for first in lanes) for last in lanes]
    rows.append(("All", [*(f"{n:,}" for n in sums), f"{sum(sums):,}"]))
    head = ("First seen in", *(f"to lane {k}" for k in lanes), "All")
    return grid(head, rows, last_is_total=True)


def grid(
    head: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], *, last_is_total: bool
) -> str:
    """A table with a header for each row: ready markup; numbers are aligned to the right."""
    columns = "".join(
        f'<th scope="col"{" class=n" if k else ""}>{escape(name)}</th>'
        for k, name in enumerate(head)
    )
    body = ""
    for k, (name, cells) in enumerate(rows):
        css = ' class="total"' if last_is_total and k == len(rows) - 1 else ""
        values = "".join(f'<td class="n">{cell}</td>' for cell in cells)
        body += f'<tr{css}><th scope="row">{name}</th>{values}</tr>'
    return (
        f'<div class="scroll"><table class="grid"><thead><tr>{columns}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _lane_name(content: TrafficContent, lane_id: int) -> str:
    if lane_id == NO_LANE:
        return "All lanes"
    return f'<span class="chip {content.lane_css()[lane_id]}">{lane_id}</span>'


def _share(count: int, total: int) -> str:
    if not count:
        return UNKNOWN_NUMBER
    return f'{count:,} <span class="share">{100.0 * count / total:.0f} %</span>'
