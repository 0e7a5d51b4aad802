"""Boxes of ONNX models equal those of an independent decoder; what can't be decoded is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_models import constant_model, red_finder
from numpy.typing import NDArray
from reference_decoder import Box, decode, iou

from geoorbit_ros.core.class_names import COCO_NAMES
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.detection.detector import DetectorSettings, ModelError
from geoorbit_ros.detection.onnx.yolo import OnnxYolo

CANVAS = (320, 256)
CELLS = 40 * 32 + 20 * 16 + 10 * 8
NAMES = {0: "person", 1: "Car", 2: "big truck", 3: "bus", 4: "traffic light", 5: "van"}
WANTED, COCO = {1, 2, 3, 5}, {1: 2, 2: 7, 3: 5, 5: 2}
PER_CLASS = DetectorSettings(any_class=False)  # as the reference suppresses
SIZES = [(1920, 1080), (640, 480), (321, 257), (97, 1511), (4000, 90), (7, 5), (5001, 3751)]


def metadata(**changes: object) -> dict[str, object]:
    width, height = CANVAS
    given = {"task": "detect", "stride": 32, "imgsz": [height, width], "names": NAMES}
    return given | {"batch": 1, "args": {"dynamic": False}, "end2end": False} | changes


def random_output(layout: str, seed: int = 1) -> NDArray[np.float32]:
    """Boxes all over the canvas and beyond its borders, in overlapping groups, some doubtful."""
    random = np.random.default_rng(seed)
    width, height = CANVAS
    groups = 14
    centre = random.uniform([-5, -5], [width + 5, height + 5], (groups, 2))
    size = random.uniform(6, 90, (groups, 2))
    member = random.integers(0, groups, CELLS)
    xy = centre[member] + random.normal(0, 2, (CELLS, 2))
    wh = size[member] * random.uniform(0.85, 1.18, (CELLS, 2))
    score = random.beta(0.4, 9.0, (CELLS, len(NAMES)))
    if layout == "raw":
        return np.column_stack([xy, wh, score]).T.astype(np.float32)
    if layout == "nms_free":
        number = random.integers(0, len(NAMES), CELLS)
        rows = np.column_stack([xy - wh / 2, xy + wh / 2, score.max(axis=1), number])
        return rows.astype(np.float32)
    grid = [(c, r, s) for s in (8, 16, 32) for r in range(height // s) for c in range(width // s)]
    corner, stride = np.array(grid)[:, :2], np.array(grid)[:, 2:]
    offset, log_size = xy / stride - corner, np.log(wh / stride)
    some = np.sqrt(score)
    return np.column_stack([offset, log_size, some.max(axis=1), some]).astype(np.float32)


def boxes_of(rows: NDArray[np.void]) -> list[Box]:
    x, y, w, h = (rows[name].astype(float) for name in ("x", "y", "width", "height"))
    columns = (x - w / 2, y - h / 2, x + w / 2, y + h / 2, rows["score"], rows["class_id"])
    return [(*map(float, row[:5]), int(row[5])) for row in zip(*columns, strict=True)]  # type: ignore[misc]


def assert_same(rows: NDArray[np.void], expected: list[Box]) -> None:
    found = boxes_of(rows)
    assert len(found) == len(expected)
    for one, two in zip(found, expected, strict=True):
        assert iou(one, two) >= 0.99
        assert one[4] == pytest.approx(two[4], rel=1e-5)
        assert one[5] == COCO[two[5]]


def given(layout: str) -> tuple[dict[str, object] | None, DetectorSettings]:
    """Metadata of the file and the user's options: YOLOX writes no metadata."""
    if layout == "grid":
        return None, replace(PER_CLASS, class_names=tuple(NAMES.values()))
    return metadata(end2end=layout == "nms_free"), PER_CLASS


@pytest.mark.parametrize("layout", ["raw", "nms_free", "grid"])
@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_boxes_are_those_of_the_reference(
    tmp_path: Path, layout: str, size: tuple[int, int]
) -> None:
    output = random_output(layout)
    said, options = given(layout)
    model = constant_model(tmp_path / "m.onnx", output, canvas=CANVAS, metadata=said)
    detector = OnnxYolo(model, options)
    image = np.zeros((size[1], size[0], 3), np.uint8)
    expected = decode(layout, output, size, CANVAS, WANTED)
    assert len(expected) > 4
    assert_same(detector.detect(0, image), expected)


@pytest.mark.parametrize("layout", ["raw", "nms_free", "grid"])
@pytest.mark.parametrize(
    ("size", "square"),
    [
        ((1920, 1080), (600, 300, 900, 500)),
        ((333, 777), (50, 600, 200, 700)),
        ((64, 48), (10, 8, 40, 30)),
        ((3000, 200), (2000, 40, 2600, 160)),
    ],
)
def test_a_red_vehicle_is_where_it_is(
    tmp_path: Path, layout: str, size: tuple[int, int], square: tuple[int, int, int, int]
) -> None:
    """The whole way: letterbox, channel order, sample range, decoding, back to the image."""
    names = {0: "car", 1: "person"}
    said = None if layout == "grid" else metadata(names=names, end2end=layout == "nms_free")
    options = DetectorSettings(class_names=("car", "person") if layout == "grid" else ())
    yolox = layout == "grid"
    cells = 300 if layout == "nms_free" else CELLS
    model = red_finder(
        tmp_path / "m.onnx", layout, CANVAS, cells, said, bgr=yolox, scale=255.0 if yolox else 1.0
    )
    image = np.full((size[1], size[0], 3), 114, np.uint8)
    left, top, right, bottom = square
    image[top:bottom, left:right] = (0, 0, 255)
    (found,) = boxes_of(OnnxYolo(model, options).detect(0, image))
    # Resampling moves an edge by half a canvas pixel, the rounded size by up to another.
    tolerance = max(size[0] / CANVAS[0], size[1] / CANVAS[1], 1.0) + 0.01
    assert found[:4] == pytest.approx(square, abs=tolerance)
    assert found[4:] == (1.0, 2)


def test_a_dynamic_export_gets_the_smallest_canvas(tmp_path: Path) -> None:
    """320 x 180 scaled to 320 x 180, padded to the next multiple of 32: 192 rows."""
    said = metadata(args={"dynamic": True}, end2end=True, names={0: "car"})
    model = red_finder(tmp_path / "m.onnx", "nms_free", CANVAS, 300, said, dynamic=True)
    detector = OnnxYolo(model, PER_CLASS)
    box = detector._letterbox((320, 180))
    assert (box.canvas_size, box.offset, box.gain) == ((320, 192), (0, 6), (1.0, 1.0))
    images = [np.zeros((180, 320, 3), np.uint8) for _ in range(3)]
    for k, image in enumerate(images):
        image[20:60, 40 * k : 40 * k + 80] = (0, 0, 255)
    for k, rows in enumerate(detector.detect_batch(images)):
        assert boxes_of(rows)[0][:4] == pytest.approx((40 * k, 20, 40 * k + 80, 60), abs=0.01)


@pytest.mark.parametrize("batch", [4, "batch"])
def test_batches_give_what_single_images_give(tmp_path: Path, batch: int | str) -> None:
    output = random_output("raw")
    model = constant_model(
        tmp_path / "m.onnx", output, canvas=CANVAS, metadata=metadata(), batch=batch
    )
    detector = OnnxYolo(model, PER_CLASS)
    images = [np.zeros((h, w, 3), np.uint8) for w, h in [*SIZES[:3], SIZES[0], SIZES[1], SIZES[2]]]
    together = detector.detect_batch(images)
    for image, rows in zip(images, together, strict=True):
        size = (image.shape[1], image.shape[0])
        assert_same(rows, decode("raw", output, size, CANVAS, WANTED))


def test_half_precision_models_run(tmp_path: Path) -> None:
    output = random_output("nms_free")
    said = metadata(end2end=True)
    model = constant_model(tmp_path / "m.onnx", output, canvas=CANVAS, metadata=said, half=True)
    rows = OnnxYolo(model, PER_CLASS).detect(0, np.zeros((256, 320, 3), np.uint8))
    halved = output.astype(np.float16).astype(np.float32)
    halved[:, :4] = output.astype(np.float16)[:, :4]
    assert_same(rows, decode("nms_free", halved, (320, 256), CANVAS, WANTED))


def test_a_grid_decoded_in_the_model_is_noticed(tmp_path: Path) -> None:
    output = random_output("grid")
    expected = decode("grid", output, (320, 256), CANVAS, WANTED)
    column, row, stride = np.array(
        [(c, r, s) for s in (8, 16, 32) for r in range(256 // s) for c in range(320 // s)]
    ).T
    done = output.copy()
    done[:, 0], done[:, 1] = (output[:, 0] + column) * stride, (output[:, 1] + row) * stride
    done[:, 2:4] = np.exp(output[:, 2:4]) * stride[:, None]
    model = constant_model(tmp_path / "m.onnx", done, canvas=CANVAS)
    options = replace(PER_CLASS, class_names=tuple(NAMES.values()))
    assert_same(OnnxYolo(model, options).detect(0, np.zeros((256, 320, 3), np.uint8)), expected)


def test_a_file_without_metadata_and_80_classes_is_coco(tmp_path: Path) -> None:
    output = np.zeros((84, CELLS), np.float32)
    output[:4, 5], output[4 + 7, 5] = (100, 90, 40, 30), 0.8
    output[:4, 9], output[4 + 0, 9] = (200, 90, 40, 30), 0.9
    model = constant_model(tmp_path / "m.onnx", output, canvas=CANVAS)
    (row,) = OnnxYolo(model).detect(0, np.zeros((256, 320, 3), np.uint8))
    assert row["class_id"] == COCO_NAMES.index("truck")
    assert row["x"] == pytest.approx(100)


def test_boxes_of_two_classes_on_one_vehicle_become_one_unless_told_not_to(tmp_path: Path) -> None:
    output = np.zeros((4 + len(NAMES), CELLS), np.float32)
    output[:4, 5], output[4 + 1, 5] = (100, 90, 40, 30), 0.8
    output[:4, 9], output[4 + 2, 9] = (101, 90, 40, 30), 0.7
    model = constant_model(tmp_path / "m.onnx", output, canvas=CANVAS, metadata=metadata())
    image = np.zeros((256, 320, 3), np.uint8)
    assert len(OnnxYolo(model, DetectorSettings(any_class=False)).detect(0, image)) == 2
    (one,) = OnnxYolo(model).detect(0, image)
    assert one["class_id"] == 2


def test_numbers_that_are_none_are_no_boxes(tmp_path: Path) -> None:
    output = random_output("raw")
    output[:, ::3], output[0, 1::3], output[2, 2::3] = np.nan, np.inf, np.nan
    model = constant_model(tmp_path / "m.onnx", output, canvas=CANVAS, metadata=metadata())
    assert len(OnnxYolo(model).detect(0, np.zeros((256, 320, 3), np.uint8))) == 0


@pytest.mark.parametrize(
    ("outputs", "said", "words"),
    [
        ([(38, CELLS), (32, 64, 80)], None, ["2 classes without names"]),
        ([(38, CELLS), (10, CELLS)], None, ["1x38x1680", "1x10x1680", "1x(4+classes)xN"]),
        ([(10, CELLS)], {"task": "pose"}, ["task 'pose'"]),
        ([(1000,)], {"task": "classify"}, ["task 'classify'"]),
        ([(1000,)], None, ["1x1000", "1xNx6", "1x(4+classes)xN"]),
        ([(3 * CELLS, 11)], None, [f"1x{3 * CELLS}x11", "one box per grid cell"]),
        ([(10, CELLS)], {"names": {0: "cat", 1: "dog"}}, ["2 class names", "6"]),
        ([(6, CELLS)], {"names": {0: "cat", 1: "dog"}}, ["cat, dog", "car"]),
        ([(6, CELLS)], {"names": "{0: 'cat"}, ["metadata 'names'", "{0: 'cat"]),
        ([(10, CELLS)], {"imgsz": "large"}, ["metadata 'imgsz'"]),
        ([(14, CELLS)], None, ["10 classes without names", "class_names"]),
    ],
)
def test_what_cannot_be_decoded_is_refused_in_one_sentence(
    tmp_path: Path, outputs: list[tuple[int, ...]], said: dict[str, object] | None, words: list[str]
) -> None:
    arrays = [np.zeros(shape, np.float32) for shape in outputs]
    file_metadata = None if said is None else metadata(**said)
    model = constant_model(tmp_path / "m.onnx", *arrays, canvas=CANVAS, metadata=file_metadata)
    with pytest.raises(ModelError) as caught:
        OnnxYolo(model)
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert str(model) in sentence
    assert [word for word in words if word not in sentence] == []


@pytest.mark.parametrize("kept", [0, 10, 500, -100])
def test_a_truncated_file_is_refused(tmp_path: Path, kept: int) -> None:
    path = constant_model(
        tmp_path / "m.onnx", random_output("raw"), canvas=CANVAS, metadata=metadata()
    )
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ModelError, match="a whole ONNX model") as caught:
        OnnxYolo(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"nowhere\.onnx: found no such file"):
        OnnxYolo(tmp_path / "nowhere.onnx")


def test_a_provider_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = constant_model(
        tmp_path / "m.onnx", random_output("raw"), canvas=CANVAS, metadata=metadata()
    )
    with pytest.raises(ParameterError, match=r"NoSuchProvider.*CPUExecutionProvider"):
        OnnxYolo(path, DetectorSettings(providers=("NoSuchProvider",)))
