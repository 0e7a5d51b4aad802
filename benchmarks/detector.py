"""What the detectors cost beside what they can't do without.

ONNX: everything around `session.run` (letterbox, decoding, suppression, tables) at 1920x1080, after
the image was decoded, for each layout, as a share of 3 ms. The model writes random boxes of the
size a 640 x 640 export has, so that its own cost is small and the difference is exact.

Processor time on one thread, so that a busy machine changes little.

Motion: frames per second of one core on a rendered scene at 1280x720, beside OpenCV's MOG2 alone
with shadows on the same images.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from geoorbit_ros.detection.motion import MotionDetector
from geoorbit_ros.detection.onnx_yolo import OnnxYolo, YoloOptions
from geoorbit_ros.scenes.render.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene

SIDE, CELLS, CLASSES = 640, 8400, 80
BUDGET_MS = 3.0
ROUNDS, BOXES = 40, 40
SCENE, SIZE, FPS, SECONDS = "straight_3x3", (1280, 720), 10.0, 20.0
WARM_FRAMES = 60
NEEDED_FPS = 25.0


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


def report(name: str, ratio: float, limit: float, note: str) -> None:
    print(json.dumps({"name": name, "ratio": round(ratio, 4), "limit": limit}), flush=True)
    print(f"{name}: {note}", file=sys.stderr)


def compare_onnx(layout: str, folder: Path) -> None:
    path = folder / f"{layout}.onnx"
    write_model(path, random_output(layout))
    detector = OnnxYolo(path, YoloOptions(providers=("CPUExecutionProvider",), threads=1))
    one_thread = onnxruntime.SessionOptions()
    one_thread.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        str(path), one_thread, providers=["CPUExecutionProvider"]
    )
    tensor = np.zeros((1, 3, SIDE, SIDE), np.float32)
    random = np.random.default_rng(2)
    image = cv2.GaussianBlur(random.integers(0, 256, (1080, 1920, 3), dtype=np.uint8), (9, 9), 0)
    jpeg = cv2.imencode(".jpg", image)[1]
    ours, bare = [], []
    for _ in range(ROUNDS):
        start = time.process_time()
        picture = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        detector.detect(0, np.asarray(picture))
        ours.append(time.process_time() - start)
        start = time.process_time()
        cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        session.run(None, {"images": tensor})
        bare.append(time.process_time() - start)
    extra_ms = 1e3 * (float(np.median(ours)) - float(np.median(bare)))
    bare_ms = 1e3 * float(np.median(bare))
    note = f"{extra_ms:.2f} ms over decoding and session.run ({bare_ms:.2f} ms)"
    report(f"onnx {layout}: extra cost at 1080p / 3 ms", extra_ms / BUDGET_MS, 1.0, note)


def compare_motion() -> None:
    detector, peer = MotionDetector(), cv2.createBackgroundSubtractorMOG2(detectShadows=True)
    ours, bare = [], []
    for frame in render_scene(load_scene(SCENE), SECONDS, 1, fps=FPS, image_size=SIZE):
        start = time.process_time()
        detector.detect(frame.stamp_ns, frame.image)
        ours.append(time.process_time() - start)
        start = time.process_time()
        peer.apply(frame.image)
        bare.append(time.process_time() - start)
    own_ms = 1e3 * float(np.median(ours[WARM_FRAMES:]))
    peer_ms = 1e3 * float(np.median(bare[WARM_FRAMES:]))
    slow_ms = 1e3 * float(np.percentile(ours[WARM_FRAMES:], 99))
    note = f"{1e3 / own_ms:.0f} frames/s on one core, {own_ms:.1f} ms (99 %: {slow_ms:.1f} ms)"
    share = own_ms * NEEDED_FPS / 1e3
    report(f"motion: share of a core at 25 fps, {SIZE[0]}x{SIZE[1]}", share, 1.0, note)
    name = "motion: boxes / OpenCV's MOG2 mask alone"
    report(name, own_ms / peer_ms, 3.5, f"MOG2 {peer_ms:.1f} ms")


def main() -> None:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        for layout in ("raw", "nms_free", "grid"):
            compare_onnx(layout, Path(name))
    compare_motion()


if __name__ == "__main__":
    main()
