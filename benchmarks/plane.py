"""How sure the road plane is: common shifts of lanes, and bends of roads that are flat.

"Within" is the share of lane boundaries of simulated scenes whose real sideways shift, over random
errors of the control points, lies within the 1-sigma that is said (68 % would be right). "Bend" is
the largest factor by which cars look larger or smaller in a stretch of the road than in others, all
roads of the scenes being flat.

    python benchmarks/plane.py [--scenes NAME,…] [--draws 60]

With GEOORBIT_REAL_DATA, also the bends at the two real cameras in its folder `us12`.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.flatness import Stretch
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography, RoadPlane
from geoorbit_ros.calibration.plane_fit import GROUND_SIGMA_M, PIXEL_SIGMA
from geoorbit_ros.cli.console import console
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.polylines import project
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.common_shift import shift_sigma_m
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import SceneRun, simulate

SCENES = "straight_3x3,motorway_4x4,curve_250m,s_curve,on_ramp_merge,lane_drop"
DURATION_S, SEED = 120.0, 3
LEAST_POINTS = 5
"""Of a boundary that must be in the image."""


def within(run: SceneRun, draws: int) -> tuple[float, float]:
    """Share of boundaries within their sigma, and that sigma's median in metres."""
    rng, points = np.random.default_rng(0), run.control_points
    exact = RoadPlane(fit_homography(points).matrix, np.zeros((1, 3, 3)))
    points = replace(
        points,
        local_m=exact.to_ground(points.pixel),
        image_size=None,
        sigma_px=None,
        sigma_m=None,
    )
    truth = fit_homography(points)
    inside, sigmas = [], []
    for _ in range(draws):
        drawn = replace(
            points,
            pixel=points.pixel + rng.normal(0.0, PIXEL_SIGMA, points.pixel.shape),
            local_m=points.local_m + rng.normal(0.0, GROUND_SIGMA_M, points.local_m.shape),
        )
        try:
            plane = fit_homography(drawn)
        except CalibrationError as error:
            console.print(f"a draw was refused: {error}", soft_wrap=True)
            continue
        for lane in run.truth:
            for line in (lane.left_m, lane.right_m):
                pixel = truth.to_pixel(line)
                seen = (pixel > 0).all(axis=1) & (pixel < run.image_size).all(axis=1)
                found = plane.to_ground(pixel[seen])
                if seen.sum() < LEAST_POINTS or not np.isfinite(found).all():
                    continue
                sigmas.append(shift_sigma_m(found, plane))
                off = _mean_along(project(found, line).offset_m, found)
                inside.append(abs(off) < sigmas[-1])
    return float(np.mean(inside)), float(np.median(sigmas))


def _mean_along(value: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Mean of values over the length of a line."""
    step = np.hypot(*np.diff(line, axis=0).T)
    weight = np.append(step, 0.0) + np.append(0.0, step)
    return float(np.average(value, weights=weight))


def bends(frames: Frames, plane: Homography, image_size: tuple[int, int]) -> list[Stretch]:
    """The stretches of a camera's road."""
    projector = BoxProjector(plane, image_size)
    projector.traffic.add(frames)
    return projector.traffic.stretches()


def real_bends(folder: Path) -> dict[str, list[Stretch]]:
    """Those of the real cameras."""
    from geoorbit_ros.cli.camera_input import load_camera

    found = {}
    for case in sorted(path.parent for path in folder.glob("*/trajectory.csv")):
        files = case / "trajectory.csv", None, case / "calibration.csv"
        camera = load_camera(*files, None, None, None, folder / "nothing.geojson")
        found[case.name] = bends(camera.frames, camera.homography, camera.image_size)
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", default=SCENES)
    parser.add_argument("--draws", type=int, default=60)
    options = parser.parse_args()
    table = Table(box=SIMPLE_HEAD)
    for title in ("camera", "within", "shift sigma m", "stretches", "bend", "its sigma", "told"):
        table.add_column(title)
    rows: dict[str, tuple[str, str, list[Stretch]]] = {}
    for name in [k for k in options.scenes.split(",") if k]:
        run = simulate(load_scene(name), DURATION_S, SEED)
        share, sigma = within(run, options.draws)
        plane = fit_homography(run.control_points)
        rows[name] = f"{share:.0%}", f"{sigma:.2f}", bends(run.frames, plane, run.image_size)
    if data := os.environ.get("GEOORBIT_REAL_DATA"):
        rows |= {name: ("–", "–", found) for name, found in real_bends(Path(data) / "us12").items()}
    for name, (share_text, sigma_text, found) in rows.items():
        worst = max(found, key=lambda k: abs(k.bend), default=None)
        size = ("–", "–") if worst is None else (f"{worst.bend:+.3f}", f"{worst.sigma:.3f}")
        told = str(sum(stretch.clear for stretch in found))
        table.add_row(name, share_text, sigma_text, str(len(found)), *size, told)
    console.print(table)


if __name__ == "__main__":
    main()
