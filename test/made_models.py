"""Small ONNX models whose output is a known function of their input."""

from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET, IR_VERSION = 17, 8


def save_model(
    path: Path,
    nodes: list[onnx.NodeProto],
    constants: dict[str, NDArray[np.generic]],
    input_shape: list[int | str],
    output_shapes: dict[str, list[int | str] | None],
    metadata: dict[str, object] | None,
    half: bool = False,
    whole: tuple[int, ...] = (),
    sizes: str = "",
) -> Path:
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "made",
        [
            helper.make_tensor_value_info("images", kind, input_shape),
            *(helper.make_tensor_value_info(n, TensorProto.INT64, ["N", 2]) for n in sizes.split()),
        ],
        [
            helper.make_tensor_value_info(n, TensorProto.INT64 if k in whole else kind, s)
            for k, (n, s) in enumerate(output_shapes.items())
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = IR_VERSION
    if metadata is not None:
        helper.set_model_props(model, {key: str(value) for key, value in metadata.items()})
    onnx.save(model, str(path))
    return path


def constant_model(
    path: Path,
    *outputs: NDArray[np.float32],
    canvas: tuple[int, int],
    metadata: dict[str, object] | None = None,
    batch: int | str = 1,
    dynamic_size: bool = False,
    half: bool = False,
    whole: tuple[int, ...] = (),
) -> Path:
    """Writes `outputs`, each (A, …), for every image of a batch, whatever is on it.

    Those named in `whole` are written as int64.
    """
    dtype = np.float16 if half else np.float32
    width, height = canvas
    size: list[int | str] = ["height", "width"] if dynamic_size else [height, width]
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
    ]
    constants: dict[str, NDArray[np.generic]] = {"zero": np.zeros(1, dtype)}
    for k, output in enumerate(outputs):
        constants[f"axes{k}"] = np.arange(1, output.ndim + 1)
        constants[f"constant{k}"] = output[None].astype(dtype)
        nodes.append(helper.make_node("Unsqueeze", ["nothing", f"axes{k}"], [f"shaped{k}"]))
        made = f"float{k}" if k in whole else f"output{k}"
        nodes.append(helper.make_node("Add", [f"shaped{k}", f"constant{k}"], [made]))
        if k in whole:
            nodes.append(helper.make_node("Cast", [made], [f"output{k}"], to=TensorProto.INT64))
    shapes: dict[str, list[int | str] | None] = {
        f"output{k}": [batch, *output.shape] for k, output in enumerate(outputs)
    }
    return save_model(path, nodes, constants, [batch, 3, *size], shapes, metadata, half, whole)


def red_finder(
    path: Path,
    layout: str,
    canvas: tuple[int, int],
    cells: int,
    metadata: dict[str, object] | None,
    *,
    bgr: bool = False,
    scale: float = 1.0,
    dynamic: bool = False,
) -> Path:
    """Writes one box of class 0 with score 1 around all pixels that are pure red.

    Args:
        path: Where it goes.
        layout: `raw`, `nms_free` or `grid`.
        canvas: Width and height of the input.
        cells: Boxes in the output; all but the first are empty.
        metadata: Of the file.
        bgr: Whether blue is the first channel.
        scale: The brightest sample.
        dynamic: Whether batch and size are left open.
    """
    red, blue = (2, 0) if bgr else (0, 2)
    weights = np.zeros((1, 3, 1, 1), np.float32)
    weights[0, red], weights[0, 1], weights[0, blue] = 1.0, -1.0, -1.0
    nodes = [
        helper.make_node("Conv", ["images", "weights"], ["redness"]),
        helper.make_node("Greater", ["redness", "threshold"], ["is_red"]),
        helper.make_node("Cast", ["is_red"], ["red"], to=TensorProto.FLOAT),
    ]
    constants: dict[str, NDArray[np.generic]] = {
        "weights": weights,
        "threshold": np.array(0.5 * scale, np.float32),
        "one": np.array(1.0, np.float32),
    }
    for axis, other, low, high in ((3, 2, "left", "right"), (2, 3, "top", "bottom")):
        # ArgMax gives the first of the red columns, or from behind the last.
        line = f"line{axis}"
        nodes += [
            helper.make_node("ReduceMax", ["red"], [line], axes=[1, other], keepdims=0),
            helper.make_node("ArgMax", [line], [f"{low}_i"], axis=1, keepdims=1),
            helper.make_node(
                "ArgMax", [line], [f"{high}_i"], axis=1, keepdims=1, select_last_index=1
            ),
            helper.make_node("Cast", [f"{low}_i"], [low], to=TensorProto.FLOAT),
            helper.make_node("Cast", [f"{high}_i"], [f"{high}_f"], to=TensorProto.FLOAT),
            helper.make_node("Add", [f"{high}_f", "one"], [high]),
        ]
    nodes += _box_nodes(layout, constants)
    rest = {"raw": [0, 0, 0, 0, 0, cells - 1], "nms_free": [0, 0, 0, 0, cells - 1, 0]}
    constants["rest"] = np.array(rest.get(layout, rest["nms_free"]), np.int64)
    nodes.append(helper.make_node("Pad", ["first", "rest"], ["output"]))
    width, height = canvas
    size: list[int | str] = ["batch", 3, "height", "width"] if dynamic else [1, 3, height, width]
    return save_model(path, nodes, constants, size, {"output": None}, metadata)


def _box_nodes(layout: str, constants: dict[str, NDArray[np.generic]]) -> list[onnx.NodeProto]:
    """Numbers of the first box, each (B, 1), joined to `first`."""
    constants |= {"half": np.array(0.5, np.float32), "eight": np.array(8.0, np.float32)}
    constants |= {"last": np.array([-1]), "middle": np.array([1])}
    nodes = [
        helper.make_node("Mul", ["left", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "one"], ["score"]),
    ]
    constants["zero"] = np.array(0.0, np.float32)
    if layout == "nms_free":
        parts = ["left", "top", "right", "bottom", "score", "nothing"]
    else:
        for low, high, centre, size in (("left", "right", "x", "w"), ("top", "bottom", "y", "h")):
            nodes += [
                helper.make_node("Add", [low, high], [f"{centre}2"]),
                helper.make_node("Mul", [f"{centre}2", "half"], [centre]),
                helper.make_node("Sub", [high, low], [size]),
                # In the first cell, which is at (0, 0) and 8 pixels wide.
                helper.make_node("Div", [centre, "eight"], [f"{centre}_cell"]),
                helper.make_node("Div", [size, "eight"], [f"{size}_cell"]),
                helper.make_node("Log", [f"{size}_cell"], [f"{size}_log"]),
            ]
        parts = ["x", "y", "w", "h", "score", "nothing"]
        if layout == "grid":
            parts = ["x_cell", "y_cell", "w_log", "h_log", "score", "score", "nothing"]
    nodes.append(helper.make_node("Concat", parts, ["flat"], axis=1))
    axes = "last" if layout == "raw" else "middle"
    nodes.append(helper.make_node("Unsqueeze", ["flat", axes], ["first"]))
    return nodes
