"""On which side of the road traffic drives: as the user says, by the map's tags, or by the place.

The place is looked up in `left_traffic.csv`, a rough table of where traffic drives on the left
(docs/adr/0036-side-of-the-road.md). Where none of the three says it, the user is asked.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import ParameterError

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
AREAS = Path(__file__).with_name("left_traffic.csv")
"""Corners of the areas, drawn by hand. Its `border_km` is the distance to a border within which the
side is not known by the place: 40 where the border is drawn roughly (farthest off: 34 km), less
where it is drawn finely or runs through water. Chosen: larger asks more often, smaller guesses
where the table is wrong (ADR 0036 has figures)."""
KM_PER_DEGREE = 111.2
"""Of latitude, on a sphere of 6371 km."""
TAGGED_SHARE = 0.5
"""Tags of at least this share of the roads speak for the whole map. Chosen: larger lets the place
overrule a map that says otherwise, smaller lets the one road with another side (the forecourt of a
London hotel) decide."""


@dataclass(frozen=True, slots=True)
class DrivingSide:
    """The side, and how it is known.

    Attributes:
        side: Where traffic drives.
        why: How that is known, as the rest of a sentence.
        doubt: What speaks against it, as a sentence without full stop; empty where nothing does.
    """

    side: Side
    why: str
    doubt: str = ""

    @property
    def sentence(self) -> str:
        """What is known, as a sentence."""
        doubt = f"; {self.doubt}" if self.doubt else ""
        return f"Traffic drives on the {self.side}, {self.why}{doubt}."


def side_at(latitude_deg: float, longitude_deg: float) -> Side | None:
    """The side on which traffic drives at a place on land; None near a border between both."""
    left = False
    for area in _areas():
        begin = area.lon_lat_deg
        end = np.roll(begin, -1, axis=0)
        (x, y), (x1, y1) = begin.T, end.T
        crosses = (y > latitude_deg) != (y1 > latitude_deg)
        rise = np.where(crosses, y1 - y, 1.0)
        right_of = longitude_deg < x + (latitude_deg - y) * (x1 - x) / rise
        left |= bool(np.count_nonzero(crosses & right_of) % 2)
        if (_distance_km(begin, end, latitude_deg, longitude_deg) < area.border_km).any():
            return None
    return "left" if left else "right"


@dataclass(frozen=True, slots=True)
class MapEvidence:
    """What a map says about the side.

    Attributes:
        tagged_m: Metres of road whose tags say left, and right.
        rings: How many roundabouts turn as on the left (clockwise), and as on the right.
        roads_m: Metres of road in all.
    """

    tagged_m: Mapping[Side, float]
    rings: Mapping[Side, int]
    roads_m: float


def choose_side(given: Side | None, evidence: MapEvidence, place: Datum, name: str) -> DrivingSide:
    """The side of a map: as given, else as most of its roads are tagged, else by the place.

    Near a border the roundabouts decide, if all turn the same way.

    Args:
        given: What the user says.
        evidence: What the map says.
        place: Where the map lies.
        name: The map, for the error.

    Raises:
        ParameterError: Nothing says it.
    """
    found = _choose(given, evidence, place, name)
    other: Side = "right" if found.side == "left" else "left"
    against = evidence.rings.get(other, 0)
    if not against:
        return found
    way = "clockwise" if other == "left" else "anticlockwise"
    rings = f"{against} of its roundabouts turn {way}"
    return replace(found, doubt="; ".join(filter(None, (found.doubt, rings))))


def _choose(given: Side | None, evidence: MapEvidence, place: Datum, name: str) -> DrivingSide:
    tagged_m, roads_m = evidence.tagged_m, evidence.roads_m
    by_place = side_at(place.latitude_deg, place.longitude_deg)
    where = f"at {place.latitude_deg:.3f}, {place.longitude_deg:.3f}"
    tags = max(SIDES, key=lambda side: tagged_m.get(side, 0.0))
    other: Side = "right" if tags == "left" else "left"
    tagged = tagged_m.get(tags, 0.0)
    sure = tagged > tagged_m.get(other, 0.0)
    if given is not None:
        doubt = ""
        if sure and tags != given:
            doubt = f"its tags say {tags}"
        elif by_place not in (None, given):
            doubt = f"{where} one drives on the {by_place}"
        return DrivingSide(given, "as --driving-side says", doubt)
    if sure and (by_place is None or tagged >= TAGGED_SHARE * roads_m):
        doubt = f"{where} one drives on the {by_place}" if by_place not in (None, tags) else ""
        return DrivingSide(tags, "by the tags driving_side of its roads", doubt)
    rings = [side for side, count in evidence.rings.items() if count]
    if by_place is None and len(rings) == 1:
        return DrivingSide(rings[0], "as its roundabouts turn")
    if by_place is None:
        found = f"a place {where}, near a border between left and right, and no tags driving_side"
        raise ParameterError(name, found, "--driving-side left or right")
    exceptions = sum(metres for side, metres in tagged_m.items() if side != by_place)
    doubt = f"{exceptions:.0f} m of its roads are tagged otherwise" if exceptions else ""
    return DrivingSide(by_place, f"by the place ({where[3:]})", doubt)


def side_doubt(side: Side, place: Datum) -> str:
    """What the place says against a network's own side, as a sentence; empty where it agrees."""
    known = side_at(place.latitude_deg, place.longitude_deg)
    if known in (None, side):
        return ""
    return (
        f"The network's traffic drives on the {side}, but at {place.latitude_deg:.3f}, "
        f"{place.longitude_deg:.3f} one drives on the {known}: geoorbit map build --driving-side "
        f"{known} makes it anew of OpenStreetMap."
    )


@dataclass(frozen=True, slots=True)
class _Area:
    """(K, 2) corners of an area with left-hand traffic, longitude first, and (K,) `border_km`.

    `border_km` belongs to the edge to the next corner: nearer to it the side is not known by the
    place. It is 0 where the edge is no border with right-hand traffic, and larger where the table's
    border is rougher.
    """

    lon_lat_deg: NDArray[np.float64]
    border_km: NDArray[np.float64]


@cache
def _areas() -> tuple[_Area, ...]:
    rows: dict[str, list[list[float]]] = {}
    with AREAS.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            corner = [float(row[key]) for key in ("longitude", "latitude", "border_km")]
            rows.setdefault(row["area"], []).append(corner)
    corners = [np.array(area) for area in rows.values()]
    return tuple(_Area(area[:, :2], area[:, 2]) for area in corners)


def _distance_km(
    begin: NDArray[np.float64], end: NDArray[np.float64], latitude_deg: float, longitude_deg: float
) -> NDArray[np.float64]:
    """From a place to edges (K, 2), longitude first: (K,), exact enough for tens of km."""
    scale = np.array([np.cos(np.radians(latitude_deg)), 1.0]) * KM_PER_DEGREE
    place = np.array([longitude_deg, latitude_deg])
    a, b = (begin - place) * scale, (end - place) * scale
    step = b - a
    share = np.clip(-(a * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-9), 0.0, 1.0)
    return np.asarray(np.hypot(*(a + share[:, None] * step).T))
