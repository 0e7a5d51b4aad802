"""Draws the figure of docs/markings.md: a rendered road, rectified, and the boundaries found.

.venv/bin/python docs/make_marking_figure.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.homography import fit_homography
from geoorbit_ros.calibration.plane import Homography
from geoorbit_ros.core.lanes import LaneMap
from geoorbit_ros.lanes.estimators.estimator import make_estimator
from geoorbit_ros.lanes.mapping.mapper import LaneMapper
from geoorbit_ros.lanes.pipeline import map_lanes, project_frames
from geoorbit_ros.markings.fusion import Road, find_roads, with_painted_edges
from geoorbit_ros.rendering.rendered_scene import render_scene
from geoorbit_ros.scenes.scene import load_scene
from geoorbit_ros.scenes.simulate import simulate

TARGET = Path(__file__).parent / "images" / "markings.jpg"
SCENE, SEED, DURATION_S = "straight_3x3", 1, 60.0
HEIGHT_PX = 560
COLOURS = {"solid": (60, 60, 230), "dashed": (220, 60, 220), "": (60, 220, 240)}
"""BGR of solid and dashed lines, and of boundaries by the traffic."""
Image = NDArray[np.uint8]


def rectified(road: Road) -> Image:
    """The road from above, the direction of travel upwards, with the lines that were found."""
    strip = road.strip
    image = strip.bgr[::-1, ::-1].astype(np.uint8)
    tall = cv2.resize(image, (330, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    across = (tall.shape[1] - 1) / (strip.offset_m[-1] - strip.offset_m[0])
    along = (tall.shape[0] - 1) / (strip.station_m[-1] - strip.station_m[0])
    for line in road.lines:
        known = np.isfinite(line.offset_m)
        x = (strip.offset_m[-1] - line.offset_m[known]) * across
        y = (strip.station_m[-1] - strip.station_m[known]) * along
        points = np.rint(np.column_stack((x, y))).astype(np.int32)
        cv2.polylines(tall, [points], False, COLOURS[line.kind], 1, cv2.LINE_AA)
    return np.asarray(tall, dtype=np.uint8)


def seen(image: Image, lane_map: LaneMap, plane: Homography) -> Image:
    """The camera's image with the boundaries of all lanes."""
    shown = image.copy()
    for lane in lane_map.lanes:
        for line, edge in ((lane.left_m, lane.left_edge), (lane.right_m, lane.right_edge)):
            colour = COLOURS[edge.marking if edge else ""]
            pixel = np.rint(plane.to_pixel(line)).astype(np.int32)
            cv2.polylines(shown, [pixel], False, colour, 3, cv2.LINE_AA)
    width = round(shown.shape[1] * HEIGHT_PX / shown.shape[0])
    small = cv2.resize(shown, (width, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def main() -> int:
    """Draw and write."""
    scene = load_scene(SCENE)
    run = simulate(scene, DURATION_S, SEED)
    plane = fit_homography(run.control_points)
    tracks = project_frames(run.frames, BoxProjector(plane, run.image_size))
    lanes = map_lanes(tracks, LaneMapper(make_estimator("curvilinear")))
    image = next(iter(render_scene(scene, 1.0, SEED, fps=1.0))).image
    roads = find_roads(lanes, image, plane)
    found = with_painted_edges(lanes, roads)
    gap = np.full((HEIGHT_PX, 12, 3), 255, np.uint8)
    figure = np.hstack((rectified(roads[0]), gap, seen(image, found, plane)))
    cv2.imwrite(str(TARGET), figure, [cv2.IMWRITE_JPEG_QUALITY, 82])
    print(TARGET)
    return 0


if __name__ == "__main__":
    sys.exit(main())
