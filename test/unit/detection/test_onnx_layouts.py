"""The same two vehicles in every way that exporters write them: found, or refused with a shape."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_models import constant_model, save_model
from numpy.typing import NDArray
from onnx import TensorProto, helper

from geoorbit_ros.core.class_names import COCO_NAMES
from geoorbit_ros.detection.detector import (
    DetectorSettings,
    ModelError,
    make_detector,
    remarks_on,
)
from geoorbit_ros.detection.onnx.yolo import OnnxYolo

SIDE = 640
CELLS = 80 * 80 + 40 * 40 + 20 * 20
CAR, TRUCK = (100.0, 200.0, 180.0, 260.0), (300.0, 300.0, 420.0, 390.0)
NAMES = {0: "car", 1: "truck"}
EIGHT = {k: name for k, name in enumerate(COCO_NAMES[:8])}
Table = NDArray[np.float64]


def centre(box: tuple[float, ...]) -> list[float]:
    a, b, c, d = box
    return [(a + c) / 2, (b + d) / 2, c - a, d - b]


def corner(box: tuple[float, ...]) -> list[float]:
    return list(box)


def table(count: int, columns: int, *rows: list[float], fill: float = 0.0) -> Table:
    """`count` rows, the first ones given, the others empty."""
    made = np.full((count, columns), fill)
    made[: len(rows)] = rows
    return made


def hits(
    count: int,
    row: Callable[[tuple[float, ...], int, float], list[float]],
    empty: list[float],
    copies: int = 1,
) -> Table:
    """Rows of the two vehicles, each `copies` times with noise, and empty ones."""
    random = np.random.default_rng(1)
    made = np.tile(np.array(empty, float), (count, 1))
    for k in range(copies):
        noise = random.normal(0, 0.5, 4) * (copies > 1)
        for start, box, kind in ((0, CAR, 0), (count // 2, TRUCK, 1)):
            near = tuple(np.array(box) + noise)
            made[start + k] = row(near, kind, 0.9 - 0.01 * k)
    return made


def shares(box: tuple[float, ...]) -> list[float]:
    return [value / SIDE for value in centre(box)]


def logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def one_hot(kind: int, score: float, classes: int = 2) -> list[float]:
    scores = [0.01] * classes
    scores[kind] = score
    return scores


# name, output, class names, whether the two classes are told apart, words of the detector's name
FOUND: list[tuple[str, Table, dict[int, str] | None, bool, str]] = [
    (
        "YOLOv10, 26",
        hits(300, lambda b, k, s: [*corner(b), s, k], [0, 0, 0, 0, 0, 0]),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "YOLOv10, low scores everywhere",
        hits(300, lambda b, k, s: [*corner(b), s, k], [5, 9, 30, 40, 0.001, 1]),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "doubtful boxes far over the border",
        hits(300, lambda b, k, s: [*corner(b), s, k], [-200, -200, 900, 900, 0.002, 1]),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "padded with -1",
        hits(300, lambda b, k, s: [*corner(b), s, k], [-1] * 6),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "DeepStream-Yolo, before suppression",
        hits(CELLS, lambda b, k, s: [*corner(b), s, k], [5, 9, 30, 40, 0.001, 1], 12),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "corners before suppression, any number of rows",
        hits(1000, lambda b, k, s: [*corner(b), s, k], [5, 9, 30, 40, 0.001, 1], 12),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "one class, corners before suppression",
        hits(CELLS, lambda b, _, s: [*corner(b), s, 0], [5, 9, 30, 40, 0.001, 0], 12),
        {0: "vehicle"},
        False,
        "corners, score, class",
    ),
    (
        "centre and size, score, class",
        hits(300, lambda b, k, s: [*centre(b), s, k], [0, 0, 0, 0, 0, 0]),
        NAMES,
        True,
        "centre, size, score, class",
    ),
    (
        "class before score",
        hits(300, lambda b, k, s: [*corner(b), k, s], [0, 0, 0, 0, 0, 0]),
        NAMES,
        True,
        "corners, class, score",
    ),
    (
        "PaddleDetection: class, score, corners",
        hits(300, lambda b, k, s: [k, s, *corner(b)], [0, 0, 0, 0, 0, 0]),
        NAMES,
        True,
        "class, score, corners",
    ),
    (
        "corners in shares of the image",
        hits(100, lambda b, k, s: [*(v / SIDE for v in b), s, k], [0, 0, 0, 0, 0, 0]),
        NAMES,
        True,
        "corners, score, class",
    ),
    (
        "YOLOv5 with one class",
        hits(3 * CELLS, lambda b, _, s: [*centre(b), s, 0.98], [10, 10, 10, 10, 0.0001, 0.9], 12),
        {0: "vehicle"},
        False,
        "centre, size, objectness, class score",
    ),
    (
        "YOLOv5 with one class and a saturated class score",
        hits(3 * CELLS, lambda b, _, s: [*centre(b), s, 1.0], [10, 10, 10, 10, 0.0001, 1.0], 12),
        {0: "car"},
        False,
        "centre, size, objectness, class score",
    ),
    (
        "YOLOv5 with eight classes",
        hits(
            3 * CELLS,
            lambda b, k, s: [*centre(b), s, *one_hot((2, 7)[k], 0.98, 8)],
            [10, 10, 10, 10, 0.0001, *[0.1] * 8],
            12,
        ),
        EIGHT,
        True,
        "anchors 1xNx(5+classes)",
    ),
    (
        "YOLOv5 in shares of the image (TensorFlow exports)",
        hits(
            3 * CELLS,
            lambda b, k, s: [*shares(b), s, *one_hot((2, 7)[k], 0.98, 8)],
            [0.1, 0.1, 0.1, 0.1, 0.0001, *[0.1] * 8],
            12,
        ),
        EIGHT,
        True,
        "anchors 1xNx(5+classes)",
    ),
    (
        "YOLOv6: objectness 1",
        hits(
            CELLS,
            lambda b, k, s: [*centre(b), 1.0, *one_hot((2, 7)[k], s, 8)],
            [400, 400, 10, 10, 1.0, *[0.01] * 8],
            12,
        ),
        EIGHT,
        True,
        "grid 1xNx(5+classes)",
    ),
    (
        "YOLOv8 transposed",
        hits(
            CELLS,
            lambda b, k, s: [*centre(b), *one_hot((2, 7)[k], s, 8)],
            [10, 10, 10, 10, *[0.01] * 8],
            12,
        ),
        EIGHT,
        True,
        "raw 1xNx(4+classes)",
    ),
    (
        "YOLOv8 transposed, two classes",
        hits(
            CELLS,
            lambda b, k, s: [*centre(b), *one_hot(k, s)],
            [10, 10, 10, 10, 0.011, 0.012],
            12,
        ),
        NAMES,
        True,
        "raw 1xNx(4+classes)",
    ),
    (
        "YOLOv8 with two classes",
        hits(
            CELLS,
            lambda b, k, s: [*centre(b), *one_hot(k, s)],
            [10, 10, 10, 10, 0.011, 0.012],
            12,
        ).T,
        NAMES,
        True,
        "raw 1x(4+classes)xN",
    ),
    (
        "RT-DETR with two classes",
        hits(300, lambda b, k, s: [*shares(b), *one_hot(k, s)], [0.5, 0.5, 0.1, 0.1, 0.02, 0.03]),
        NAMES,
        True,
        "centre, size, two class scores",
    ),
    (
        "DETR with two classes, logits",
        hits(
            100,
            lambda b, k, s: [*shares(b), *map(logit, one_hot(k, s))],
            [0.5, 0.5, 0.1, 0.1, -5.0, -6.0],
        ),
        NAMES,
        True,
        "centre, size, two class scores",
    ),
    (
        "RT-DETR with 80 classes",
        hits(
            300,
            lambda b, k, s: [*shares(b), *one_hot((2, 7)[k], s, 80)],
            [0.5, 0.5, 0.1, 0.1, *[0.02] * 80],
        ),
        None,
        True,
        "transformer 1xNx(4+classes)",
    ),
    (
        "RT-DETR with eight classes, logits",
        hits(
            300,
            lambda b, k, s: [*shares(b), *map(logit, one_hot((2, 7)[k], s, 8))],
            [0.5, 0.5, 0.1, 0.1, *[-5.0] * 8],
        ),
        EIGHT,
        True,
        "transformer 1xNx(4+classes)",
    ),
    (
        "YOLO-NAS, flat: image, corners, score, class",
        hits(40, lambda b, k, s: [0, *corner(b), s, k], [0] * 7),
        NAMES,
        True,
        "image, corners, score, class",
    ),
    (
        "YOLOv7 end to end: image, corners, class, score",
        hits(40, lambda b, k, s: [0, *corner(b), k, s], [0] * 7),
        NAMES,
        True,
        "image, corners, class, score",
    ),
]


def kinds_of(count: int, car: int, truck: int) -> Table:
    made = np.zeros(count)
    made[0], made[count // 2] = car, truck
    return made


def logits_of(count: int, classes: int, car: int, truck: int) -> Table:
    made = np.full((count, classes), -6.0)
    made[0, car] = made[count // 2, truck] = logit(0.9)
    return made


CORNERS = hits(300, lambda b, *_: corner(b), [0.0] * 4)
IN_SHARES = hits(300, lambda b, *_: shares(b), [0.5, 0.5, 0.1, 0.1])
SCORES = hits(300, lambda _b, _k, s: [s], [0.0])[:, 0]
# name, outputs, which of them are whole numbers, words of the detector's name
APART: list[tuple[str, list[Table], tuple[int, ...], str]] = [
    ("labels, boxes, scores (D-FINE, RT-DETR)", [kinds_of(300, 2, 7), CORNERS, SCORES], (0,), ""),
    ("boxes, labels, scores in shares", [IN_SHARES, kinds_of(300, 2, 7), SCORES], (1,), "centre"),
    (
        "count, boxes, scores, classes (EfficientNMS)",
        [np.array([2.0]), CORNERS, SCORES, kinds_of(300, 2, 7)],
        (0, 3),
        "corners",
    ),
    ("classes as floats", [CORNERS, SCORES, kinds_of(300, 2, 7)], (), "corners"),
    ("logits of 80 classes, boxes", [logits_of(300, 80, 2, 7), IN_SHARES], (), "transformer"),
    ("boxes, logits of 91 (RF-DETR)", [IN_SHARES, logits_of(300, 91, 3, 8)], (), "transformer"),
    (
        "boxes, logits, masks (RF-DETR for segmentation)",
        [IN_SHARES, logits_of(300, 91, 3, 8), np.zeros((300, 20, 20))],
        (),
        "transformer",
    ),
    (
        "logits of 92, the last for nothing (DETR)",
        [
            np.column_stack([logits_of(300, 91, 3, 8), np.where(SCORES > 0, -0.25, 9.0)]),
            IN_SHARES,
        ],
        (),
        "transformer",
    ),
    (
        "masks beside raw boxes",
        [
            np.concatenate(
                [
                    hits(
                        CELLS,
                        lambda b, k, s: [*centre(b), *one_hot(5 * k + 2, s, 80)],
                        [9.0] * 4 + [0.01] * 80,
                    ).T,
                    np.full((32, CELLS), -0.7),
                ]
            ),
            np.zeros((32, 160, 160)),
        ],
        (),
        "raw",
    ),
    (
        "masks beside boxes after suppression",
        [
            hits(
                300,
                lambda b, k, s: [*corner(b), s, 5 * k + 2, *[-0.7] * 32],
                [0] * 38,
            ),
            np.zeros((32, 160, 160)),
        ],
        (),
        "corners",
    ),
    (
        "scores without the sigmoid",
        [
            hits(
                CELLS,
                lambda b, k, s: [*centre(b), *(logit(p) for p in one_hot(5 * k + 2, s, 80))],
                [9.0] * 4 + [-7.0] * 80,
            ).T
        ],
        (),
        "raw",
    ),
]


@pytest.mark.parametrize(
    ("outputs", "whole", "words"), [e[1:] for e in APART], ids=[e[0] for e in APART]
)
def test_two_vehicles_are_found_in_outputs_that_stand_apart(
    tmp_path: Path, outputs: list[Table], whole: tuple[int, ...], words: str
) -> None:
    arrays = [output.astype(np.float32) for output in outputs]
    model = constant_model(tmp_path / "m.onnx", *arrays, canvas=(SIDE, SIDE), whole=whole)
    detector = OnnxYolo(model)
    assert words in detector.name
    assert_both(detector.detect(0, np.zeros((SIDE, SIDE, 3), np.uint8)), True)


def test_transformers_see_the_image_over_their_whole_canvas(tmp_path: Path) -> None:
    """As their own predictors show it to them; a box is then wider than it is in the model."""
    arrays = [IN_SHARES.astype(np.float32), logits_of(300, 91, 3, 8).astype(np.float32)]
    detector = OnnxYolo(constant_model(tmp_path / "m.onnx", *arrays, canvas=(SIDE, SIDE)))
    rows = detector.detect(0, np.zeros((SIDE, 2 * SIDE, 3), np.uint8))
    wide = rows.copy()
    wide["x"], wide["width"] = rows["x"] / 2, rows["width"] / 2
    assert_both(wide, True)


def test_a_model_that_asks_for_the_image_size_is_told_that_of_its_input(tmp_path: Path) -> None:
    """RT-DETR and D-FINE write boxes in the size that their second input names."""
    two = np.array([shares(CAR), shares(TRUCK)], np.float32)
    corners = np.concatenate([two[:, :2] - two[:, 2:] / 2, two[:, :2] + two[:, 2:] / 2], axis=1)
    nodes = [
        helper.make_node("Cast", ["sizes"], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Concat", ["float", "float"], ["both"], axis=1),
        helper.make_node("Unsqueeze", ["both", "one"], ["each"]),
        helper.make_node("Mul", ["each", "shares"], ["boxes"]),
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Unsqueeze", ["nothing", "one"], ["column"]),
        helper.make_node("Add", ["column", "score"], ["scores"]),
        helper.make_node("Add", ["column", "kind"], ["kinds"]),
        helper.make_node("Cast", ["kinds"], ["labels"], to=TensorProto.INT64),
    ]
    constants: dict[str, NDArray[np.generic]] = {
        "one": np.array([1], np.int64),
        "shares": corners[None],
        "zero": np.zeros(1, np.float32),
        "score": np.full((1, 2), 0.9, np.float32),
        "kind": np.array([[2, 7]], np.float32),
    }
    model = save_model(
        tmp_path / "m.onnx",
        nodes,
        constants,
        ["N", 3, SIDE, SIDE],
        {"labels": ["N", 2], "boxes": ["N", 2, 4], "scores": ["N", 2]},
        None,
        whole=(0,),
        sizes="sizes",
    )
    detector = OnnxYolo(model)
    assert_both(detector.detect(0, np.zeros((SIDE, SIDE, 3), np.uint8)), True)
    for rows in detector.detect_batch([np.zeros((SIDE, SIDE, 3), np.uint8)] * 3):
        assert_both(rows, True)


def model_of(folder: Path, output: Table, names: dict[int, str] | None, **more: object) -> Path:
    said: dict[str, object] | None = None if names is None else {"names": names}
    made = output.astype(np.float32)
    return constant_model(folder / "m.onnx", made, canvas=(SIDE, SIDE), metadata=said, **more)  # type: ignore[arg-type]


def assert_both(rows: NDArray[np.void], told_apart: bool) -> None:
    assert len(rows) == 2
    left = rows["x"] - rows["width"] / 2
    top = rows["y"] - rows["height"] / 2
    for box, kind in ((CAR, 2), (TRUCK, 7)):
        k = int(np.argmin(np.abs(left - box[0])))
        row = rows[k]
        found = (left[k], top[k], left[k] + row["width"], top[k] + row["height"])
        assert found == pytest.approx(box, abs=2.0)
        assert row["score"] == pytest.approx(0.9, abs=0.05)
        assert row["class_id"] == (kind if told_apart else 2)


@pytest.mark.parametrize(
    ("output", "names", "told_apart", "words"),
    [entry[1:] for entry in FOUND],
    ids=[entry[0] for entry in FOUND],
)
@pytest.mark.parametrize("half", [False, True], ids=["float", "half"])
def test_two_vehicles_are_found_in_every_layout(
    tmp_path: Path,
    output: Table,
    names: dict[int, str] | None,
    told_apart: bool,
    words: str,
    half: bool,
) -> None:
    detector = OnnxYolo(model_of(tmp_path, output, names, half=half))
    assert words in detector.name
    assert_both(detector.detect(0, np.zeros((SIDE, SIDE, 3), np.uint8)), told_apart)


def without_batch(path: Path, output: Table, names: dict[int, str], found_on_grey: bool) -> Path:
    """A model that writes its rows without a dimension for the batch, and none for a grey image."""
    kept = output[output[:, -1] > 0] if not found_on_grey else output
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["brightest"], keepdims=0),
        helper.make_node("Greater", ["brightest", "limit"], ["lit"]),
        helper.make_node("Cast", ["lit"], ["count"], to=7),
        helper.make_node("Mul", ["count", "rows"], ["end"]),
        helper.make_node("Reshape", ["end", "one"], ["ends"]),
        helper.make_node("Slice", ["table", "start", "ends"], ["output"]),
    ]
    constants: dict[str, NDArray[np.generic]] = {
        "limit": np.array(-1.0 if found_on_grey else 0.9, np.float32),
        "rows": np.array(len(kept), np.int64),
        "one": np.array([1]),
        "start": np.array([0]),
        "table": kept.astype(np.float32),
    }
    shapes: dict[str, list[int | str] | None] = {"output": ["n", kept.shape[1]]}
    size: list[int | str] = [1, 3, SIDE, SIDE]
    return save_model(path, nodes, constants, size, shapes, {"names": names})


@pytest.mark.parametrize("found_on_grey", [True, False])
@pytest.mark.parametrize(
    "row",
    [
        lambda b, k, s: [0, *corner(b), k, s],
        lambda b, k, s: [0, *corner(b), s, k + 0.0],
        lambda b, k, s: [*corner(b), s, k],
    ],
    ids=["image, corners, class, score", "image, corners, score, class", "corners, score, class"],
)
def test_rows_of_any_number_are_understood_once_there_are_some(
    tmp_path: Path, row: Callable[[tuple[float, ...], int, float], list[float]], found_on_grey: bool
) -> None:
    rows = np.array([row(CAR, 0, 0.9), row(TRUCK, 1, 0.88)])
    model = without_batch(tmp_path / "m.onnx", rows + 0.0, NAMES, True)
    if not found_on_grey:
        model = without_batch(tmp_path / "m.onnx", np.abs(rows) + 0.0, NAMES, False)
    detector = OnnxYolo(model)
    dark, light = (np.full((SIDE, SIDE, 3), level, np.uint8) for level in (0, 255))
    if not found_on_grey:
        assert len(detector.detect(0, dark)) == 0
    found = detector.detect_batch([light, light])
    assert len(found[0]) == len(found[1])
    if len(found[0]) == 2:
        assert_both(found[0], True)
    else:
        assert not found_on_grey


# name, outputs, class names, words of the sentence
REFUSED: list[tuple[str, list[Table], dict[int, str] | None, list[str]]] = [
    (
        "two scores, names unknown",
        [hits(300, lambda b, k, s: [*shares(b), *one_hot(k, s)], [0.5, 0.5, 0.1, 0.1, 0.02, 0.03])],
        None,
        ["1x300x6", "two scores a box for classes without names"],
    ),
    (
        "two scores for three names",
        [hits(300, lambda b, k, s: [*shares(b), *one_hot(k, s)], [0.5, 0.5, 0.1, 0.1, 0.02, 0.03])],
        {0: "car", 1: "truck", 2: "bus"},
        ["1x300x6", "two scores a box for 3 classes"],
    ),
    (
        "rotated boxes after suppression",
        [hits(300, lambda b, k, s: [*centre(b), s, k, 0.7], [0] * 7)],
        NAMES,
        ["1x300x7", "rotated boxes?"],
    ),
    (
        "rotated boxes before suppression",
        [hits(CELLS, lambda b, k, s: [*centre(b), *one_hot(k, s), -0.4], [9] * 4 + [0.01] * 3).T],
        {0: "car", 1: "truck", 2: "bus"},
        [f"1x7x{CELLS}", "no poses, masks or rotated boxes"],
    ),
    (
        "poses",
        [hits(CELLS, lambda b, _, s: [*centre(b), s, *[300.0, 200.0, 0.9] * 17], [9] * 56).T],
        None,
        [f"1x56x{CELLS}", "no poses, masks or rotated boxes"],
    ),
    (
        "boxes twice",
        [np.zeros((100, 4)), np.zeros((100, 4)), np.zeros(100)],
        None,
        ["3 outputs 1x100x4, 1x100x4, 1x100"],
    ),
    (
        "classes and scores that are not told apart",
        [np.zeros((100, 4)), np.zeros(100), np.zeros(100)],
        None,
        ["3 outputs 1x100x4, 1x100, 1x100"],
    ),
    (
        "angles below zero",
        [np.full((84, CELLS), -0.5)],
        None,
        [f"1x84x{CELLS}", "values from -0.5 to -0.5", "class scores from 0 to 1"],
    ),
    (
        "numbers that are neither scores nor classes",
        [hits(300, lambda b, *_: [*corner(b), 37.5, -12.0], [0] * 6)],
        NAMES,
        ["1x300x6", "values from -12 to 37.5"],
    ),
    (
        "a class without a name",
        [hits(300, lambda b, k, s: [*corner(b), s, 5 * k], [0] * 6)],
        NAMES,
        ["1x300x6", "class number 5 of 2 classes"],
    ),
    (
        "boxes that are none",
        [hits(300, lambda _, k, s: [9000, 9000, -40, -50, s, k], [0] * 6)],
        NAMES,
        ["1x300x6", "neither corners nor centre and size"],
    ),
    ("five columns", [np.zeros((300, 5))], {0: "car"}, ["1x300x5"]),
    ("YOLOv5 as feature maps", [np.zeros((3, 80, 80, 85))], None, ["1x3x80x80x85"]),
    ("no box has a size", [np.zeros((3 * CELLS, 13))], EIGHT, [f"1x{3 * CELLS}x13"]),
]


@pytest.mark.parametrize(
    ("outputs", "names", "words"), [e[1:] for e in REFUSED], ids=[e[0] for e in REFUSED]
)
def test_what_cannot_be_understood_is_refused_with_its_shape(
    tmp_path: Path, outputs: list[Table], names: dict[int, str] | None, words: list[str]
) -> None:
    said: dict[str, object] | None = None if names is None else {"names": names}
    arrays = [output.astype(np.float32) for output in outputs]
    model = constant_model(tmp_path / "m.onnx", *arrays, canvas=(SIDE, SIDE), metadata=said)
    with pytest.raises(ModelError) as caught:
        OnnxYolo(model)
    text = str(caught.value)
    assert "\n" not in text
    assert str(model) in text
    assert [word for word in words if word not in text] == []


def test_feature_maps_beside_the_boxes_are_not_needed(tmp_path: Path) -> None:
    """Older exports of YOLOv5 write both."""
    boxes = FOUND[[entry[0] for entry in FOUND].index("YOLOv5 with eight classes")][1]
    outputs = [boxes, np.zeros((3, 80, 80, 13)), np.zeros((3, 40, 40, 13))]
    arrays = [output.astype(np.float32) for output in outputs]
    said: dict[str, object] = {"names": EIGHT}
    model = constant_model(tmp_path / "m.onnx", *arrays, canvas=(SIDE, SIDE), metadata=said)
    assert_both(OnnxYolo(model).detect(0, np.zeros((SIDE, SIDE, 3), np.uint8)), True)


def echo(path: Path, kind: int, last: bool) -> Path:
    """A model whose score is the mean of the first channel's samples, as a share of 255."""
    shape: list[int | str] = [1, SIDE, SIDE, 3] if last else [1, 3, SIDE, SIDE]
    axes = [1, 2] if last else [2, 3]
    nodes = [
        helper.make_node("Cast", ["images"], ["floats"], to=1),
        helper.make_node("ReduceMean", ["floats"], ["means"], axes=axes, keepdims=0),
        helper.make_node("Slice", ["means", "start", "end", "axis"], ["first"]),
        helper.make_node("Mul", ["first", "scale"], ["score"]),
        helper.make_node("Concat", ["box", "score", "class"], ["row"], axis=1),
        helper.make_node("Unsqueeze", ["row", "axis"], ["output"]),
    ]
    constants: dict[str, NDArray[np.generic]] = {
        "start": np.array([0]),
        "end": np.array([1]),
        "axis": np.array([1]),
        "scale": np.array(1.0 if kind != 2 else 1 / 255, np.float32),
        "box": np.array([CAR], np.float32),
        "class": np.array([[0]], np.float32),
    }
    model = save_model(path, nodes, constants, shape, {"output": [1, 1, 6]}, {"names": NAMES})
    import onnx

    loaded = onnx.load(str(model))
    loaded.graph.input[0].type.tensor_type.elem_type = kind
    loaded.graph.output[0].type.tensor_type.elem_type = 1
    onnx.save(loaded, str(model))
    return model


@pytest.mark.parametrize("last", [False, True], ids=["NCHW", "NHWC"])
@pytest.mark.parametrize("kind", [1, 2, 10, 11], ids=["float", "uint8", "half", "double"])
def test_inputs_of_every_type_and_order_get_the_same_image(
    tmp_path: Path, kind: int, last: bool
) -> None:
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    image[:, :, 2] = 204  # red, which comes first in the model
    (row,) = OnnxYolo(echo(tmp_path / "m.onnx", kind, last)).detect(0, image)
    assert row["score"] == pytest.approx(0.8, abs=5e-3)


def test_an_input_of_other_types_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"tensor\(int8\), expected one input Bx3xHxW or BxHxWx3"):
        OnnxYolo(echo(tmp_path / "m.onnx", 3, False))


@pytest.mark.parametrize("batch", [4, "batch"])
def test_tables_of_several_images_are_kept_apart(tmp_path: Path, batch: int | str) -> None:
    detector = OnnxYolo(model_of(tmp_path, FOUND[0][1], NAMES, batch=batch))
    for rows in detector.detect_batch([np.zeros((SIDE, SIDE, 3), np.uint8)] * 5):
        assert_both(rows, True)


def test_names_that_are_no_vehicles_are_listed(tmp_path: Path) -> None:
    names = {0: "car", 1: "LKW", 2: "Motorrad"}
    settings = DetectorSettings()
    detector = make_detector(model_of(tmp_path, FOUND[0][1], names), settings)
    (remark,) = remarks_on(detector, settings)
    assert "taken for vehicles: car; not taken: LKW, Motorrad" in remark
    assert "English words such as car, van, truck" in remark
    with pytest.raises(ModelError, match="classes PKW, LKW, expected at least one of car, van"):
        OnnxYolo(model_of(tmp_path, FOUND[0][1], {0: "PKW", 1: "LKW"}))
    coco = make_detector(model_of(tmp_path, FOUND[0][1], None), settings)
    assert list(remarks_on(coco, settings)) == []


def test_a_class_that_appears_later_without_a_name_is_refused(tmp_path: Path) -> None:
    rows = np.array([[*CAR, 0.9, 0.0], [*TRUCK, 0.8, 7.0]])
    detector = OnnxYolo(without_batch(tmp_path / "m.onnx", rows, NAMES, False))
    with pytest.raises(ModelError, match="class number 7 of 2 classes"):
        detector.detect(0, np.full((SIDE, SIDE, 3), 255, np.uint8))
