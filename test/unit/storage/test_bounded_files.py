"""Small files and messages that stand for a lot: refused in one sentence, in no time."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros import MAX_IMAGE_PIXELS
from geoorbit_ros.conversions import encode_compressed_image
from geoorbit_ros.core.bounded_json import MAX_DEPTH, MAX_TEXT, read_json
from geoorbit_ros.core.errors import GeoOrbitError, InputFileError, MessageError
from geoorbit_ros.core.input_report import InputReport
from geoorbit_ros.detection.detector import ModelError
from geoorbit_ros.detection.onnx.session import parse_metadata
from geoorbit_ros.fleet.fleet_io import load_fleet
from geoorbit_ros.lanes.geojson import parse_lane_file
from geoorbit_ros.storage.bag_file import Faults
from geoorbit_ros.storage.bag_folder import _metadata
from geoorbit_ros.storage.image_cdr import decode_compressed_image, decode_reduced
from geoorbit_ros.storage.tracks.classes import class_table

LEVELS = 9


def bomb(levels: int = LEVELS, width: int = 9) -> str:
    """Anchors in anchors: `width` to the power of `levels` values in half a kilobyte."""
    lines = ["x-a0: &a0 [" + ", ".join("v" * width) + "]"]
    for k in range(1, levels):
        lines.append(f"x-a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * width)}]")
    return "\n".join([*lines, f"cameras: *a{levels - 1}", ""])


def merged_bomb() -> str:
    lines = ["x-a0: &a0 {k: 1}"]
    for k in range(1, 12):
        lines.append(f"x-a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}")
    return "\n".join([*lines, "cameras: *a11", ""])


@pytest.mark.parametrize("text", [bomb(), merged_bomb(), "cameras: &a [*a]\n"])
def test_anchors_that_stand_for_billions_are_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text(text)
    tracemalloc.start()
    with pytest.raises(InputFileError, match="anchor") as caught:
        load_fleet(file, InputReport(str(file), "cameras", 1))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 20e6
    assert len(str(caught.value)) < 300
    with pytest.raises(GeoOrbitError):
        class_table(str(file))
    (tmp_path / "metadata.yaml").write_text(text)
    assert _metadata(tmp_path, Faults(Counter())) is None


def test_anchors_of_people_are_read(tmp_path: Path) -> None:
    text = bomb(3, 3).replace("cameras: *a2", "names: {0: car, 1: truck}")
    file = tmp_path / "classes.yaml"
    file.write_text(text)
    assert class_table(str(file)) == {"0": "car", "1": "truck"}


@pytest.mark.parametrize(
    "value",
    [
        "[" * 100_000,
        "(" * 5000 + ")" * 5000,
        "-" * 100_000 + "1",
        "{0: " * 3000 + "1" + "}" * 3000,
        "{" + ", ".join(f"{k}: 'a'" for k in range(100_000)) + "}",
        "9" * 10_000,
        "{" + "9" * 5000 + ": 'car'}",
        "{1e400: 'car'}",
        "{None: 'car'}",
    ],
    ids=["brackets", "parens", "minus", "objects", "long", "digits", "key", "infinite", "none"],
)
@pytest.mark.parametrize("key", ["names", "imgsz", "stride", "args", "end2end"])
def test_hostile_metadata_of_a_model_is_one_sentence(key: str, value: str) -> None:
    try:
        parse_metadata({key: value}, "m.onnx")
    except ModelError as error:
        assert len(str(error)) < 400
        assert key in str(error)


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a":' * 100_000, "1" * 10_000, '"' + "\\" * 99_999, "{", "", "\ud800"],
    ids=["brackets", "objects", "digits", "backslashes", "open", "nothing", "surrogate"],
)
def test_hostile_json_is_one_sentence_or_a_value(text: str) -> None:
    try:
        read_json(text, "topic", "a lane map")
    except MessageError as error:
        assert str(error).startswith("topic")
        assert len(str(error)) < 300


@given(st.text(st.sampled_from('[]{}",:\\01eE.-'), max_size=60))
def test_whatever_is_read_is_bounded(text: str) -> None:
    try:
        value = read_json(text, "topic", "a lane map")
    except MessageError:
        return
    waiting, depth = [value], 0
    while waiting:
        depth += 1
        assert depth <= MAX_DEPTH + 1
        inner: list[object] = []
        for item in waiting:
            if type(item) is int:
                assert -(2**63) <= item < 2**63
            inner += item.values() if isinstance(item, dict) else item if type(item) is list else ()
        waiting = inner


def test_brackets_in_texts_are_no_depth_and_size_is_looked_at_first() -> None:
    text = '{"name": "' + "[" * 500 + '\\"[", "n": [1]}'
    assert read_json(text, "topic", "a lane map")["n"] == [1]
    with pytest.raises(MessageError, match=f"of {MAX_TEXT} at most"):
        read_json(" " * (MAX_TEXT + 1), "topic", "a lane map")


@pytest.mark.parametrize("number", ["1e400", "-1e400", "1" + "0" * 30, "1" + "0" * 5000, "NaN"])
@pytest.mark.parametrize("where", ["stamp_ns", "lane_id", "coordinate", "width_m", "datum"])
def test_numbers_out_of_range_in_a_lane_map(number: str, where: str) -> None:
    values = dict.fromkeys(("stamp_ns", "lane_id", "coordinate", "width_m", "datum"), "1")
    values[where] = number
    text = (
        '{{"type": "FeatureCollection", "geoorbit": {{"stamp_ns": {stamp_ns}, "datum":'
        ' {{"latitude": 1, "longitude": {datum}}}}}, "features": [{{"type": "Feature",'
        ' "properties": {{"lane_id": {lane_id}, "width_m": {width_m}}}, "geometry": {{"type":'
        ' "LineString", "coordinates": [[1, 1], [{coordinate}, 1.001]]}}}}]}}'
    ).format(**values)
    try:
        found = parse_lane_file(text, "lanes/geojson")
    except GeoOrbitError as error:
        assert len(str(error)) < 300
        return
    assert -(2**63) <= found.lane_map.stamp_ns < 2**63


def png(width: int, height: int) -> bytes:
    """A black image, which packs a thousand to one."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    packer, row = zlib.compressobj(1), bytes(1 + width)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_a_small_image_that_stands_for_gigabytes_is_refused() -> None:
    side = 12_000  # 144 megapixels
    assert side**2 > MAX_IMAGE_PIXELS
    content = png(side, side)
    assert len(content) < 1_000_000
    message = encode_compressed_image(5, "camera", "png", content)
    with pytest.raises(MessageError, match="no whole image"):
        decode_compressed_image(message, "image/compressed")
    assert decode_reduced(message, "image/compressed", (side, side), 8) is None
    sound = encode_compressed_image(5, "camera", "png", png(64, 48))
    assert decode_compressed_image(sound, "image/compressed")[2].shape == (48, 64, 3)
