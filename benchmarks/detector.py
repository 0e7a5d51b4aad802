"""What the detectors without a YOLO model cost.

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

from geoorbit_ros.detection.detector import Detector
from geoorbit_ros.detection.motion.detector import MotionDetector
from geoorbit_ros.detection.network.detector import NetworkDetector
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene

SCENE, SIZE, FPS, SECONDS = "straight_3x3", (1280, 720), 10.0, 20.0
WARM_FRAMES = 60
NEEDED_FPS = 25.0


def report(name: str, ratio: float, limit: float, note: str) -> None:
    print(json.dumps({"name": name, "ratio": round(ratio, 4), "limit": limit}), flush=True)
    print(f"{name}: {note}", file=sys.stderr)


def compare() -> None:
    detectors: dict[str, Detector] = {"network": NetworkDetector(), "motion": MotionDetector()}
    peer = cv2.createBackgroundSubtractorMOG2(detectShadows=True)
    times: dict[str, list[float]] = {name: [] for name in (*detectors, "MOG2")}
    for frame in render_scene(load_scene(SCENE), SECONDS, 1, fps=FPS, image_size=SIZE):
        for name, detector in detectors.items():
            start = time.process_time()
            detector.detect(frame.stamp_ns, frame.image)
            times[name].append(time.process_time() - start)
        start = time.process_time()
        peer.apply(frame.image)
        times["MOG2"].append(time.process_time() - start)
    median_ms = {name: 1e3 * float(np.median(t[WARM_FRAMES:])) for name, t in times.items()}
    for name in detectors:
        own_ms = median_ms[name]
        slow_ms = 1e3 * float(np.percentile(times[name][WARM_FRAMES:], 99))
        note = f"{1e3 / own_ms:.0f} frames/s on one core, {own_ms:.1f} ms (99 %: {slow_ms:.1f} ms)"
        share = own_ms * NEEDED_FPS / 1e3
        report(f"{name}: share of a core at 25 fps, {SIZE[0]}x{SIZE[1]}", share, 1.0, note)
    ratio = median_ms["motion"] / median_ms["MOG2"]
    note = f"MOG2 {median_ms['MOG2']:.1f} ms"
    report("motion: boxes / OpenCV's MOG2 mask alone", ratio, 3.5, note)


def main() -> None:
    cv2.setNumThreads(1)
    compare()


if __name__ == "__main__":
    main()
