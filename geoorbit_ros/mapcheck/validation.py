"""Compares a camera's lanes with a network: first the map as a whole, then lane by lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.mapcheck.alignment import SIGNIFICANT_M, Alignment, align
from geoorbit_ros.mapcheck.discrepancies import Discrepancies, compare
from geoorbit_ros.mapcheck.findings import TITLES, Finding
from geoorbit_ros.roadnet.network import RoadNetwork

OPPOSITE = float(np.cos(np.radians(30.0)))
"""Opposite directions differ by 180 degrees, give or take 30. Chosen: less misses roads in bends,
more takes crossing roads for one."""


@dataclass(frozen=True, slots=True)
class Validation:
    """The result of a comparison.

    Attributes:
        alignment: How the camera's map frame lies on the network.
        findings: The displaced map first, then single lanes, the most certain first.
        discrepancies: Single lanes, with those not compared.
        notes: What else the user should know, as sentences without full stop.
    """

    alignment: Alignment
    findings: tuple[Finding, ...]
    discrepancies: Discrepancies
    notes: tuple[str, ...] = ()

    def summary(self) -> list[str]:
        """What was found, in one or two sentences."""
        found = [say_alignment(self.alignment)]
        lanes = sum(finding.kind != "offset" for finding in self.findings)
        if lanes:
            found.append(
                f"the map differs from the lanes seen in {lanes} places: "
                "geoorbit twin patch corrects it."
            )
        return found + [f"{note}." for note in self.notes]

    def record(self, datum: Datum) -> dict[str, Any]:
        """Everything for a JSON file, positions in degrees."""
        a = self.alignment
        return {
            "alignment": {
                "significant": a.significant,
                **a.values(),
                "unobserved_heading_deg": _heading(a),
                "residual_m": round(a.residual_m, 3),
                "lanes": a.lanes,
            },
            "findings": [_record(finding, datum) for finding in self.findings],
            "notes": list(self.notes),
            "not_seen": [{"lane": u.lane_id, "why": u.sentence} for u in self.discrepancies.unseen],
            "compared_m": {k: round(m, 1) for k, m in self.discrepancies.compared.items()},
        }


def validate(lanes: Sequence[Lane], network: RoadNetwork) -> Validation:
    """Compare detected lanes with a network, both in the camera's map frame.

    Raises:
        NoTrafficError: No confirmed lane.
        RoadNetworkError: The network lies elsewhere.
    """
    alignment = align(lanes, network)
    found = compare(lanes, network, alignment.applied)
    findings = found.findings
    if alignment.significant:
        findings = (_offset(alignment), *findings)
    other = made_for_other_side(found)
    notes = ((_other_side(len(found.compared), network),) if other else ()) + found.reserved
    return Validation(alignment, findings, found, notes)


def made_for_other_side(found: Discrepancies) -> bool:
    """Whether traffic runs against all lanes that were compared, in both directions of a road.

    Then no lane is wrong by itself: the map is made for traffic on the other side.
    """
    turned = {f.lane_id: f.measured for f in found.findings if f.kind == "direction"}
    if not turned or turned.keys() != found.compared.keys():
        return False
    heading = np.radians(list(turned.values()))
    return bool(np.cos(heading[:, None] - heading).min() < -OPPOSITE)


def _other_side(lanes: int, network: RoadNetwork) -> str:
    side, other = ("left", "right") if network.left_hand else ("right", "left")
    return (
        f"traffic runs against all {lanes} lanes that were compared: the map is made for traffic "
        f"on the {side}, here it drives on the {other} "
        f"(geoorbit map build --driving-side {other} makes it anew)"
    )


def in_frame(lanes: Sequence[Lane], datum: Datum, wanted: Datum) -> list[Lane]:
    """Lanes of one map frame in another."""
    if datum == wanted:
        return list(lanes)

    def move(line: NDArray[np.float64]) -> NDArray[np.float64]:
        return wanted.to_local(*datum.to_geodetic(line).T)

    return [
        replace(
            lane,
            centerline_m=move(lane.centerline_m),
            left_m=move(lane.left_m),
            right_m=move(lane.right_m),
        )
        for lane in lanes
    ]


def say_alignment(a: Alignment) -> str:
    """The alignment as a sentence."""
    unknown = _heading(a)
    along = "" if unknown is None else f" (not known along {unknown:.0f}°, where all lanes run)"
    if not a.significant:
        return (
            f"As a whole, camera and map fit within {a.size_m:.2f} ± {a.sigma_m:.2f} m{along}; "
            "single lanes may not."
        )
    east, north = -a.shift_m
    return (
        f"The map lies {_metres(east, 'east', 'west')} and {_metres(north, 'north', 'south')} of "
        f"what the camera sees, ± {a.sigma_m:.2f} m{along}."
    )


def _metres(value: float, positive: str, negative: str) -> str:
    return f"{abs(value):.2f} m {positive if value >= 0 else negative}"


def _heading(a: Alignment) -> float | None:
    """Degrees from north of the direction that is not observed, below 180; None if both are."""
    if not a.unobserved.any():
        return None
    return round(float(np.degrees(np.arctan2(*a.unobserved)) % 180.0), 1)


def _offset(a: Alignment) -> Finding:
    return Finding(
        kind="offset",
        lane_id="",
        detected=None,
        line_m=a.centre_m[None, :],
        measured=a.size_m,
        expected=0.0,
        tolerance=max(SIGNIFICANT_M, 3.0 * a.sigma_m),
        unit="m",
        confidence=1.0 - float(np.exp(-0.5 * (a.size_m / max(a.sigma_m, 1e-3)) ** 2)),
        sentence=say_alignment(a)[:-1],
    )


def _record(finding: Finding, datum: Datum) -> dict[str, Any]:
    latitude, longitude = datum.to_geodetic(finding.middle_m)[0]
    return {
        "kind": finding.kind,
        "meaning": TITLES[finding.kind],
        "lane": finding.lane_id,
        "detected": finding.detected,
        "latitude_deg": round(float(latitude), 7),
        "longitude_deg": round(float(longitude), 7),
        "measured": round(finding.measured, 3),
        "expected": round(finding.expected, 3),
        "tolerance": round(finding.tolerance, 3),
        "unit": finding.unit,
        "confidence": round(finding.confidence, 4),
        "sentence": finding.sentence,
    }
