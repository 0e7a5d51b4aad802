"""Inputs held against each other: each fault is found, and right inputs give no finding."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cameras import Camera, Drive, frames
from made_up_camera import MadeUpCamera
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.core.tables import FLAG_DOUBTFUL, FLAG_GROUND_POINT, frames_from_rows
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.storage.track_csv import read_track_csv

Rows = NDArray[np.void]
CAMERA = Camera((0.0, 0.0, 9.0), 60.0, 14.0)
CAR = ((4.6, 1.85, 1.55), 2)
TIMES = np.arange(0.0, 40.0, 0.1)
REAL_DATA = os.environ.get("GEOORBIT_REAL_DATA")


def traffic(speed: float = 25.0) -> list[tuple[int, Rows]]:
    """Cars on two lanes each way, past the camera and out of its image on both sides."""
    drives = []
    for n in range(40):
        x, heading = ((6.0, 90.0), (9.5, 90.0), (16.0, 270.0), (19.5, 270.0))[n % 4]
        start = 5.0 + 0.85 * n
        y = 40.0 - speed * start * (1.0 if heading == 90.0 else -1.0)
        drives.append(Drive(CAR[0], CAR[1], (x, y), heading, speed, n + 1))
    return [(stamp_ns, rows) for stamp_ns, rows, _ in frames(CAMERA, drives, TIMES)]


CARS = traffic()


def findings(
    seen: list[tuple[int, Rows]], image_size: tuple[int, int] = (1920, 1080)
) -> tuple[str, BoxProjector, list[Rows]]:
    projector = BoxProjector(fit_homography(CAMERA.control_points()), image_size)
    ground = [projector.project(stamp_ns, rows) for stamp_ns, rows in seen]
    projector.traffic.judge()
    doubts = (s for report in projector.reports("tracks.csv") for s in report.sentences())
    return " | ".join(doubts), projector, ground


def each(change: Callable[[Rows], None]) -> list[tuple[int, Rows]]:
    changed = []
    for stamp_ns, rows in CARS:
        other = rows.copy()
        change(other)
        changed.append((stamp_ns, other))
    return changed


def later(factor: float) -> list[tuple[int, Rows]]:
    return [(round(stamp_ns * factor), rows) for stamp_ns, rows in CARS]


def corner(rows: Rows) -> None:
    rows["x"] -= rows["width"] / 2
    rows["y"] -= rows["height"] / 2


def lower_edge(rows: Rows) -> None:
    rows["y"] += rows["height"] / 2


def exchanged(rows: Rows) -> None:
    width = rows["width"].copy()
    rows["width"], rows["height"] = rows["height"], width


def corners(rows: Rows) -> None:
    corner(rows)
    rows["width"] += rows["x"]
    rows["height"] += rows["y"]


def scaled(factor: float) -> Callable[[Rows], None]:
    def change(rows: Rows) -> None:
        for name in ("x", "y", "width", "height"):
            rows[name] *= factor

    return change


def lifted(rows: Rows) -> None:
    rows["y"] -= 500.0


def as_points(rows: Rows) -> None:
    lower_edge(rows)
    rows["width"] = rows["height"] = 0.0
    rows["flags"] |= FLAG_GROUND_POINT


FAULTS: dict[str, tuple[list[tuple[int, Rows]], str]] = {
    "x, y are the upper left corner": (each(corner), "look like the boxes' upper left corner"),
    "x, y are the middle of the lower edge": (each(lower_edge), "middle of the boxes' lower edge"),
    "w and h are exchanged": (each(exchanged), "look"),
    "w, h are the lower right corner": (each(corners), "w, h look like the boxes' lower right"),
    "boxes of an image of half the size": (each(scaled(0.5)), "above the horizon"),
    "boxes of an image of two thirds of the size": (each(scaled(2 / 3)), "above the horizon"),
    "boxes of a larger image": (each(scaled(1.5)), "cars look"),
    "traffic above the horizon": (each(lifted), "above the horizon of the calibration"),
    "a frame number in place of the time": (later(10.0), "is the time a frame number"),
    "times ten times too short": (later(0.1), "are the times right (--fps)"),
    "thirty times too slow": (later(30.0), "km/h"),
    "ground points ten times too fast": (
        [(stamp_ns // 10, rows) for stamp_ns, rows in each(as_points)],
        "vehicles drive",
    ),
}


@pytest.mark.parametrize(("seen", "words"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_found_and_flags_what_comes_after(
    seen: list[tuple[int, Rows]], words: str
) -> None:
    said, projector, ground = findings(seen)
    assert words in said
    assert projector.doubtful
    last = [rows for rows in ground if len(rows)][-1:]
    assert all((rows["flags"] & FLAG_DOUBTFUL).all() for rows in last)


@pytest.mark.parametrize("factor", [0.5, 2 / 3, 4 / 3, 1.5, 2.0])
def test_control_points_of_another_size_than_boxes_and_image_are_named(factor: float) -> None:
    """A still of a film in another size was clicked: no border and no horizon shows it."""
    size = round(1920 * factor), round(1080 * factor)
    near = [(s, rows[rows["height"] >= 25.0 * factor]) for s, rows in each(scaled(factor))]
    said, projector, _ = findings(near, size)
    assert "the control points look like those of an image of 1920x1080" in said or (
        f"the image is {size[0]}x{size[1]}, but the control points reach" in said
    )
    assert projector.doubtful


SOUND: dict[str, list[tuple[int, Rows]]] = {
    "free traffic": CARS,
    "slow traffic": traffic(6.0),
    "fast traffic": traffic(38.0),
    "ground points": each(as_points),
    "one vehicle": [(s, rows[rows["track_id"] == 1]) for s, rows in CARS],
}


@pytest.mark.parametrize("seen", SOUND.values(), ids=SOUND)
def test_right_inputs_give_no_finding(seen: list[tuple[int, Rows]]) -> None:
    said, projector, ground = findings(seen)
    assert said == ""
    assert not projector.doubtful
    assert not any((rows["flags"] & FLAG_DOUBTFUL).any() for rows in ground)


def test_traffic_that_stops_and_goes_is_slow_and_no_fault() -> None:
    """The same way, driven in 25 s instead of 4 s with a stop half-way."""
    stop_s = np.array([0.0, 8.0, 22.0, 40.0])
    plain_s = np.array([0.0, 20.0, 20.05, 40.0])
    slow = [(round(np.interp(s / 1e9, plain_s, stop_s) * 6e9), rows) for s, rows in CARS]
    stamps = [s for s, _ in slow]
    kept = [pair for pair, new in zip(slow, np.diff(stamps, prepend=-1) > 0, strict=True) if new]
    said, _, _ = findings(kept)
    assert "none stops" not in said


def test_images_without_vehicles_count_among_the_times() -> None:
    """Slow traffic that a detector sees in every third image: its times are no frame numbers."""
    projector = BoxProjector(fit_homography(CAMERA.control_points()), (1920, 1080))
    for k, (stamp_ns, rows) in enumerate(CARS):
        seen = rows.copy()
        if k % 3:
            seen["class_id"] = 0
        projector.traffic.add(frames_from_rows(np.full(len(seen), 5 * stamp_ns), seen))
    assert projector.traffic.judge() == ()


def test_no_lane_is_confirmed_on_doubtful_rows_and_all_are_again_without() -> None:
    projector = BoxProjector(fit_homography(CAMERA.control_points()), (1920, 1080))
    ground = [(stamp_ns, projector.project(stamp_ns, rows)) for stamp_ns, rows in CARS]
    sure = map_lanes(ground, LaneMapper(make_estimator("curvilinear")))
    assert len(sure.confirmed) == 4
    flagged = []
    for stamp_ns, rows in ground:
        other = rows.copy()
        other["flags"] |= FLAG_DOUBTFUL
        flagged.append((stamp_ns, other))
    doubted = map_lanes(flagged, LaneMapper(make_estimator("curvilinear")))
    assert doubted.doubtful
    assert not doubted.confirmed
    for a, b in zip(sure.lanes, doubted.lanes, strict=True):
        np.testing.assert_array_equal(a.centerline_m, b.centerline_m)


@pytest.mark.skipif(REAL_DATA is None, reason="GEOORBIT_REAL_DATA names no recordings")
@pytest.mark.parametrize("camera", ["Yahara", "Monona"])
def test_real_cameras_give_no_finding(camera: str) -> None:
    place = Path(str(REAL_DATA)) / "us12" / camera
    homography = fit_homography(read_control_points(place / "calibration.csv"))
    projector = BoxProjector(homography, (1920, 1080))
    for _ in project_frames(read_track_csv(place / "trajectory.csv"), projector):
        pass
    projector.traffic.judge()
    assert [s for report in projector.reports(camera) for s in report.sentences()] == []


@pytest.mark.parametrize("pause_s", [0.1, 20.0])
def test_a_recording_that_is_played_again_with_the_same_ids_gives_no_finding(
    pause_s: float, camera: MadeUpCamera
) -> None:
    homography = fit_homography(read_control_points(camera.calibration))
    projector = BoxProjector(homography, camera.image_size)
    stamps_ns = camera.frames.stamp_ns.tolist()
    length_ns = stamps_ns[-1] - stamps_ns[0] + round(pause_s * 1e9)
    for lap in range(5):
        for k, stamp_ns in enumerate(stamps_ns):
            projector.project(stamp_ns + lap * length_ns, camera.frames.frame(k))
    assert projector.traffic.judge() == ()


def test_traffic_is_judged_more_seldom_as_time_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within seconds at first, and later after a tenth of the time so far, or two minutes."""
    check = BoxProjector(fit_homography(CAMERA.control_points()), (1920, 1080)).traffic
    judged: list[float] = []
    now_s, judge = 0.0, check.judge

    def noted() -> object:
        judged.append(now_s)
        return judge()

    monkeypatch.setattr(check, "judge", noted)
    monkeypatch.setattr("geoorbit_ros.calibration.plausibility.MAX_ROWS", 50)
    length_ns = CARS[-1][0] + 100_000_000
    for lap in range(90):
        for stamp_ns, rows in CARS:
            stamp_ns += lap * length_ns
            now_s = stamp_ns / 1e9
            check.add(frames_from_rows(np.full(len(rows), stamp_ns), rows))
    pauses = np.diff(judged)
    assert judged[1] < 10.0
    assert pauses.min() >= 2.0
    allowed = np.minimum(np.maximum(0.1 * np.array(judged[:-1]), 2.0), 120.0)
    assert (pauses >= 0.99 * allowed - 1.0).all()
    assert (pauses <= allowed + 25.0).all()  # traffic of 20 s is not enough for another look
    assert len(judged) < 100
