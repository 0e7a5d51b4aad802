"""How sure a lane is, and how much traffic would make it sure."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from geoorbit_ros.core.lanes import Lane

VEHICLE_SCALE = 2.2
"""Confidence by traffic alone is 1 - exp(-vehicles / VEHICLE_SCALE): 0.37 for one, 0.93 for six."""
MIN_VEHICLES = 6.0
CONFIRM = 0.8
BEGIN = 0.35
"""A lane is first shown with what one vehicle that drove along all of it would give (0.365): scraps
of tracks beside a lane give less."""
KEEP_CONFIRMED = 0.5
"""A confirmed lane stays so until its confidence falls under this: no flicker at the threshold."""


@dataclass(frozen=True, slots=True)
class LaneEvidence:
    """What speaks for a lane.

    Attributes:
        vehicles: Distinct vehicles that drove along it; one seen over a short stretch counts less.
        lane_share: Share of the traffic in its band that drives along it rather than across.
        length: Its length in units of the road's scale (about a second of travel).
        presence: Traffic seen there as a share of the most seen in that band of the road.
    """

    vehicles: float
    lane_share: float
    length: float
    presence: float


def judge(lane: Lane, evidence: LaneEvidence, was_confirmed: bool) -> Lane:
    """The lane with its confidence, status and missing traffic filled in.

    Args:
        lane: The lane.
        evidence: What speaks for it.
        was_confirmed: Whether an earlier map had it confirmed.
    """
    beside_traffic = _beside_traffic(evidence)
    confidence = (1.0 - math.exp(-evidence.vehicles / VEHICLE_SCALE)) * beside_traffic
    confirmed = evidence.vehicles >= MIN_VEHICLES and confidence >= CONFIRM
    confirmed |= was_confirmed and confidence >= KEEP_CONFIRMED
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
    )


def _beside_traffic(evidence: LaneEvidence) -> float:
    """The confidence that any number of vehicles would give."""
    # Half the band's traffic driving across is common at a merge; nearly all of it is no lane.
    along = 1.0 / (1.0 + math.exp(-(evidence.lane_share - 0.3) / 0.06))
    long = 1.0 - math.exp(-evidence.length / 0.5)
    # Where vehicles fade from sight, tails of broken tracks form bundles that are no lanes.
    sight = 1.0 / (1.0 + math.exp(-(evidence.presence - 0.25) / 0.04))
    return along * long * sight
