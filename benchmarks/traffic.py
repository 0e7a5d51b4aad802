"""Vehicles per lane, speeds and headways, against exact truth and against real gates.

Scenes: five minutes of boxes as a camera sees them, through calibration, lanes and counting; the
truth is where every vehicle was. Lines of the table are scenes.

    python benchmarks/traffic.py [--scenes NAME,…] [--random 30] [--duration 300] [--json FILE]

With --films, rendered films of the scenes by day, found without a model, as `geoorbit process` and
`geoorbit traffic` do: two minutes of 1280x720 at 12.5 images per second. Films are kept in the
folder, and rendered and looked at only if they are not there.

    python benchmarks/traffic.py --films FOLDER [--scenes NAME,…] [--seed 1]

With FOLDER, real cameras with gates in the road: FOLDER/NAME/ has `tracks.csv`, `calibration.csv`,
`gates.csv` (`lane_index,speed_kmh,valid,time_last_gate_s`, a row per vehicle), `measure.csv`
(`line,pixel_x1,pixel_y1,pixel_x2,pixel_y2`: line 0 is the last gate) and `lines.csv`
(`line,pixel_x,pixel_y`: lane k lies between lines k and k + 1). Speeds are compared after one scale
per camera, as calibrations are off by a few percent.

    python benchmarks/traffic.py FOLDER [--tracks tracks.csv]
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import RoadPlane
from geoorbit_ros.cli.camera_input import load_camera
from geoorbit_ros.cli.inputs import make_mapper
from geoorbit_ros.cli.main import main as geoorbit
from geoorbit_ros.core.lane_order import lane_ids_at
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.polylines import project, sample
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.pipeline import map_blocks, project_blocks
from geoorbit_ros.scenes.random_scene import random_scene
from geoorbit_ros.scenes.scene import load_scene, shipped_scenes
from geoorbit_ros.scenes.simulate import SceneRun, simulate
from geoorbit_ros.traffic.counter import TrafficCounter
from geoorbit_ros.traffic.interval_clock import NS
from geoorbit_ros.traffic.stations import Station

Array = NDArray[np.float64]
SEED = 1
SAME_TIME_S, SAME_PLACE_M = 1.0, 4.0
SAME_LANE_M = 1.75
BESIDE_M = 14.0
"""Vehicles farther from a station's middle cross another road."""
INSIDE = 0.3
"""Share of a passage, from either end, where its lane is held against the truth: nearer to the ends
vehicles are beyond the stretch for which true lanes are known, or between two lanes."""
GATE_S = 0.3
"""A track crosses the gate within this time of the gate's own, or is another vehicle."""
FILM_SIZE, FILM_FPS, FILM_S = "1280x720", "12.5", 120.0
NO_DAY = ("night_sparse",)
ON_TO_GATE_S = 0.6
"""Tracks that end this long before the gate are extended to it."""


@dataclass(frozen=True)
class Truth:
    """One true crossing of a station."""

    station_id: int
    lane_id: int
    time_s: float
    speed_kmh: float


@dataclass(frozen=True)
class Outcome:
    """One scene.

    Attributes:
        name: The scene.
        true, found: Vehicles that crossed a station, in truth and as counted.
        off: Sum over lanes of the absolute differences.
        time_p95_s: Error of crossing times at 95 %.
        speed_median_kmh, speed_p95_kmh: Errors of passages' mean speeds.
        covered: Share of them within the stated 1 sigma.
        p85_kmh: Error of the 85th percentile of speeds of each lane with more than 20 vehicles.
        headway_s: Mean error of a lane's mean headway.
        movements: Share of vehicles with the right lanes at the beginning and at the end.
        seconds: Processor time of counting.
    """

    name: str
    true: int
    found: int
    off: int
    time_p95_s: float
    speed_median_kmh: float
    speed_p95_kmh: float
    covered: float
    p85_kmh: tuple[float, ...]
    headway_s: float
    movements: float
    seconds: float


@dataclass(frozen=True)
class TruePaths:
    """Exact tracks, one vehicle after the other."""

    time_s: Array
    place: Array
    heading: Array
    speed: Array
    offset: NDArray[np.int64]

    @classmethod
    def of(cls, clean: Frames) -> TruePaths:
        """The paths in frames of exact ground points."""
        stamps = clean.row_stamp_ns()
        order = np.lexsort((stamps, clean.rows["track_id"]))
        rows = clean.rows[order]
        begin = np.flatnonzero(np.diff(rows["track_id"], prepend=-1))
        place = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
        speed = np.hypot(rows["vx"], rows["vy"]).astype(np.float64)
        heading = rows["heading"].astype(np.float64)
        offset = np.append(begin, len(rows))
        return cls(stamps[order] / NS, place, heading, speed, offset)

    def crossings(self, station: Station, truth: Sequence[Lane]) -> list[Truth]:
        """Who crosses a station, by the true lanes."""
        along = np.array([np.cos(station.heading_rad), np.sin(station.heading_rad)])
        relative = self.place - station.place_m
        beyond, aside = relative @ along, relative @ np.array([-along[1], along[0]])
        found = []
        for a, b in zip(self.offset[:-1].tolist(), self.offset[1:].tolist(), strict=True):
            steps = np.flatnonzero((beyond[a : b - 1] < 0) & (beyond[a + 1 : b] >= 0)) + a
            for k in steps[np.abs(aside[steps]) < BESIDE_M][:1].tolist():
                part = -beyond[k] / (beyond[k + 1] - beyond[k])
                at = self.place[k] + part * (self.place[k + 1] - self.place[k])
                (lane,) = lane_ids_at(at[None], self.heading[k : k + 1], truth).tolist()
                when = self.time_s[k] + part * (self.time_s[k + 1] - self.time_s[k])
                if lane:
                    speed = 3.6 * float(self.speed[k])
                    found.append(Truth(station.station_id, lane, float(when), speed))
        return found

    def lane_of(self, time_s: float, place: Array, truth: Sequence[Lane]) -> int | None:
        """True lane of the vehicle nearest to a place at a time; None: nobody, or no lane."""
        best, lane = SAME_PLACE_M, None
        for a, b in zip(self.offset[:-1].tolist(), self.offset[1:].tolist(), strict=True):
            if self.time_s[a] <= time_s <= self.time_s[b - 1]:
                k = min(a + int(np.searchsorted(self.time_s[a:b], time_s)), b - 1)
                apart = float(np.hypot(*(self.place[k] - place)))
                if apart < best:
                    found = lane_ids_at(self.place[k : k + 1], self.heading[k : k + 1], truth)
                    best, lane = apart, int(found[0]) or None
        return lane

    def mean_speed_kmh(self, first_s: float, last_s: float, place: Array) -> float | None:
        """Of the vehicle that is at a place half-way through a time, over the time; None: none."""
        middle = (first_s + last_s) / 2
        best, speed = SAME_PLACE_M, None
        for a, b in zip(self.offset[:-1].tolist(), self.offset[1:].tolist(), strict=True):
            if not self.time_s[a] <= middle <= self.time_s[b - 1]:
                continue
            k = a + int(np.searchsorted(self.time_s[a:b], middle))
            apart = float(np.hypot(*(self.place[min(k, b - 1)] - place)))
            if apart < best:
                i, j = a + np.searchsorted(self.time_s[a:b], [first_s, last_s])
                j = min(int(j), b - 1)
                if j - i < 3:
                    continue
                way = float(np.hypot(*np.diff(self.place[i : j + 1], axis=0).T).sum())
                best, speed = apart, 3.6 * way / float(self.time_s[j] - self.time_s[i])
        return speed


def true_lanes(lanes: Sequence[Lane], truth: Sequence[Lane]) -> dict[int, int]:
    """The id of the true lane that each found one is, 0 for none."""
    same = {}
    for lane in lanes:
        points, best = sample(lane.centerline_m, 2.0), (SAME_LANE_M, 0)
        for true in truth:
            at = project(points.point_m, true.centerline_m)
            beside = at.inside & ((at.tangent * points.tangent).sum(axis=1) > 0.7)
            if beside.mean() > 0.3:
                best = min(best, (float(np.abs(at.offset_m[beside]).mean()), true.lane_id))
        same[lane.lane_id] = best[1]
    return same


def scene_outcome(duration_s: float, name: str) -> Outcome:
    """Run one scene and count in it."""
    scene = random_scene(int(name[6:])) if name.startswith("random") else load_scene(name)
    run = simulate(scene, duration_s, SEED)
    plane = fit_homography(run.control_points)
    blocks = list(project_blocks(run.frames, BoxProjector(plane, run.image_size)))
    lane_map = map_blocks(blocks, make_mapper("curvilinear", 5.0))
    return outcome_of(name, run, plane, blocks, lane_map)


def film_outcome(folder: Path, seed: int, name: str) -> Outcome:
    """Count in the film of one scene."""
    film = folder / f"{name}_{seed}"
    made = ("scene", "render", name, "--size", FILM_SIZE, "--fps", FILM_FPS, "--seed", str(seed))
    if not (film / "video.mp4").exists():
        _run(*made, "--duration", str(FILM_S), "--out", str(film))
    found, points = film / "found", film / "calibration.csv"
    if not (found / "tracks.csv").exists():
        _run("process", str(film / "video.mp4"), "--calibration", str(points), "--out", str(found))
    run = simulate(load_scene(name), FILM_S, seed)
    datum, road = f"{run.datum.latitude_deg},{run.datum.longitude_deg}", str(found / "road.png")
    options = (None, datum, film / "none.geojson", None, road)
    camera = load_camera(found / "tracks.csv", None, points, name, *options)
    blocks = list(camera.ground_tracks())
    lane_map = camera.find_lanes(iter(blocks), make_mapper("curvilinear", 5.0))
    lane_map, _ = camera.follow_paint(lane_map, road)
    return outcome_of(name, run, camera.homography, blocks, lane_map)


def _run(*words: str) -> None:
    if geoorbit(list(words)) != 0:
        raise SystemExit(f"geoorbit {' '.join(words)} failed")


def outcome_of(
    name: str, run: SceneRun, plane: RoadPlane, blocks: Sequence[Frames], lane_map: LaneMap
) -> Outcome:
    """Count ground tracks on lanes that were found in them, against the truth of the scene."""
    begin = time.process_time()
    counter = TrafficCounter(lane_map.lanes, plane)
    for block in blocks:
        counter.add(block)
    counted = counter.finish()
    seconds = time.process_time() - begin
    same = true_lanes(lane_map.lanes, run.truth)
    paths = TruePaths.of(run.clean)
    lanes_of = {
        s.station_id: {same[lane_map.lanes[k].lane_id] for k in s.lanes} for s in counter.stations
    }
    true = [
        t
        for station in counter.stations
        for t in paths.crossings(station, run.truth)
        if t.lane_id in lanes_of[station.station_id]
    ]
    speeds = passage_errors(counted.passages, lane_map.lanes, paths)
    moved = movements_right(counted.passages, lane_map.lanes, same, paths, run.truth)
    return compared(name, true, counted.crossings, same, speeds, (moved, seconds))


def passage_errors(passages: NDArray[np.void], lanes: Sequence[Lane], paths: TruePaths) -> Array:
    """(N, 2) error of each passage's speed in km/h, and its stated 1 sigma."""
    by_id = {lane.lane_id: lane for lane in lanes}
    errors = []
    for row in passages:
        line = by_id[int(row["lane_id"])].centerline_m
        arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        at = (row["first_arc_m"] + row["last_arc_m"]) / 2
        place = np.array([np.interp(at, arc, line[:, k]) for k in (0, 1)])
        speed = paths.mean_speed_kmh(row["first_ns"] / NS, row["last_ns"] / NS, place)
        if speed is not None:
            errors.append((3.6 * row["speed_mps"] - speed, 3.6 * row["speed_sigma_mps"]))
    return np.array(errors)


def movements_right(
    passages: NDArray[np.void],
    lanes: Sequence[Lane],
    same: dict[int, int],
    paths: TruePaths,
    truth: Sequence[Lane],
) -> float:
    """Share of vehicles whose first and last lanes are those that they truly were in there."""
    by_id = {lane.lane_id: lane for lane in lanes}
    right = []
    begin = np.flatnonzero(np.diff(passages["vehicle_id"], prepend=-1))
    for a, b in zip(begin.tolist(), [*begin[1:].tolist(), len(passages)], strict=True):
        ends = []
        for row, share in ((passages[a], INSIDE), (passages[b - 1], 1.0 - INSIDE)):
            line = by_id[int(row["lane_id"])].centerline_m
            along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
            arc = row["first_arc_m"] + share * (row["last_arc_m"] - row["first_arc_m"])
            place = np.array([np.interp(arc, along, line[:, k]) for k in (0, 1)])
            when = row["first_ns"] + share * (row["last_ns"] - row["first_ns"])
            true = paths.lane_of(when / NS, place, truth)
            if true is not None and same[int(row["lane_id"])]:
                ends.append(true == same[int(row["lane_id"])])
        if len(ends) == 2:
            right.append(all(ends))
    return float(np.mean(right))


def compared(
    name: str,
    true: Sequence[Truth],
    crossings: NDArray[np.void],
    same: dict[int, int],
    speeds: Array,
    others: tuple[float, float],
) -> Outcome:
    """The figures of one scene."""
    wanted = Counter((t.station_id, t.lane_id) for t in true)
    lanes = [same[int(lane)] for lane in crossings["lane_id"].tolist()]
    keys = list(zip(crossings["station_id"].tolist(), lanes, strict=True))
    got = Counter(keys)
    times, by_lane = list[float](), defaultdict[tuple[int, int], list[Truth]](list)
    for t in true:
        by_lane[t.station_id, t.lane_id].append(t)
    p85, headways = list[float](), list[float]()
    for key, expected in by_lane.items():
        rows = crossings[[k == key for k in keys]]
        when = np.sort(rows["stamp_ns"]) / NS
        due = np.sort([t.time_s for t in expected])
        if not len(when):
            continue
        nearest = np.abs(when[:, None] - due).min(axis=1)
        times.extend(nearest[nearest < SAME_TIME_S].tolist())
        if len(when) > 20:
            speed = np.quantile([t.speed_kmh for t in expected], 0.85)
            p85.append(3.6 * float(np.quantile(rows["speed_mps"], 0.85)) - float(speed))
            headways.append(abs(float(np.diff(when).mean() - np.diff(due).mean())))
    error = np.abs(speeds[:, 0])
    return Outcome(
        name,
        sum(wanted.values()),
        sum(got.values()),
        sum(abs(wanted[k] - got[k]) for k in {*wanted, *got}),
        float(np.quantile(times, 0.95)),
        float(np.median(error)),
        float(np.quantile(error, 0.95)),
        float((error <= speeds[:, 1]).mean()),
        tuple(p85),
        float(np.mean(headways)) if headways else float("nan"),
        *others,
    )


def show(outcomes: Sequence[Outcome], console: Console) -> None:
    """One line per scene, and the means."""
    table = Table(title="Traffic in scenes")
    headings = (
        "vehicles|counted|off|off %|s 95 %|km/h|km/h 95 %|in 1 sigma|p85 km/h|headway s|moves %|s"
    )
    for heading in ("scene", *headings.split("|")):
        table.add_column(heading, justify="left" if heading == "scene" else "right")
    for o in outcomes:
        worst_kmh = max(map(abs, o.p85_kmh), default=float("nan"))
        figures = (o.time_p95_s, o.speed_median_kmh, o.speed_p95_kmh, o.covered, worst_kmh)
        table.add_row(
            o.name,
            str(o.true),
            str(o.found),
            str(o.off),
            f"{100 * o.off / max(o.true, 1):.1f}",
            *(f"{x:.2f}" for x in figures),
            f"{o.headway_s:.3f}",
            f"{100 * o.movements:.1f}",
            f"{o.seconds:.2f}",
        )
    true, off = sum(o.true for o in outcomes), sum(o.off for o in outcomes)
    means = [
        float(np.nanmean([getattr(o, name) for o in outcomes]))
        for name in ("time_p95_s", "speed_median_kmh", "speed_p95_kmh", "covered")
    ]
    p85 = np.array([error for o in outcomes for error in o.p85_kmh])
    worst = [max(map(abs, o.p85_kmh)) for o in outcomes if o.p85_kmh]
    each = float(np.mean([100 * o.off / o.true for o in outcomes if o.true]))
    headway = float(np.nanmean([o.headway_s for o in outcomes]))
    moved = float(np.mean([o.movements for o in outcomes]))
    console.print(table)
    console.print(
        f"All: {true} vehicles, off by {off} ({100 * off / true:.2f} %; in the mean of scenes "
        f"{each:.2f} %); times {means[0]:.3f} s at 95 %; speeds {means[1]:.2f} km/h in the median, "
        f"{means[2]:.2f} at 95 %, {100 * means[3]:.0f} % within 1 sigma; "
        f"p85 of {len(p85)} lanes {np.abs(p85).mean():.2f} km/h in the mean ({p85.mean():+.2f} "
        f"with its sign), {100 * (np.abs(p85) <= 1.0).mean():.0f} % within 1 km/h, the worst lane "
        f"of a scene {np.mean(worst):.2f}; headways {headway:.3f} s; "
        f"movements {100 * moved:.1f} % right"
    )


@dataclass(frozen=True)
class Gates:
    """What a camera's gates saw, and where they are in its image."""

    rows: list[dict[str, str]]
    line: Array
    lanes: dict[int, Array]

    @classmethod
    def read(cls, folder: Path) -> Gates:
        """The gates of one camera."""
        lines = defaultdict[int, list[tuple[float, float]]](list)
        for row in _rows(folder / "lines.csv"):
            lines[int(row["line"])].append((float(row["pixel_y"]), float(row["pixel_x"])))
        places = {k: np.array(points) for k, points in lines.items()}
        fits = {k: np.polyfit(at[:, 0], at[:, 1], 1) for k, at in places.items()}
        (last,) = (row for row in _rows(folder / "measure.csv") if row["line"] == "0")
        ends = [float(last[k]) for k in ("pixel_x1", "pixel_y1", "pixel_x2", "pixel_y2")]
        valid = [row for row in _rows(folder / "gates.csv") if row["valid"] == "1"]
        single = [row for row in valid if "|" not in row["lane_index"]]
        return cls(single, np.array(ends).reshape(2, 2), fits)

    def lane_at(self, pixel: Array) -> int:
        """Which lane a pixel is in."""
        edges = [np.polyval(self.lanes[k], pixel[1]) for k in sorted(self.lanes)]
        return int(np.searchsorted(edges, pixel[0])) - 1

    def beyond(self, pixel: Array) -> Array:
        """Distance (N,) of pixels (N, 2) from the last gate, signed."""
        way = self.line[1] - self.line[0]
        return np.asarray((pixel - self.line[0]) @ np.array([-way[1], way[0]]))


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def tracks_at_gate(frames: Frames, gates: Gates) -> dict[int, tuple[float, int]]:
    """When and in which lane each track crosses the last gate, by its own pixels."""
    order = np.lexsort((frames.row_stamp_ns(), frames.rows["track_id"]))
    rows, time_s = frames.rows[order], frames.row_stamp_ns()[order] / NS
    pixel = np.column_stack((rows["x"], rows["y"])).astype(np.float64)
    beyond = gates.beyond(pixel)
    begin = np.flatnonzero(np.diff(rows["track_id"], prepend=-1))
    found = {}
    for a, b in zip(begin.tolist(), [*begin[1:].tolist(), len(rows)], strict=True):
        steps = np.flatnonzero(np.sign(beyond[a : b - 1]) != np.sign(beyond[a + 1 : b])) + a
        if len(steps):
            k = int(steps[0])
            part = beyond[k] / (beyond[k] - beyond[k + 1])
            at = pixel[k] + part * (pixel[k + 1] - pixel[k])
            when = float(time_s[k] + part * (time_s[k + 1] - time_s[k]))
        elif b - a > 11:
            k = b - 1
            rate = (beyond[k] - beyond[k - 10]) / (time_s[k] - time_s[k - 10])
            ahead_s = -beyond[k] / rate if rate else -1.0
            if not 0.0 < ahead_s < ON_TO_GATE_S:
                continue
            at, when = pixel[k], float(time_s[k] + ahead_s)
        else:
            continue
        found[int(rows["track_id"][a])] = when, gates.lane_at(at)
    return found


def lanes_at_gate(lanes: Sequence[Lane], plane: RoadPlane, gates: Gates) -> dict[int, int]:
    """Which of the gates' lanes each found lane is."""
    found = {}
    for lane in lanes:
        pixel = plane.to_pixel(sample(lane.centerline_m, 1.0).point_m)
        pixel = pixel[np.isfinite(pixel[:, 0])]
        found[lane.lane_id] = gates.lane_at(pixel[int(np.abs(gates.beyond(pixel)).argmin())])
    return found


def camera_row(folder: Path, tracks: str) -> tuple[str, list[float]]:
    """Vehicles, share in the right lane, speed errors, coverage, processor time of one camera."""
    begin = time.process_time()
    camera = load_camera(
        folder / tracks, None, folder / "calibration.csv", None, None, None, folder / "none.geojson"
    )
    blocks = list(camera.ground_tracks())
    lane_map = camera.find_lanes(iter(blocks), make_mapper("curvilinear", 5.0))
    counter = TrafficCounter(lane_map.lanes, camera.homography)
    for block in blocks:
        counter.add(block)
    counted = counter.finish()
    seconds = time.process_time() - begin
    gates = Gates.read(folder)
    at_gate = tracks_at_gate(camera.frames, gates)
    lane_of = lanes_at_gate(lane_map.lanes, camera.homography, gates)
    rows = defaultdict[int, list[np.void]](list)
    for row in counted.passages:
        rows[int(row["track_id"])].append(row)
    right, speeds = list[bool](), list[tuple[float, float, float]]()
    for gate in gates.rows:
        when, lane = float(gate["time_last_gate_s"]), int(gate["lane_index"])
        near = [(abs(t - when), k) for k, (t, at) in at_gate.items() if at == lane]
        if not near or min(near)[0] > GATE_S:
            continue
        passages = rows.get(min(near)[1], [])
        if not passages:
            right.append(False)
            continue
        row = min(passages, key=lambda p: max(p["first_ns"] / NS - when, when - p["last_ns"] / NS))
        right.append(lane_of[int(row["lane_id"])] == lane)
        truth = float(gate["speed_kmh"])
        if truth > 0.0:
            speeds.append((3.6 * row["speed_mps"], truth, 3.6 * row["speed_sigma_mps"]))
    measured, true, sigma = np.array(speeds).T
    scale = float(np.median(true / measured))
    error = np.abs(measured * scale - true)
    inside = float((error <= sigma).mean())
    figures = [len(right), float(np.mean(right)), scale, float(np.median(error))]
    return folder.name, [*figures, float(np.quantile(error, 0.95)), inside, seconds]


def real_cameras(folder: Path, tracks: str, console: Console) -> None:
    """One line per camera."""
    table = Table(title="Traffic at real gates")
    headings = "vehicles|right lane|scale|km/h|km/h 95 %|in 1 sigma|s"
    for heading in ("camera", *headings.split("|")):
        table.add_column(heading, justify="left" if heading == "camera" else "right")
    figures = []
    for path in sorted(p for p in folder.iterdir() if (p / "gates.csv").is_file()):
        name, row = camera_row(path, tracks)
        figures.append(row)
        table.add_row(
            name, f"{row[0]:.0f}", f"{100 * row[1]:.1f} %", *(f"{x:.2f}" for x in row[2:])
        )
    console.print(table)
    count, right = np.array(figures)[:, 0], np.array(figures)[:, 1]
    mean = np.array(figures).mean(axis=0)
    console.print(
        f"All: {100 * float((count * right).sum() / count.sum()):.2f} % of {count.sum():.0f} in "
        f"the right lane, {100 * right.min():.1f} % at worst; speeds {mean[3]:.2f} km/h in median "
        f"({max(row[3] for row in figures):.2f} at worst), {mean[4]:.2f} at 95 %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--tracks", default="tracks.csv")
    parser.add_argument("--scenes", default=",".join(shipped_scenes()))
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--duration", type=float, default=300.0)
    parser.add_argument("--films", type=Path)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    console = Console(width=120)
    if given.folder:
        real_cameras(given.folder, given.tracks, console)
        return
    names = [n for n in given.scenes.split(",") if n]
    names += [f"random{k}" for k in range(1, given.random + 1)]
    outcome = partial(scene_outcome, given.duration)
    if given.films:
        names = [n for n in names if n not in NO_DAY]
        outcome = partial(film_outcome, given.films, given.seed)
    outcomes = []
    for name in names:
        outcomes.append(outcome(name))
        console.print(outcomes[-1].name, end=" ", style="dim")
    console.print()
    show(outcomes, console)
    if given.json:
        given.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))


if __name__ == "__main__":
    main()
