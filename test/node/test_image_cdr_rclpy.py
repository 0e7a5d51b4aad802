"""Images in messages: the pixels that rclpy's own serialisation put there, or one sentence."""

from typing import Any

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from geoorbit_ros.core.errors import MessageError
from geoorbit_ros.storage.image_cdr import decode_compressed_image, decode_image

STAMP_NS = 12_000_000_345


def header(frame_id: str = "pole_7_optical_frame") -> Header:
    return Header(stamp=Time(sec=12, nanosec=345), frame_id=frame_id)


def image_of(height: int = 31, width: int = 47) -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)


def compressed(kind: str, array: NDArray[np.integer[Any]], frame_id: str = "a") -> bytes:
    _, data = cv2.imencode(f".{kind}", array)
    message = CompressedImage(header=header(frame_id), format=kind, data=data.tobytes())
    return bytes(serialize_message(message))


@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "abcd", "pole_7"])
def test_a_compressed_image_comes_back(frame_id: str) -> None:
    stamp_ns, found_id, pixels = decode_compressed_image(
        compressed("png", image_of(), frame_id), "image/compressed"
    )
    assert (stamp_ns, found_id) == (STAMP_NS, frame_id)
    assert (pixels == image_of()).all()


def test_grey_and_deep_images_become_three_channels_of_eight_bits() -> None:
    grey = image_of()[:, :, 0]
    assert (decode_compressed_image(compressed("png", grey), "t")[2] == grey[..., None]).all()
    deep = image_of().astype(np.uint16) * 257
    assert (decode_compressed_image(compressed("png", deep), "t")[2] == image_of()).all()


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("bgr8", [0, 1, 2]), ("rgb8", [2, 1, 0]), ("8UC3", [0, 1, 2])],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_a_raw_image_comes_back(encoding: str, order: list[int], padding: int) -> None:
    pixels = image_of()
    height, width, _ = pixels.shape
    rows = np.zeros((height, 3 * width + padding), np.uint8)
    rows[:, : 3 * width] = pixels[:, :, order].reshape(height, -1)
    message = Image(header=header(), height=height, width=width, encoding=encoding)
    message.step, message.data = rows.shape[1], rows.tobytes()
    stamp_ns, frame_id, found = decode_image(bytes(serialize_message(message)), "image")
    assert (stamp_ns, frame_id) == (STAMP_NS, "pole_7_optical_frame")
    assert (found == pixels).all()


@pytest.mark.parametrize(("encoding", "channels"), [("mono8", 1), ("bgra8", 4), ("rgba8", 4)])
def test_grey_and_alpha_raw_images(encoding: str, channels: int) -> None:
    pixels = np.full((4, 6, channels), 7, np.uint8)
    message = Image(header=header(), height=4, width=6, encoding=encoding, step=6 * channels)
    message.data = pixels.tobytes()
    found = decode_image(bytes(serialize_message(message)), "image")[2]
    assert found.shape == (4, 6, 3)
    assert (found == 7).all()


def raw(encoding: str = "bgr8", width: int = 6, step: int = 18, size: int = 72) -> bytes:
    message = Image(header=header(), height=4, width=width, encoding=encoding, step=step)
    message.data = bytes(size)
    return bytes(serialize_message(message))


@pytest.mark.parametrize(
    ("cdr", "words"),
    [
        (raw("mono16", step=12), "encoding 'mono16', expected one of bgr8"),
        (raw(step=10), "rows of 10 bytes"),
        (raw(size=50), "50 bytes of data"),
        (raw(width=0), "0x4"),
        (raw()[:30], "break off"),
        (b"\x00\x00" + raw()[2:], "encapsulation 0x0000"),
    ],
)
def test_a_raw_image_that_contradicts_itself_is_refused(cdr: bytes, words: str) -> None:
    with pytest.raises(MessageError, match=words) as caught:
        decode_image(cdr, "north/image")
    assert str(caught.value).startswith("north/image: found ")


@pytest.mark.parametrize("kept", [3, 20, 60, 500])
def test_a_compressed_image_cut_short_is_refused(kept: int) -> None:
    whole = compressed("jpg", image_of(200, 300))
    with pytest.raises(MessageError, match="break off"):
        decode_compressed_image(whole[:kept], "t")


def test_bytes_that_are_no_image_are_refused() -> None:
    for data in (b"", b"hello", cv2.imencode(".png", image_of())[1].tobytes()[:40]):
        message = CompressedImage(header=header(), format="jpeg", data=data)
        with pytest.raises(MessageError, match=r"'jpeg' that are no whole image"):
            decode_compressed_image(bytes(serialize_message(message)), "t")
