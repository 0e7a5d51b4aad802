"""Lane boundaries on painted lines, beside those of the traffic alone, against the exact truth.

A minute of a scene's traffic gives the lanes, one of its images the lines. "Edge" is the distance
of lane boundaries from the true ones; the error of the surveyed control points is part of both.
A kind counts as right where the boundary that was found solid or dashed is so painted.

    python benchmarks/markings.py [--scenes NAME,…] [--random 60] [--light day,dusk] [--rain]
                                  [--worn 0.5] [--shadows] [--yellow] [--drivers measured]
                                  [--json FILE]

With FOLDER, real cameras instead: FOLDER/NAME/ has `image.png`, `calibration.csv` and `tracks.csv`;
a contact sheet shows what was found over each image. Where there is a `lines.csv`
(`line,pixel_x,pixel_y`: two and more points of each surveyed line), widths are compared with it. It
is told, too, how far the surveyed lines are from painted boundaries, which are the middles of
lines, and from the nearer edge of the paint.

    python benchmarks/markings.py FOLDER --sheet sheet.png
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.cli.camera_input import load_camera
from geoorbit_ros.cli.inputs import make_mapper
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.core.lanes import Lane, LaneEdge, LaneMap
from geoorbit_ros.core.polylines import project
from geoorbit_ros.lanes.pipeline import map_lanes, project_blocks, project_frames
from geoorbit_ros.markings.fusion import follow_paint
from geoorbit_ros.rendering.conditions import Conditions
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.rendering.road_surface import surface_of
from geoorbit_ros.rendering.surface import RoadSurface
from geoorbit_ros.scenes.random_scene import random_scene
from geoorbit_ros.scenes.roads import place_roads
from geoorbit_ros.scenes.scene import (
    Scene,
    load_scene,
    shipped_scenes,
    with_measured_drivers,
)
from geoorbit_ros.scenes.simulate import simulate

DURATION_S, SEED, IMAGE_AT_S = 60.0, 1, 4
SAME_LANE_M = 1.5
"""A found lane is the true one whose centreline is this near."""
SAME_LINE_M = 0.4
TILE = (640, 360)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """One scene in one light.

    Attributes:
        name: Scene.
        light: Light, with `+rain` and the like.
        before, after: Mean distance of boundaries from the true ones, without and with the image.
        p95: Its 95th percentile, with the image.
        width_before, width_after: Mean error of lane widths.
        painted: Share of boundaries that follow a line.
        kind_right: Share of their length on which the kind is right.
        lanes: Found, and of them true.
        seconds: To find the lines.
    """

    name: str
    light: str
    before: float
    after: float
    p95: float
    width_before: float
    width_after: float
    painted: float
    kind_right: float
    lanes: tuple[int, int]
    seconds: float


def true_lane(lane: Lane, truth: Sequence[Lane]) -> Lane | None:
    """The true lane that a found one is; None for none."""
    best: tuple[float, Lane | None] = (SAME_LANE_M, None)
    for other in truth:
        at = project(lane.centerline_m, other.centerline_m)
        if np.count_nonzero(at.inside) > 3:
            apart = float(np.median(np.abs(at.offset_m[at.inside])))
            best = min(best, (apart, other), key=lambda pair: pair[0])
    return best[1]


def edge_errors(lane: Lane, truth: Lane) -> Array:
    """Distances of a lane's two boundaries from the true ones."""
    parts = []
    for line, true in ((lane.left_m, truth.left_m), (lane.right_m, truth.right_m)):
        at = project(line, true)
        parts.append(np.abs(at.offset_m[at.inside]))
    return np.concatenate(parts)


def kind_right(line: Array, edge: LaneEdge | None, surface: RoadSurface) -> list[bool]:
    """For each point of a boundary on a line whether the paint there is of its kind."""
    if edge is None or edge.source != "paint":
        return []
    near = {}
    dashed = [middle for middle, _, _ in surface.dashed]
    for kind, lines in (("solid", surface.solid + surface.yellow), ("dashed", dashed)):
        distance = np.full(len(line), np.inf)
        for middle in lines:
            if len(middle) > 1:
                at = project(line, middle)
                distance = np.minimum(distance, np.where(at.inside, np.abs(at.offset_m), np.inf))
        near[kind] = distance
    other = "dashed" if edge.marking == "solid" else "solid"
    known = np.minimum(near["solid"], near["dashed"]) < SAME_LINE_M
    return list(near[edge.marking][known] <= near[other][known])


@dataclass(frozen=True)
class Setting:
    """What the scenes are like.

    Attributes:
        lights: Each of them.
        rain, worn, shadows: As in `Conditions`.
        yellow: Whether left edge lines are yellow.
        measured_drivers: Whether drivers have measured habits.
    """

    lights: tuple[str, ...]
    rain: bool
    worn: float
    shadows: bool
    yellow: bool
    measured_drivers: bool

    @property
    def words(self) -> str:
        """Beside the light, in tables."""
        flags = {"rain": self.rain, f"worn {self.worn:g}": self.worn > 0.0}
        flags |= {"shadows": self.shadows, "yellow": self.yellow}
        flags |= {"measured drivers": self.measured_drivers}
        return "".join(f"+{word}" for word, is_so in flags.items() if is_so)

    def scene(self, name: str) -> Scene:
        """A scene of this name, so changed."""
        scene = random_scene(int(name[6:])) if name.startswith("random") else load_scene(name)
        if self.measured_drivers:
            scene = with_measured_drivers(scene)
        if self.yellow:
            roads = [road.model_copy(update={"yellow_left_line": True}) for road in scene.roads]
            scene = scene.model_copy(update={"roads": roads})
        return scene


def measured(setting: Setting, name: str) -> list[Outcome]:
    """One scene in every light."""
    scene = setting.scene(name)
    run = simulate(scene, DURATION_S, SEED)
    plane = fit_homography(run.control_points)
    tracks = project_frames(run.frames, BoxProjector(plane, run.image_size))
    before = map_lanes(tracks, make_mapper("curvilinear", 5.0))
    surface = surface_of(place_roads(scene))
    outcomes = []
    for light in setting.lights:
        conditions = Conditions(
            light,  # type: ignore[arg-type]
            rain=setting.rain,
            worn=setting.worn,
            shadows=setting.shadows,
        )
        frames = render_scene(scene, IMAGE_AT_S + 1.0, SEED, conditions, fps=1.0)
        image = [frame.image for frame in frames][-1]
        begin = time.perf_counter()
        after = follow_paint(before, image, plane, run.image_size, InputReport("image"))
        seconds = time.perf_counter() - begin
        label = light + setting.words
        outcomes.append(outcome(name, label, (before, after), run.truth, surface, seconds))
    return outcomes


def outcome(
    name: str,
    light: str,
    maps: tuple[LaneMap, LaneMap],
    truth: Sequence[Lane],
    surface: RoadSurface,
    seconds: float,
) -> Outcome:
    """The figures of one scene."""
    errors: list[list[Array]] = [[], []]
    widths: list[list[float]] = [[], []]
    kinds: list[bool] = []
    edges = [e for lane in maps[1].lanes for e in (lane.left_edge, lane.right_edge)]
    for k, lane_map in enumerate(maps):
        for lane in lane_map.lanes:
            if (true := true_lane(lane, truth)) is not None:
                errors[k].append(edge_errors(lane, true))
                widths[k].append(abs(lane.width_m - true.width_m))
    for lane in maps[1].lanes:
        kinds += kind_right(lane.left_m, lane.left_edge, surface)
        kinds += kind_right(lane.right_m, lane.right_edge, surface)
    before, after = (np.concatenate(e) if e else np.array([np.nan]) for e in errors)
    return Outcome(
        name, light, float(before.mean()), float(after.mean()), float(np.quantile(after, 0.95)),
        float(np.mean(widths[0])), float(np.mean(widths[1])),
        float(np.mean([e is not None and e.source == "paint" for e in edges])),
        float(np.mean(kinds)) if kinds else float("nan"),
        (len(maps[1].lanes), len(widths[1])), seconds,
    )  # fmt: skip


def show(outcomes: Sequence[Outcome]) -> None:
    """A table, and the means of each light."""
    print("| scene | light | edge before, m | after | 95 % | width before, m | after | painted |"
          " kind right | lanes | s |\n|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")  # fmt: skip
    for o in outcomes:
        cells = (
            *(o.name, o.light, f"{o.before:.3f}", f"{o.after:.3f}", f"{o.p95:.2f}"),
            *(f"{o.width_before:.3f}", f"{o.width_after:.3f}", f"{o.painted:.0%}"),
            *(f"{o.kind_right:.0%}", f"{o.lanes[1]} of {o.lanes[0]}", f"{o.seconds:.1f}"),
        )
        print("| " + " | ".join(cells) + " |")
    for light in dict.fromkeys(o.light for o in outcomes):
        some = [o for o in outcomes if o.light == light]
        means = {
            name: float(np.nanmean([getattr(o, name) for o in some]))
            for name in ("before", "after", "p95", "width_before", "width_after", "painted")
        }
        worse = [o.name for o in some if o.after > o.before + 0.02]
        kind = float(np.nanmean([o.kind_right for o in some]))
        shown = ", ".join(f"{name} {value:.3f}" for name, value in means.items())
        print(f"{light}: mean of {len(some)}: {shown}, kind right {kind:.1%}")
        print(f"  0.02 m worse than the traffic alone and more: {', '.join(worse) or 'none'}")


def surveyed(path: Path, plane: Homography) -> list[Array]:
    """Lines on the ground, from their points in the image."""
    if not path.exists():
        return []
    rows = np.genfromtxt(path, delimiter=",", names=True)
    pixel = np.column_stack([rows["pixel_x"], rows["pixel_y"]])
    return [plane.to_ground(pixel[rows["line"] == k]) for k in np.unique(rows["line"])]


def offsets_at_middle(lane: Lane, lines: Sequence[Array]) -> Array:
    """How far left of a lane's middle lines are, half-way along it."""
    x, y, heading = lane.middle
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-along[1], along[0]])
    found = []
    for line in lines:
        forward, side = (line - (x, y)) @ along, (line - (x, y)) @ across
        order = np.argsort(forward)
        found.append(np.interp(0.0, forward[order], side[order]))
    return np.array(found)


def against_survey(lane: Lane, lines: Sequence[Array]) -> tuple[float, list[tuple[float, float]]]:
    """Distance of the two surveyed lines that are nearest to a lane's boundaries, at its middle.

    Returns:
        It, and for each painted boundary how far the surveyed line is from it, and from the nearer
        edge of its paint.
    """
    surveyed_m = offsets_at_middle(lane, lines)
    sides = offsets_at_middle(lane, (lane.left_m, lane.right_m))
    left, right = (surveyed_m[np.argmin(np.abs(surveyed_m - side))] for side in sides)
    apart = []
    edges = lane.left_edge, lane.right_edge
    for true_m, side, edge in zip((left, right), sides, edges, strict=True):
        if edge is not None and edge.source == "paint":
            off = abs(float(true_m - side))
            apart.append((off, abs(off - 0.5 * edge.marking_width_m)))
    return float(left - right), apart


def sheet_of(folder: Path, target: Path) -> None:
    """Find the lines of real cameras, and show them over their images."""
    tiles, errors, apart = [], [], []
    print(
        "| camera | lane | width by the traffic, m | with the image, m | surveyed, m | boundaries |"
    )
    print("|---|--:|--:|--:|--:|---|")
    for case in sorted(path.parent for path in folder.glob("*/image.*")):
        image = np.asarray(cv2.imread(str(next(case.glob("image.*")))), dtype=np.uint8)
        size = f"{image.shape[1]}x{image.shape[0]}"
        camera = load_camera(
            case / "tracks.csv", None, case / "calibration.csv", case.name, size, None, target
        )
        tracks = project_blocks(camera.frames, camera.projector)
        before = camera.find_lanes(tracks, make_mapper("curvilinear", 5.0))
        found = follow_paint(
            before, image, camera.homography, camera.image_size, InputReport(case.name)
        )
        lines = surveyed(case / "lines.csv", camera.homography)
        by_traffic = {lane.lane_id: lane.width_m for lane in before.lanes}
        for lane in found.lanes:
            old_m, width_m = by_traffic.get(lane.lane_id, float("nan")), float("nan")
            if lines:
                width_m, off = against_survey(lane, lines)
                apart += off
            errors.append((abs(old_m - width_m), abs(lane.width_m - width_m)))
            edges = [e.marking if e else "" for e in (lane.left_edge, lane.right_edge)]
            marks = ", ".join(mark or "traffic" for mark in edges)
            cells = (case.name, str(lane.lane_id), f"{old_m:.2f}", f"{lane.width_m:.2f}")
            print("| " + " | ".join((*cells, f"{width_m:.2f}", marks)) + " |", flush=True)
        tiles.append(drawn(image, found, camera.homography, case.name))
    known = np.array([pair for pair in errors if np.isfinite(pair).all()])
    if len(known):
        (old_m, new_m), worst = known.mean(axis=0), known.max(axis=0)
        print(f"mean error of {len(known)} widths by the traffic: {old_m:.3f} m, {worst[0]:.2f} m "
              f"at worst; with the image: {new_m:.3f} m, {worst[1]:.2f} m at worst")  # fmt: skip
    if apart:
        middle_m, edge_m = np.mean(apart, axis=0)
        print(f"surveyed lines are {middle_m:.3f} m from the middle of the paint of {len(apart)} "
              f"boundaries in the mean, {edge_m:.3f} m from its nearer edge")  # fmt: skip
    tiles += [np.zeros((TILE[1], TILE[0], 3), np.uint8)] * (-len(tiles) % 3)
    rows = [np.hstack(tiles[k : k + 3]) for k in range(0, len(tiles), 3)]
    cv2.imwrite(str(target), np.vstack(rows))


def drawn(
    image: NDArray[np.uint8], lane_map: LaneMap, plane: Homography, name: str
) -> NDArray[np.uint8]:
    """Solid lines red, dashed ones magenta, boundaries by the traffic yellow, centrelines green."""
    thick = max(round(image.shape[1] / 480), 1)
    colours = {"solid": (0, 0, 255), "dashed": (255, 0, 255), "": (0, 255, 255)}
    for lane in lane_map.lanes:
        edges = ((lane.left_m, lane.left_edge), (lane.right_m, lane.right_edge))
        for line, edge in edges:
            pixel = np.rint(plane.to_pixel(line)).astype(np.int32)
            cv2.polylines(image, [pixel], False, colours[edge.marking if edge else ""], thick)
        pixel = np.rint(plane.to_pixel(lane.centerline_m)).astype(np.int32)
        cv2.polylines(image, [pixel], False, (0, 255, 0), thick)
    tile = cv2.resize(image, TILE, interpolation=cv2.INTER_AREA)
    cv2.putText(tile, name, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 255, 255), 2)
    return np.asarray(tile, dtype=np.uint8)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--sheet", type=Path, default=Path("sheet.png"))
    parser.add_argument("--scenes", default=",".join(shipped_scenes()))
    parser.add_argument("--random", type=int, default=0, help="that many random scenes, too")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--light", default="day")
    parser.add_argument("--rain", action="store_true")
    parser.add_argument("--worn", type=float, default=0.0, help="share of the paint that is gone")
    parser.add_argument("--shadows", action="store_true", help="of gantries and guard rails")
    parser.add_argument("--yellow", action="store_true", help="left edge lines")
    parser.add_argument("--drivers", choices=("middle", "measured"), default="middle")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.folder:
        sheet_of(given.folder, given.sheet)
        return 0
    names = [name for name in given.scenes.split(",") if name]
    names += [f"random{k}" for k in range(given.first_seed, given.first_seed + given.random)]
    setting = Setting(
        tuple(given.light.split(",")), given.rain, given.worn, given.shadows, given.yellow,
        given.drivers == "measured",
    )  # fmt: skip
    work = partial(measured, setting)
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(given.workers) as pool:
        for name, some in zip(names, pool.map(work, names), strict=True):
            outcomes += some
            print(f"{name}: {some[0].before:.3f} to {some[0].after:.3f} m", file=sys.stderr)
    show(outcomes)
    if given.json:
        given.json.write_text(json.dumps([asdict(o) for o in outcomes], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
