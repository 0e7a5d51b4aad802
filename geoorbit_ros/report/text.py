"""Sentences about lanes and scores, for the terminal and the report page."""

from __future__ import annotations

import math
from collections.abc import Sequence

from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.metrics.lane_score import LaneScore

_COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")


def compass(heading_deg: float) -> str:
    """One of eight compass directions, from degrees clockwise from north."""
    return _COMPASS[round(heading_deg / 45.0) % 8]


def number(value: float, decimals: int = 2, *, signed: bool = False) -> str:
    """A rounded number; a dash where it is not known."""
    if not math.isfinite(value):
        return "–"
    rounded = round(value, decimals) + 0.0  # no "-0.00"
    return f"{rounded:+.{decimals}f}" if signed else f"{rounded:.{decimals}f}"


def count(n: int, singular: str, plural: str | None = None) -> str:
    """`1 lane`, `2 lanes`."""
    return f"{n} {singular if n == 1 else plural or singular + 's'}"


def summary_sentence(lanes: Sequence[Lane]) -> str:
    """How many lanes of which status lead where."""
    confirmed = [lane for lane in lanes if lane.status == "confirmed"]
    by_compass: dict[str, int] = {}
    for lane in confirmed:
        name = compass(lane.heading_deg)
        by_compass[name] = by_compass.get(name, 0) + 1
    towards = ", ".join(f"{n} towards {name}" for name, n in by_compass.items())
    sentence = f"{count(len(confirmed), 'lane')} confirmed" + (f" ({towards})" if towards else "")
    tentative = len(lanes) - len(confirmed)
    return f"{sentence}, {tentative} tentative." if tentative else f"{sentence}."


def missing_sentence(lane: Lane) -> str:
    """What a tentative lane still needs."""
    seen = f"Lane {lane.lane_id} is tentative after {count(int(lane.vehicles), 'vehicle')}"
    if lane.vehicles_missing <= 0:
        return f"{seen}: the traffic does not show clearly that it is one lane."
    more = count(lane.vehicles_missing, "more vehicle")
    return f"{seen}: about {more} will confirm it."


def view_sentences(lane_map: LaneMap) -> list[str]:
    """What is to be known of the camera's view: lanes that are held, and since when."""
    view = lane_map.view
    if view is None:
        return []
    if view.held:
        return [f"The lanes are held, those of an earlier time: {view.why}."]
    return [f"The lanes are live; boxes are put back to the view that was calibrated: {view.why}."]


def shift_sentences(lane_map: LaneMap) -> list[str]:
    """By how much lanes lie aside together, by the calibration."""
    shifts = [lane.shift_sigma_m[0] for lane in lane_map.lanes]
    known = [shift for shift in shifts if math.isfinite(shift)]
    if not known:
        return []
    low, high = (number(value) for value in (min(known), max(known)))
    by = low if low == high else f"{low} to {high}"
    return [
        f"Each lane may lie aside as a whole by {by} m (1σ), by the errors of the calibration, "
        "however many vehicles were seen."
    ]


def tentative_sentences(lane_map: LaneMap) -> list[str]:
    """Why lanes are not confirmed, and what they still need."""
    if lane_map.doubtful:
        return [
            "No lane is confirmed, as something speaks against the calibration or the boxes: "
            "see the remarks."
        ]
    return [missing_sentence(lane) for lane in lane_map.lanes if lane.status == "tentative"]


def score_sentences(score: LaneScore) -> list[str]:
    """Counts, errors and faults, one sentence each."""
    lines = [
        f"{len(score.matched)} of {count(len(score.lanes), 'lane')} found, "
        f"{len(score.confirmed)} of them confirmed; {len(score.invented)} invented, "
        f"{len(score.direction_wrong)} in the wrong direction."
    ]
    if score.confirmed:
        lines.append(
            f"Centreline error {number(score.centerline_mean_m)} m on average, 95 % of it below "
            f"{number(score.centerline_p95_m)} m; width error {number(score.width_error_m)} m; "
            f"{score.coverage:.0%} of the length found."
        )
    for traffic, words in (
        ("busy", "8 vehicles or more"),
        ("sparse", "3 to 7 vehicles"),
        ("rare", "fewer than 3 vehicles"),
        ("unknown", "unknown traffic"),
    ):
        missed = score.missed(traffic)  # type: ignore[arg-type]
        if missed:
            lines.append(f"Missed with {words}: {_lanes(missed)}.")
    if score.unconfirmed:
        lines.append(f"Busy but not confirmed: {_lanes(score.unconfirmed)}.")
    if score.invented:
        lines.append(f"Invented: detected {_lanes(score.invented)}.")
    if score.unmatched_tentative:
        lines.append(
            f"Tentative without a true lane: detected {_lanes(score.unmatched_tentative)}."
        )
    if score.direction_wrong:
        lines.append(f"Wrong direction: detected {_lanes(score.direction_wrong)}.")
    return lines


def _lanes(ids: Sequence[int]) -> str:
    return f"lane{'s' if len(ids) != 1 else ''} {', '.join(map(str, ids))}"
