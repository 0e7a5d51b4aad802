"""Passages of vehicles along lanes, and their speeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import UNKNOWN_CLASS, distinct
from geoorbit_ros.traffic.lane_sequence import LaneSequence
from geoorbit_ros.traffic.motion_fit import fit_motions
from geoorbit_ros.traffic.records import PASSAGE_DTYPE, PIECE_DTYPE
from geoorbit_ros.traffic.vehicle_paths import Paths

Array = NDArray[np.float64]

SHORTEST_M = 5.0
"""A lane in which a vehicle drove less far was none of its lanes. Chosen: a car's length."""


SEAM_M = 20.0
"""Who is so far back along its lane from one row to the next has passed the place where a
roundabout's lane ends and begins. Chosen: more than any error of a place, less than half of the
smallest roundabout."""
PIECE_NS = 10_000_000_000
"""Length of the pieces of a passage. Chosen: most vehicles of a flowing road are seen for less, so
that they have one; shorter makes tables of a jam long, longer smears a stop over more time."""
END_M = 1.5
"""1-sigma error of a passage's length by its first and last place. Chosen: boxes are cut or merged
there by a third of a car."""
LEAST_SIGMA_M = 0.02
"""No place is surer. Chosen: keeps weights finite where a producer claims exact places."""


@dataclass(frozen=True, slots=True)
class Runs:
    """Stretches of rows of one vehicle in one lane.

    Attributes:
        vehicle: (R,) number of the path.
        lane: (R,) index of the lane.
        rows: (M,) rows of the paths that belong to them, in order.
        run: (M,) which run each belongs to.
    """

    vehicle: NDArray[np.int64]
    lane: NDArray[np.int64]
    rows: NDArray[np.int64]
    run: NDArray[np.int64]


def find_passages(paths: Paths, found: LaneSequence, runs: Runs) -> NDArray[np.void]:
    """Passages of vehicles, ordered by vehicle and time.

    Args:
        paths: Whole paths.
        found: Their lanes.
        runs: Their runs.

    Returns:
        (P,) `PASSAGE_DTYPE`, with numbers of paths and lanes from 0 in place of ids, -1 for no
        lane, and speed errors without that of the calibration.
    """
    stamp_ns = paths.rows["stamp_ns"][runs.rows]
    arc = found.places.arc_m[runs.rows, runs.lane[runs.run]]
    begin = np.flatnonzero(np.diff(runs.run, prepend=-1))
    end = np.append(begin[1:], len(runs.rows)) - 1
    out = np.zeros(len(begin), PASSAGE_DTYPE)
    if not len(out):
        return out
    out["vehicle_id"], out["lane_id"] = runs.vehicle, runs.lane
    out["track_id"] = paths.rows["track_id"][paths.offset[runs.vehicle]]
    out["class_id"] = classes(paths)[runs.vehicle]
    out["length_m"] = lengths(paths)[runs.vehicle]
    out["first_ns"], out["last_ns"] = stamp_ns[begin], stamp_ns[end]
    out["first_arc_m"], out["last_arc_m"] = arc[begin], arc[end]
    time_s = (stamp_ns - stamp_ns[begin][runs.run]) * 1e-9
    fit = fit_motions(runs.run, len(begin), time_s, arc, place_sigma(paths)[runs.rows])
    # One curve describes who keeps driving. Who stops on the way has the speed of way and time.
    duration_s = np.maximum((out["last_ns"] - out["first_ns"]) * 1e-9, 1e-3)
    plain, plain_sigma = (out["last_arc_m"] - out["first_arc_m"]) / duration_s, END_M / duration_s
    stops = np.abs(plain - fit.mean_mps) > 3.0 * np.hypot(plain_sigma, fit.noise_mps)
    out["speed_mps"] = np.where(stops, plain, fit.mean_mps)
    out["speed_sigma_mps"] = np.where(stops, plain_sigma, fit.noise_mps)
    out["from_lane"] = out["to_lane"] = -1
    same = out["vehicle_id"][1:] == out["vehicle_id"][:-1]
    same &= out["lane_id"][1:] != out["lane_id"][:-1]
    out["from_lane"][1:][same] = out["lane_id"][:-1][same]
    out["to_lane"][:-1][same] = out["lane_id"][1:][same]
    return out


def find_pieces(paths: Paths, found: LaneSequence, runs: Runs) -> NDArray[np.void]:
    """(P,) `PIECE_DTYPE`, ordered by vehicle and time; see `find_passages` for ids.

    A piece ends where the next one of its passage begins.
    """
    if not len(runs.rows):
        return np.empty(0, PIECE_DTYPE)
    stamp_ns = paths.rows["stamp_ns"][runs.rows]
    arc = found.places.arc_m[runs.rows, runs.lane[runs.run]]
    run_begin = np.flatnonzero(np.diff(runs.run, prepend=-1))
    number = (stamp_ns - stamp_ns[run_begin][runs.run]) // PIECE_NS
    begins = (np.diff(runs.run, prepend=-1) != 0) | (np.diff(number, prepend=-1) != 0)
    begin = np.flatnonzero(begins)
    end = np.append(begin[1:], len(runs.rows) - 1)
    run = runs.run[begin]
    end = np.where(runs.run[end] == run, end, end - 1)
    out = np.zeros(len(begin), PIECE_DTYPE)
    out["vehicle_id"], out["lane_id"] = runs.vehicle[run], runs.lane[run]
    out["class_id"] = classes(paths)[runs.vehicle[run]]
    out["length_m"] = lengths(paths)[runs.vehicle[run]]
    out["first_ns"], out["last_ns"] = stamp_ns[begin], stamp_ns[end]
    out["way_m"] = arc[end] - arc[begin]
    return out[out["last_ns"] > out["first_ns"]]


def find_runs(paths: Paths, found: LaneSequence) -> Runs:
    """Runs long enough to be passages; what lies between two runs in the same lane joins them."""
    owner, lane = paths.owner, found.lane
    rows = np.flatnonzero(lane >= 0)
    while True:
        changed = np.diff(lane[rows], prepend=-2) != 0
        changed |= np.diff(owner[rows], prepend=-1) != 0
        arc = found.places.arc_m[rows, lane[rows]]
        changed |= np.diff(arc, prepend=0.0) < -SEAM_M
        run = np.cumsum(changed) - 1
        begin = np.flatnonzero(changed)
        end = np.append(begin[1:], len(rows)) - 1
        kept = arc[end] - arc[begin] >= SHORTEST_M if len(rows) else np.zeros(0, np.bool_)
        if kept.all():
            return Runs(owner[rows][begin], lane[rows][begin], rows, run)
        rows = rows[kept[run]]


def classes(paths: Paths) -> NDArray[np.int64]:
    """(V,) class of each vehicle: of most of its rows, weighed by score and sharpness."""
    of_rows = paths.rows["class_id"]
    kinds = distinct(of_rows)
    if not len(kinds):
        return np.full(len(paths), UNKNOWN_CLASS, np.int64)
    kind = np.searchsorted(kinds, of_rows)
    weight = paths.rows["score"] / np.maximum(paths.rows["sigma"], 0.05) ** 2
    weight = np.nan_to_num(weight, nan=0.0) + 1e-9
    cell, cells = paths.owner * len(kinds) + kind, len(paths) * len(kinds)
    votes = np.bincount(cell, weight, cells).reshape(len(paths), len(kinds))
    return np.asarray(kinds[votes.argmax(axis=1)], dtype=np.int64)


def lengths(paths: Paths) -> Array:
    """(V,) length of each vehicle as learnt by the end of its path; NaN where nothing shows it."""
    return paths.rows["length"][paths.offset[1:] - 1].astype(np.float64)


def place_sigma(paths: Paths) -> Array:
    """(N,) expected 1-sigma error of each place; none is exact."""
    return np.asarray(np.maximum(paths.rows["sigma"], LEAST_SIGMA_M))
