"""Long recordings: a file instead of memory and two processes instead of one, the same bytes."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from camera_files import CameraFiles, to_pixel

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.control_point_file import read_control_points
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.cli.main import main
from geoorbit_ros.core import frame_spool
from geoorbit_ros.core.frame_spool import FrameSpool
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.lanes import projection_helper
from geoorbit_ros.lanes.projection_helper import ProjectionHelper
from geoorbit_ros.storage.database.writer import TrajectoryDatabase
from geoorbit_ros.storage.track_csv import read_track_csv
from geoorbit_ros.storage.tracks import long_csv
from geoorbit_ros.traffic import count


@pytest.fixture
def tracks(camera: CameraFiles, tmp_path: Path) -> Path:
    """The camera's traffic, and a vehicle that drives against its lane."""
    x_m = np.arange(100.0, 10.0, -1.5)
    pixel = to_pixel(np.column_stack((x_m, np.full_like(x_m, -3.5))))
    extra = [
        f"999,{400.0 + k / 10:.1f},{4000 + k},2,0.9,{u:.2f},{v:.2f},0,0"
        for k, (u, v) in enumerate(pixel)
    ]
    path = tmp_path / "tracks.csv"
    path.write_text(camera.tracks.read_text() + "\n".join(extra) + "\n")
    return path


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Every recording is a long one; the functions that second processes were started for."""
    started: list[object] = []
    for module in (projection_helper, count):

        class Noted(module.HelperProcess):  # type: ignore[name-defined,misc]
            def __init__(self, function: object, *args: object) -> None:
                started.append(function)
                super().__init__(function, *args)

        monkeypatch.setattr(module, "HelperProcess", Noted)
    for module in (frame_spool, long_csv):
        monkeypatch.setattr(module, "SPOOLED_ROWS", 10)
    monkeypatch.setattr(long_csv, "LEAST_BYTES", 0)
    monkeypatch.setattr(long_csv, "PIECE_BYTES", 4000)
    return started


def run(command: str, camera: CameraFiles, tracks: Path, out: Path, *more: object) -> int:
    words = (command, "--tracks", tracks, "--calibration", camera.calibration, "--out", out)
    return main([str(word) for word in (*words, *more)])


@pytest.mark.parametrize("known", [True, False])
def test_traffic_has_the_bytes_of_one_process(
    camera: CameraFiles,
    tracks: Path,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
    known: bool,
) -> None:
    lanes = ("--lanes", camera.truth) if known else ()
    out = tmp_path / "out"
    said = []
    for folder in ("one", "two"):
        helpers = request.getfixturevalue("helpers") if folder == "two" else []
        assert run("traffic", camera, tracks, out, *lanes) == 0
        out.rename(tmp_path / folder)
        said.append(capsys.readouterr().out)
    assert len(helpers) == 2
    assert said[0] == said[1]
    names = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert "events.csv" in names
    for name in names:
        one, two = ((tmp_path / folder / name).read_bytes() for folder in ("one", "two"))
        assert one == two, name
    events = (tmp_path / "two" / "events.csv").read_text().splitlines()
    assert any("wrong_way" in event for event in events) == known
    assert not multiprocessing.active_children()


def test_lanes_have_the_bytes_of_one_process(
    camera: CameraFiles, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    one, two = tmp_path / "one.geojson", tmp_path / "two.geojson"
    assert run("lanes", camera, camera.tracks, one) == 0
    helpers = request.getfixturevalue("helpers")
    assert run("lanes", camera, camera.tracks, two) == 0
    assert len(helpers) == 1
    assert one.read_bytes() == two.read_bytes()


def boxes_and_projector(camera: CameraFiles) -> tuple[Frames, BoxProjector]:
    homography = fit_homography(read_control_points(camera.calibration))
    return read_track_csv(camera.tracks), BoxProjector(homography, (1920, 1080))


def test_ground_tracks_have_the_bytes_of_one_process(camera: CameraFiles) -> None:
    boxes, projector = boxes_and_projector(camera)
    boxes.rows["width"] = boxes.rows["height"] = 30.0
    boxes.rows["flags"] = 0
    alone = BoxProjector(projector.homography, projector.image_size)
    expected = [alone.project_block(block) for block in boxes.blocks(200)]
    spool = FrameSpool(PIXEL_TRACK_DTYPE)
    helper = ProjectionHelper(spool, projector, 200)
    ground = helper.ground
    for part in boxes.blocks(77):  # while boxes are still coming
        spool.append(part)
        helper.take()
    found = list(helper.blocks())
    assert len(found) > 3
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.rows.tobytes() == theirs.rows.tobytes()
        assert ours.offset.tolist() == theirs.offset.tolist()
    whole = b"".join(block.rows.tobytes() for block in expected)
    assert ground.part(0, len(ground)).rows.tobytes() == whole
    assert projector.counts == alone.counts
    assert projector.traffic.findings == alone.traffic.findings


def test_an_interruption_leaves_no_process(camera: CameraFiles) -> None:
    boxes, projector = boxes_and_projector(camera)

    def interrupted() -> None:
        spool = FrameSpool.of([boxes], PIXEL_TRACK_DTYPE)
        blocks = ProjectionHelper(spool, projector, 100).blocks()
        next(blocks)
        assert isinstance(blocks, Generator)
        assert len(multiprocessing.active_children()) == 1
        blocks.throw(KeyboardInterrupt())

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not multiprocessing.active_children()


def test_what_is_wrong_is_said_as_by_one_process(
    camera: CameraFiles,
    tmp_path: Path,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Vehicles that stand make no lane."""
    tracks = tmp_path / "tracks.csv"
    rows = [
        f"{k % 3},{k // 3 / 10},{k // 3},2,0.9,{800 + 100 * (k % 3)},700,0,0" for k in range(300)
    ]
    tracks.write_text("\n".join(["id,time,frame_num,class,conf,x,y,w,h", *rows]) + "\n")
    errors = []
    for helpers in (0, 1):
        if helpers:
            started = request.getfixturevalue("helpers")
        assert run("lanes", camera, tracks, tmp_path / "none.geojson") == 2
        errors.append(capsys.readouterr().err)
    assert len(started) == 1
    assert errors[0] == errors[1]
    assert "none driving along a lane" in errors[0]


def test_a_database_has_the_bytes_of_one_process(
    camera: CameraFiles, tracks: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Maps that change over the time, too."""
    boxes, projector = read_track_csv(tracks), boxes_and_projector(camera)[1]
    path, out = tmp_path / "tracks.db", tmp_path / "out"
    with TrajectoryDatabase(path) as database:
        ground = projector.project_block(boxes)
        for stamp_ns, rows in ground.tables():
            database.append("pole_7", stamp_ns, rows)
        text = camera.truth.read_text(encoding="utf-8")
        database.append_lanes("pole_7", 0, text)
        moved = json.loads(text)
        for feature in moved["features"]:
            ways = np.array(feature["geometry"]["coordinates"])
            feature["geometry"]["coordinates"] = np.add(ways, [0.0, 1e-5]).tolist()
        database.append_lanes("pole_7", int(ground.stamp_ns[len(ground) // 2]), json.dumps(moved))
    for folder in ("one", "two"):
        helpers = request.getfixturevalue("helpers") if folder == "two" else []
        words = ("traffic", "--database", path, "--out", out, "--interval", "10s")
        assert main([str(word) for word in words]) == 0
        out.rename(tmp_path / folder)
    assert len(helpers) == 1
    for name in sorted(found.name for found in (tmp_path / "one").iterdir()):
        one, two = ((tmp_path / folder / name).read_bytes() for folder in ("one", "two"))
        assert one == two, name
