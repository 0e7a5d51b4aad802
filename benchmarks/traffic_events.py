"""Events planted in scene runs: how many are found and when, and what is reported without reason.

    python benchmarks/traffic_events.py planted [--runs 100] [--first 0] [--kinds stopped,queue]
    python benchmarks/traffic_events.py ordinary [--hours 5] [--first 0]

Every other run is on a shipped scene, the others on random ones. Boxes come from the camera model
with its noise, gaps and exchanged ids, and are placed on the road with a surveyed calibration. An
event of ordinary traffic is false unless the simulated vehicles really did that.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.core.polylines import project
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.scenes.random_scene import random_scene
from geoorbit_ros.scenes.scene import Scene, load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import START_NS, simulate
from geoorbit_ros.scenes.traffic import STEP_S, TrafficRecord, simulate_traffic
from geoorbit_ros.traffic.event_records import EventKind, EventState
from geoorbit_ros.traffic.events import EventWatch
from planted_events import PLANTS, Planted, at_rate, ground_tracks, lanes_in_view, true_queue

FPS = 5.0
KINDS = {
    "stopped": EventKind.STOPPED,
    "wrong_way": EventKind.WRONG_WAY,
    "queue": EventKind.QUEUE,
    "lane_unused": EventKind.LANE_UNUSED,
}
PLACE_M = 8.0
PIECE_S = 600.0
"""Ordinary traffic is watched in pieces of ten minutes, each with another scene or seed."""


def scene_of(number: int) -> Scene:
    """Shipped and random scenes in turn."""
    names = shipped_scenes()
    if number % 2 == 0:
        return at_rate(load_scene(names[number // 2 % len(names)]), FPS)
    return at_rate(random_scene(number // 2), FPS)


def watch(tracks: Frames, lanes: tuple[Lane, ...]) -> NDArray[np.void]:
    """All rows of events."""
    watch = EventWatch(lanes)
    watch.add(tracks)
    return watch.take()


def seconds(stamp_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Time since the run began."""
    return np.asarray((stamp_ns - START_NS) * 1e-9)


def is_real(row: NDArray[np.void], record: TrafficRecord, lanes: tuple[Lane, ...]) -> bool:
    """Whether the simulated vehicles really did what an event says."""
    stamp_s = float(seconds(row["stamp_ns"]))
    place = np.array([row["x"], row["y"]])
    now = np.abs(record.step * STEP_S - stamp_s) < 0.06
    near = np.hypot(*(record.xy[now] - place).T)
    if row["kind"] == EventKind.STOPPED:
        return bool(((near < PLACE_M) & (record.speed[now] < 0.3)).any())
    if row["kind"] == EventKind.QUEUE:
        return int(((near < 40.0) & (record.speed[now] < 3.0)).sum()) >= 3
    if row["kind"] == EventKind.SPEED_DROP:
        since = record.step * STEP_S > float(seconds(row["first_ns"])) - 1.0
        close = since & (record.step * STEP_S < stamp_s)
        close &= np.hypot(*(record.xy - place).T) < 10.0
        close[close] = np.abs(across(record.xy[close], row, lanes)) < 1.5
        _, vehicle = np.unique(record.vehicle[close], return_inverse=True)
        mean = np.bincount(vehicle, record.speed[close]) / np.bincount(vehicle)
        return float(np.median(mean)) < 0.75 * float(row["usual_mps"])
    if row["kind"] == EventKind.LANE_UNUSED:
        since = (record.step * STEP_S > float(seconds(row["first_ns"])) + 1.0) & (
            record.step * STEP_S < stamp_s
        )
        there = since & (np.hypot(*(record.xy - place).T) < 3.0)
        inside = np.abs(across(record.xy[there], row, lanes)) < 1.2
        return len(np.unique(record.vehicle[there][inside])) <= 2
    return False


def across(
    xy: NDArray[np.float64], row: NDArray[np.void], lanes: tuple[Lane, ...]
) -> NDArray[np.float64]:
    """Distance from the event's lane."""
    lane = next(lane for lane in lanes if lane.lane_id == row["lane_id"])
    return project(xy, lane.centerline_m).offset_m


def made(kind: str, number: int, cache: Path | None) -> Planted:
    """The run of a number; kept in the cache, if there is one."""
    file = None if cache is None else cache / f"{number}_{kind}.pickle"
    if file is not None and file.exists():
        planted: Planted = pickle.loads(file.read_bytes())
        return planted
    planted = PLANTS[kind](scene_of(number), number)
    if file is not None:
        file.write_bytes(pickle.dumps(planted))
    return planted


def score_planted(kind: str, planted: Planted) -> tuple[int, int, list[float], list[float], int]:
    """Events to be found, found, delays, errors of the place, and false events."""
    rows = watch(planted.tracks, planted.run.truth)
    began = rows[rows["state"] == EventState.BEGAN]
    mine = began[began["kind"] == KINDS[kind]]
    stamp_s = seconds(mine["stamp_ns"])
    found, delays, errors = 0, list[float](), list[float]()
    used = np.zeros(len(mine), np.bool_)
    for lane_id in planted.lane_ids:
        fits = (mine["lane_id"] == lane_id) & (stamp_s > planted.begin_s)
        fits &= stamp_s < planted.end_s + 15.0
        if kind == "stopped":
            away = np.hypot(mine["x"] - planted.place_m[0], mine["y"] - planted.place_m[1])
            fits &= away < 1.5 * PLACE_M
        used |= fits
        if not fits.any():
            continue
        found += 1
        first = int(np.argmax(fits))
        begin_s = planted.begin_s
        if kind == "queue":
            lane = next(k for k in planted.run.truth if k.lane_id == lane_id)
            tails, _ = true_queue(planted.run, lane)
            times = np.array(list(tails))
            begin_s = _run_begin(times, float(stamp_s[first]))
            nearest = times[np.abs(times - stamp_s[first]).argmin()]
            if abs(nearest - stamp_s[first]) < 0.5:
                errors.append(abs(tails[nearest] - float(mine["arc_m"][first])))
        delays.append(float(stamp_s[first]) - begin_s)
    false = 0
    for k, row in enumerate(began):
        claimed = (
            row["kind"] == KINDS[kind] and used[np.flatnonzero(mine["event_id"] == row["event_id"])]
        )
        if not claimed and not is_real(row, planted.record, planted.run.truth):
            false += 1
            show("false", row)
        del k
    return len(planted.lane_ids), found, delays, errors, false


def _run_begin(times: NDArray[np.float64], at_s: float) -> float:
    """The first of the times in a row, with gaps of 4 s at most, that lead to a time."""
    times = times[times <= at_s]
    breaks = np.flatnonzero(np.diff(times) > 4.0)
    return float(times[breaks[-1] + 1 if len(breaks) else 0]) if len(times) else float("nan")


def show(what: str, row: NDArray[np.void]) -> None:
    """One event on standard error."""
    kind = EventKind(int(row["kind"])).name
    print(
        f"  {what} {kind}: {seconds(row['first_ns']):.1f}-{seconds(row['stamp_ns']):.1f} s, "
        f"lane {row['lane_id']}, track {row['track_id']}, {row['arc_m']:.0f} m, "
        f"{row['vehicles']} vehicles, {row['length_m']:.0f} m, "
        f"{row['speed_mps']:.1f} of {row['usual_mps']:.1f} m/s, by chance {row['by_chance_s']:.1e}",
        file=sys.stderr,
    )


def run_planted(first: int, runs: int, kinds: list[str], cache: Path | None) -> None:
    """Recall of each kind."""
    table: dict[str, list[tuple[int, int, list[float], list[float], int]]] = {}
    for number in range(first, first + runs):
        kind = list(PLANTS)[(number // 2 + number // 20) % len(PLANTS)]
        if kind not in kinds:
            continue
        begin_s = time.time()
        planted = made(kind, number, cache)
        result = score_planted(kind, planted)
        table.setdefault(kind, []).append(result)
        print(
            f"{number} {planted.run.scene.name} {kind}: {result[1]}/{result[0]}, "
            f"{np.round(result[2], 1)} s, false {result[4]} ({time.time() - begin_s:.0f} s)",
            file=sys.stderr,
            flush=True,
        )
    for kind, results in table.items():
        due = sum(result[0] for result in results)
        found = sum(result[1] for result in results)
        delays = [delay for result in results for delay in result[2]]
        errors = [error for result in results for error in result[3]]
        print(
            json.dumps(
                {
                    "name": f"planted {kind}: share missed, of {due} in {len(results)} runs",
                    "runs_without": sum(not result[0] for result in results),
                    "ratio": round(1.0 - found / max(due, 1), 4),
                    "limit": 0.05,
                    "delay_median_s": round(float(np.nanmedian(delays or [np.nan])), 1),
                    "delay_most_s": round(float(np.nanmax(delays or [np.nan])), 1),
                    "place_error_median_m": round(float(np.median(errors or [np.nan])), 1),
                    "false": sum(result[4] for result in results),
                }
            )
        )


def run_ordinary(first: int, hours: float) -> None:
    """False events in traffic as it comes."""
    watched_s, false, real, number = 0.0, 0, 0, first
    while watched_s < hours * 3600.0:
        scene, seed = scene_of(number), 1000 + number
        placed, _ = lanes_in_view(scene)
        record = simulate_traffic(scene, placed, PIECE_S, seed)
        run = simulate(scene, PIECE_S, seed, traffic_record=record)
        rows = watch(ground_tracks(run), run.truth)
        watched_s += PIECE_S
        for row in rows[rows["state"] == EventState.BEGAN]:
            good = is_real(row, record, run.truth)
            real, false = real + bool(good), false + (not good)
            show(f"{scene.name} {seed} {'real' if good else 'FALSE'}", row)
        print(f"{number} {scene.name}: {watched_s / 3600:.1f} h", file=sys.stderr, flush=True)
        number += 1
    days = watched_s / 86400.0
    # So many false events a day at most, with 95 % confidence (Poisson; three of none).
    upper = (false + 3.0 + 1.7 * np.sqrt(false)) / days
    print(
        json.dumps(
            {
                "name": f"false events per camera and day, in {watched_s / 3600:.1f} h",
                "ratio": round(false / days, 2),
                "limit": 1.0,
                "upper_95": round(float(upper), 2),
                "real": real,
            }
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("planted", "ordinary"), nargs="?", default="planted")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--hours", type=float, default=5.0)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--kinds", default=",".join(PLANTS), help="comma between names")
    parser.add_argument("--cache", type=Path, help="keep planted runs here and use them again")
    options = parser.parse_args()
    if options.what == "planted":
        run_planted(options.first, options.runs, options.kinds.split(","), options.cache)
    else:
        run_ordinary(options.first, options.hours)


if __name__ == "__main__":
    main()
