"""What the tracker learns of its camera and detector, and what cut boxes say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.tables import DETECTION_DTYPE, FLAG_PREDICTED
from geoorbit_ros.tracking.association import complete_cut_box
from geoorbit_ros.tracking.motion_model import (
    MotionNoise,
    measurement_variance,
    measurements,
    start,
)
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.track import prepare
from geoorbit_ros.tracking.tracker import Tracker
from geoorbit_ros.tracking.traffic_model import (
    KEPT_SCORES,
    OverlapModel,
    ScoreModel,
    UnsteadyMotion,
)

SIZE = (1200, 400)
STEP_NS = 100_000_000


def detections(*boxes: tuple[float, float, float, float, float]) -> NDArray[np.void]:
    """Rows of x, y, width, height, score; cut to the image as a detector cuts them."""
    rows = np.zeros(len(boxes), DETECTION_DTYPE)
    for k, (x, y, width, height, score) in enumerate(boxes):
        left, right = max(x - width / 2, 0.0), min(x + width / 2, SIZE[0])
        rows[k] = ((left + right) / 2, y, right - left, height, score, 2)
    visible: NDArray[np.void] = rows[rows["width"] > 8.0]
    return visible


def observed(tracker: Tracker, k: int, rows: NDArray[np.void]) -> NDArray[np.void]:
    found = tracker.update(k * STEP_NS + 1, rows)
    seen: NDArray[np.void] = found[(found["flags"] & FLAG_PREDICTED) == 0]
    return seen


def parameters() -> TrackerParameters:
    return TrackerParameters(image_width=SIZE[0], image_height=SIZE[1])


def test_vehicles_that_leave_one_after_the_other_keep_their_own_ids() -> None:
    """A row of parked cars beside a moving camera: the border cuts each as the next follows."""
    tracker = Tracker(parameters())
    ids: dict[int, set[int]] = {}
    for k in range(60):
        cars = [(900.0 + 260.0 * n - 30.0 * k, 250.0, 180.0, 150.0, 0.95) for n in range(6)]
        rows = detections(*cars)
        for row in observed(tracker, k, rows):
            right = row["x"] + row["width"] / 2
            car = min(range(6), key=lambda n: abs(min(cars[n][0] + 90.0, SIZE[0]) - right))
            ids.setdefault(car, set()).add(int(row["track_id"]))
    assert {car: len(found) for car, found in ids.items()} == dict.fromkeys(range(6), 1)
    assert len(set.union(*ids.values())) == 6


def test_a_cut_box_is_completed_from_its_inner_edge() -> None:
    whole = (20.0, 250.0, 180.0, 150.0)
    rows = detections((*whole, 0.9))  # its left part is outside the image
    (cut,), _ = prepare(rows, parameters(), MotionNoise())
    assert cut.box == (55.0, 250.0, 110.0, 150.0)
    predicted = start(whole, (1.0,) * 4, (0.0,) * 4, (1.0,) * 4)
    values, variances = complete_cut_box(predicted, cut)
    of_whole = measurement_variance(whole, MotionNoise())
    assert values == pytest.approx(measurements(whole))
    assert variances[:2] == pytest.approx(of_whole[:2])
    assert variances[3] == pytest.approx(of_whole[3])
    assert variances[2] > 100.0, "the width is not measured"


def test_scores_that_only_false_boxes_have_stop_confirming_tracks() -> None:
    """Leaves with 0.8 come and go; vehicles have 0.95. At first one box of 0.8 is enough."""
    tracker = Tracker(parameters())
    random = np.random.default_rng(4)
    shown = []
    for k in range(400):
        vehicle = (50.0 + 12.0 * (k % 90), 300.0, 60.0, 50.0, 0.95)
        leaf = (*random.uniform((100, 50), (1100, 150)), 30.0, 30.0, 0.8)
        rows = observed(tracker, k, detections(vehicle, leaf))
        shown.append(int((rows["y"] < 200).sum()))
    assert sum(shown[:5]) >= 3
    assert sum(shown[200:]) < 0.05 * 200


@pytest.mark.parametrize(("vehicle_score", "continued"), [(0.97, False), (0.6, True)])
def test_a_box_continues_a_vehicle_only_with_a_score_that_vehicles_have_here(
    vehicle_score: float, continued: bool
) -> None:
    """After each vehicle, half a vehicle beside where it would be, a box of 0.5 appears."""
    tracker = Tracker(parameters())
    random = np.random.default_rng(4)
    taken = 0
    for k in range(900):
        leaf = (*random.uniform((100, 50), (1100, 150)), 30.0, 30.0, 0.5)
        x = 50.0 + 12.0 * (k % 45)
        score = float(np.clip(vehicle_score + random.normal(0.0, 0.02), 0.0, 1.0))
        vehicle = (x, 300.0, 60.0, 50.0, score) if k % 45 < 40 else (x, 328.0, 66.0, 55.0, 0.5)
        rows = observed(tracker, k, detections(vehicle, leaf))
        taken += int(k > 450 and (rows["y"] > 320).sum())
    assert (taken > 25) == continued


def test_a_score_says_nothing_before_anything_was_learnt_at_the_neutral_one() -> None:
    model = ScoreModel(0.42)
    low, neutral, high = (model.bin_of(score) for score in (0.1, 0.42, 0.9))
    assert model.evidence(low) + model.prior < -1.0
    assert abs(model.evidence(neutral) + model.prior) < 0.5
    before = model.evidence(high)
    assert before + model.prior > 1.5
    for _ in range(20):
        model.learn([high] * KEPT_SCORES, lasted=False)
    assert model.evidence(high) < before - 1.0


@pytest.mark.parametrize("shake_px", [0.0, 5.0])
def test_ids_last_though_the_camera_shakes(shake_px: float) -> None:
    tracker = Tracker(parameters())
    random = np.random.default_rng(2)
    ids: list[set[int]] = [set() for _ in range(4)]
    for k in range(80):
        dx, dy = shake_px * random.normal(size=2)
        boxes = [(60.0 + 13.0 * k + dx, 80.0 + 70.0 * n + dy, 60.0, 45.0, 0.9) for n in range(4)]
        for row in observed(tracker, k, detections(*boxes)):
            ids[round((float(row["y"]) - dy - 80.0) / 70.0)].add(int(row["track_id"]))
    assert [len(found) for found in ids] == [1, 1, 1, 1]


def test_noise_grows_with_errors_and_falls_back_to_that_of_a_still_camera() -> None:
    motion = UnsteadyMotion(MotionNoise())
    still = motion.noise.acceleration
    for _ in range(40):
        motion.learn([80.0] * 6)
    assert motion.noise.acceleration > 3.0 * still
    for _ in range(200):
        motion.learn([0.01] * 6)
    assert motion.noise.acceleration == pytest.approx(still)


def test_an_overlap_speaks_against_a_track_where_tracks_that_began_so_ended_early() -> None:
    model = OverlapModel()
    beside, partly, inside = (model.kind_of(share) for share in (0.0, 0.4, 0.9))
    assert [model.evidence(kind) for kind in (beside, partly, inside)] == [0.0, 0.0, 0.0]
    for _ in range(10):
        model.learn(beside, lasted=True)
        model.learn(partly, lasted=True)
        model.learn(inside, lasted=False)
    assert model.evidence(beside) == 0.0
    assert model.evidence(partly) == pytest.approx(0.0)
    assert model.evidence(inside) < -2.0


@pytest.mark.parametrize(("split", "expected"), [(True, (40, 46)), (False, (80, 80))])
def test_pieces_of_lorries_get_no_ids_once_the_detector_is_known_to_split_them(
    split: bool, expected: tuple[int, int]
) -> None:
    """40 lorries; each is found in two for three images, or has a car before it all the way."""
    tracker = Tracker(parameters())
    for k in range(800):
        x = 60.0 + 50.0 * (k % 20)
        boxes = [(x, 250.0, 160.0, 120.0, 0.9)]
        if not split:
            boxes.append((x + 20.0, 270.0, 60.0, 50.0, 0.9))
        elif k % 20 in (8, 9, 10):
            boxes.append((x + 20.0, 230.0, 60.0, 50.0, 0.9))
        observed(tracker, k, detections(*boxes))
    fewest, most = expected
    assert fewest <= tracker.counts.births <= most


@pytest.mark.parametrize("score", [0.5, 0.6])
def test_a_vehicle_with_a_score_that_no_other_had_gets_an_id(score: float) -> None:
    """Twenty cars with 0.9; then a lorry that the detector is less sure of."""
    tracker = Tracker(parameters())
    random = np.random.default_rng(0)
    k = 0
    for _ in range(20):
        for step in range(60):
            car = (60.0 + 17.0 * step, 250.0, 60.0, 45.0, 0.9 + 0.02 * random.normal())
            observed(tracker, k, detections(car))
            k += 1
        k += 20
    cars = tracker.counts.births
    for step in range(20):
        lorry = (60.0 + 9.0 * step, 330.0, 60.0, 45.0, score + 0.02 * random.normal())
        observed(tracker, k, detections(lorry))
        k += 1
    assert (cars, tracker.counts.births) == (20, 21)
