"""What the ONNX detector costs beside what no detector can do without.

Everything around `session.run` (letterbox, tensor, decoding, suppression, table) at 1920x1080,
after the image was decoded, for each layout, as a share of 3 ms. The model writes random boxes of
the size a 640 x 640 export has, so that its own cost is small and the difference is exact.

Each round decodes an image and detects in it, and decodes the same image and runs the bare session,
in one process and in changing order; reported are the differences within the rounds. Processor
time on one thread, so that a busy machine changes little.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from geoorbit_ros.detection.detector import DetectorSettings
from geoorbit_ros.detection.onnx.yolo import OnnxYolo

SIDE, CELLS, CLASSES = 640, 8400, 80
BUDGET_MS = 3.0
IMAGES, WARM_ROUNDS, ROUNDS, BOXES = 4, 5, 120, 40


def random_output(layout: str) -> NDArray[np.float32]:
    """What a model writes for a road with some vehicles: most cells see nothing."""
    random = np.random.default_rng(1)
    score = random.uniform(0.0, 0.05, (CELLS, CLASSES))
    seen = random.choice(CELLS, 5 * BOXES, replace=False)
    score[seen, 2] = random.uniform(0.3, 0.9, len(seen))
    centre = np.repeat(random.uniform(50, SIDE - 50, (BOXES, 2)), 5, axis=0)
    box = np.tile([0.0, 0.0, 30.0, 20.0], (CELLS, 1))
    box[seen, :2] = centre + random.normal(0.0, 1.0, centre.shape)
    if layout == "raw":
        return np.column_stack([box, score]).T.astype(np.float32)
    if layout == "grid":
        box[:, 2:] = np.log(box[:, 2:] / 16.0)
        box[:, :2] = random.uniform(0.0, 1.0, (CELLS, 2))
        return np.column_stack([box, np.sqrt(score.max(axis=1)), np.sqrt(score)]).astype(np.float32)
    half = 0.5 * box[seen, 2:]
    corners = np.column_stack([box[seen, :2] - half, box[seen, :2] + half])
    rows = np.column_stack([corners, score[seen, 2], np.full(len(seen), 2)])
    return np.vstack([rows, np.zeros((300 - len(rows), 6))]).astype(np.float32)


def write_model(path: Path, output: NDArray[np.float32]) -> None:
    """A model that writes `output`, and looks at one pixel of its input."""
    nodes = [
        helper.make_node("Slice", ["images", "from", "to", "axes"], ["pixel"]),
        helper.make_node("ReduceMean", ["pixel"], ["mean"], axes=[1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "boxes"], ["output"]),
    ]
    constants = {
        "from": np.array([0, 0]),
        "to": np.array([1, 1]),
        "axes": np.array([2, 3]),
        "zero": np.zeros(1, np.float32),
        "boxes": output[None],
    }
    given = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, SIDE, SIDE])
    made = helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, *output.shape])
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "benchmark", [given], [made], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, str(path))


def report(name: str, ratio: float, limit: float | None, note: str) -> None:
    """Print one ratio for the runner and, with a note, for a reader."""
    line: dict[str, object] = {"name": name, "ratio": round(ratio, 4)}
    if limit is not None:
        line["limit"] = limit
    print(json.dumps(line), flush=True)
    print(f"{name}: {note}", file=sys.stderr)


def images() -> list[NDArray[np.uint8]]:
    """Images of 1920 x 1080 as JPEG."""
    random = np.random.default_rng(2)
    noise = [random.integers(0, 256, (1080, 1920, 3), dtype=np.uint8) for _ in range(IMAGES)]
    images = [cv2.GaussianBlur(each, (9, 9), 0) for each in noise]
    return [np.asarray(cv2.imencode(".jpg", each)[1]) for each in images]


def spent_ms(work: Callable[[NDArray[np.uint8]], None], jpeg: NDArray[np.uint8]) -> float:
    """Processor time of one call."""
    start = time.process_time()
    work(jpeg)
    return 1e3 * (time.process_time() - start)


def compare(layout: str, folder: Path) -> None:
    """Report the extra cost of one layout."""
    path = folder / f"{layout}.onnx"
    write_model(path, random_output(layout))
    detector = OnnxYolo(path, DetectorSettings(providers=("CPUExecutionProvider",), threads=1))
    one_thread = onnxruntime.SessionOptions()
    one_thread.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        str(path), one_thread, providers=["CPUExecutionProvider"]
    )
    tensor = np.zeros((1, 3, SIDE, SIDE), np.float32)
    jpegs = images()

    def ours(jpeg: NDArray[np.uint8]) -> None:
        detector.detect(0, np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR)))

    def bare(jpeg: NDArray[np.uint8]) -> None:
        cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        session.run(None, {"images": tensor})

    rounds = []
    for k in range(WARM_ROUNDS + ROUNDS):
        order = (ours, bare) if k % 2 else (bare, ours)
        spent = {work: spent_ms(work, jpegs[k % IMAGES]) for work in order}
        rounds.append((spent[ours], spent[bare]))
    own_ms, bare_ms = np.array(rounds[WARM_ROUNDS:]).T
    low, middle, high = np.percentile(own_ms - bare_ms, [10, 50, 90]).tolist()
    note = f"{middle:.2f} ms over {np.median(bare_ms):.2f} ms of decoding and session.run"
    spread = f"10 to 90 % of the rounds: {low:.2f} to {high:.2f} ms"
    report(f"onnx {layout}: extra cost at 1080p / 3 ms", middle / BUDGET_MS, 1.0, note)
    report(f"onnx {layout}: the same, 90 % of the rounds", high / BUDGET_MS, None, spread)


def main() -> None:
    """Measure all layouts."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        for layout in ("raw", "nms_free", "grid"):
            compare(layout, Path(name))


if __name__ == "__main__":
    main()
