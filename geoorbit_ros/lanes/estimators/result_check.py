"""What a plug-in's lane map must be: checked in full, against the tracks that it was given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from geoorbit_ros.core.lanes import CrossSection, Lane, LaneEvidence, LaneMap, Status
from geoorbit_ros.core.plugin_methods import ARRAYS, Returns, WrongResult, checked_arrays, what
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import TrajectorySegments

MIN_POINTS = 2
"""A line has at least so many points."""
MIN_LENGTH_M = 0.1
"""Least length of a line. Chosen: larger refuses short lanes, smaller takes a point for a line."""
MAX_WIDTH_M = 50.0
"""Largest width and its error. Chosen: smaller refuses open squares, larger accepts other units."""
MAX_DISTANCE_M = 1000.0
"""How far a line may reach beyond all tracks. Chosen: smaller refuses lanes that go on beyond what
is seen, larger accepts coordinates of another frame."""
_LINES = ("centerline_m", "left_m", "right_m")
_STATUSES = get_args(Status)
_WORDS = " or ".join(f"'{status}'" for status in _STATUSES)


class ResultCheck:
    """Checks the results of one estimator, and notes what it was given."""

    def __init__(self) -> None:
        self._first_ns: float = math.inf
        self._last_ns: int | None = None
        self._low = np.full(2, np.inf)
        self._high = np.full(2, -np.inf)

    def returns(self) -> Mapping[str, Returns]:
        """What each method must return."""
        return {
            "add": Returns("no error", self._note_frame),
            "lanes": Returns("a LaneMap whose fields are as core/lanes.py says", self._check_map),
            "finished_segments": Returns("a whole number, at least 0", _check_count),
            "segments_after": Returns("TrajectorySegments", _check_segments),
            "state": Returns(ARRAYS, checked_arrays),
            "restore": Returns("no error", self._note_restored),
        }

    def _note_frame(self, _: object, given: tuple[Any, ...], result: object) -> object:
        stamp_ns, rows = given
        self._last_ns, self._first_ns = stamp_ns, min(self._first_ns, stamp_ns)
        for k, name in enumerate("xy"):
            if len(values := rows[name][np.isfinite(rows[name])]):
                self._low[k] = min(self._low[k], values.min())
                self._high[k] = max(self._high[k], values.max())
        return result

    def _note_restored(self, _: object, __: object, result: object) -> object:
        self._first_ns = -math.inf
        return result

    def _check_map(self, _: object, __: object, found: object) -> LaneMap:
        if not isinstance(found, LaneMap):
            raise WrongResult(what(found))
        self._check_stamp(found.stamp_ns)
        if not isinstance(found.lanes, tuple | list):
            raise WrongResult(f"{what(found.lanes)} as lanes, not a tuple")
        for k, lane in enumerate(found.lanes):
            try:
                self._check_lane(lane)
            except WrongResult as error:
                raise WrongResult(f"lane {k}: {error}") from None
        if not isinstance(found.cross_sections, tuple) or not all(
            isinstance(section, CrossSection) for section in found.cross_sections
        ):
            raise WrongResult("cross_sections that are not a tuple of CrossSection")
        seen = found.visible_m
        if not (isinstance(seen, np.ndarray) and seen.ndim == 2 and seen.shape[1] == 2):
            raise WrongResult("visible_m that is not an array of shape (V, 2)")
        _whole("segments", found.segments)
        return found

    def _check_stamp(self, stamp_ns: object) -> None:
        if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, int | np.integer):
            found = f"stamp_ns {stamp_ns!r} of type {type(stamp_ns).__name__}"
            raise WrongResult(f"{found}, not a whole number of nanoseconds")
        if self._last_ns is not None and not self._first_ns <= stamp_ns <= self._last_ns:
            found = f"stamp_ns {stamp_ns}, not that of a frame it was given (the last one:"
            raise WrongResult(f"{found} {self._last_ns})")

    def _check_lane(self, lane: object) -> None:
        if not isinstance(lane, Lane):
            raise WrongResult(what(lane))
        for name in _LINES:
            self._check_line(name, getattr(lane, name))
        _check_sides(lane)
        if isinstance(lane.lane_id, bool) or not isinstance(lane.lane_id, int | np.integer):
            raise WrongResult(f"lane_id {lane.lane_id!r}, not a whole number")
        if not isinstance(lane.status, str) or lane.status not in _STATUSES:
            raise WrongResult(f"status {lane.status!r}, not {_WORDS}")
        _number("confidence", lane.confidence, 0.0, 1.0)
        _number("width_m", lane.width_m, 0.0, MAX_WIDTH_M)
        if lane.width_m == 0.0:
            raise WrongResult("width_m 0.0, not above 0")
        _number("width_sigma_m", lane.width_sigma_m, 0.0, MAX_WIDTH_M, unknown=True)
        _number("sigma_m", lane.sigma_m, 0.0, math.inf, unknown=True)
        _number("vehicles", lane.vehicles, 0.0, math.inf, unknown=True)
        _whole("vehicles_missing", lane.vehicles_missing)
        if lane.evidence is not None and not isinstance(lane.evidence, LaneEvidence):
            raise WrongResult(f"{what(lane.evidence)} as evidence, not LaneEvidence")

    def _check_line(self, name: str, line: object) -> None:
        if not isinstance(line, np.ndarray):
            raise WrongResult(f"{what(line)} as {name}, not a float64 array")
        if line.ndim != 2 or line.shape[1] != 2 or len(line) < MIN_POINTS:
            raise WrongResult(f"{name} of shape {line.shape}, not (K, 2) with K at least 2")
        if line.dtype != np.float64:
            raise WrongResult(f"{line.dtype} in {name}, not float64")
        if not np.isfinite(line).all():
            raise WrongResult(f"values that are not finite in {name}")
        length_m = float(np.hypot(*np.diff(line, axis=0).T).sum())
        if not length_m >= MIN_LENGTH_M:
            raise WrongResult(f"{name} of {length_m:.3g} m length")
        if (self._low <= self._high).all():
            beyond = np.maximum(self._low - line, line - self._high).max()
            if beyond > MAX_DISTANCE_M:
                far = f"{name} {beyond / 1000.0:.3g} km away from all tracks"
                raise WrongResult(f"{far}, farther than {MAX_DISTANCE_M / 1000.0:g} km")


def _check_sides(lane: Lane) -> None:
    for name in ("left_m", "right_m"):
        if (number := len(getattr(lane, name))) != (wanted := len(lane.centerline_m)):
            raise WrongResult(f"{name} with {number} points, not {wanted} as centerline_m has")
    east, north = np.gradient(lane.centerline_m, axis=0).T
    across = lane.left_m - lane.right_m
    if not float(np.sum(east * across[:, 1] - north * across[:, 0])) > 0.0:
        raise WrongResult("left_m that is not to the left of right_m in travel order")


def _number(name: str, value: object, low: float, high: float, *, unknown: bool = False) -> None:
    """Refuse what is no number from low to high; not a number means unknown, where that may be."""
    real = isinstance(value, int | float | np.integer | np.floating)
    if not real or isinstance(value, bool):
        raise WrongResult(f"{name} {value!r}, not a number")
    number = float(value)  # type: ignore[arg-type]  # real, as checked
    if not (unknown and math.isnan(number)) and not (low <= number <= high and number < math.inf):
        bounds = f"from {low:g} to {high:g}" if high < math.inf else f"of at least {low:g}"
        raise WrongResult(f"{name} {number:g}, not a number {bounds}")


def _whole(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise WrongResult(f"{name} {value!r}, not a whole number of at least 0")


def _check_count(_: object, __: object, number: Any) -> int:
    _whole("number", number)
    return int(number)


def _check_segments(_: object, __: object, found: object) -> object:
    if not isinstance(found, TrajectorySegments):
        raise WrongResult(what(found))
    return found
