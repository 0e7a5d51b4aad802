"""How sure a lane is, and how much traffic would make it sure."""

from __future__ import annotations

import math
from dataclasses import replace

from geoorbit_ros.core.lanes import Lane, LaneEvidence, LaneMap

VEHICLE_SCALE = 2.2
"""Confidence by traffic alone is 1 - exp(-vehicles / VEHICLE_SCALE): 0.37 for one, 0.93 for six.
Chosen: larger asks for more traffic, smaller trusts lanes of one or two vehicles."""
MIN_VEHICLES = 6.0
"""A confirmed lane has at least so many. Chosen: more delays quiet lanes, fewer confirms a line
whose mean position is off by more than 0.1 m (drivers differ by 0.2 m, 1 sigma)."""
CONFIRM = 0.8
"""A lane is confirmed from this confidence on. Chosen: larger delays lanes, smaller confirms wrong
ones."""
SHOW = 0.35
"""A lane is first shown from this confidence on: what one vehicle that drove along all of it gives
(0.365). Scraps of tracks beside a lane give less."""
KEEP_CONFIRMED = 0.5
"""A confirmed lane stays so until its confidence falls below this. Chosen: closer to `CONFIRM`
lanes flicker, smaller keeps lanes that are no longer driven."""


def assess(lane: Lane, evidence: LaneEvidence) -> Lane:
    """The lane with its evidence, confidence, status and missing vehicles filled in."""
    beside_traffic = _beside_traffic(evidence)
    confidence = (1.0 - math.exp(-evidence.vehicles / VEHICLE_SCALE)) * beside_traffic
    confirmed = evidence.vehicles >= MIN_VEHICLES and confidence >= CONFIRM
    missing = 0
    if not confirmed:
        target = evidence.vehicles + MIN_VEHICLES
        if beside_traffic > CONFIRM:
            target = max(MIN_VEHICLES, -VEHICLE_SCALE * math.log(1.0 - CONFIRM / beside_traffic))
        missing = max(1, math.ceil(target - evidence.vehicles))
    return replace(
        lane,
        confidence=confidence,
        status="confirmed" if confirmed else "tentative",
        vehicles_missing=missing,
        evidence=evidence,
    )


def keep_confirmed(lane: Lane, before: Lane | None) -> Lane:
    """The lane, confirmed if it was so before and its confidence has not fallen far since.

    Args:
        lane: The lane as it is now.
        before: The same lane in an earlier map; None for a new lane.
    """
    was_confirmed = before is not None and before.status == "confirmed"
    if lane.status == "confirmed" or not was_confirmed or lane.confidence < KEEP_CONFIRMED:
        return lane
    return replace(lane, status="confirmed", vehicles_missing=0)


def unconfirmed(lane_map: LaneMap) -> LaneMap:
    """The map of doubtful input: its lanes are tentative, and more traffic doesn't change that."""
    lanes = tuple(replace(lane, status="tentative", vehicles_missing=0) for lane in lane_map.lanes)
    return replace(lane_map, lanes=lanes, doubtful=True)


def count_vehicles(lane: Lane, vehicles: int) -> Lane:
    """The lane with `vehicles` more vehicles; assessed anew where its evidence is known."""
    more = replace(lane, vehicles=lane.vehicles + vehicles)
    if lane.evidence is None:
        return more
    return assess(more, replace(lane.evidence, vehicles=lane.evidence.vehicles + vehicles))


def _beside_traffic(evidence: LaneEvidence) -> float:
    """The confidence that any number of vehicles would give."""
    # Half the band's traffic driving across is common at a merge; nearly all of it is no lane.
    along = 1.0 / (1.0 + math.exp(-(evidence.lane_share - 0.3) / 0.06))
    long = 1.0 - math.exp(-evidence.length / 0.5)
    # Where vehicles fade from view, tails of broken tracks form clusters that are no lanes.
    sight = 1.0 / (1.0 + math.exp(-(evidence.presence - 0.25) / 0.04))
    return along * long * sight
