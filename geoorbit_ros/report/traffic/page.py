"""The traffic report: one HTML page without other files, for a traffic engineer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.report.document import bullets, document, figure, remarks_section, section
from geoorbit_ros.report.tables import facts
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.report.traffic.diagrams import headways, speed_flow
from geoorbit_ros.report.traffic.over_time import over_time
from geoorbit_ros.report.traffic.speed_map import speed_map
from geoorbit_ros.report.traffic.speed_scale import SpeedScale, speed_scale
from geoorbit_ros.report.traffic.tables import (
    class_table,
    classes_known,
    lane_table,
    movement_groups,
    movement_table,
)
from geoorbit_ros.report.traffic.text import (
    counting_notes,
    duration_text,
    event_sentences,
    lead_sentences,
    moment_text,
    station_title,
    step_text,
    window_text,
)
from geoorbit_ros.report.traffic.time_space import time_space
from geoorbit_ros.traffic.measures import FOLLOWING_S
from geoorbit_ros.traffic.records import NO_LANE
from geoorbit_ros.traffic.stations import Station

NO_VEHICLE = "No vehicle crossed it while the camera watched."
"""In place of the pictures of a station."""


def write_traffic_report(
    path: Path,
    content: TrafficContent,
    provenance: Sequence[tuple[str, str]],
    remarks: Sequence[InputReport] = (),
) -> None:
    """Write the page; the same input gives the same bytes.

    Args:
        path: The file.
        content: What is shown.
        provenance: Names and values: how the tables were made.
        remarks: What was done with the inputs, and what speaks against them.
    """
    path.write_text(traffic_html(content, provenance, remarks), encoding="utf-8")


def traffic_html(
    content: TrafficContent,
    provenance: Sequence[tuple[str, str]],
    remarks: Sequence[InputReport] = (),
) -> str:
    """The page as text."""
    title = f"Traffic of {content.camera_id}"
    head = (
        f"<header><p class='kicker'>Traffic report</p><h1>{escape(title)}</h1>"
        f"<p class='lead'>{escape(lead_sentences(content))}</p>{_tiles(content)}</header>"
    )
    body = traffic_sections(content) + section("How this was made", facts(provenance))
    return document(title, head + remarks_section(remarks) + body)


def traffic_sections(content: TrafficContent) -> str:
    """Tables and pictures of the traffic; also a part of the lane report."""
    scale = speed_scale(3.6 * content.tracks["speed_mps"])
    return "".join(
        (
            section("Traffic per lane", _per_station(content, lane_table) + _notes(content)),
            section("Events", _events(content)),
            section("Where it was counted", _map(content, scale)),
            section("Flow and speed over time", _per_station(content, _over_time)),
            section("Speed and flow", _per_station(content, _speed_flow)),
            section(
                "Every vehicle in time and space",
                _per_station(content, lambda c, s: _time_space(c, s, scale)),
            ),
            section("Headways", _per_station(content, _headways)),
            section("From lane to lane", _movements(content)),
            section("Classes of vehicles", _classes(content)),
        )
    )


def provenance_of(content: TrafficContent) -> list[tuple[str, str]]:
    """Names and values that follow from the traffic itself."""
    zone = content.clock.zone
    first, last = (moment_text(stamp, zone) for stamp in content.span_ns)
    return [
        ("Recording", f"{first} to {last}, {zone}"),
        ("Intervals of the tables", duration_text(content.clock.length_s)),
        ("Classes of vehicles", content.traffic.scheme.name),
    ]


def _tiles(content: TrafficContent) -> str:
    rows = [content.whole_row(s) for s in content.stations]
    fastest = max((row["flow_veh_per_h"] for row in rows), default=float("nan"))
    tiles = [
        (f"{sum(int(row['volume']) for row in rows):,}", "vehicles counted"),
        (duration_text(content.watched_s), f"watched of {duration_text(content.duration_s)}"),
        (str(len(content.lanes)), "lane" if len(content.lanes) == 1 else "lanes"),
        (
            f"{fastest:,.0f}" if np.isfinite(fastest) else "–",
            "vehicles per hour in the busiest direction",
        ),
    ]
    cells = "".join(f"<div><b>{escape(a)}</b><span>{escape(b)}</span></div>" for a, b in tiles)
    return f"<div class='tiles'>{cells}</div>"


def _per_station(content: TrafficContent, draw: Callable[[TrafficContent, Station], str]) -> str:
    """A heading and what is drawn for each station; a sentence where no vehicle was counted."""
    parts = list[str]()
    for station in content.stations:
        parts.append(f"<h3>{escape(station_title(content, station))}</h3>")
        empty = not content.whole_row(station)["volume"] and draw is not lane_table
        parts.append(f"<p>{NO_VEHICLE}</p>" if empty else draw(content, station))
    return "".join(parts)


def _notes(content: TrafficContent) -> str:
    words = (
        "Speeds are means at the counting station with their error, one standard deviation. 85 % "
        "of the vehicles drove no faster than the next column says. Headway: from one vehicle's "
        f"front to the next one's; below {FOLLOWING_S:g} s a vehicle counts as in a platoon. A "
        "dash: not known."
    )
    return f'<p class="note">{escape(words)}</p>{bullets(counting_notes(content))}'


def _events(content: TrafficContent) -> str:
    """A sentence each, or that there were none."""
    if not len(content.events):
        return "<p>No stopped or wrong-way vehicle, queue, unused lane or drop of speed.</p>"
    return bullets(event_sentences(content.events, content.clock.zone))


def _map(content: TrafficContent, scale: SpeedScale) -> str:
    drawing, frame = speed_map(content, scale)
    caption = [
        "The lanes from above: colours are the mean speed on each 10 m of lane"
        + (f" in {window_text(content)}" if content.is_part else "")
        + ", in km/h; circles are lane ids, and vehicles are counted at the lines across the lanes."
    ]
    if frame.stretch > 1:
        caption.append(
            f"Up and down the page, lengths are drawn {frame.stretch:.0f} times as large as from "
            "left to right."
        )
    return figure(drawing.markup(), " ".join(caption), "map")


def _over_time(content: TrafficContent, station: Station) -> str:
    caption = (
        "Above, how many vehicles per hour crossed the station in each lane, and below their mean "
        f"speed in km/h, {step_text(content)}; hatched: not watched. A line is interrupted where "
        "no vehicle came whose speed could be measured, or too little was watched."
    )
    return figure(over_time(content, station).markup(), caption, "chart")


def _speed_flow(content: TrafficContent, station: Station) -> str:
    caption = (
        "Space mean speed in km/h over flow in vehicles per hour, one mark per lane for each "
        f"{duration_text(content.step_clock.length_s)}; marks that fall to low speeds show "
        "congestion."
    )
    return figure(speed_flow(content, station).markup(), caption, "chart")


def _time_space(content: TrafficContent, station: Station, scale: SpeedScale) -> str:
    part = f"Shown: {window_text(content)}." if content.is_part else ""
    caption = (
        "Each line is a vehicle: how many metres it had come along its lane at which time, "
        "coloured by its speed in km/h; a line that becomes flat is a vehicle that stops, and one "
        f"that begins or ends within the lane is a lane change or a vehicle out of sight. {part}"
    )
    return figure(time_space(content, station, scale).markup(), caption.strip(), "chart")


def _headways(content: TrafficContent, station: Station) -> str:
    caption = (
        "Share of vehicles, in percent, by the time in seconds from the vehicle before in the same "
        f"lane; bars in full colour are below {FOLLOWING_S:g} s, where a vehicle counts as in a "
        "platoon, and the last bar holds all longer times."
    )
    return figure(headways(content, station).markup(), caption, "chart")


def _movements(content: TrafficContent) -> str:
    note = (
        "Rows: the lane in which a vehicle was first seen; columns: the one in which it was last "
        "seen, with the share of the row. Vehicles count here that were seen along a lane, whether "
        "or not they crossed a station."
    )
    tables = "".join(movement_table(content, lanes) for lanes in movement_groups(content))
    return f'{tables}<p class="note">{escape(note)}</p>'


def _classes(content: TrafficContent) -> str:
    if not any(classes_known(content, s, NO_LANE) for s in content.stations):
        return "<p>The tracks don't say of which class vehicles are.</p>"
    return _per_station(content, class_table)
