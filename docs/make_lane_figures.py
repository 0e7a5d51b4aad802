"""Draws the figures of README.md and docs/lanes.md from the shipped scenes.

    ./dev run scene list        # makes .venv, should it be missing
    .venv/bin/python docs/make_lane_figures.py

Each figure shows what the estimator computes, by calling its own stages: nothing is drawn by hand.
The same version of the code gives the same figures.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.resources import share_path
from geoorbit_ros.lanes.estimators.curvilinear.candidates import find_ridges
from geoorbit_ros.lanes.estimators.curvilinear.corridors import Corridor, find_corridors
from geoorbit_ros.lanes.estimators.curvilinear.evidence import Evidence
from geoorbit_ros.lanes.estimators.curvilinear.profiles import lateral_profiles
from geoorbit_ros.lanes.estimators.curvilinear.reference_line import RUN_OUT_M
from geoorbit_ros.lanes.estimators.curvilinear.trajectory_segments import TrajectorySegments
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.lanes.pipeline import StampedRows, map_lanes, project_frames
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import SceneRun, simulate

IMAGES = Path(__file__).parent / "images"
DURATION_S = 60.0
SEED = 1
INK, GREY, PALE = "#20262b", "#69737b", "#d9dee2"
COLOURS = ("#2f6db5", "#c0651a", "#3a8f5c", "#8a4fa3", "#a8862a", "#b03a48")
THETA = LaneParameters()

plt.rcParams.update(
    {
        "font.family": "DejaVu Sans",
        "font.size": 9,
        "axes.edgecolor": PALE,
        "axes.titlesize": 10,
        "axes.titlelocation": "left",
        "axes.titlecolor": INK,
        "axes.labelcolor": GREY,
        "xtick.color": GREY,
        "ytick.color": GREY,
        "legend.frameon": False,
        "svg.hashsalt": "geoorbit",
    }
)


@dataclass(frozen=True)
class Camera:
    """One scene through its camera, with what the estimator makes of it.

    Attributes:
        run: The scene's run.
        tracks: Ground tracks, frame by frame.
        segments: Condensed vehicle tracks.
        weight: (P,) weight of each segment.
        corridors: Streams of traffic.
        lane_map: The lanes.
    """

    run: SceneRun
    tracks: list[StampedRows]
    segments: TrajectorySegments
    weight: NDArray[np.float64]
    corridors: list[Corridor]
    lane_map: LaneMap


def look_through(scene: str) -> Camera:
    """Run a shipped scene and the estimator on it."""
    run = simulate(load_scene(share_path(f"params/scenes/{scene}.yaml")), DURATION_S, SEED)
    projector = BoxProjector(fit_homography(run.control_points), run.image_size)
    tracks = list(project_frames(run.frames, projector))
    evidence = Evidence()
    for stamp_ns, rows in tracks:
        evidence.add(stamp_ns, rows)
    segments, weight = evidence.segments()
    lane_map = map_lanes(tracks, LaneMapper(make_estimator("curvilinear"), THETA))
    return Camera(run, tracks, segments, weight, find_corridors(segments), lane_map)


def draw_hero(camera: Camera) -> Figure:
    """What goes in, what comes out."""
    figure, (image, road) = plt.subplots(
        1, 2, figsize=(7.0, 3.0), width_ratios=(8, 15), layout="constrained"
    )
    draw_image(image, camera, "In: a minute of tracked boxes")
    draw_map(road, camera, "Out: lanes with width, error, confidence", text_size=8.5)
    return figure


def draw_image(axes: Axes, camera: Camera, title: str) -> None:
    """The camera's view: paths of all box centres, boxes of one frame."""
    frames, (width, height) = camera.run.frames, camera.run.image_size
    for track_id in np.unique(frames.rows["track_id"]):
        mine = frames.rows[frames.rows["track_id"] == track_id]
        axes.plot(mine["x"], mine["y"], color="white", lw=0.5, alpha=0.35)
    counts = np.diff(frames.offset)
    for row in frames.frame(int(np.argmax(counts))):
        corner = (row["x"] - row["width"] / 2, row["y"] - row["height"] / 2)
        axes.add_patch(
            Rectangle(corner, row["width"], row["height"], fill=False, ec="#f2b84b", lw=1.2)
        )
    used = frames.rows
    left, right = np.clip([used["x"].min() - 80.0, used["x"].max() + 80.0], 0, width)
    bottom, top = np.clip([used["y"].max() + 80.0, used["y"].min() - 80.0], 0, height)
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[], facecolor="#2b3238")
    axes.set_aspect("equal")
    axes.set_title(title)


def draw_map(axes: Axes, camera: Camera, title: str, text_size: float = 6.5) -> None:
    """Lanes over vehicle paths, turned so that the first corridor runs to the right."""
    turn = Turn(camera)
    for k in range(len(camera.segments)):
        xy = turn(nodes_of(camera.segments, k))
        axes.plot(*xy.T, color=GREY, lw=0.5, alpha=0.35)
    for lane in camera.lane_map.confirmed:
        draw_lane(axes, lane, turn, colour_of(camera, lane), text_size)
    ends = np.vstack([turn(lane.centerline_m) for lane in camera.lane_map.confirmed])
    axes.set_xlim(ends[:, 0].min() - 8.0, ends[:, 0].max() + 8.0)
    axes.set_ylim(ends[:, 1].min() - 9.0, ends[:, 1].max() + 9.0)
    axes.set_xticks([])
    axes.set_yticks([])
    draw_scale(axes)
    axes.set_title(title)


class Turn:
    """Rotation of the map that lays the longest corridor along the page."""

    def __init__(self, camera: Camera) -> None:
        reference = camera.corridors[0].reference_line
        along = reference.xy[-1] - reference.xy[0]
        cos, sin = along / np.hypot(*along)
        self._matrix = np.array([[cos, sin], [-sin, cos]])

    def __call__(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) points, turned."""
        return np.asarray(xy @ self._matrix.T)


def draw_lane(axes: Axes, lane: Lane, turn: Turn, colour: str, text_size: float) -> None:
    """A lane's area, centreline, arrow and figures."""
    left, right, line = turn(lane.left_m), turn(lane.right_m), turn(lane.centerline_m)
    tentative = lane.status == "tentative"
    area = np.vstack([left, right[::-1]])
    axes.fill(*area.T, color=colour, alpha=0.05 if tentative else 0.16, lw=0)
    for side in (left, right):
        axes.plot(*side.T, color=colour, lw=0.8, ls=":" if tentative else "-")
    axes.plot(*line.T, color=colour, lw=1.5, ls="--" if tentative else "-")
    k = len(line) // 6
    axes.annotate(
        "", line[k + 3], line[k], arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.5}
    )
    m = len(line) // 2
    text = f"{lane.lane_id}   {lane.width_m:.2f} ± {lane.width_sigma_m:.2f} m"
    text += f"   {lane.confidence:.2f}"
    box = {"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.85}
    axes.annotate(text, line[m], ha="center", va="center", size=text_size, color=colour, bbox=box)


def draw_scale(axes: Axes, length_m: float = 20.0) -> None:
    """A bar that says how long metres are along the page."""
    (x, _), (y, top) = axes.get_xlim(), axes.get_ylim()
    x, y = x + 4.0, y + 0.06 * (top - y)
    axes.plot([x, x + length_m], [y, y], color=GREY, lw=1.2)
    axes.annotate(f"{length_m:.0f} m", (x + length_m + 1.5, y), va="center", size=7, color=GREY)


def draw_segments(camera: Camera) -> Figure:
    """Stage 1: thirty rows a second become a few nodes per vehicle."""
    figure, axes = plt.subplots(figsize=(9.0, 4.0), layout="constrained")
    turn = Turn(camera)
    every = np.concatenate([rows for _, rows in camera.tracks])
    xy = turn(np.column_stack([every["x"], every["y"]]).astype(np.float64))
    axes.plot(*xy.T, ".", color=PALE, ms=2.0, label=f"{len(every)} rows of `tracks`")
    for k in range(len(camera.segments)):
        axes.plot(*turn(nodes_of(camera.segments, k)).T, color=COLOURS[0], lw=0.6, alpha=0.6)
    nodes = turn(camera.segments.xy)
    text = f"{len(nodes)} nodes of {len(camera.segments)} segments"
    axes.plot(*nodes.T, ".", color=COLOURS[0], ms=2.5, label=text)
    draw_scale(axes)
    axes.legend(loc="lower right", bbox_to_anchor=(0.72, 0.0), markerscale=3)
    axes.set(xticks=[], yticks=[])
    axes.set_title(
        "1. Trajectory segments: tracks without stops, jumps and border boxes, condensed to nodes"
    )
    return figure


def draw_corridors(cameras: Sequence[Camera]) -> Figure:
    """Stage 2: streams of traffic with their reference lines."""
    figure, panels = plt.subplots(
        1, len(cameras), figsize=(9.0, 3.1), width_ratios=(6, 5), layout="constrained"
    )
    for axes, camera in zip(panels, cameras, strict=True):
        turn = Turn(camera)
        for k, corridor in enumerate(camera.corridors):
            colour = COLOURS[k % len(COLOURS)]
            nodes = turn(camera.segments.xy[corridor.node])
            axes.plot(*nodes.T, ".", color=colour, ms=2.0, alpha=0.5)
            if len(np.unique(camera.segments.owner[corridor.node])) < 3:
                continue
            reference = corridor.reference_line
            low, high = corridor.s.min(), corridor.s.max()
            line = turn(reference.xy[(reference.s >= low) & (reference.s <= high)])
            axes.plot(*line.T, color=INK, lw=1.4)
            axes.annotate(
                "", line[-1], line[-4], arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.4}
            )
            for s in np.arange(np.ceil(low / RUN_OUT_M) * RUN_OUT_M, high, RUN_OUT_M):
                tick = turn(reference.to_map(np.full(2, s), np.array([-1.2, 1.2])))
                axes.plot(*tick.T, color=INK, lw=0.8)
        axes.set_aspect("equal")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"2. Corridors of {camera.run.scene.name}", loc="left")
    return figure


def draw_density(camera: Camera) -> Figure:
    """Stage 3: density over (s, d), its ridges, and one section through it."""
    profiles = lateral_profiles(camera.corridors[:1], camera.segments, camera.weight)
    stages = find_ridges(profiles, camera.segments.large[profiles.segment], THETA)
    density = stages.density
    figure, (plane, section) = plt.subplots(
        1, 2, figsize=(9.0, 4.2), width_ratios=(7, 3), sharey=True, layout="constrained"
    )
    s = profiles.station_m
    plane.pcolormesh(s, density.offset_m, density.value.T, cmap="Blues", rasterized=True)
    for ridge in stages.ridges:
        plane.plot(s[ridge.stations], ridge.d, color=COLOURS[1], lw=1.3)
    at = len(s) // 2
    plane.axvline(s[at], color=GREY, lw=0.8, ls="--")
    used = density.offset_m[density.value.max(axis=0) > 0.1]
    plane.set(
        xlabel="s, metres along the corridor",
        ylabel="d, metres to the left",
        ylim=(used.min(), used.max()),
        xlim=(s[profiles.station.min()], s[profiles.station.max()]),
    )
    plane.set_title("3. Density of vehicles in road coordinates, and its ridges")
    section.plot(density.value[at], density.offset_m, color=COLOURS[0])
    section.fill_betweenx(density.offset_m, density.value[at], color=COLOURS[0], alpha=0.15)
    for ridge in stages.ridges:
        if at in ridge.stations:
            k = at - ridge.first
            section.plot(ridge.height[k], ridge.d[k], "o", color=COLOURS[1], ms=5)
    section.set(xlabel="vehicles per metre", xlim=(0, None))
    section.set_title(f"Section at s = {s[at]:.0f} m")
    return figure


def draw_lanes(camera: Camera) -> Figure:
    """Stage 4: the lanes against the truth."""
    figure, axes = plt.subplots(figsize=(9.0, 4.6), layout="constrained")
    draw_map(axes, camera, "4. Centrelines, widths, confidence; thin black: the true lanes")
    turn = Turn(camera)
    for lane in camera.run.truth:
        for line in (lane.left_m, lane.right_m):
            axes.plot(*turn(line).T, color=INK, lw=0.5)
    return figure


def nodes_of(segments: TrajectorySegments, k: int) -> NDArray[np.float64]:
    """(M, 2) nodes of one segment."""
    return segments.xy[segments.offset[k] : segments.offset[k + 1]]


def colour_of(camera: Camera, lane: Lane) -> str:
    """One colour per direction of travel, that of the first corridor first."""
    heading = camera.corridors[0].reference_line.heading
    x, y, own = lane.middle
    corridor = camera.corridors[0].reference_line
    s, _ = corridor.to_road(np.array([[x, y]]))
    along = np.cos(own - np.interp(s[0], corridor.s, heading))
    return COLOURS[0] if along > 0.0 else COLOURS[1]


def save(figure: Figure, name: str, dpi: int = 120) -> None:
    """One PNG in docs/images; no time, no version in its metadata."""
    IMAGES.mkdir(exist_ok=True)
    path = IMAGES / name
    figure.savefig(path, dpi=dpi, facecolor="white", metadata={"Software": None})
    plt.close(figure)
    print(f"{path}: {path.stat().st_size // 1024} kB")


def main() -> int:
    """Draw all figures."""
    save(draw_hero(look_through("curve_250m")), "lanes-overview.png", dpi=180)
    ramp, city = look_through("off_ramp_diverge"), look_through("urban_turn")
    save(draw_segments(ramp), "lanes-1-segments.png")
    save(draw_corridors([ramp, city]), "lanes-2-corridors.png")
    save(draw_density(ramp), "lanes-3-density.png")
    save(draw_lanes(ramp), "lanes-4-lanes.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
