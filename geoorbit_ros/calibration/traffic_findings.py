"""What a camera's traffic says against its inputs: speeds, sizes, borders, the horizon.

All from medians over vehicles, so that a few odd ones don't matter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.camera_pose import MAX_SKEW, CameraPose, recover_pose
from geoorbit_ros.calibration.flatness import Stretch, road_stretches
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.calibration.vehicle_fit import fit_vehicles
from geoorbit_ros.calibration.vehicle_size import COVARIANCE, MEAN_M
from geoorbit_ros.core.errors import CalibrationError
from geoorbit_ros.core.input_report import Remark, Treatment
from geoorbit_ros.core.tables import CAR as CAR_CLASS
from geoorbit_ros.core.tables import FLAG_GROUND_POINT, UNKNOWN_CLASS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_TRACKS = 5
"""Vehicles that must have been seen before anything is said: lanes are confirmed from six on."""
MIN_TRAVEL_M = 10.0
"""A vehicle drives if it comes this far: two car lengths, more than a box wanders."""
SHARP_M = 2.0
"""Positions less certain than this say nothing about speed and size: half a car's length."""
FASTEST = (50.0, 70.0)
"""m/s: no road's median, and what no tenth of its vehicles exceeds. Chosen: 180 and 250 km/h, where
makers limit their cars; larger misses streets filmed at a wrong frame rate, smaller doubts a
motorway without a limit."""
SLOWEST = 3.0
"""m/s. Vehicles that drive more slowly than this (11 km/h) and never stop are no traffic. Chosen:
larger doubts a yard, smaller misses times that are ten times too long."""
SLOWEST_STEPWISE = 6.0
"""m/s: the same where images are a second apart. Vehicles would then be dozens of metres apart
from image to image, unless the second is a frame number."""
STEP_S = 0.999
"""Images this far apart could be counted rather than timed."""
GAP_S, GAP_FRAMES = 2.0, 5.0
"""An id that was away for longer than both is another vehicle's: recordings are played again, and
trackers begin anew. Chosen: longer joins two vehicles, shorter parts one behind a lorry."""
STEADY = 0.25
"""Standard deviation over mean of a vehicle's speed on its way. Chosen: free traffic has 0.03 to
0.07 in the scenes and at US-12; larger doubts traffic that stops and goes, where slow is right."""
LEG_M = 4.0
"""Speed is measured over ways of this length. Chosen: longer hides stops, shorter is noise."""
SKY_SHARE = 0.1
"""A larger share of vehicles above the horizon is none of this camera. Chosen: detectors see few
vehicles in the sky; at twelve cameras it was none of all boxes."""


MIN_CARS = 8
"""Cars whose sizes are compared at least. Chosen: fewer could all be vans, more takes longer."""
MIN_SHARP = 0.5
"""Share of boxes whose place is certain; with fewer the calibration is not that of the traffic."""
MIN_ROWS = 3
"""Boxes of one car at least, for its median."""
MIN_STEP_M = 1.0
"""A car's direction is known from a way of this length. Chosen: longer leaves slow ones out,
shorter takes noise for a direction."""
MAX_BOXES = 1500
"""So many boxes are compared with cars. Chosen: more costs time, fewer sees too few cars."""
MAX_FLATNESS_BOXES = 4000
"""The same where the road's stretches are told apart."""
SIZE_DOUBT = 0.5
"""Sum of |log| of width and height of cars over what cars have: 0.05 to 0.16 in the scenes and at
US-12. Chosen: a scale that is off by 28 %; smaller doubts cameras with lens distortion."""
EXPLAINED = (0.3, 0.15)
"""A smaller misfit is doubted, too, if another reading of the boxes brings it down so far. Chosen:
w and h exchanged make 0.44 to 1.0; smaller first, larger second believes chance."""
SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 1.5, 4 / 3, 2.0, 3.0, 4.0)
"""Common ratios of two image sizes of one camera: 1080 rows to 720, 540, 360, 1440, 2160…"""
TOUCHING = 0.01
"""An edge this near to the image's border, as a share of its side, ends there."""
WORSE = 0.03
"""Boxes are not misread if cars' sizes would become worse by this much. Chosen: in the scenes and
at US-12 a wrong reading makes them worse by 0.1; smaller vetoes right ones by noise."""
POKING = 0.1
"""A box that reaches this share of its side beyond the border was not drawn in this image. Chosen:
trackers that predict put a box a few per cent beyond; larger overlooks what does not fit."""
ODD_SHARE = 0.1
"""Where a reading of the boxes is right, at most this share of those that meet the border reach
beyond it. Chosen: larger believes a wrong reading, smaller a tracker's predictions."""
MISREAD_SHARE = 0.3
"""Boxes are misread if, of the vehicles whose boxes end at the border in another reading, at most
this share does in the given one, or at least this share reaches beyond the border. Chosen: 0 and 0
where the reading is right, 0.4 and more where it is wrong."""
READINGS = {
    "x, y look like the boxes' upper left corner (--columns left=x,top=y)": (0.5, 0.5, False),
    "x, y look like the middle of the boxes' lower edge": (0.0, -0.5, False),
    "x, y look like the boxes' lower left corner": (0.5, -0.5, False),
    "w and h look exchanged (--columns w=h,h=w)": (0.0, 0.0, True),
}
"""What the four numbers of a box may mean: from x, y to its middle in shares of its sides; whether
these are exchanged."""
OUTSIDE_SHARE = 0.05
"""More boxes whose middle lies outside of the image are no accident. Chosen: trackers that predict
vehicles on their way out make a few; larger overlooks images of another size."""
CORNERS_SHARE = 0.95
"""Share of boxes with w above x and h above y from which on these are coordinates of corners."""
COMMON_SIZES = (
    (640, 360), (640, 480), (704, 576), (720, 576), (800, 600), (854, 480), (960, 540),
    (1024, 768), (1280, 720), (1280, 960), (1920, 1080), (2560, 1440), (2592, 1944),
)  # fmt: skip
"""Sizes of cameras' images."""


@dataclass(frozen=True, slots=True)
class SeenTraffic:
    """Boxes of vehicles, ordered by track and time.

    Attributes:
        track_id: (N,) numbers of the vehicles: an id that comes back later is another one.
        time_s: (N,) capture time.
        box: (N, 4) x, y, width, height in pixels.
        solid: (N,) False where the pixel already is the ground point.
        car: (N,) of class car or of none.
        ground: (N, 2) metres, NaN above the horizon.
        sharp: (N,) the position is certain to `SHARP_M`.
        step_s: Usual time between two frames.
    """

    track_id: NDArray[np.int32]
    time_s: Array
    box: Array
    solid: Mask
    car: Mask
    ground: Array
    sharp: Mask
    step_s: float

    def tracks(self, use: Mask) -> Iterator[NDArray[np.intp]]:
        """Rows of each track that are in `use`."""
        at = np.flatnonzero(use)
        if len(at):
            yield from np.split(at, np.flatnonzero(np.diff(self.track_id[at])) + 1)


TIME, TRACK, BOX, FLAGS, CLASS = 0, 1, slice(2, 6), 6, 7
"""Columns of `boxes_as_numbers`."""
GROUND, SHARP = slice(8, 10), 10
"""Columns that `on_the_road` adds."""
COLUMNS = 11


def boxes_as_numbers(time_s: Array, rows: NDArray[np.void]) -> Array:
    """(N, 8) of `PIXEL_TRACK_DTYPE` rows at times (N,): plain numbers are quicker to handle."""
    names = ("track_id", "x", "y", "width", "height", "flags", "class_id")
    return np.column_stack([time_s, *(rows[name] for name in names)])


def on_the_road(boxes: Array, homography: Homography) -> Array:
    """(N, 11) of (N, 8): with the ground below the middle of each box's lower edge."""
    x, y, _, height = boxes[:, BOX].T
    foot = np.column_stack((x, y + height / 2))
    sharp = homography.sigma_m(foot, 1.5) <= SHARP_M
    return np.column_stack([boxes, homography.to_ground(foot), sharp])


def seen_traffic(seen: Array, times: Sequence[float]) -> SeenTraffic:
    """Order what was seen by vehicles.

    Args:
        seen: (N, 11), in the order of time.
        times: Of all frames that were looked at, those without vehicles, too.
    """
    step_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    seen = seen[np.argsort(seen[:, TRACK], kind="stable")]
    time_s = seen[:, TIME]
    other = np.diff(seen[:, TRACK], prepend=0) != 0
    other |= np.diff(time_s, prepend=0.0) > max(GAP_S, GAP_FRAMES * step_s)
    return SeenTraffic(
        np.cumsum(other).astype(np.int32),
        time_s,
        seen[:, BOX],
        (seen[:, FLAGS].astype(np.int64) & FLAG_GROUND_POINT) == 0,
        np.isin(seen[:, CLASS], (CAR_CLASS, UNKNOWN_CLASS)),
        seen[:, GROUND],
        seen[:, SHARP] > 0.0,
        step_s,
    )


def sky_finding(traffic: SeenTraffic) -> Iterator[Remark]:
    """Vehicles above the horizon of the calibration."""
    above = ~np.isfinite(traffic.ground[:, 0])
    share = float(above.mean())
    seen = sum(1 for _ in traffic.tracks(above))
    if share > SKY_SHARE and seen >= MIN_TRACKS:
        text = (
            f"{share:.0%} of the vehicles' boxes lie above the horizon of the calibration: "
            "are boxes and control points of the same image, in the same size?"
        )
        yield Remark(Treatment.DOUBTFUL, 0, text)


def speed_finding(traffic: SeenTraffic) -> Iterator[Remark]:
    """Speeds that no traffic has."""
    tracks = _driving(traffic)
    if len(tracks) < MIN_TRACKS:
        return
    speed = [travel_m / seconds for _, travel_m, seconds in tracks]
    low, usual, high = (3.6 * v for v in np.quantile(speed, (0.1, 0.5, 0.9)))
    range_text = f"vehicles drive {low:.0f} to {high:.0f} km/h, {usual:.0f} km/h in the middle"
    if usual > 3.6 * FASTEST[0] or high > 3.6 * FASTEST[1]:
        text = f"{range_text}: are the times right (--fps), and the control points in metres?"
        yield Remark(Treatment.DOUBTFUL, 0, text)
    stepwise = traffic.step_s >= STEP_S
    slow = usual <= 3.6 * (SLOWEST_STEPWISE if stepwise else SLOWEST)
    if slow and _unsteadiness(traffic, tracks) < STEADY:
        asked = "is the time a frame number" if stepwise else "are the times right (--fps)"
        text = f"{range_text}, and none stops: {asked}, and are the control points in metres?"
        yield Remark(Treatment.DOUBTFUL, 0, text)


_Driving = tuple[NDArray[np.intp], float, float]
"""Rows of a vehicle that drives, its way in metres, and the seconds that it took."""


def _driving(traffic: SeenTraffic) -> list[_Driving]:
    """Every vehicle that drives, where its place is certain."""
    at = np.flatnonzero(traffic.sharp)
    if not len(at):
        return []
    new = np.flatnonzero(np.diff(traffic.track_id[at])) + 1
    first, last = at[np.append(0, new)], at[np.append(new, len(at)) - 1]
    travel_m = np.hypot(*(traffic.ground[last] - traffic.ground[first]).T)
    seconds = traffic.time_s[last] - traffic.time_s[first]
    drives = (travel_m >= MIN_TRAVEL_M) & (seconds > 0.0)
    rows = np.split(at, new)
    return [(rows[k], float(travel_m[k]), float(seconds[k])) for k in np.flatnonzero(drives)]


def _unsteadiness(traffic: SeenTraffic, tracks: list[_Driving]) -> float:
    """How unsteady vehicles usually are on their way."""
    unsteady = []
    for rows, travel_m, _ in tracks:
        xy, time_s = traffic.ground[rows], traffic.time_s[rows]
        along_m = np.maximum.accumulate((xy - xy[0]) @ ((xy[-1] - xy[0]) / travel_m))
        legs = np.unique(np.floor(along_m / LEG_M), return_index=True)[1]
        if len(legs) > 2:
            leg = np.diff(along_m[legs]) / np.diff(time_s[legs])
            unsteady.append(float(leg.std() / leg.mean()))
    return float(np.median(unsteady)) if unsteady else np.inf


def border_finding(
    traffic: SeenTraffic,
    image_size: tuple[int, int],
    homography: Homography,
    pose: CameraPose | None,
) -> Iterator[Remark]:
    """Boxes that fit into the image only if read in another way, or into another image."""
    size = np.array(image_size, dtype=np.float64)
    box, track_id = np.ascontiguousarray(traffic.box[traffic.solid].T), traffic.track_id
    track_id = track_id[traffic.solid]
    if len(np.unique(track_id)) < MIN_TRACKS:
        return
    if np.mean((box[2:] > box[:2]).all(axis=0)) >= CORNERS_SHARE:
        text = "w, h look like the boxes' lower right corner: --columns x1=x,y1=y,x2=w,y2=h"
        yield Remark(Treatment.DOUBTFUL, 0, text)
        return
    ends, beyond = _at_border(box, track_id, (0.0, 0.0, False), size)
    fitting = {}
    for meaning, reading in READINGS.items():
        count, odd = _at_border(box, track_id, reading, size)
        fits = count >= max(MIN_TRACKS, ends) and odd <= ODD_SHARE * count
        misread = ends <= MISREAD_SHARE * count or beyond >= MISREAD_SHARE * count
        if not fits or not misread:
            continue
        gain = _size_gain(traffic, reading, homography, pose)
        if gain > -WORSE:
            fitting[meaning] = (gain, count)
    if fitting:
        meaning = max(fitting, key=lambda known: fitting[known])
        text = (
            f"{meaning}: so read, boxes of {fitting[meaning][1]} vehicles end at the image's "
            f"border; else those of {ends}, and those of {beyond} reach beyond it"
        )
        yield Remark(Treatment.DOUBTFUL, 0, text)
        return
    image = f"{image_size[0]}x{image_size[1]}"
    outside = ((box[:2] < 0.0) | (box[:2] > size[:, None])).any(axis=0)
    reach = np.quantile(box[:2] + box[2:] / 2, 0.999, axis=1)
    if outside.mean() > OUTSIDE_SHARE:
        text = f"the image is {image}, but boxes reach {reach[0]:.0f}x{reach[1]:.0f}"
        yield Remark(Treatment.DOUBTFUL, 0, text)
    for known in COMMON_SIZES:
        other = np.array(known, dtype=np.float64)
        if (np.abs(reach - other) <= 1.5 * TOUCHING * other).all() and (other < 0.9 * size).all():
            ends, beyond = _at_border(box, track_id, (0.0, 0.0, False), other)
            if ends >= MIN_TRACKS and beyond <= ODD_SHARE * ends:
                text = f"boxes end at {known[0]}x{known[1]}: is the image really {image}?"
                yield Remark(Treatment.DOUBTFUL, 0, text)


def _size_gain(
    traffic: SeenTraffic,
    reading: tuple[float, float, bool],
    homography: Homography,
    pose: CameraPose | None,
) -> float:
    """How much nearer cars' sizes come to what cars have if boxes are so read; 0: not known."""
    use = traffic.solid & traffic.car
    if pose is None or not use.any():
        return 0.0
    track_id, box = traffic.track_id[use], traffic.box[use]
    given = _car_size(track_id, box, homography, pose)
    other = _car_size(track_id, _read_as(box.T, reading).T, homography, pose)
    return 0.0 if given is None or other is None else _misfit(given) - _misfit(other)


def _at_border(
    box: Array, track_id: NDArray[np.int32], reading: tuple[float, float, bool], size: Array
) -> tuple[int, int]:
    """Vehicles of boxes (4, N): with one that ends at the border, with one that reaches beyond."""
    box, size = _read_as(box, reading), size[:, None]
    side, near = box[2:], TOUCHING * size
    low, high = box[:2] - side / 2, box[:2] + side / 2
    beyond = ((low < -POKING * side - near) | (high > size + POKING * side + near)).any(axis=0)
    ends = ((np.abs(low) <= near) | (np.abs(high - size) <= near)).any(axis=0) & ~beyond
    return len(np.unique(track_id[ends])), len(np.unique(track_id[beyond]))


def _read_as(box: Array, reading: tuple[float, float, bool]) -> Array:
    """Boxes (4, N) by their middle, of numbers that mean something else."""
    right, down, exchanged = reading
    side = box[3:1:-1] if exchanged else box[2:]
    return np.concatenate((box[:2] + np.array([[right], [down]]) * side, side))


def size_finding(
    traffic: SeenTraffic, image_size: tuple[int, int], homography: Homography, pose: CameraPose
) -> Iterator[Remark]:
    """Cars of sizes that cars don't have, and how their boxes may be meant."""
    track_id, box = _whole_cars(traffic, image_size)
    if not len(box):
        return
    found = _car_size(track_id, box, homography, pose)
    if found is None or _misfit(found) < EXPLAINED[0]:
        return
    misfit = {}
    for meaning, columns in _other_readings(box).items():
        other = _car_size(track_id, np.column_stack(columns), homography, pose)
        if other is not None:
            misfit[meaning] = _misfit(other)
    best = min(misfit, key=lambda meaning: misfit[meaning], default="")
    if not best or misfit[best] > EXPLAINED[1]:
        if _misfit(found) < SIZE_DOUBT:
            return
        best = "are the control points in metres, and of this image, in the boxes' size?"
    width_m, height_m = np.exp(found) * MEAN_M[0, 1:]
    text = (
        f"cars look {width_m:.1f} m wide and {height_m:.1f} m high "
        f"(usual: {MEAN_M[0, 1]:.1f} and {MEAN_M[0, 2]:.1f} m): {best}"
    )
    yield Remark(Treatment.DOUBTFUL, 0, text)


def other_size_finding(
    traffic: SeenTraffic, image_size: tuple[int, int], homography: Homography
) -> Iterator[Remark]:
    """Control points of an image of another size, where these fit no camera of the given one.

    Said where their plane fits a camera of that size in which cars have the sizes of cars, while in
    the given size cars have other sizes, or some points lie outside of the image.
    """
    track_id, box = _whole_cars(traffic, image_size)
    if not len(box) or homography.lens is not None:  # a lens belongs to one size
        return
    misfit = {}
    scaled = [(round(k * image_size[0]), round(k * image_size[1])) for k in SCALES]
    for other in (image_size, *scaled, *COMMON_SIZES):
        try:
            pose = recover_pose(homography, other, np.inf if other == image_size else MAX_SKEW)
        except CalibrationError:
            continue  # no camera of that size, either
        ratio = np.tile(np.divide(other, image_size), 2)
        found = _car_size(track_id, ratio * box, homography, pose)
        if found is not None:
            misfit[other] = _misfit(found)
    given = misfit.pop(image_size, np.inf)
    # Points outside of the given image speak for another one, too.
    reach = homography.points.pixel[homography.residual.inlier].max(axis=0)
    margin = 0.0 if (reach > image_size).any() else EXPLAINED[1]
    inside = {other: m for other, m in misfit.items() if (reach <= other).all() or margin}
    best = min(inside, key=lambda other: inside[other], default=None)
    if best is not None and inside[best] <= min(EXPLAINED[0], given - margin):
        text = (
            f"the control points look like those of an image of {best[0]}x{best[1]}, while the "
            f"boxes' image is {image_size[0]}x{image_size[1]}: in that size they fit a camera, and "
            "cars have the sizes of cars"
        )
        yield Remark(Treatment.DOUBTFUL, 0, text)


def _whole_cars(
    traffic: SeenTraffic, image_size: tuple[int, int], most: int = MAX_BOXES
) -> tuple[NDArray[np.int32], Array]:
    """Tracks (N,) and boxes (N, 4) of cars that no border cuts; none where there are too few."""
    size = np.array(image_size, dtype=np.float64)
    low = traffic.box[:, :2] - traffic.box[:, 2:] / 2
    high = low + traffic.box[:, 2:]
    whole = ((low > TOUCHING * size) & (high < (1.0 - TOUCHING) * size)).all(axis=1)
    use = traffic.solid & traffic.car & whole
    cars = np.unique(traffic.track_id[use])
    if len(cars) < MIN_CARS:
        return np.empty(0, np.int32), np.empty((0, 4))
    fewer = min(int(use.sum()) // most, len(cars) // (3 * MIN_CARS))
    use &= np.isin(traffic.track_id, cars[:: max(1, fewer)])
    return traffic.track_id[use], traffic.box[use]


def _other_readings(box: Array) -> dict[str, tuple[Array, ...]]:
    """What the four numbers of a box may mean, and x, y, width, height if they do."""
    x, y, width, height = box.T
    scaled: dict[str, tuple[Array, ...]] = {
        f"the boxes look drawn in an image {1 / k:.3g} times as large as that of the control "
        "points": (k * x, k * y, k * width, k * height)
        for k in SCALES
    }
    return {"w and h look exchanged (--columns w=h,h=w)": (x, y, height, width)} | scaled


def _misfit(log_ratio: Array) -> float:
    return float(np.abs(log_ratio).sum())


def _car_size(
    track_id: NDArray[np.int32], box: Array, homography: Homography, pose: CameraPose
) -> Array | None:
    """Log of width and height (2,) of cars over those that cars have; None: too few to say."""
    found = _car_ratios(track_id, box, homography, pose)
    if found is None:
        return None
    usual = _medians(found[0], found[1])
    return np.median(usual, axis=0) if len(usual) >= MIN_CARS else None


def stretches_of(
    traffic: SeenTraffic, image_size: tuple[int, int], homography: Homography, pose: CameraPose
) -> list[Stretch]:
    """How the road bends along it: where cars all look larger or smaller."""
    track_id, box = _whole_cars(traffic, image_size, MAX_FLATNESS_BOXES)
    found = _car_ratios(track_id, box, homography, pose) if len(box) else None
    if found is None:
        return []
    track_id, ratio, ground = found
    distance_m = np.hypot(*(ground - pose.position_m[:2]).T)
    return road_stretches(track_id, distance_m, ratio.mean(axis=1))


def _car_ratios(
    track_id: NDArray[np.int32], box: Array, homography: Homography, pose: CameraPose
) -> tuple[NDArray[np.int32], Array, Array] | None:
    """Of boxes that can be judged: track (N,), log ratios as `_car_size` (N, 2), place (N, 2)."""
    foot = box[:, :2] + np.column_stack((np.zeros(len(box)), box[:, 3] / 2))
    with np.errstate(invalid="ignore"):
        sharp = (homography.sigma_m(foot, 1.5) <= SHARP_M) & (box[:, 2:] > 0.0).all(axis=1)
    if not sharp.mean() >= MIN_SHARP:
        return None
    track_id, box = track_id[sharp], box[sharp]
    ground = homography.to_ground(foot[sharp])
    before, after = _neighbours(track_id)
    step = ground[after] - ground[before]
    moving = np.hypot(*step.T) >= MIN_STEP_M
    track_id, box, step = track_id[moving], box[moving], step[moving]
    n = len(box)
    if not n:
        return None
    size_m, size_cov = np.tile(MEAN_M[0, :, None], n), np.tile(COVARIANCE[0, :, :, None], n)
    heading = np.arctan2(step[:, 1], step[:, 0])
    with np.errstate(all="ignore"):
        fit = fit_vehicles(
            pose.projection,
            box[:, :2].T,
            box[:, 2:].T,
            heading,
            size_m,
            size_cov,
            homography.lens,
        )
        ratio = np.log(box[:, 2:] / fit.side_px.T)
    good = fit.good & np.isfinite(ratio).all(axis=1)
    at = np.flatnonzero(good)
    return (track_id[at], ratio[at], fit.xy.T[at]) if len(at) else None


def _medians(track_id: NDArray[np.int32], value: Array) -> Array:
    """(T, K) medians of values (N, K) of each track that has `MIN_ROWS` of them."""
    first = np.flatnonzero(np.diff(track_id, prepend=-1))
    count = np.diff(np.append(first, len(track_id)))
    first, count = first[count >= MIN_ROWS], count[count >= MIN_ROWS]
    ordered = [column[np.lexsort((column, track_id))] for column in value.T]
    return np.column_stack(
        [(column[first + (count - 1) // 2] + column[first + count // 2]) / 2 for column in ordered]
    )


def _neighbours(track_id: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (N,) two before and two after each row, within its track."""
    at = np.arange(len(track_id))
    new = np.flatnonzero(np.diff(track_id)) + 1
    first = np.concatenate(([0], new))
    last = np.append(new, len(track_id)) - 1
    own = np.searchsorted(new, at, side="right")
    return np.maximum(at - 2, first[own]), np.minimum(at + 2, last[own])
