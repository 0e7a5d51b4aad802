"""Through the real graph or without it, at any rate: the same bytes."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_bags import TRACKS, MadeMcap, tables
from made_markings import image_with_lines
from made_up_camera import MadeUpCamera
from probe import LIMIT_S
from rclpy.node import Node

from geoorbit_ros.cli.inputs import read_plane
from geoorbit_ros.cli.main import main
from geoorbit_ros.core.polylines import offset_line
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames
from geoorbit_ros.lanes.geojson import read_lanes
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.storage.database.writer import TrajectoryReader
from geoorbit_ros.storage.track_bag import write_track_bag
from geoorbit_ros.storage.track_csv import read_track_csv


def lanes(camera: MadeUpCamera, out: Path, *more: str) -> bytes:
    words = ["lanes", "--bag", camera.bag, "--calibration", camera.calibration, "--out", out]
    assert main([*map(str, words), *more]) == 0
    return out.read_bytes()


def replay(camera: MadeUpCamera, out: Path, *more: str) -> bytes:
    words = ["replay", camera.bag, "--calibration", camera.calibration, "--out", out]
    assert main([*map(str, words), *more]) == 0
    return out.read_bytes()


@pytest.mark.parametrize("estimator", ["curvilinear", "geolane"])
def test_replay_at_any_rate_gives_the_bytes_of_lanes(
    camera: MadeUpCamera, tmp_path: Path, estimator: str
) -> None:
    more = ("--estimator", estimator, "--update-period-s", "2")
    expected = lanes(camera, tmp_path / "lanes.geojson", *more)
    for rate in ("0", "10", "37"):
        got = replay(camera, tmp_path / f"rate_{rate}.geojson", "--rate", rate, *more)
        assert got == expected, f"rate {rate}"


def test_with_an_image_of_the_road_the_bytes_are_those_of_lanes_too(
    camera: MadeUpCamera, tmp_path: Path
) -> None:
    plain = lanes(camera, tmp_path / "plain.geojson")
    plane = read_plane(camera.calibration)
    found = read_lanes(tmp_path / "plain.geojson", plane.datum).lanes
    road = tmp_path / "road.png"
    # The lines are 0.3 m left of where the traffic has the boundaries.
    moved = [
        replace(lane, left_m=offset_line(lane.left_m, 0.3), right_m=offset_line(lane.right_m, 0.3))
        for lane in found
    ]
    cv2.imwrite(str(road), image_with_lines(plane, moved, camera.image_size))
    more = ("--image", str(road), "--update-period-s", "2")
    expected = lanes(camera, tmp_path / "lanes.geojson", *more)
    assert expected != plain
    assert expected.count(b'"boundary_source":"paint"') == 2 * len(found)
    for rate in ("0", "20"):
        got = replay(camera, tmp_path / f"rate_{rate}.geojson", "--rate", rate, *more)
        assert got == expected, f"rate {rate}"


def test_a_bag_with_faults_gives_the_lanes_of_lanes(
    camera: MadeUpCamera, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Cut off, on two channels, out of order, with boxes that are none, in the root namespace."""
    rows = camera.frames.rows.copy()
    rows["x"][5::50] = np.nan
    frames = Frames(camera.frames.stamp_ns, camera.frames.offset, rows)
    messages = tables(frames.stamp_ns.tolist(), [frames.frame(k) for k in range(len(frames))])
    messages[50], messages[51] = (
        (2, messages[50][1], messages[51][2]),
        (1, messages[51][1], messages[50][2]),
    )
    topic = ("/tracks_px", *TRACKS)
    content = MadeMcap({1: topic, 2: topic}, chunk=20).content(messages)
    odd = replace(camera, bag=tmp_path / "odd.mcap")
    odd.bag.write_bytes(content[: int(0.9 * len(content))])
    named = ("--camera-id", "north")
    expected = lanes(odd, tmp_path / "lanes.geojson", *named)
    assert replay(odd, tmp_path / "replay.geojson", "--rate", "0", *named) == expected
    told = " ".join(capfd.readouterr().out.split())
    for part in ("has no end", "a position or size that is no number", "sorted"):
        assert told.count(part) == 2


def test_replay_can_record_every_frame(camera: MadeUpCamera, tmp_path: Path) -> None:
    database = tmp_path / "t.db"
    replay(camera, tmp_path / "lanes.geojson", "--rate", "0", "--database", str(database))
    with TrajectoryReader(database) as reader:
        (content,) = reader.cameras()
        assert content.frames == len(camera.frames)
        (*_, (stamp_ns, text)) = reader.lane_maps("north")
    assert stamp_ns == camera.frames.stamp_ns[-1]
    assert text == (tmp_path / "lanes.geojson").read_text()


def test_a_camera_without_traffic_is_one_sentence_and_no_file(
    camera: MadeUpCamera, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    stamps = np.arange(1, 50, dtype=np.int64) * 10**8
    nothing = Frames(stamps, np.zeros(50, np.int64), np.empty(0, PIXEL_TRACK_DTYPE))
    bag = tmp_path / "quiet"
    write_track_bag(bag, "north", nothing)
    out = tmp_path / "lanes.geojson"
    words = ["replay", bag, "--calibration", camera.calibration, "--out", out, "--rate", "0"]
    assert main([str(word) for word in words]) == 2
    said = capfd.readouterr().err.strip()
    assert said.count("\n") == 0
    assert str(bag) in said
    assert "vehicle" in said
    assert not out.exists()
    assert os.listdir(tmp_path) == ["quiet"]


def test_an_interrupted_replay_ends_at_once_and_leaves_nothing(
    camera: MadeUpCamera, tmp_path: Path
) -> None:
    out = tmp_path / "lanes.geojson"
    words = [sys.executable, "-m", "geoorbit_ros.cli.main", "replay", str(camera.bag)]
    words += ["--calibration", str(camera.calibration), "--out", str(out), "--rate", "0.01"]
    root = str(Path(__file__).parents[2])
    with subprocess.Popen(
        [*words, "--verbose"],
        stderr=subprocess.PIPE,
        cwd=root,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            assert process.stderr is not None
            said = ""
            # Nodes log what they were told: the graph is up.
            for line in process.stderr:
                said += line
                if "calibration.csv" in line:
                    break
            assert "calibration.csv" in said
            process.send_signal(signal.SIGINT)
            said += process.communicate(timeout=LIMIT_S)[1]
        finally:
            process.kill()
    assert process.returncode == 130
    assert "Traceback" not in said
    assert os.listdir(tmp_path) == []


def test_a_composition_is_alone_unless_told_otherwise() -> None:
    with Composition() as first, Composition() as second, Composition(first.domain_id) as third:
        assert first.domain_id != second.domain_id
        lone = first.add(Node("lone", context=first.context))
        other = second.add(Node("other", context=second.context))
        friend = third.add(Node("friend", context=third.context))
        third.wait(lambda: "lone" in friend.get_node_names(), LIMIT_S, "the node of its domain")
        first.wait(lambda: "friend" in lone.get_node_names(), LIMIT_S, "the node of its domain")
        assert other.get_node_names() == ["other"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rate"), [("Yahara", "10"), ("Monona", "0")])
def test_real_cameras_give_the_bytes_of_lanes(name: str, rate: str, tmp_path: Path) -> None:
    shared = os.environ.get("GEOORBIT_REAL_DATA")
    if not shared:
        pytest.skip("GEOORBIT_REAL_DATA names no folder with us12/")
    folder = Path(shared) / "us12" / name
    frames = read_track_csv(folder / "trajectory.csv", (1920, 1080))
    write_track_bag(tmp_path / "bag", name.lower(), frames)
    common = ["--calibration", str(folder / "calibration.csv"), "--out"]
    offline, live = tmp_path / "lanes.geojson", tmp_path / "replay.geojson"
    assert main(["lanes", "--bag", str(tmp_path / "bag"), *common, str(offline)]) == 0
    words = ["replay", str(tmp_path / "bag"), *common, str(live), "--rate", rate]
    assert main(words) == 0
    assert live.read_bytes() == offline.read_bytes()
