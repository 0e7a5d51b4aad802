"""The camera node: every frame of a recording, the newest of a stream, and no end with either."""

import struct
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from made_videos import SINCE_1904_S, patched, write_video
from mjpeg_server import MjpegServer, grey_image
from probe import KEEP_ALL, LIMIT_S, Probe
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.camera import CameraNode
from geoorbit_ros.nodes.support.composition import Composition
from geoorbit_ros.storage.frames import open_source

LOSSLESS = {"reliability": "reliable", "queue_depth": 0, "rate": 0.0}
START_NS = 10**9


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve images, 25 a second, each brighter than the one before."""
    images = tmp_path / "images"
    images.mkdir()
    for k in range(12):
        assert cv2.imwrite(str(images / f"{k}.png"), grey_image(20 * k, (64, 48)))
    return images


def start(nodes: Composition, source: object, **overrides: object) -> CameraNode:
    values = LOSSLESS | {"source": str(source), "fps": 25.0} | overrides
    return nodes.make(CameraNode, "north", values)


def stamp_ns(message: CompressedImage) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def level(message: CompressedImage) -> int:
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return round(float(image.mean()))


def test_every_frame_of_a_recording_arrives_with_its_own_time(
    nodes: Composition, folder: Path
) -> None:
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    node = start(nodes, folder, start_time_s=1_700_000_000.5)
    probe.until(lambda: node.done and len(heard) == 12, "all images")
    first_ns = 1_700_000_000_500_000_000
    assert [stamp_ns(message) for message in heard] == [
        first_ns + k * 40_000_000 for k in range(12)
    ]
    assert [level(message) for message in heard] == pytest.approx(range(0, 240, 20), abs=2)
    assert {message.header.frame_id for message in heard} == {"north_optical_frame"}
    assert {message.format for message in heard} == {"bgr8; jpeg compressed bgr8"}


def test_a_recording_can_be_stamped_as_if_it_were_live(nodes: Composition, folder: Path) -> None:
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    before_ns = time.time_ns()
    start(nodes, folder, start_time_s=0.0)
    probe.until(lambda: bool(heard), "an image")
    assert before_ns <= stamp_ns(heard[0]) <= time.time_ns()


def test_a_recording_can_have_the_time_that_its_file_says(
    nodes: Composition, tmp_path: Path
) -> None:
    film = write_video(tmp_path / "film.mp4", 5)
    patched(film, b"mvhd", 4, struct.pack(">I", SINCE_1904_S + 1_700_000_000))
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    start(nodes, film, start_time_s=-1.0)
    probe.until(lambda: bool(heard), "an image")
    assert stamp_ns(heard[0]) == 1_700_000_000 * 10**9
    remarks = probe.status_of("/north/camera")["remarks"]
    assert "starts at 2023-11-14 22:13:20 UTC" in remarks
    assert "--fps 25 is not used" in remarks


def test_nobody_who_asks_a_node_is_told_a_password(
    nodes: Composition, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Neither `ros2 param get`, /parameter_events, /diagnostics nor the log shows it."""
    secret = tmp_path / "password"
    secret.write_text("SECRET77")
    probe = Probe(nodes)
    events = probe.listen("/parameter_events", ParameterEvent, KEEP_ALL)
    with MjpegServer([grey_image(90)] * 5) as server:
        server.credentials = "admin:SECRET77"
        host = server.address.partition("://")[2]
        first = nodes.make(
            CameraNode, "first", {"source": f"http://admin:SECRET77@{host}?t=SECRET"}
        )
        second = nodes.make(
            CameraNode, "second", {"source": f"http://admin@{host}", "password_file": str(secret)}
        )
        probe.until(lambda: first._feed.captured + second._feed.captured > 0, "images")
        told = [p.value.string_value for event in events for p in event.new_parameters]
        shown = [n.get_parameter("source").value for n in (first, second)]
        assert shown == [f"http://admin:***@{host}?t=***", f"http://admin@{host}"]
        assert shown[0] in told
        status = probe.status_of("/first/camera")
        assert status["source"] == shown[0]
        assert "SECRET" not in str(told) + str(status)
    for node in (first, second):
        node.close()
    output = capfd.readouterr()
    assert "SECRET" not in output.out + output.err


def test_a_wrong_password_setting_is_one_sentence(nodes: Composition) -> None:
    for overrides, words in (
        ({"password_variable": "NO_SUCH_VARIABLE"}, "no environment variable NO_SUCH_VARIABLE"),
        ({"password_file": "/absent"}, "/absent: No such file"),
        ({"source": "rtsp://admin:SE#CRET@192.0.2.1/s"}, "%23 in its place"),
    ):
        values = {"source": "rtsp://admin@192.0.2.1/s"} | overrides
        with pytest.raises(GeoOrbitError, match=words) as caught:
            nodes.make(CameraNode, "north", values)
        assert "CRET" not in str(caught.value)


def test_a_loop_goes_on_in_time_and_max_fps_thins_it(nodes: Composition, folder: Path) -> None:
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    node = start(nodes, folder, loop=True, max_fps=5.0)
    probe.until(lambda: len(heard) > 12, "the sixth round")
    steps = np.diff([stamp_ns(message) for message in heard])
    assert set(steps[1:]) == {200_000_000}
    assert not node.done


def test_a_recording_waits_for_a_subscriber_but_not_for_ever(
    nodes: Composition, folder: Path
) -> None:
    node = start(nodes, folder, wait_timeout_s=0.3)
    nodes.wait(lambda: node.done, LIMIT_S, "the end")
    assert node.diagnostics.published == 12


def test_limits_change_while_it_runs(nodes: Composition, folder: Path) -> None:
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    node = start(nodes, folder, loop=True)
    probe.until(lambda: len(heard) > 3, "images")
    changed = [Parameter("max_fps", value=1.0), Parameter("jpeg_quality", value=5)]
    assert all(result.successful for result in node.set_parameters(changed))
    probe.until(lambda: stamp_ns(heard[-1]) - stamp_ns(heard[-2]) > 900_000_000, "a slow image")
    probe.until(lambda: len(heard[-1].data) < len(heard[0].data), "a coarse image")


def test_an_image_that_cant_be_used_is_refused_and_the_rest_goes_on(
    nodes: Composition, folder: Path
) -> None:
    (folder / "3.png").write_bytes(b"no image")
    assert cv2.imwrite(str(folder / "5.png"), grey_image(1, (32, 24)))
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    node = start(nodes, folder, exit_when_done=False)
    probe.until(lambda: node.finished and len(heard) == 10, "the other images")
    status = probe.status_of("/north/camera")
    assert (status["refused"], status["captured"], status["dropped"]) == ("2", "10", "0")
    assert "5.png: found a frame of 32x24 pixels" in status["last_refusal"]
    assert not node.done


def test_a_video_that_breaks_off_gives_what_it_holds_and_the_node_says_so(
    nodes: Composition, tmp_path: Path
) -> None:
    path, random = tmp_path / "long.avi", np.random.default_rng(1)
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 2.0, (160, 120))
    for _ in range(20):
        writer.write(random.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    writer.release()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    node = start(nodes, path, fps=0.0, exit_when_done=False)
    probe.until(lambda: node.finished and len(heard) > 7, "the first half")
    status = probe.status_of("/north/camera")
    assert status["refused"] == "1"
    assert "what is there is used" in status["remarks"]
    assert "long.avi: found a video that breaks off after" in status["last_refusal"]
    assert not node.done


def test_a_stream_is_stamped_on_arrival_and_its_loss_ends_nothing(
    nodes: Composition, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(open_source, "FIRST_WAIT_S", 0.01)
    monkeypatch.setattr("geoorbit_ros.nodes.camera.SILENT_S", 0.2)
    probe = Probe(nodes)
    heard = probe.listen("image/compressed", CompressedImage, KEEP_ALL)
    sources = [grey_image(50)] * 4, [grey_image(150)] * 4
    with MjpegServer(*sources) as server:
        before_ns = probe.node.get_clock().now().nanoseconds
        node = start(nodes, server.address, stall_timeout_s=2.0, buffer_frames=10)
        probe.until(lambda: bool(heard) and level(heard[-1]) > 100, "the second connection")
        stamps = [stamp_ns(message) for message in heard]
        assert before_ns < stamps[0] < stamps[-1] < probe.node.get_clock().now().nanoseconds
        probe.until(lambda: node._source.reconnects > 1, "the stall is noticed")
        status = probe.status_of("/north/camera")
        assert "no frame for" in status["message"]
        assert int(status["reconnects"]) >= 1
        assert not node.done


def test_a_stream_that_is_not_there_ends_nothing_and_stops_at_once(nodes: Composition) -> None:
    node = start(nodes, "http://127.0.0.1:9/stream")
    statuses: list[DiagnosticArray] = []
    probe = Probe(nodes)
    probe.node.create_subscription(DiagnosticArray, "/diagnostics", statuses.append, 10)
    probe.until(lambda: bool(statuses), "a status")
    assert not node.done
    node.close()
    names = {thread.name for thread in threading.enumerate()}
    assert not names & {"capture", "publish"}


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"source": "/nowhere.mp4"}, ("/nowhere.mp4", "no such file")),
        ({"source": ""}, ("'source'", "not empty")),
        ({"fps": 0.0}, ("frames per second for this folder",)),
        ({"rate": -1.0}, ("'rate'", "0 to 1000")),
        ({"jpeg_quality": 0}, ("'jpeg_quality'", "1 to 100")),
    ],
)
def test_a_bad_start_is_one_sentence(
    nodes: Composition, folder: Path, overrides: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(GeoOrbitError) as caught:
        start(nodes, **({"source": folder} | overrides))
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)
