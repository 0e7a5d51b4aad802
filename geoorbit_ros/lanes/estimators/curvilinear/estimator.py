"""The lane estimator that users get: lanes as crests of traffic density along curved roads.

Per update: passes (condensed tracks) -> corridors (streams with a reference curve) -> lateral
profiles -> density over (s, d) -> crests -> members -> centrelines -> widths. Nothing in it knows
an axis: it depends on distances and angles between vehicles alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.core.plugins import register
from geoorbit_ros.lanes.confidence import BEGIN, LaneEvidence, judge
from geoorbit_ros.lanes.estimators.curvilinear.candidates import find_candidates, find_ridges
from geoorbit_ros.lanes.estimators.curvilinear.corridors import Corridor, find_corridors
from geoorbit_ros.lanes.estimators.curvilinear.evidence import Evidence
from geoorbit_ros.lanes.estimators.curvilinear.profiles import lateral_profiles
from geoorbit_ros.lanes.estimators.curvilinear.reference_line import Spine
from geoorbit_ros.lanes.estimators.curvilinear.shapes import cross_sections, shape_lanes
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import Passes
from geoorbit_ros.lanes.mapping.lane_ids import LaneRegistry
from geoorbit_ros.lanes.mapping.state import State
from geoorbit_ros.lanes.mapping.update_policy import LaneCounter, Strays
from geoorbit_ros.lanes.parameters import LaneParameters

GROWTH = 1.0
"""Share by which the evidence grows before a derivation. A centreline's error shrinks with the root
of the traffic: twice as much sharpens it by a third, and less would hardly move it."""
LEAST_GROWTH = 0.05
"""The same where vehicles drive off the known lanes. Time per derivation grows with the evidence:
a least share of it between two keeps the time per vehicle the same however long the camera runs."""
RETRACE = 0.1
"""Share of the evidence that must be new for the reference curves to be traced anew."""


@dataclass(frozen=True)
class _Derived:
    """The last map derived in full, and what is needed to count on from it."""

    lane_map: LaneMap
    parameters: LaneParameters
    evidence: dict[int, LaneEvidence]
    passes: int
    finished: int

    @cached_property
    def counter(self) -> LaneCounter:
        """Counts new vehicles into the map's lanes."""
        return LaneCounter(self.lane_map.lanes)


@register("estimator", "curvilinear")
class CurvilinearEstimator:
    """`LaneEstimator` for any heading, bends, ramps, both directions and sparse lanes."""

    def __init__(self) -> None:
        self._evidence = Evidence()
        self.add: Callable[[int, NDArray[np.void]], None] = self._evidence.add
        """Take one frame of `TRACK_DTYPE` rows; stamps increase from call to call."""
        self._registry = LaneRegistry()
        self._spines: list[tuple[Spine, float]] = []
        self._traced = 0
        self._last: _Derived | None = None
        self._counted = 0
        self._strays = Strays()
        self._bundle = False

    def lanes(self, parameters: LaneParameters) -> LaneMap:
        """The lanes as the evidence stands now; see the module's text for the method."""
        passes, worth = self._evidence.passes()
        stamp_ns = self._evidence.stamp_ns
        if len(passes) == 0:
            return LaneMap(stamp_ns, ())
        corridors = self._corridors(passes)
        if not corridors:
            return LaneMap(stamp_ns, ())
        profiles = lateral_profiles(corridors, passes, worth)
        traced = find_ridges(profiles, passes.large[profiles.passes], parameters)
        candidates = find_candidates(profiles, traced)
        lanes = shape_lanes(candidates, corridors, profiles, parameters.width_scale)
        matched = self._registry.match(lanes)
        lanes = [
            judge(lane, candidate.evidence, old is not None and old.status == "confirmed")
            for lane, candidate, old in zip(lanes, candidates, matched, strict=True)
        ]
        shown = [
            k
            for k, (lane, old) in enumerate(zip(lanes, matched, strict=True))
            if old is not None or lane.confidence >= BEGIN
        ]
        lanes, matched = [lanes[k] for k in shown], [matched[k] for k in shown]
        candidates = [candidates[k] for k in shown]
        sections = cross_sections(candidates, corridors, profiles, traced.density)
        named = self._registry.identify(lanes, matched)
        lane_map = LaneMap(stamp_ns, tuple(sorted(named, key=lambda k: k.lane_id)), sections)
        self._counted, self._bundle = self._evidence.finished_ever, False
        self._strays.derived()
        self._last = _Derived(
            lane_map,
            parameters,
            {lane.lane_id: c.evidence for lane, c in zip(named, candidates, strict=True)},
            len(passes),
            self._evidence.finished_ever,
        )
        return lane_map

    def update(self, parameters: LaneParameters) -> LaneMap:
        """Count new vehicles into the last map, or derive it anew when that is worth it.

        A derivation costs time in proportion to the evidence, which is bounded; done once per so
        many vehicles, it costs the same per vehicle however long the camera has run.
        """
        last = self._last
        self._evidence.settle()
        if last is None or last.parameters != parameters:
            return self.lanes(parameters)
        fresh = self._evidence.finished_after(self._counted, last.lane_map.stamp_ns)
        self._counted = self._evidence.finished_ever
        self._bundle |= self._strays.add(fresh, last.counter.add(fresh))
        growth = (self._counted - last.finished) / last.passes
        if growth >= GROWTH or (self._bundle and growth >= LEAST_GROWTH):
            return self.lanes(parameters)
        lanes = []
        for lane, count in zip(last.lane_map.lanes, last.counter.vehicles.tolist(), strict=True):
            evidence = last.evidence[lane.lane_id]
            more = replace(lane, vehicles=lane.vehicles + count)
            seen = replace(evidence, vehicles=evidence.vehicles + count)
            lanes.append(judge(more, seen, lane.status == "confirmed"))
        self._registry.identify(lanes, lanes)
        return replace(last.lane_map, stamp_ns=self._evidence.stamp_ns, lanes=tuple(lanes))

    def state(self) -> State:
        """Passes and lanes; what is derived from them is not kept."""
        return self._evidence.state() | self._registry.state()

    def restore(self, state: Mapping[str, NDArray[Any]], stamp_ns: int) -> None:
        """Go on from a state; the next frame comes at `stamp_ns`.

        Raises:
            KeyError, ValueError, IndexError: Not such a state.
        """
        self._evidence.restore(state, stamp_ns)
        self._registry.restore(state)

    def _corridors(self, passes: Passes) -> list[Corridor]:
        """Corridors along the known reference curves; these are traced anew as evidence grows."""
        fresh = self._evidence.finished_ever - self._traced
        if not self._spines or fresh >= RETRACE * len(passes):
            corridors = find_corridors(passes)
            self._traced = self._evidence.finished_ever
        else:
            corridors = find_corridors(passes, self._spines)
        self._spines = [(c.spine, c.speed_mps) for c in corridors]
        return corridors
