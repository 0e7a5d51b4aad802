"""Cameras calibrated from traffic alone, against the truth.

Random scenes with cameras of any height, tilt, field of view and a little roll, and fleets whose
vehicles are up to 4 % larger or smaller than usual; the estimator knows neither. Distances are
compared where vehicles drive: local metres along and across their way, against the true ones.
Where GEOORBIT_REAL_DATA names its folder, the two real cameras take part; the calibration that they
are held against is itself 10 to 20 % uncertain along the road.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration_scenes import FLEET, watch
from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.camera_facts import CameraFacts
from geoorbit_ros.calibration.camera_pose import recover_pose
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.control_points import ControlPoints
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.lens import Lens
from geoorbit_ros.calibration.robust import jacobian
from geoorbit_ros.calibration.traffic.control_grid import control_grid
from geoorbit_ros.calibration.traffic.doubts import scale_sigmas
from geoorbit_ros.calibration.traffic.estimate import TrafficCalibration, calibrate_from_traffic
from geoorbit_ros.core.errors import GeoOrbitError, NoTrafficError
from geoorbit_ros.core.tables import Frames
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.storage.track_csv import read_track_csv

Array = NDArray[np.float64]
MOVES_M_S = 2.0
"""Slower vehicles have no speed to compare."""
REAL_CAMERAS, REAL_SIZE = ("Yahara", "Monona"), (1920, 1080)


@dataclass(frozen=True)
class Errors:
    """Of one camera.

    Attributes:
        along, across: Median ratio of local distances to the true ones.
        inner: 5 and 95 % of them, along then across.
        lanes, true_lanes: Confirmed lanes with this calibration and with the true one.
        off_sigma: Errors along and across in units of their claimed sigma.
        speed: Median ratio of vehicles' speeds to those with the true calibration.
        seconds: Processor time.
    """

    along: float
    across: float
    inner: tuple[float, ...]
    lanes: int
    true_lanes: int
    off_sigma: tuple[float, float]
    speed: float
    seconds: float


def local_ratios(
    found: TrafficCalibration, to_pixel: Array, lens: Lens | None = None
) -> tuple[Array, Array]:
    """(N,) ratios of distances along and across the vehicles' ways to those of a true camera."""
    explained = found.explained
    good = explained.fit.good
    ground = np.vstack((explained.fit.xy[:, good], np.ones(int(good.sum()))))
    angle = explained.headings.angle[good]
    plane = found.projection[:, [0, 1, 3]]
    uvw = plane @ ground
    pixel = (uvw[:2] / uvw[2]).T
    real = pixel if found.lens is None else found.lens.distort(pixel)
    seen = real if lens is None else lens.undistort(real)
    to_road = jacobian(np.asarray(np.linalg.inv(to_pixel), np.float64), seen)
    if lens is not None:
        to_road = to_road @ np.linalg.inv(lens.slope(seen))
    if found.lens is not None:
        to_road = to_road @ found.lens.slope(pixel)
    from_road = np.linalg.inv(jacobian(np.asarray(np.linalg.inv(plane), np.float64), pixel))
    truly = to_road @ from_road
    ahead = np.einsum("nij,nj->ni", truly, np.column_stack((np.cos(angle), np.sin(angle))))
    length = np.hypot(*ahead.T)
    # Across: what the true camera calls perpendicular.
    aside = np.column_stack((-ahead[:, 1], ahead[:, 0])) / length[:, None]
    back = np.einsum("nij,nj->ni", np.linalg.inv(truly), aside)
    ratios = 1.0 / length, np.hypot(*back.T)
    known = np.isfinite(ratios[0]) & np.isfinite(ratios[1])
    return ratios[0][known], ratios[1][known]


def lanes_and_speeds(
    frames: Frames, points: ControlPoints, size: tuple[int, int]
) -> tuple[int, dict[int, float]]:
    """Confirmed lanes, as `geoorbit lanes` finds them, and the median speed of each track."""
    ground = list(project_frames(frames, BoxProjector(fit_homography(points), size)))
    mapper = LaneMapper(make_estimator("curvilinear"))
    try:
        count = sum(lane.status == "confirmed" for lane in map_lanes(ground, mapper).lanes)
    except NoTrafficError:
        count = 0
    rows = np.concatenate([table for _, table in ground])
    speed = np.hypot(rows["vx"], rows["vy"]).astype(float)
    known = {int(k): speed[rows["track_id"] == k] for k in np.unique(rows["track_id"])}
    return count, {k: float(np.nanmedian(v)) for k, v in known.items() if np.isfinite(v).sum() >= 8}


def exact_points(
    found: TrafficCalibration, to_pixel: Array, lens: Lens | None = None
) -> ControlPoints:
    """The grid of a camera with the true positions, and the true lens."""
    grid = control_grid(found)
    ideal = grid.pixel if lens is None else lens.undistort(grid.pixel)
    homogeneous = np.column_stack((ideal, np.ones(len(grid)))).T
    ground = np.linalg.solve(to_pixel, homogeneous)
    local = (ground[:2] / ground[2]).T
    facts = CameraFacts(found.image_size, lens)
    return ControlPoints(grid.pixel, local, None, grid.line_number, facts=facts)


def judge(
    frames: Frames,
    size: tuple[int, int],
    to_pixel: Array,
    find_lens: bool,
    count_lanes: bool,
    lens: Lens | None = None,
) -> Errors:
    """Calibrate, and hold it against a true camera's (3, 3) plane, and its lens."""
    began = time.process_time()
    found = calibrate_from_traffic(frames, size, find_lens=find_lens)
    seconds = time.process_time() - began
    along, across = local_ratios(found, to_pixel, lens)
    inner = (*np.quantile(along, [0.05, 0.95]), *np.quantile(across, [0.05, 0.95]))
    lanes = true_lanes = 0
    speed = float("nan")
    if count_lanes:
        lanes, speeds = lanes_and_speeds(frames, control_grid(found), size)
        exact = exact_points(found, to_pixel, lens)
        true_lanes, true_speeds = lanes_and_speeds(frames, exact, size)
        both = [k for k in speeds if true_speeds.get(k, 0.0) > MOVES_M_S]
        if both:
            speed = float(np.median([speeds[k] / true_speeds[k] for k in both]))
    middle = float(np.median(along)), float(np.median(across))
    sigma = scale_sigmas(found)
    off = (middle[0] - 1.0) / sigma[0], (middle[1] - 1.0) / sigma[1]
    return Errors(*middle, tuple(map(float, inner)), lanes, true_lanes, off, speed, seconds)


def line(name: str, errors: Errors, more: str = "") -> None:
    """Print a row."""
    a, b, c, d = errors.inner
    print(
        f"{name:>12}  along {errors.along:.3f} ({a:.2f} {b:.2f})  across {errors.across:.3f} "
        f"({c:.2f} {d:.2f})  lanes {errors.lanes}/{errors.true_lanes}  "
        f"speed {errors.speed:.3f}  {errors.off_sigma[0]:+.1f} {errors.off_sigma[1]:+.1f} sigma  "
        f"{errors.seconds:.1f} s  {more}",
        flush=True,
    )


def summary(found: list[Errors], fleets: list[float], refused: int) -> None:
    """Print medians and 95 % of the errors."""
    print(f"\n{len(found)} cameras calibrated, {refused} refused")
    for name in ("along", "across"):
        ratio = np.array([getattr(errors, name) for errors in found])
        for what, off in (
            ("", np.abs(ratio - 1.0)),
            (", without the fleet's part", np.abs(ratio * np.array(fleets) - 1.0)),
        ):
            middle, high = 100 * np.quantile(off, [0.5, 0.95])
            print(f"scale {name}{what}: {middle:.1f} % in the median, {high:.1f} % at 95 %")
    same = np.mean([errors.lanes == errors.true_lanes for errors in found])
    speeds = np.abs([e.speed - 1.0 for e in found if np.isfinite(e.speed)])
    if any(errors.true_lanes for errors in found):
        print(f"as many lanes as with the true calibration: {100 * same:.0f} %")
    if len(speeds):
        middle, high = 100 * np.quantile(speeds, [0.5, 0.95])
        print(f"speeds: {middle:.1f} % in the median, {high:.1f} % at 95 %")
    for k, name in enumerate(("along", "across")):
        off = np.abs([errors.off_sigma[k] for errors in found])
        one, two = 100 * np.mean(off <= 1.0), 100 * np.mean(off <= 2.0)
        print(f"{name}: within one claimed sigma in {one:.0f} %, within two in {two:.0f} %")
    print(f"processor time: {np.median([errors.seconds for errors in found]):.1f} s in the median")


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--usual-fleet", action="store_true", help="no fleet larger or smaller")
    parser.add_argument("--lens", action="store_true", help="also look for a lens in the paths")
    parser.add_argument("--lanes", action="store_true", help="also count lanes, which takes longer")
    parser.add_argument("--distorted", action="store_true", help="lenses that nobody tells")
    options = parser.parse_args()
    found, fleets, refused = [], [], 0
    for seed in range(options.first, options.first + options.scenes):
        fleet = 0.0 if options.usual_fleet else FLEET
        seen = watch(seed, options.seconds, fleet, options.distorted)
        plane = seen.camera.matrix[:, [0, 1, 3]]
        try:
            errors = judge(
                seen.frames,
                seen.camera.image_size,
                plane,
                options.lens or options.distorted,
                options.lanes,
                seen.camera.lens,
            )
        except GeoOrbitError as error:
            print(f"{seen.name:>12}  {error}", flush=True)
            refused += 1
            continue
        camera = f"{seen.height_m:.0f} m, {seen.tilt_deg:.0f} deg down"
        camera += f", {seen.field_of_view_deg:.0f} deg wide, fleet {seen.fleet:.3f}"
        line(seen.name, errors, camera)
        found.append(errors)
        fleets.append(seen.fleet)
    if found:
        summary(found, fleets, refused)
    folder = os.environ.get("GEOORBIT_REAL_DATA")
    for name in REAL_CAMERAS if folder else ():
        place = Path(str(folder)) / "us12" / name
        frames = read_track_csv(place / "trajectory.csv")
        surveyed = fit_homography(read_control_points(place / "calibration.csv"))
        pose = recover_pose(surveyed, REAL_SIZE)
        line(name, judge(frames, REAL_SIZE, pose.projection[:, [0, 1, 3]], options.lens, True))


if __name__ == "__main__":
    main()
