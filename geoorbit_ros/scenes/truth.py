"""True lanes, cut to the part in which the camera can see a vehicle and place it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import Lane
from geoorbit_ros.scenes.camera import PinholeCamera
from geoorbit_ros.scenes.detector_model import View, exact_boxes
from geoorbit_ros.scenes.roads import LaneKey, PlacedRoad, lane_chains

SAMPLE_M = 1.0
"""Spacing of a true lane's points. Chosen: finer takes more time."""
CAR_M = (4.5, 1.82, 1.47)
"""Length, width, height of the car whose visibility decides: that of `VEHICLE_TYPES`."""
MIN_HEIGHT_PX = 14.0
"""Least height of that car in the image. Chosen: a little more than a detector's 12 px, so that
noise hides none."""
BORDER_PX = 2.0
"""The car is at least this far within the image, so that noise cuts none."""
MAX_GROUND_SIGMA_M = 1.3
"""Where one pixel is more than this on the ground, the camera places no vehicle in a lane. Chosen:
a third of a lane."""
MIN_LENGTH_M = 20.0
"""Shorter lanes are left out (docs/scenes.md). Chosen: four cars."""
COUNT_M = 20.0
"""A vehicle counts for a lane after this distance in it, or half of the lane if that is less
(docs/scenes.md). Chosen: as `MIN_LENGTH_M`."""


@dataclass(frozen=True, slots=True)
class VisibleLane:
    """A lane as far as it is seen, and the road lanes it consists of."""

    lane: Lane
    chain: tuple[LaneKey, ...]


def visible_lanes(placed: dict[str, PlacedRoad], camera: PinholeCamera) -> list[VisibleLane]:
    """All lanes of which the camera sees at least `MIN_LENGTH_M`, numbered from 1."""
    found: list[VisibleLane] = []
    for chain in lane_chains(placed):
        parts = [placed[road].centerline(lane) for road, lane in chain]
        line = np.concatenate([parts[0], *(p[1:] for p in parts[1:])])
        width = float(np.mean([placed[road].width_m for road, _ in chain]))
        line = _resample(line)
        run = _longest_run(_seen(line, camera))
        if run.stop - run.start < MIN_LENGTH_M / SAMPLE_M:
            continue
        cut = line[run]
        along = np.gradient(cut, axis=0)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
        lane = Lane(
            lane_id=len(found) + 1,
            centerline_m=cut,
            left_m=cut + 0.5 * width * normal,
            right_m=cut - 0.5 * width * normal,
            width_m=width,
            width_sigma_m=0.0,
            confidence=1.0,
            status="confirmed",
            vehicles=0.0,
            sigma_m=0.0,
        )
        found.append(VisibleLane(lane, tuple(chain)))
    return found


class TruthCounter:
    """Counts the vehicles that the camera saw drive along each lane."""

    def __init__(self, lanes: list[VisibleLane], lane_names: list[LaneKey]) -> None:
        self._lanes = lanes
        chain_of = {key: k for k, lane in enumerate(lanes) for key in lane.chain}
        self._chain = np.array([chain_of.get(name, -1) for name in lane_names] + [-1])
        self._driven: dict[tuple[int, int], float] = {}
        self._last: dict[int, NDArray[np.float64]] = {}

    def count(self, seen: NDArray[np.int64], view: View, lane: NDArray[np.int64]) -> None:
        """Take one frame.

        Args:
            seen: Vehicles that the detector reported.
            view: All vehicles.
            lane: (N,) lane number of each vehicle of `view`, -1 in a junction.
        """
        present = set(seen.tolist())
        for vehicle, xy, number in zip(view.vehicle.tolist(), view.xy, lane, strict=True):
            chain = int(self._chain[number])
            if vehicle not in present or chain < 0:
                continue
            last = self._last.get(vehicle)
            self._last[vehicle] = xy
            if last is not None and self._beside(chain, xy):
                key = chain, vehicle
                step = float(np.hypot(*(xy - last)))
                self._driven[key] = self._driven.get(key, 0.0) + min(step, 10.0)

    def lanes(self) -> tuple[Lane, ...]:
        """The visible lanes with their numbers of vehicles."""
        counted = []
        for k, visible in enumerate(self._lanes):
            enough = min(COUNT_M, 0.5 * visible.lane.length_m)
            vehicles = sum(
                1 for (chain, _), m in self._driven.items() if chain == k and m >= enough
            )
            counted.append(replace(visible.lane, vehicles=float(vehicles)))
        return tuple(counted)

    def _beside(self, chain: int, xy: NDArray[np.float64]) -> bool:
        line = self._lanes[chain].lane.centerline_m
        return bool(np.min(np.hypot(*(line - xy).T)) <= self._lanes[chain].lane.width_m)


def _resample(line: NDArray[np.float64]) -> NDArray[np.float64]:
    step = np.hypot(*np.diff(line, axis=0).T)
    line = line[np.append(True, step > 1e-6)]
    arc = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.arange(0.0, arc[-1], SAMPLE_M)
    return np.column_stack([np.interp(at, arc, line[:, k]) for k in range(2)])


def _seen(line: NDArray[np.float64], camera: PinholeCamera) -> NDArray[np.bool_]:
    """Whether a car on each point is wholly in the image, large enough, and well placed."""
    along = np.gradient(line, axis=0)
    heading = np.arctan2(along[:, 1], along[:, 0])
    count = len(line)
    car = View(
        np.arange(count),
        line,
        heading,
        np.tile(CAR_M, (count, 1)),
        np.full(count, 2),
    )
    boxes, depth = exact_boxes(camera, car)
    width, height = camera.image_size
    low = [BORDER_PX, BORDER_PX]
    with np.errstate(invalid="ignore"):
        inside = np.all(boxes[:, :2] > low, axis=1) & (boxes[:, 2] < width - BORDER_PX)
        inside &= (boxes[:, 3] < height - BORDER_PX) & (depth > 1.0)
        inside &= boxes[:, 3] - boxes[:, 1] >= MIN_HEIGHT_PX
    sharp = np.zeros(count, bool)
    sharp[inside] = camera.ground_sigma_m(line[inside], 1.0) <= MAX_GROUND_SIGMA_M
    return sharp


def _longest_run(flag: NDArray[np.bool_]) -> slice:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flag.astype(np.int8), [0]])))
    runs = edges.reshape(-1, 2)
    if len(runs) == 0:
        return slice(0, 0)
    start, stop = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return slice(int(start), int(stop))
