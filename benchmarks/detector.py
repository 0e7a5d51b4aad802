"""What the motion detector costs.

Frames per second of one core on a rendered scene at 1280x720, beside OpenCV's MOG2 alone with
shadows on the same images. Processor time on one thread, so that a busy machine changes little.
The ONNX detector is in onnx_wrapper.py.
"""

from __future__ import annotations

import json
import sys
import time

import cv2
import numpy as np

from geoorbit_ros.detection.motion.detector import MotionDetector
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene

SCENE, SIZE, FPS, SECONDS = "straight_3x3", (1280, 720), 10.0, 20.0
WARM_FRAMES = 60
NEEDED_FPS = 25.0


def report(name: str, ratio: float, limit: float, note: str) -> None:
    print(json.dumps({"name": name, "ratio": round(ratio, 4), "limit": limit}), flush=True)
    print(f"{name}: {note}", file=sys.stderr)


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
    compare_motion()


if __name__ == "__main__":
    main()
