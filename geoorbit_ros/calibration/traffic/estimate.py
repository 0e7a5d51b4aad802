"""The most likely camera for a minute of traffic, with the errors that it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from geoorbit_ros.calibration.lens import Lens, LensEstimate, with_focal
from geoorbit_ros.calibration.lens_from_paths import estimate_lens_from_paths
from geoorbit_ros.calibration.traffic.model import Explained, TrafficModel
from geoorbit_ros.calibration.traffic.parameters import (
    FEW,
    FOCAL,
    HEIGHT,
    HIGHEST,
    LOWEST,
    MANY,
    ROLL,
    ROOF,
    ROOF_MEAN,
    STEP,
    TILT,
    KnownPoints,
    prior_residuals,
    projection_matrix,
)
from geoorbit_ros.calibration.traffic.samples import TrafficSamples, sample_traffic, whole
from geoorbit_ros.calibration.vehicle_size import MEAN_M
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.tables import Frames

Array = NDArray[np.float64]

MIN_VEHICLES = 5
"""Fewer vehicles are no traffic: one unusual one among them decides."""
MAX_VEHICLES = 80
"""So many are taken, at random. Chosen: more take time; errors common to all vehicles are larger
than what they would add."""
FIRST_VEHICLES = 40
"""With how many the search begins."""
FOCALS = (0.45, 0.75, 1.2, 2.0, 3.2)
TILTS_DEG = (6.0, 12.0, 20.0, 30.0, 42.0)
"""Where the search begins: focal lengths in image widths, tilts below the horizontal."""
BEST_STARTS = 5
"""How many of these are followed."""
FIRST_STEPS, STEPS, ROUNDS = 8, 5, 3
"""Evaluations of the slope in the search, and after each time that neighbours are chosen."""
SEARCHED = (FOCAL, TILT, ROLL, HEIGHT, ROOF)
"""Parameters of the search: the fleet and the detector are taken for usual ones."""
MAX_FOCAL_SIGMA, MAX_SCALE_SIGMA = 0.4, 0.25
"""Cameras less certain than this are refused. Chosen: lanes would be a quarter off."""
MAX_MISFIT = 2.0
"""Boxes that are off by more, over their usual errors, in the middle, are not those of vehicles
before a camera that stands still. Real cameras have 0.4 to 0.9, one that turns 2.8, boxes anywhere
6. Chosen: larger believes them, smaller refuses a bad detector."""
MAX_UNUSUAL = 5.0
"""So many sigma may a camera and its vehicles be from what is known of all beforehand. Real and
made cameras are at 0.6 to 3.9, boxes of one size everywhere at 5.1. Chosen: smaller refuses unusual
fleets, larger believes boxes that are no vehicles'."""
AT_BOUND = 1e-3
"""A parameter that ends this near to a bound, as a share of its range, was stopped by it: the best
camera lies beyond."""
ODD_POINT_SIGMAS, MAX_POINT_SIGMAS = 1.5, 3.0
"""Known points that are off by more than the first, in the mean, are told; beyond the second they
contradict the traffic or each other. Chosen: a place read from an aerial image may be off by twice
its usual error; larger believes points of another camera."""
MIN_REACH = 0.08
"""The traffic must fill this share of the image's height or width."""
PLACE_NAME = "traffic"


@dataclass(frozen=True, slots=True)
class TrafficCalibration:
    """A camera found from traffic.

    Attributes:
        x: Parameters, see `model`.
        covariance: Of them.
        model: Boxes, and how well they are explained.
        image_size: (width, height) in pixels.
        lens: Its distortion, in units of the focal length; None: none is known.
        lens_sentence: What was found about it.
        samples: All vehicles with usable boxes, those that were not taken too.
    """

    x: Array
    covariance: Array
    model: TrafficModel
    image_size: tuple[int, int]
    lens: Lens | None
    lens_sentence: str
    samples: TrafficSamples

    @property
    def projection(self) -> Array:
        """(3, 4) metres to ideal pixels."""
        return projection_matrix(self.x, self.image_size)

    @property
    def explained(self) -> Explained:
        """What it makes of the boxes."""
        return self.model.explain(self.x, 4)

    @property
    def vehicles(self) -> int:
        """How many vehicles it was fitted to."""
        return len(self.model.group)

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal length and its 1-sigma error, pixels."""
        focal = float(np.exp(self.x[FOCAL])) * self.image_size[0]
        return focal, focal * self.sigma(FOCAL)

    @property
    def height_m(self) -> tuple[float, float]:
        """Height above the road and its 1-sigma error."""
        height = float(np.exp(self.x[HEIGHT]))
        return height, height * self.sigma(HEIGHT)

    @property
    def points_off(self) -> float:
        """How far known points are off in the mean, in sigma, beside what they decide; 0: none."""
        off = self.model.known_points(self.x)
        spare = max(len(off) - (MANY - FEW), 1)
        return float(np.sqrt((off**2).sum() / spare))

    def degrees(self, parameter: int) -> tuple[float, float]:
        """An angle and its 1-sigma error."""
        return float(np.degrees(self.x[parameter])), float(np.degrees(self.sigma(parameter)))

    @property
    def field_of_view_deg(self) -> tuple[float, float]:
        """From the left border to the right one, without distortion, and its 1-sigma error."""
        half = 0.5 * self.image_size[0] / self.focal_px[0]
        return (
            float(np.degrees(2.0 * np.arctan(half))),
            float(np.degrees(2.0 * half / (1.0 + half**2) * self.sigma(FOCAL))),
        )

    def sigma(self, parameter: int) -> float:
        """1-sigma error of a parameter."""
        return float(np.sqrt(self.covariance[parameter, parameter]))


def calibrate_from_traffic(
    frames: Frames,
    image_size: tuple[int, int],
    *,
    lens: Lens | None = None,
    points: KnownPoints | None = None,
    find_lens: bool = True,
) -> TrafficCalibration:
    """Focal length, tilt, roll and height of a camera from the boxes of vehicles.

    Square pixels, a principal point in the middle of the image, a flat road. Several starts, then
    Levenberg-Marquardt on robust residuals (`model`). The errors are those of the linearised
    problem. The scale is that of the vehicles' usual sizes, and as certain as the fleet is usual.

    Args:
        frames: `PIXEL_TRACK_DTYPE`.
        image_size: (width, height) in pixels.
        lens: What is known of the lens; its focal length is used where it is one.
        points: Points whose places are known.
        find_lens: Look for a distortion in the vehicles' paths where no lens is given.

    Raises:
        CalibrationError: Too few vehicles, ground points without boxes, or a camera that they
            leave too uncertain. The sentence says which.
    """
    sentence = "the lens is as given" if lens is not None else "no lens was looked for"
    if lens is None and find_lens:
        found = _lens(frames, image_size)
        lens, sentence = found.lens, found.sentence
    samples = sample_traffic(frames, image_size, lens)
    _check_samples(samples, image_size)
    focal_px = lens.fx if lens is not None and lens.focal_known else None
    random = np.random.default_rng(0)
    chosen = random.permutation(len(samples.group))
    few = TrafficModel(samples.take(chosen[:FIRST_VEHICLES]), image_size, None, focal_px)
    x = _search(few)
    x[ROLL] *= 0.3
    model = TrafficModel(samples.take(chosen[:MAX_VEHICLES]), image_size, points, focal_px)
    model.robust = True
    if points is not None:
        x = np.concatenate((x, _laid_on(points, x, image_size)))
    for _ in range(ROUNDS):
        model.settle(x)
        solution = _solve(model, x, STEPS)
        x = solution.x
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac, hermitian=True)
    result = TrafficCalibration(x, covariance, model, image_size, lens, sentence, samples)
    _check_fit(result)
    _check_result(result)
    if lens is not None and not lens.focal_known:
        lens = with_focal(lens, result.focal_px[0])
    return TrafficCalibration(x, covariance, model, image_size, lens, sentence, samples)


def _lens(frames: Frames, image_size: tuple[int, int]) -> LensEstimate:
    """The distortion that the ways of all whole boxes show."""
    rows = frames.rows
    half = np.stack((rows["width"], rows["height"])).astype(np.float64) / 2
    centre = np.stack((rows["x"], rows["y"])).astype(np.float64)
    good = np.flatnonzero(whole(frames, np.concatenate((centre - half, centre + half)), image_size))
    order = good[np.argsort(rows["track_id"][good], kind="stable")]
    cuts = np.flatnonzero(np.diff(rows["track_id"][order])) + 1
    return estimate_lens_from_paths(np.split(centre[:, order].T, cuts), image_size)


def _check_samples(samples: TrafficSamples, image_size: tuple[int, int]) -> None:
    if samples.ground_points > 0.5:
        raise CalibrationError(
            PLACE_NAME,
            "ground points without width and height",
            "boxes of vehicles: the camera's scale and focal length follow from their sizes",
        )
    count = len(samples.group)
    if count < MIN_VEHICLES:
        raise CalibrationError(
            PLACE_NAME,
            f"{count} moving vehicles with whole and free boxes, of {samples.vehicles_seen} tracks",
            f"at least {MIN_VEHICLES}: record for longer",
        )
    centre = (samples.edges[:2] + samples.edges[2:]) / 2
    reach = np.ptp(centre, axis=1) / image_size
    if reach.max() < MIN_REACH:
        raise CalibrationError(
            PLACE_NAME,
            f"vehicles in {100 * reach.max():.0f} % of the image only",
            f"traffic over at least {100 * MIN_REACH:.0f} % of its width or height",
        )


def _check_fit(result: TrafficCalibration) -> None:
    """Refuse a camera that does not explain what it was fitted to."""
    x, model = result.x, result.model
    if not result.points_off <= MAX_POINT_SIGMAS:
        raise CalibrationError(
            PLACE_NAME,
            f"known points that are off by {result.points_off:.0f} times their errors",
            "points of this camera, in pixels of this image size, and positions in metres that "
            "belong to them",
        )
    if not model.misfit <= MAX_MISFIT:
        raise CalibrationError(
            PLACE_NAME,
            f"boxes that are off by {model.misfit:.1f} times their usual errors for every camera",
            "boxes of vehicles on one flat road, from a camera that stands still and does not zoom",
        )
    for name, k in (("focal length", FOCAL), ("tilt", TILT), ("roll", ROLL), ("height", HEIGHT)):
        near = min(x[k] - LOWEST[k], HIGHEST[k] - x[k])
        if near < AT_BOUND * (HIGHEST[k] - LOWEST[k]):
            raise CalibrationError(
                PLACE_NAME,
                f"boxes that are best explained by a camera whose {name} lies beyond its bounds",
                "a camera 2.5 to 90 m above a flat road, held nearly level, that looks down by 1 "
                "to 80 degrees and sees 6 to 127 degrees of width",
            )
    unusual = float(np.abs(prior_residuals(x, result.image_size[0], None)).max())
    if unusual > MAX_UNUSUAL:
        raise CalibrationError(
            PLACE_NAME,
            f"boxes that only vehicles or a camera {unusual:.1f} sigma from all others explain",
            "boxes that grow with nearness, and classes that are the vehicles' (--classes)",
        )


def _check_result(result: TrafficCalibration) -> None:
    focal, height = result.sigma(FOCAL), result.sigma(HEIGHT)
    if not (focal <= MAX_FOCAL_SIGMA and height <= MAX_SCALE_SIGMA):
        raise CalibrationError(
            PLACE_NAME,
            f"a focal length known to {100 * focal:.0f} % and a scale to {100 * height:.0f} %",
            f"{100 * MAX_FOCAL_SIGMA:.0f} % and {100 * MAX_SCALE_SIGMA:.0f} %: more traffic, the "
            "camera's focal length (--camera-info), or points that you know (--points)",
        )


def _search(model: TrafficModel) -> Array:
    """The best of the cameras that are found from several starts."""
    starts = []
    for focal in FOCALS:
        for tilt in np.radians(TILTS_DEG):
            x = np.zeros(FEW)
            x[[FOCAL, TILT, HEIGHT, ROOF]] = np.log(focal), tilt, np.log(10.0), ROOF_MEAN
            if _with_height(model, x):
                starts.append((float((model.residuals(x) ** 2).sum()), x))
    if not starts:
        raise CalibrationError(
            PLACE_NAME,
            "boxes that no camera above a road shows",
            "tracks of vehicles on one flat road, in pixels of the image size given",
        )
    starts.sort(key=lambda start: start[0])
    found = [_solve(model, x, FIRST_STEPS, SEARCHED) for _, x in starts[:BEST_STARTS]]
    return np.array(min(found, key=lambda solution: solution.cost).x)


def _with_height(model: TrafficModel, x: Array) -> bool:
    """Set the height with which vehicles have their usual sizes; False where most can't be."""
    usual = MEAN_M[model.group].T
    for _ in range(4):
        found = model.explain(x, 1, usual)
        good = found.fit.good
        if good.mean() < 0.9:
            return False
        larger = np.sqrt((model.side / np.maximum(found.fit.side_px, 1e-6)).prod(axis=0))[good]
        ratio = float(np.median(larger))
        if not 0.01 < ratio < 100.0:
            return False
        x[HEIGHT] = np.clip(x[HEIGHT] - np.log(ratio), LOWEST[HEIGHT] + 0.04, HIGHEST[HEIGHT] - 0.1)
    return True


def _solve(
    model: TrafficModel, x: Array, steps: int, free: Sequence[int] | None = None
) -> scipy.optimize.OptimizeResult:
    """The best camera near `x`; only `free` parameters move, all if None."""
    unbound = np.full(model.parameters - FEW, np.inf)
    low, high = np.append(LOWEST, -unbound), np.append(HIGHEST, unbound)
    which = list(range(model.parameters)) if free is None else list(free)
    whole = np.clip(x, low + 1e-6, high - 1e-6)

    def residuals(some: Array) -> Array:
        at = whole.copy()
        at[which] = some
        return model.residuals(at)

    solution = scipy.optimize.least_squares(
        residuals,
        whole[which],
        x_scale=STEP[which],
        bounds=(low[which], high[which]),
        diff_step=1e-5,
        ftol=1e-8,
        xtol=3e-4,
        max_nfev=steps,
    )
    whole[which] = solution.x
    solution.x = whole
    return solution


def _laid_on(points: KnownPoints, x: Array, image_size: tuple[int, int]) -> Array:
    """(3,) heading and place with which the camera's road lies on known points best."""
    matrix = projection_matrix(x, image_size)[:, [0, 1, 3]]
    ground = np.linalg.solve(matrix, np.column_stack((points.pixel, np.ones(len(points.pixel)))).T)
    ground = (ground[:2] / ground[2]).T
    a, b = ground - ground.mean(axis=0), points.local_m - points.local_m.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return np.append(yaw, points.local_m.mean(axis=0) - turn @ ground.mean(axis=0))
