"""Corrects a network by the findings of a camera, through netconvert, and checks the result.

Only lanes with a finding change. The part of a lane beyond the view moves along with the part seen.
A lane that isn't there is removed only if most of it was in view.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.datum import Datum
from geoorbit_ros.core.errors import RoadNetworkError
from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.mapcheck.driven_lanes import DrivenLane, moved_line, places_along
from geoorbit_ros.mapcheck.findings import Finding
from geoorbit_ros.mapcheck.validation import Validation, made_for_other_side, validate
from geoorbit_ros.roadnet.map_build import write_moved
from geoorbit_ros.roadnet.netconvert import drop_header
from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.roadnet.plain_network import EdgeEdit, LaneEdit, PlainNetwork

UNSEEN_SHARE = 0.5
"""Share of a lane that may lie outside the view for the lane to be removed. Chosen: larger removes
lanes that may be there farther down the road, smaller leaves extra lanes whose ends are hidden."""
NETWORK, FOLDER = "network.net.xml", "patch"


@dataclass(frozen=True, slots=True)
class Patched:
    """A corrected network.

    Attributes:
        network: As loaded again.
        before: What was found in the given network.
        after: What is found in the corrected network.
        done: Findings that the patch corrects.
        left: Findings that it doesn't, with the reason.
        options: Those netconvert was run with.
        warnings: What it warned of.
    """

    network: RoadNetwork
    before: Validation
    after: Validation
    done: tuple[Finding, ...]
    left: tuple[tuple[Finding, str], ...]
    options: tuple[str, ...]
    warnings: tuple[str, ...]

    def record(self, datum: Datum) -> dict[str, Any]:
        """Everything for a JSON file."""
        return {
            "netconvert": {"options": list(self.options), "warnings": list(self.warnings)},
            "corrected": [f.sentence for f in self.done],
            "left": [{"finding": f.sentence, "why": reason} for f, reason in self.left],
            "before": self.before.record(datum),
            "after": self.after.record(datum),
        }


def patch_network(lanes: Sequence[Lane], network: RoadNetwork, folder: Path) -> Patched:
    """Correct a network by the lanes that a camera sees.

    Args:
        lanes: Detected, in the camera's map frame.
        network: In the same frame.
        folder: Gets `network.net.xml`, and in `patch/` the plain XML.

    Raises:
        NoTrafficError: No confirmed lane.
        RoadNetworkError: The network lies elsewhere, or netconvert refuses the patch.
    """
    before = found = validate(lanes, network)
    plain_folder = folder / FOLDER
    plain_folder.mkdir()
    source = network.path
    done: list[Finding] = []
    if before.alignment.significant:
        source = plain_folder / "moved.net.xml"
        write_moved(network, before.alignment.inverse_points, source)
        network = load_network(source, network.datum)
        found = validate(lanes, network)
        done.append(before.findings[0])
    plain = PlainNetwork(source, plain_folder)
    editor = _Editor(plain, network)
    left = []
    order = ("direction", "missing", "shifted", "width", "extra")
    for finding in sorted(found.findings, key=lambda f: (*order, "offset").index(f.kind)):
        reason = editor.apply(finding, found, lanes)
        if reason:
            left.append((finding, reason))
        else:
            done.append(finding)
    out = folder / NETWORK
    if plain.changed:
        warnings, options = plain.write(out)
    else:
        shutil.copyfile(source, out)
        warnings, options = (), ()
    if plain.changed:
        drop_header(out)
    patched = load_network(out, network.datum)
    _check(patched, plain)
    return Patched(
        patched, before, validate(lanes, patched), tuple(done), tuple(left), options, warnings
    )


class _Editor:
    """Applies findings one by one.

    Args:
        plain: What is changed.
        network: The network before the changes, in the map frame.
    """

    def __init__(self, plain: PlainNetwork, network: RoadNetwork) -> None:
        self._plain, self._network = plain, network

    def apply(self, finding: Finding, found: Validation, lanes: Sequence[Lane]) -> str:
        """Change the network; the reason where that can't be done, else empty."""
        if not finding.lane_id:
            return "no road of the map is beside it"
        k = self._network.number[finding.lane_id]
        edge_id, index = self._network.edge_id[k], int(self._network.index[k])
        if finding.kind == "direction":
            return self._reverse(edge_id, found)
        edit = self._plain.edge(edge_id)
        at = next((i for i, lane in enumerate(edit.lanes) if lane.origin == index), None)
        if at is None:
            return "its lane is gone"
        lane = edit.lanes[at]
        if finding.kind == "extra":
            if reason := self._kept(k, finding, edit):
                return reason
            del edit.lanes[at]
        elif finding.kind == "width":
            lane.width_m = finding.measured
        elif finding.kind == "shifted":
            lane.shape_m = self._moved(k, finding.line_m)
        else:
            width = next(d.width_m for d in lanes if d.lane_id == finding.detected)
            line = self._network.line(k)
            side = float(np.median(project(finding.line_m, line).offset_m))
            new = LaneEdit(
                None, self._moved(k, finding.line_m), width, self._rules(edit, lane), lane.profile
            )
            inner = (side > 0) != self._network.left_hand
            edit.lanes.insert(at + 1 if inner else at, new)
        return ""

    def _kept(self, k: int, finding: Finding, edit: EdgeEdit) -> str:
        """Why an extra lane is not removed; empty where it is."""
        if len(edit.lanes) == 1:
            return "it is its edge's only lane"
        length_m = float(self._network.length_m[k])
        seen_m = float(np.ptp(project(finding.line_m, self._network.line(k)).arc_m))
        if length_m - seen_m > UNSEEN_SHARE * length_m:
            seen = f"only {seen_m:.0f} m of its {length_m:.0f} m were in view"
            return f"{seen}: it may be there farther on (split the edge to remove a part)"
        return ""

    def _rules(self, edit: EdgeEdit, beside: LaneEdit) -> dict[str, str]:
        """Rules of a new lane: as beside it, open to all cars, because it was seen to be driven."""
        lanes = [lane for lane in edit.lanes if lane.origin is not None]
        number = (self._network.number.get(f"{edit.edge_id}_{lane.origin}") for lane in lanes)
        open_lanes = [
            lane
            for lane, k in zip(lanes, number, strict=True)
            if k is not None and self._network.for_cars[k]
        ]
        at = lanes.index(beside) if beside in lanes else 0
        if open_lanes:
            nearest = min(open_lanes, key=lambda lane: abs(lanes.index(lane) - at))
            return dict(nearest.rules)
        return {k: v for k, v in beside.rules.items() if k not in ("allow", "disallow", "prefer")}

    def _reverse(self, edge_id: str, found: Validation) -> str:
        if made_for_other_side(found.discrepancies):
            return "the map is made for traffic on the other side"
        wrong = {f.lane_id for f in found.findings if f.kind == "direction"}
        right = set(found.discrepancies.compared) - wrong
        if any(self._network.edge_id[self._network.number[lane]] == edge_id for lane in right):
            return "only some lanes of its edge run the other way"
        edit = self._plain.edge(edge_id)
        if not edit.reversed:
            edit.reverse()
        return ""

    def _moved(self, k: int, seen_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Lane k's line, moved sideways to points seen (N, 2), in the network's coordinates."""
        foot = project(seen_m, self._network.line(k), 3.0)
        order = np.argsort(foot.arc_m)
        driven = DrivenLane(foot.arc_m[order], foot.offset_m[order], 0.0)
        at = places_along(self._network, k)
        line = moved_line(self._network, k, at, driven.left_at(at))
        return self._network.plane.to_network.points(line)


def _check(network: RoadNetwork, plain: PlainNetwork) -> None:
    """Check that netconvert made all lanes of the changed edges.

    Raises:
        RoadNetworkError: An edge has more or fewer.
    """
    import sumolib

    loaded = sumolib.net.readNet(str(network.path))
    for edge_id, edit in plain.changed.items():
        found = loaded.getEdge(edge_id).getLaneNumber() if loaded.hasEdge(edge_id) else 0
        if found != len(edit.lanes):
            place = f"{network.path}, edge '{edge_id}'"
            raise RoadNetworkError(place, f"{found} lanes", f"{len(edit.lanes)} lanes")
