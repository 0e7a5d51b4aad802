"""Frames that are projected together give the bytes of frames that come one by one."""

from __future__ import annotations

import pickle
from itertools import pairwise
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
    Frames,
    join_frames,
)
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_blocks, map_lanes, project_blocks, project_frames

CAMERAS = {"posed": Camera((0, 0, 11), 65, 15), "straight down": Camera((0, 0, 60), 90, 89.99)}
TIMES = np.arange(0, 36, 0.1)


def random_frames(camera: Camera, seed: int) -> Frames:
    """Vehicles of all kinds for 40 s, with every fault that a row may have."""
    random = np.random.default_rng(seed)
    drives = []
    for k in range(30):
        size = random.uniform((2.0, 0.8, 1.4), (18.0, 2.6, 4.0))
        heading = float(random.choice([90, 270])) + random.normal(0, 3)
        start = random.uniform(0, 40) * (1 if heading < 180 else -1)
        speed = float(random.uniform(2, 30))
        through = (float(random.uniform(-15, 20)), 40 - start * speed)
        drive = Drive((*size,), int(random.choice([2, 3, 5, 7, 0])), through, heading, speed, k % 9)
        drives.append(drive)
    stamps, tables = [], []
    for stamp_ns, rows, _ in frames(camera, drives, TIMES, seed=seed):
        # One vehicle per id and image; an id comes back, now and then after more than ten seconds.
        rows = rows[np.unique(rows["track_id"], return_index=True)[1]]
        away = (stamp_ns // 10**9 % 23 > 11) & (rows["track_id"] == 3)
        rows = random.permutation(rows[(random.random(len(rows)) > 0.1) & ~away])
        for flag, share in ((FLAG_PREDICTED, 0.1), (FLAG_TRUNCATED, 0.05)):
            rows["flags"] |= np.where(random.random(len(rows)) < share, flag, 0).astype(np.uint32)
        point = rows["track_id"] % 4 == 1
        rows["flags"][point] |= FLAG_GROUND_POINT
        rows["width"][point] = rows["height"][point] = 0.0
        rows["track_id"][random.random(len(rows)) < 0.03] = -1
        rows["x"][random.random(len(rows)) < 0.02] = np.nan
        rows["score"] = random.random(len(rows))
        stamps.append(stamp_ns + int(random.integers(0, 10**7)))
        tables.append(rows[: 0 if random.random() < 0.05 else None])
    return join_frames(list(zip(stamps, tables, strict=True)))


def projector(camera: Camera, image: tuple[int, int] = (1920, 1080), **options: Any) -> Any:
    return BoxProjector(fit_homography(camera.control_points()), image, **options)


def joined(parts: list[Frames]) -> tuple[bytes, list[int]]:
    counts = [int(n) for block in parts for n in np.diff(block.offset)]
    return b"".join(block.rows.tobytes() for block in parts), counts


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("reject", [True, False])
def test_blocks_give_the_bytes_of_single_frames(seed: int, view: str, reject: bool) -> None:
    camera = CAMERAS[view]
    content = random_frames(camera, seed)
    alone = projector(camera, reject_truncated=reject)
    assert (alone.pose is None) == (view == "straight down")
    one_by_one = [
        alone.project(int(stamp_ns), content.frame(k))
        for k, stamp_ns in enumerate(content.stamp_ns)
    ]
    random = np.random.default_rng(seed)
    for blocks in (1, 6, 40):
        inner = np.sort(random.integers(0, len(content) + 1, blocks - 1)).tolist()
        together = projector(camera, reject_truncated=reject)
        borders = pairwise([0, *inner, len(content)])
        found = [together.project_block(content.part(*border)) for border in borders]
        data, counts = joined(found)
        assert counts == [len(rows) for rows in one_by_one]
        assert data == b"".join(rows.tobytes() for rows in one_by_one)
        assert together.counts == alone.counts
        assert together.traffic.findings == alone.traffic.findings


def test_doubt_begins_at_the_same_frame() -> None:
    """The vehicles are ten times too fast, which is found after some seconds."""
    drives = [Drive((4.6, 1.8, 1.5), 2, (6.0, 30 - 250.0 * k), 90, 250.0, k) for k in range(40)]
    content = [(t, r) for t, r, _ in frames(CAMERAS["posed"], drives, np.arange(0, 40, 0.02))]
    every = join_frames(content)
    alone, together = projector(CAMERAS["posed"]), projector(CAMERAS["posed"])
    expected = np.concatenate([alone.project(*frame) for frame in content])
    doubtful = (expected["flags"] & FLAG_DOUBTFUL) != 0
    assert doubtful.any()
    assert not doubtful.all()
    assert together.project_block(every).rows.tobytes() == expected.tobytes()


def test_the_offline_way_cuts_blocks_and_keeps_every_frame() -> None:
    content = random_frames(CAMERAS["posed"], 5)
    blocks = list(project_blocks(content, projector(CAMERAS["posed"]), block_rows=100))
    assert len(blocks) > 5
    assert max(len(block.rows) for block in blocks) <= 100
    assert (
        np.concatenate([block.stamp_ns for block in blocks]).tolist() == content.stamp_ns.tolist()
    )
    whole = projector(CAMERAS["posed"]).project_block(content)
    assert joined(blocks) == joined([whole])
    frame_by_frame = list(project_frames(content, projector(CAMERAS["posed"])))
    assert [stamp_ns for stamp_ns, _ in frame_by_frame] == content.stamp_ns.tolist()
    assert b"".join(rows.tobytes() for _, rows in frame_by_frame) == whole.rows.tobytes()


def test_lanes_found_offline_are_those_of_single_frames() -> None:
    ways = [(x, heading) for x in (3.0, 6.5, 12.0) for heading in (90, 270)]
    drives = [
        Drive(
            (4.6, 1.8, 1.5), 2, (x, 40 - 3.0 * k * (25 if heading < 180 else -25)), heading, 25.0, k
        )
        for k, (x, heading) in enumerate(ways * 5)
    ]
    content = [(t, rows) for t, rows, _ in frames(CAMERAS["posed"], drives, np.arange(0, 80, 0.1))]
    alone = projector(CAMERAS["posed"])
    live, offline = (LaneMapper(make_estimator("curvilinear")) for _ in range(2))
    lane_map = map_lanes(((t, alone.project(t, rows)) for t, rows in content), live)
    blocks = project_blocks(join_frames(content), projector(CAMERAS["posed"]), block_rows=170)
    assert lane_map.lanes
    assert pickle.dumps(map_blocks(blocks, offline)) == pickle.dumps(lane_map)


def test_an_id_twice_in_a_frame_is_one_track() -> None:
    content = random_frames(CAMERAS["posed"], 6)
    content.rows["track_id"] //= 3
    alone, together = projector(CAMERAS["posed"]), projector(CAMERAS["posed"])
    expected = [alone.project(int(t), content.frame(k)) for k, t in enumerate(content.stamp_ns)]
    assert together.project_block(content).rows.tobytes() == np.concatenate(expected).tobytes()


def test_a_block_of_no_frames_is_one() -> None:
    nothing = Frames(np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, PIXEL_TRACK_DTYPE))
    made = projector(CAMERAS["posed"])
    assert made.project_block(nothing).rows.dtype == TRACK_DTYPE
    assert not len(made.project_block(nothing))


def test_a_block_must_be_later_than_the_one_before() -> None:
    rows: NDArray[np.void] = np.zeros(1, PIXEL_TRACK_DTYPE)
    made = projector(CAMERAS["posed"])
    made.project(100, rows)
    with pytest.raises(TableError, match="stamp 100 ns after 100 ns"):
        made.project_block(Frames(np.array([100, 200]), np.array([0, 1, 1]), rows))
