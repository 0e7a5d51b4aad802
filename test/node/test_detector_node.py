"""The detector node: images in, the detector's boxes out, whatever comes in between."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_msgs.msg import PolygonStamped
from made_models import red_finder
from numpy.typing import NDArray
from probe import LIMIT_S, LOSSLESS, Probe
from rclpy.publisher import Publisher
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image

from geoorbit_ros.conversions import encode_compressed_image
from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.detection import road_segments
from geoorbit_ros.detection.detector import Detector, make_detector
from geoorbit_ros.detection.onnx.yolo import OnnxYolo
from geoorbit_ros.nodes.detector import DetectorNode
from geoorbit_ros.nodes.support.composition import Composition

CANVAS = (160, 96)
TOPIC = "image/compressed"


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Finds the red pixels of an image, one box around all of them."""
    said = {"task": "detect", "imgsz": [96, 160], "names": {0: "car"}, "end2end": True}
    return red_finder(tmp_path / "red.onnx", "nms_free", CANVAS, 10, said)


def made_image(left: int, size: tuple[int, int] = CANVAS) -> NDArray[np.uint8]:
    image = np.full((size[1], size[0], 3), 90, np.uint8)
    image[40:60, left : left + 30] = (0, 0, 255)
    return image


def message(k: int, image: NDArray[np.uint8]) -> bytes:
    data = cv2.imencode(".png", image)[1].tobytes()
    return encode_compressed_image((k + 1) * 10**8, "pole_optical_frame", "png", data)


def start(
    nodes: Composition, model: Path | str, **overrides: object
) -> tuple[DetectorNode, Probe, Publisher]:
    node = nodes.make(DetectorNode, "north", LOSSLESS | {"model": str(model)} | overrides)
    probe = Probe(nodes)
    probe.listen_tables("detections", DETECTION_DTYPE)
    probe.until(lambda: node.detections.get_subscription_count() == 1, "the node to see the probe")
    return node, probe, probe.publisher(TOPIC, CompressedImage)


def test_tables_are_those_of_the_detector(nodes: Composition, model: Path) -> None:
    _, probe, images = start(nodes, model)
    for k in range(12):
        images.publish(message(k, made_image(10 * k)))
    heard = probe.heard["detections"]
    probe.until(lambda: len(heard) == 12, "all frames")
    own = OnnxYolo(model)
    for k, (stamp_ns, frame_id, rows) in enumerate(heard):
        assert (stamp_ns, frame_id) == ((k + 1) * 10**8, "pole_optical_frame")
        assert rows.tobytes() == own.detect(0, made_image(10 * k)).tobytes()
        assert rows["x"][0] == pytest.approx(10 * k + 15, abs=0.1)


def test_raw_images_are_taken_too(nodes: Composition, model: Path) -> None:
    _, probe, _ = start(nodes, model)
    images = probe.publisher("image", Image)
    rgb = made_image(50)[:, :, ::-1]
    raw = Image(height=96, width=160, encoding="rgb8", step=480, data=rgb.tobytes())
    raw.header.stamp.sec = 7
    images.publish(raw)
    heard = probe.heard["detections"]
    probe.until(lambda: len(heard) == 1, "the frame")
    assert heard[0][0] == 7 * 10**9
    assert heard[0][2]["x"][0] == pytest.approx(65, abs=0.1)


def test_without_a_model_moving_things_are_found(nodes: Composition) -> None:
    _, probe, images = start(nodes, "")
    for k in range(30):
        images.publish(message(3 * k, made_image(5 * k if k > 12 else 200)))
    heard = probe.heard["detections"]
    probe.until(lambda: len(heard) == 30, "all frames")
    assert [len(rows) for _, _, rows in heard[:13]] == [0] * 13
    assert [len(rows) for _, _, rows in heard[13:25]] == [1] * 12
    assert heard[20][2]["x"][0] == pytest.approx(5 * 20 + 15, abs=2)


def test_images_that_cannot_be_used_are_refused_and_the_next_one_is_taken(
    nodes: Composition, model: Path
) -> None:
    node, probe, images = start(nodes, model)
    images.publish(message(0, made_image(0)))
    heard = probe.heard["detections"]
    probe.until(lambda: len(heard) == 1, "the first")
    images.publish(encode_compressed_image(2 * 10**8, "f", "jpeg", b"no image"))
    images.publish(message(3, made_image(0, (80, 64))))
    images.publish(message(0, made_image(0)))
    probe.until(lambda: node.diagnostics.refused == 3, "three refusals")
    assert "stamps that increase" in str(node.diagnostics.last_refusal)
    images.publish(message(4, made_image(0)))
    probe.until(lambda: len(heard) == 2, "the one after")
    status = probe.status_of("/north/detector")
    assert status["refused"] == "3"
    assert status["detector"].startswith("red.onnx (NMS-free")


def test_when_it_is_behind_the_oldest_images_are_dropped_and_counted(
    nodes: Composition, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, begun = threading.Event(), threading.Event()

    def make_slow(*arguments: object, **options: object) -> Detector:
        made = make_detector(*arguments, **options)  # type: ignore[arg-type]
        quick = made.detect

        def slow(stamp_ns: int, image: NDArray[np.generic]) -> NDArray[np.void]:
            begun.set()
            assert gate.wait(LIMIT_S)
            return quick(stamp_ns, image)

        made.detect = slow  # type: ignore[method-assign]
        return made

    monkeypatch.setattr("geoorbit_ros.nodes.detector.make_detector", make_slow)
    node, probe, images = start(nodes, model, reliability="reliable", queue_depth=2)
    images.publish(message(0, made_image(0)))
    probe.until(begun.is_set, "the first image to be worked on")
    for k in range(1, 6):
        images.publish(message(k, made_image(0)))
        probe.until(lambda k=k: node.stream.received == k + 1, "it to arrive")  # type: ignore[misc]
    gate.set()
    heard = probe.heard["detections"]
    probe.until(lambda: len(heard) == 3, "those that were not dropped")
    assert [stamp_ns // 10**8 - 1 for stamp_ns, _, _ in heard] == [0, 4, 5]
    assert node.stream.dropped == 3
    assert probe.status_of("/north/detector")["dropped"] == "3"


def test_road_segments_are_published_for_late_joiners_and_others_are_counted(
    nodes: Composition, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(road_segments, "LEARNING_S", 3.0)
    monkeypatch.setattr(road_segments, "UPDATE_S", 1.0)
    _, probe, images = start(nodes, model, only_on_road=True)
    for k in range(45):
        images.publish(message(k, made_image((3 * k) % 120)))
    heard = probe.heard["detections"]
    probe.until(lambda: len(heard) == 45, "all frames on the road")
    before = int(probe.status_of("/north/detector")["boxes_outside_road_segments"])
    images.publish(message(45, np.roll(made_image(60), 36, axis=0)))
    probe.until(lambda: len(heard) == 46, "the frame beside it")
    assert len(heard[44][2]) == 1
    assert len(heard[45][2]) == 0
    status = probe.status_of("/north/detector")
    assert int(status["boxes_outside_road_segments"]) == before + 1
    assert status["boxes"] == "46", "those left out are counted"
    polygons = probe.listen("road_segments/segment_0", PolygonStamped)
    probe.until(lambda: len(polygons) == 1, "the segment")
    points = np.array([(p.x, p.y) for p in polygons[0].polygon.points])
    assert polygons[0].header.frame_id == "pole_optical_frame"
    assert points[:, 1].min() > 25
    assert points[:, 1].max() < 85
    assert np.ptp(points[:, 0]) > 100


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"model": "/nowhere.onnx"}, "no such file"),
        ({"min_score": 2.0}, "parameter 'min_score'"),
        ({"providers": "NoSuchProvider"}, "CPUExecutionProvider"),
    ],
)
def test_what_cannot_work_is_said_at_the_start(
    nodes: Composition, model: Path, overrides: dict[str, object], words: str
) -> None:
    with pytest.raises(GeoOrbitError, match=words):
        nodes.make(DetectorNode, "north", {"model": str(model)} | overrides)


def test_the_road_without_vehicles_comes_after_half_a_minute_and_then_every_period(
    nodes: Composition, model: Path
) -> None:
    node, probe, images = start(nodes, model, road_image_period_s=60.0)
    roads = probe.listen("road_image/compressed", CompressedImage)
    for k in range(0, 1001, 10):  # an image a second, a car that drives on in each
        images.publish(message(k, made_image(k % 120)))
        done = k // 10 + 1
        probe.until(lambda done=done: len(probe.heard["detections"]) == done, "a table")  # type: ignore[misc]
    expected = 2  # after 30 s and after 90 s
    probe.until(lambda: len(roads) >= expected, "images of the road")
    assert [round(Time.from_msg(r.header.stamp).nanoseconds / 1e9) for r in roads] == [30, 91]
    for road in roads:
        assert road.header.frame_id == "pole_optical_frame"
        shown = cv2.imdecode(np.frombuffer(road.data, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        assert np.array_equal(shown, np.full((96, 160, 3), 90, np.uint8))
    assert node.diagnostic_values()["road_images"] == expected


def test_no_image_of_the_road_where_none_is_asked_for(nodes: Composition, model: Path) -> None:
    node, probe, images = start(nodes, model, road_image_period_s=0.0)
    for k in range(0, 401, 20):
        images.publish(message(k, made_image(k % 120)))
        done = k // 20 + 1
        probe.until(lambda done=done: len(probe.heard["detections"]) == done, "a table")  # type: ignore[misc]
    assert node.diagnostic_values()["road_images"] == 0
    assert probe.node.count_publishers("/north/road_image/compressed") == 0
