"""The ground point is the footprint's centre, and depends on stamps and rows alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cameras import Camera, Drive, frames
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.tables import (
    FLAG_DOUBTFUL,
    FLAG_GROUND_POINT,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    PIXEL_TRACK_DTYPE,
    TRACK_DTYPE,
)

Array = NDArray[np.float64]
Frame = tuple[int, NDArray[np.void], Array]

CAR, BUS, TRUCK = 2, 5, 7
SIZES = {
    "car": ((4.6, 1.85, 1.5), CAR),
    "suv": ((4.9, 1.95, 1.8), CAR),
    "van": ((5.5, 2.0, 2.4), CAR),
    "pickup": ((5.8, 2.0, 1.9), TRUCK),
    "lorry": ((9.0, 2.5, 3.5), TRUCK),
    "trailer": ((18.0, 2.55, 4.0), TRUCK),
    "bus": ((12.0, 2.55, 3.2), BUS),
}
VIEWS = [Camera((0, 0, 8), 75, 12), Camera((0, 0, 12), 60, 15), Camera((0, 0, 20), 45, 25, 1200)]
TIMES = np.arange(0, 12, 0.1)


def projector(camera: Camera, **options: Any) -> BoxProjector:
    return BoxProjector(fit_homography(camera.control_points()), camera.image_size, **options)


def lanes(size_m: tuple[float, float, float], class_id: int) -> list[Drive]:
    """One vehicle per lane and direction, on a road along north; all pass y = 40 at 6 s."""
    ways = [(x, heading) for x in (-12.0, -4.0, 4.0, 12.0, 20.0) for heading in (90, 270)]
    return [
        Drive(size_m, class_id, (x, 40 - 6 * 25.0 * (1 if heading == 90 else -1)), heading, 25.0, k)
        for k, (x, heading) in enumerate(ways)
    ]


def run(camera: Camera, all_frames: Sequence[Frame], **options: Any) -> NDArray[np.void]:
    made = projector(camera, **options)
    return np.concatenate([made.project(stamp, rows) for stamp, rows, _ in all_frames])


def with_truth(
    camera: Camera, all_frames: Sequence[Frame]
) -> tuple[NDArray[np.void], Array, NDArray[np.void]]:
    """Ground tracks, true centres (N, 2) and the boxes they came from."""
    made, out, truth, boxes = projector(camera), [], [], []
    for stamp, rows, centres in all_frames:
        ground = made.project(stamp, rows)
        pick = [rows["track_id"].tolist().index(i) for i in ground["track_id"]]
        out.append(ground)
        truth.append(centres[pick])
        boxes.append(rows[pick])
    return np.concatenate(out), np.concatenate(truth), np.concatenate(boxes)


def position(ground: NDArray[np.void]) -> Array:
    return np.column_stack((ground["x"], ground["y"])).astype(np.float64)


def mean_bias(error_m: Array, track_id: NDArray[np.int32]) -> float:
    """Mean over tracks of the size of their mean error."""
    return float(np.mean([abs(error_m[track_id == i].mean()) for i in np.unique(track_id)]))


@pytest.mark.parametrize("vehicle", SIZES)
def test_lateral_bias_of_the_ground_point(vehicle: str) -> None:
    size_m, class_id = SIZES[vehicle]
    bias: dict[str, list[float]] = {"ours": [], "centre": [], "lower edge": []}
    for camera in VIEWS:
        ground, truth, box = with_truth(camera, frames(camera, lanes(size_m, class_id), TIMES))
        near = ground["sigma"] < 1.5
        pixel = np.column_stack((box["x"], box["y"])).astype(np.float64)
        lower = pixel + np.column_stack((0 * box["height"], box["height"] / 2))
        for name, xy in (
            ("ours", position(ground)),
            ("centre", camera.ground(pixel)),
            ("lower edge", camera.ground(lower)),
        ):
            lateral = (xy - truth)[near, 0]
            bias[name].append(mean_bias(lateral, ground["track_id"][near]))
    assert np.mean(bias["ours"]) < (0.05 if class_id == CAR else 0.15)
    assert np.mean(bias["ours"]) < 0.15 * np.mean(bias["centre"])
    assert np.mean(bias["ours"]) < 0.15 * np.mean(bias["lower edge"])


@pytest.mark.parametrize("vehicle", ["car", "lorry", "bus"])
def test_sigma_is_the_error_it_has(vehicle: str) -> None:
    size_m, class_id = SIZES[vehicle]
    square = []
    for camera in VIEWS:
        ground, truth, _ = with_truth(camera, frames(camera, lanes(size_m, class_id), TIMES))
        error = np.hypot(*(position(ground) - truth).T)
        square.append(np.mean((error / ground["sigma"]) ** 2))
    assert 0.15 < np.mean(square) < 1.5


@pytest.mark.parametrize("heading", [0, 35, 90, 145, 180, 250, 300])
def test_heading_and_velocity_of_a_straight_drive(heading: int) -> None:
    camera = Camera((0, 0, 12), 90, 18)
    drive = Drive(*SIZES["car"], (0.0, 60.0), heading, 20.0)
    ground = run(camera, frames(camera, [drive], np.arange(-4, 4, 1 / 30)))
    moving = ground[np.isfinite(ground["heading"])]
    assert len(moving) > 0.6 * len(ground)
    turn = np.degrees(moving["heading"]) - heading
    assert np.abs((turn + 180) % 360 - 180)[5:].max() < 5
    assert np.median(np.hypot(moving["vx"], moving["vy"])) == pytest.approx(20, rel=0.05)


@pytest.mark.parametrize("y", [30.0, 120.0, 250.0])
def test_a_parked_vehicle_has_no_heading_however_its_box_jitters(y: float) -> None:
    camera = Camera((0, 0, 12), 90, 12)
    parked = Drive(*SIZES["car"], (3.0, y), 90, 0.0)
    ground = run(camera, frames(camera, [parked], np.arange(0, 60, 1 / 30)))
    assert len(ground) > 1700
    assert np.isnan(ground["heading"]).all()


def test_a_vehicle_that_stops_keeps_its_heading() -> None:
    camera = Camera((0, 0, 12), 90, 18)
    drive = Drive(*SIZES["car"], (3.0, 30.0), 90, 15.0)
    t = np.arange(0, 3, 0.1)
    moving = frames(camera, [drive], t)
    _, last, centre = moving[-1]
    standing = [(moving[-1][0] + (k + 1) * 10**8, last, centre) for k in range(50)]
    ground = run(camera, [*moving, *standing])
    assert np.degrees(ground["heading"][-1]) == pytest.approx(90, abs=5)
    assert np.hypot(ground["vx"][-1], ground["vy"][-1]) < 1.0


def traffic(camera: Camera, seed: int = 0) -> list[Frame]:
    drives = [
        replace(d, track_id=10 * k + i)
        for k, vehicle in enumerate(("car", "lorry", "bus"))
        for i, d in enumerate(lanes(*SIZES[vehicle])[k::3])
    ]
    return frames(camera, drives, TIMES, seed=seed)


def test_stamps_count_from_anywhere() -> None:
    camera = VIEWS[1]
    shifted = [(s + 1_700_000_000_000_000_000, r, c) for s, r, c in traffic(camera)]
    assert run(camera, shifted).tobytes() == run(camera, traffic(camera)).tobytes()


def same(a: NDArray[np.void], b: NDArray[np.void]) -> None:
    assert len(a) == len(b)
    for name in TRACK_DTYPE.names or ():
        np.testing.assert_allclose(a[name], b[name], rtol=1e-4, atol=1e-4)


def test_order_of_the_rows_changes_nothing() -> None:
    camera = VIEWS[1]
    turned = [(s, r[::-1], c[::-1]) for s, r, c in traffic(camera)]
    a, b = projector(camera), projector(camera)
    for (stamp, rows, _), (_, back, _) in zip(traffic(camera), turned, strict=True):
        same(a.project(stamp, rows), b.project(stamp, back)[::-1])


def test_a_track_does_not_depend_on_the_others() -> None:
    camera = VIEWS[1]
    everyone = run(camera, traffic(camera))
    alone = [(s, r[r["track_id"] == 11], c) for s, r, c in traffic(camera)]
    same(run(camera, alone), everyone[everyone["track_id"] == 11])


def test_turning_the_world_turns_the_result() -> None:
    camera, turned = Camera((0, 0, 12), 60, 15), Camera((0, 0, 12), 130, 15)
    a, b = run(camera, traffic(camera)), run(turned, traffic(camera))
    c, s = np.cos(np.radians(70)), np.sin(np.radians(70))
    turn = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(position(b), position(a) @ turn.T, atol=2e-3)
    np.testing.assert_allclose(b["sigma"], a["sigma"], rtol=1e-3)
    difference = b["heading"] - a["heading"] - np.radians(70)
    np.testing.assert_allclose(
        np.sin(difference / 2), np.where(np.isnan(a["heading"]), np.nan, 0), atol=1e-3
    )


def row(x: float, y: float, w: float, h: float, **values: int) -> NDArray[np.void]:
    rows = np.zeros(1, dtype=PIXEL_TRACK_DTYPE)
    rows["x"], rows["y"], rows["width"], rows["height"] = x, y, w, h
    rows["class_id"], rows["score"], rows["track_id"] = CAR, 0.7, 5
    for name, value in values.items():
        rows[name] = value
    return rows


@pytest.mark.parametrize(
    ("box", "truncated"),
    [
        ((960, 600, 100, 60), False),
        ((1875, 600, 80, 60), True),
        ((1850, 600, 80, 60), False),
        ((45, 600, 80, 60), True),
        ((960, 1040, 100, 70), True),
        ((960, 1020, 100, 70), False),
    ],
)
def test_boxes_at_the_border_are_truncated(
    box: tuple[float, float, float, float], truncated: bool
) -> None:
    camera = Camera()
    strict, lenient = projector(camera), projector(camera, reject_truncated=False)
    assert len(strict.project(0, row(*box))) == (not truncated)
    assert strict.counts.truncated == truncated
    kept = lenient.project(0, row(*box))
    assert bool(kept["flags"][0] & FLAG_TRUNCATED) == truncated


def test_a_row_flagged_truncated_is_truncated() -> None:
    assert not len(projector(Camera()).project(0, row(960, 600, 100, 60, flags=FLAG_TRUNCATED)))


def test_every_row_is_counted_once() -> None:
    camera = Camera(pitch_deg=10)
    made = projector(camera, max_sigma_m=3.0)
    rows = np.concatenate(
        [
            row(960, 800, 100, 60),
            row(960, 100, 30, 20),
            row(960, float("nan"), 30, 20),
            row(960, 306, 12, 10),
            row(1900, 800, 100, 60),
        ]
    )
    assert len(made.project(0, rows)) == 1
    counts = made.counts
    assert (counts.rows, counts.returned, counts.above_horizon) == (5, 1, 1)
    assert (counts.not_finite, counts.too_uncertain, counts.truncated) == (1, 1, 1)


def test_a_ground_point_is_projected_as_it_is() -> None:
    camera = Camera()
    made, pixel = projector(camera), np.array([[700.0, 600.0]])
    for k in range(30):
        pixel += [0, 4.0]
        out = made.project(k * 10**8, row(700.0, pixel[0, 1], 0, 0, flags=FLAG_GROUND_POINT))
        np.testing.assert_allclose(position(out), camera.ground(pixel), atol=1e-3)
    assert np.isfinite(out["heading"][0])


def test_a_ground_point_on_the_border_is_not_truncated() -> None:
    out = projector(Camera()).project(0, row(960, 1079, 0, 0, flags=FLAG_GROUND_POINT))
    assert len(out) == 1
    assert not out["flags"][0] & FLAG_TRUNCATED


def test_identity_score_and_the_predicted_flag_pass_through() -> None:
    out = projector(Camera()).project(0, row(960, 700, 100, 60, flags=FLAG_PREDICTED))
    assert out.dtype == TRACK_DTYPE
    assert (out["track_id"][0], out["class_id"][0], out["flags"][0]) == (5, CAR, FLAG_PREDICTED)
    assert out["score"][0] == np.float32(0.7)


def test_predictions_do_not_move_the_filter() -> None:
    camera = Camera((0, 0, 12), 90, 18)
    drive = Drive(*SIZES["car"], (3.0, 30.0), 90, 15.0)
    seen = frames(camera, [drive], np.arange(0, 2, 0.1))
    made = projector(camera)
    for stamp, rows, _ in seen:
        before = made.project(stamp, rows)
    wild = seen[-1][1].copy()
    wild["x"] += 200
    wild["flags"] |= FLAG_PREDICTED
    after = made.project(seen[-1][0] + 10**8, wild)
    np.testing.assert_allclose(after["vx"], before["vx"], atol=1e-3)
    np.testing.assert_allclose(after["vy"], before["vy"], atol=1e-3)


def test_an_id_that_jumps_is_a_new_vehicle() -> None:
    camera = Camera((0, 0, 12), 90, 18)
    first = frames(camera, [Drive(*SIZES["car"], (3.0, 30.0), 90, 15.0)], np.arange(0, 2, 0.1))
    other = frames(camera, [Drive(*SIZES["car"], (-9.0, 140.0), 270, 15.0)], np.arange(0, 2, 0.1))
    made = projector(camera)
    for stamp, rows, _ in first:
        made.project(stamp, rows)
    headings = [made.project(stamp + 2 * 10**9, rows)["heading"][0] for stamp, rows, _ in other]
    assert np.isnan(headings[0])
    assert np.degrees(headings[-1]) == pytest.approx(-90, abs=5)


def test_an_id_that_jumps_forgets_the_size_of_the_other_vehicle() -> None:
    """Two ids are exchanged: the lorry under the car's id is placed as if it had its own."""
    camera = Camera((0, 0, 12), 90, 18)
    times = np.arange(0, 3, 0.1)
    car = Drive(*SIZES["car"], (3.0, 30.0), 90, 10.0)
    lorry = Drive(*SIZES["lorry"], (-6.0, 100.0), 270, 10.0)
    exchanged = projector(camera)
    for stamp, rows, _ in frames(camera, [car], times):
        exchanged.project(stamp, rows)
    first = [
        exchanged.project(s + 4 * 10**9, rows) for s, rows, _ in frames(camera, [lorry], times)
    ]
    second = [exchanged.project(s + 8 * 10**9, rows) for s, rows, _ in frames(camera, [car], times)]
    for drive, found in ((lorry, first), (car, second)):
        last = np.concatenate(found[-10:])
        error = position(last) - drive.centre(times[-10:])
        assert np.hypot(*error.mean(axis=0)) < 1.0
        assert last["length"][-1] == pytest.approx(drive.size_m[0], abs=1.5)


def test_an_id_unseen_for_ten_seconds_is_a_new_vehicle() -> None:
    camera = Camera((0, 0, 12), 90, 18)
    drive = frames(camera, [Drive(*SIZES["lorry"], (3.0, 30.0), 90, 15.0)], np.arange(0, 2, 0.1))
    made = projector(camera)
    for stamp, rows, _ in drive:
        out = made.project(stamp, rows)
    assert np.isfinite(out["heading"]).all()
    again = made.project(drive[-1][0] + 10_100_000_000, drive[-1][1])
    fresh = projector(camera).project(0, drive[-1][1])
    assert again.tobytes() == fresh.tobytes()


def test_memory_is_bounded_over_many_vehicles() -> None:
    made = projector(Camera())
    for k in range(6000):
        made.project(k * 10**8, row(960, 700, 100, 60, track_id=k // 10))
    assert made.tracks <= 12


def test_detections_without_identity_share_nothing() -> None:
    made = projector(Camera())
    for k in range(40):
        rows = np.concatenate([row(400 + 20 * k, 700, 100, 60, track_id=-1) for _ in range(3)])
        out = made.project(k * 10**8, rows)
        assert np.isnan(out["heading"]).all()
    assert made.tracks <= 40


def test_frames_without_vehicles_give_empty_tables() -> None:
    out = projector(Camera()).project(0, np.empty(0, dtype=PIXEL_TRACK_DTYPE))
    assert out.dtype == TRACK_DTYPE
    assert not len(out)


def test_time_must_advance_until_reset() -> None:
    made = projector(Camera())
    made.project(100, row(960, 700, 100, 60))
    with pytest.raises(TableError, match="stamp 100 ns after 100 ns"):
        made.project(100, row(960, 700, 100, 60))
    made.reset()
    assert len(made.project(50, row(960, 700, 100, 60))) == 1


def test_rows_of_another_table_are_refused() -> None:
    with pytest.raises(TableError, match="expected"):
        projector(Camera()).project(0, np.empty(0, dtype=TRACK_DTYPE))


def test_control_points_of_a_larger_image_are_doubted_and_every_row_says_so() -> None:
    made = BoxProjector(fit_homography(Camera().control_points()), (1280, 720))
    (sentence,) = made.calibration_report.sentences(doubts=True)
    assert "the image is 1280x720, but the control points reach pixel (1728, 1026)" in sentence
    assert (made.project(0, row(640, 600, 60, 40))["flags"] & FLAG_DOUBTFUL).all()
    assert not projector(Camera()).doubtful


def test_without_a_pose_the_lower_edge_is_the_ground_point() -> None:
    camera = Camera((0, 0, 60), 90, 89.99)
    made = projector(camera)
    assert made.pose is None
    assert "focal length" in str(made.pose_error)
    out = made.project(0, row(900, 500, 100, 60))
    np.testing.assert_allclose(position(out), camera.ground(np.array([[900.0, 530.0]])), atol=1e-3)
    assert out["sigma"][0] > 0.9
