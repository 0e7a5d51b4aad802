"""Sentences about traffic."""

from __future__ import annotations

from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.report.text import compass, count, number
from geoorbit_ros.report.traffic.content import TrafficContent
from geoorbit_ros.report.traffic.tables import UNKNOWN_NUMBER, heavy_text, with_error
from geoorbit_ros.traffic.event_records import EventKind, EventState
from geoorbit_ros.traffic.interval_clock import CLOCK_SINCE_NS, NS
from geoorbit_ros.traffic.records import NO_LANE
from geoorbit_ros.traffic.stations import Station

UNFITTING = 0.6
"""Share of vehicles in no lane from which lanes and tracks may not belong together. Chosen: a view
of side streets has half of its vehicles in no lane."""


def towards(station: Station) -> str:
    """`towards SE`."""
    return f"towards {compass((90.0 - np.degrees(station.heading_rad)) % 360.0)}"


def station_title(content: TrafficContent, station: Station) -> str:
    """`Station 1, towards SE: lanes 6, 4`."""
    lanes = content.lane_ids(station)
    word = "lane" if len(lanes) == 1 else "lanes"
    return f"Station {station.station_id}, {towards(station)}: {word} {', '.join(map(str, lanes))}"


def duration_text(seconds: float) -> str:
    """`45 s`, `10 min`, `2.5 h`, `3 days`."""
    for unit, length_s, from_s in (("days", 86_400, 172_800), ("h", 3600, 7200), ("min", 60, 300)):
        if seconds >= from_s:
            return f"{round(seconds / length_s, 1):g} {unit}"
    return f"{seconds:.0f} s"


def moment_text(stamp_ns: int, zone: str) -> str:
    """A stamp as people write it; seconds for a recording's own clock."""
    if stamp_ns < CLOCK_SINCE_NS:
        return f"{number(stamp_ns / NS, 0)} s"
    local = datetime.fromtimestamp(stamp_ns // NS, ZoneInfo(zone))
    return f"{local.day} {local:%b %Y, %H:%M:%S}"


def lead_sentences(content: TrafficContent) -> str:
    """How many vehicles drove where, and how fast, in a few sentences."""
    busy = [s for s in content.stations if content.whole_row(s)["volume"]]
    if not busy:
        return f"In {duration_text(content.watched_s)} no vehicle crossed a counting station."
    parts = [_station_sentence(content, s, first=k == 0) for k, s in enumerate(busy)]
    quiet = [f"{s.station_id} ({towards(s)})" for s in content.stations if s not in busy]
    if quiet:
        parts.append(f"No vehicle crossed station {', '.join(quiet)}.")
    return " ".join(parts).replace(" %", "\u00a0%").replace(" km/h", "\u00a0km/h")


def _station_sentence(content: TrafficContent, station: Station, *, first: bool) -> str:
    row = content.whole_row(station)
    vehicles = f"{row['volume']:,} {'vehicle' if row['volume'] == 1 else 'vehicles'}"
    begin = f"In {duration_text(content.watched_s)}, {vehicles} drove" if first else vehicles
    same_way = [s for s in content.stations if towards(s) == towards(station)]
    where = f" past station {station.station_id}" if len(same_way) > 1 else ""
    speed = with_error(row["time_mean_speed_kmh"], row["time_mean_speed_sigma_kmh"])
    if speed == UNKNOWN_NUMBER:
        return f"{begin} {towards(station)}{where}."
    fast = number(row["speed_p85_kmh"], 0)
    heavy = heavy_text(content, station, NO_LANE)
    lorries = "" if heavy == UNKNOWN_NUMBER else f"; {heavy} % of them were heavy vehicles"
    one = int(row["volume"]) == 1
    spread = "" if one else f" (85 % of them at no more than {fast} km/h)"
    return (
        f"{begin} {towards(station)}{where}, at {speed} km/h{'' if one else ' on average'}{spread}"
        f"{'' if one else lorries}."
    )


def event_sentences(events: NDArray[np.void], zone: str) -> list[str]:
    """One sentence per event.

    Args:
        events: (E,) `event_records.EVENT_DTYPE`, the newest row of each event.
        zone: IANA name of the time zone.
    """
    return [_event_sentence(row, zone) for row in events]


def _event_sentence(row: np.void, zone: str) -> str:
    kind, lane = EventKind(int(row["kind"])), f"lane {row['lane_id']}"
    begin, end = (moment_text(int(row[name]), zone) for name in ("first_ns", "last_ns"))
    time = f"from {begin} to {end}"
    if row["state"] != EventState.ENDED:
        time = f"since {begin}, still so at {end}"
    at = f"{number(row['arc_m'], 0)} m along it"
    speed = f"{number(3.6 * row['speed_mps'], 0)} km/h"
    words = {
        EventKind.STOPPED: f"Stopped vehicle in {lane}, {at}, {time} (track {row['track_id']}).",
        EventKind.WRONG_WAY: f"Vehicle against the direction of {lane}, at {speed}, {time} "
        f"(track {row['track_id']}).",
        EventKind.QUEUE: f"Queue in {lane}, {count(int(row['vehicles']), 'vehicle')} over "
        f"{number(row['length_m'], 0)} m, its tail {at}, {time}.",
        EventKind.LANE_UNUSED: f"Nobody in {lane} {time}, while "
        f"{count(int(row['vehicles']), 'vehicle')} drove beside it.",
        EventKind.SPEED_DROP: f"Vehicles in {lane} at {speed} instead of "
        f"{number(3.6 * row['usual_mps'], 0)} km/h, {time}.",
    }
    return words[kind]


def uncounted_sentences(vehicles: int, in_no_lane: int, not_crossed: int) -> list[str]:
    """Why fewer vehicles are counted than were seen.

    Args:
        vehicles: How many were seen.
        in_no_lane: How many of them drove along no lane.
        not_crossed: How many drove along a lane and crossed no station.
    """
    sentences = list[str]()
    if in_no_lane > UNFITTING * vehicles:
        sentences.append(
            f"Only {vehicles - in_no_lane} of {count(vehicles, 'vehicle')} drove along a lane of "
            "the map: do the lanes belong to these tracks, and do they lead the right way?"
        )
    elif in_no_lane:
        sentences.append(
            f"Of {count(vehicles, 'vehicle')}, {in_no_lane} were followed in a lane for less than "
            "5 m, most of them at the edge of the view, and are not counted."
        )
    if not_crossed:
        sentences.append(
            f"{not_crossed} more drove in a lane but were not seen where vehicles are counted."
        )
    return sentences


def counting_notes(content: TrafficContent) -> list[str]:
    """What the numbers leave out."""
    notes = list[str]()
    missing_s = content.duration_s - content.watched_s
    if missing_s > 1.0:
        notes.append(
            f"The camera did not watch for {duration_text(missing_s)} of "
            f"{duration_text(content.duration_s)}: that time is missing in the counts and left out "
            "of flows. In the pictures it is hatched."
        )
    notes.extend(uncounted_sentences(content.vehicles, content.in_no_lane, content.not_crossed))
    return notes


def step_text(content: TrafficContent) -> str:
    """How long the steps of pictures are, and that the files have others, if so."""
    step = duration_text(content.step_clock.length_s)
    if content.step_clock.length_s == content.clock.length_s:
        return f"in intervals of {step}"
    return f"in steps of {step} (the files: {duration_text(content.clock.length_s)})"


def window_text(content: TrafficContent) -> str:
    """Which part of the recording is shown vehicle by vehicle; empty for all of it."""
    if not content.is_part:
        return ""
    first_ns, last_ns = content.window_ns
    length = duration_text((last_ns - first_ns) / NS)
    begin = moment_text(first_ns, content.clock.zone)
    return f"the busiest {length} of the recording, from {begin}"
