"""Draws vehicles, their trails, lanes and road segments into the camera's image."""

from __future__ import annotations

import colorsys
import itertools
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.homography import Homography
from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.lanes import Lane, LaneMap
from geoorbit_ros.core.tables import FLAG_PREDICTED
from geoorbit_ros.detection.detector import Image
from geoorbit_ros.detection.road_segments import RoadSegments
from geoorbit_ros.report.lane_drawing import direction_groups
from geoorbit_ros.report.text import compass

Colour = tuple[int, int, int]

TRAIL_FRAMES = 40
"""Length of a trail. Chosen: longer covers the image in dense traffic."""
TRAIL_MAX_AGE_FRAMES = 10
"""Trails of vehicles that have not been seen for this long are removed. Chosen: a short gap in a
track does not cut its trail."""
MIN_LABEL_PX = 20.0
"""Lower boxes have no label, in an image of 720 lines. Chosen: the label would be longer than the
vehicle."""
LEAST_TEXT_SCALE = 0.85
"""Text is scaled with the image's height (1 at 720 lines), but not below this. Chosen: smaller text
can't be read."""
LANE_OPACITY = 0.35
"""Of the lanes' colours over the image. Chosen: lanes and vehicles are both visible."""
HEAT_SHARE = 0.55
"""Of the hottest colour over the image. Chosen: the road below stays visible."""
_DIRECTIONS: tuple[Colour, ...] = (
    (230, 170, 60),
    (70, 160, 250),
    (120, 200, 90),
    (200, 110, 200),
    (80, 220, 230),
    (150, 150, 250),
)
"""Colours of the lanes by direction of travel, as blue, green, red."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BLACK = (0, 0, 0)
"""Of the rim of text. OpenCV's font has ASCII only."""
_WHITE, _GREY, _DARK = (255, 255, 255), (170, 170, 170), (60, 30, 20)
"""Outlines and captions, predicted boxes, and the rim of road segments."""
_NAMES = {2: "car", 3: "motorcycle", 5: "bus", 7: "truck"}
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
"""OpenCV takes coordinates as whole numbers of 1/16 pixel."""


class ImageOverlay:
    """Draws into the images of one camera, one after the other.

    Args:
        homography: The road plane; None: lanes are not drawn.
    """

    def __init__(self, homography: Homography | None) -> None:
        self._homography = homography
        self._trails: dict[int, deque[NDArray[np.float64]]] = {}
        self._seen: dict[int, int] = {}
        self._frame = 0
        self._lanes_of: LaneMap | None = None
        self._layer: Image | None = None

    def draw(
        self,
        image: Image,
        tracks: NDArray[np.void],
        ground: NDArray[np.void] | None,
        lane_map: LaneMap | None,
        caption: str,
    ) -> Image:
        """A new image with everything drawn into it.

        Args:
            image: (H, W, 3) uint8 BGR.
            tracks: `PIXEL_TRACK_DTYPE` of this frame.
            ground: `TRACK_DTYPE` of this frame, for the speeds; None shows none.
            lane_map: The lanes known now.
            caption: Line in the upper left corner.
        """
        self._frame += 1
        scale = max(image.shape[0] / 720.0, 0.5)
        drawn = self._with_lanes(image, lane_map, scale)
        speed: dict[int, float] = {}
        if ground is not None:
            speeds_m_s = np.hypot(ground["vx"], ground["vy"])
            speed = dict(zip(ground["track_id"].tolist(), speeds_m_s, strict=True))
        self._remember(tracks)
        for track_id, trail in self._trails.items():
            points = np.array(trail)
            cv2.polylines(
                drawn,
                [_fixed(points)],
                isClosed=False,
                color=id_colour(track_id),
                thickness=max(round(1.5 * scale), 1),
                lineType=cv2.LINE_AA,
                shift=_SHIFT,
            )
        for row in tracks:
            _draw_box(drawn, row, speed.get(int(row["track_id"])), scale)
        text = _text_scale(scale)
        write_text(drawn, caption, (round(12 * text), round(28 * text)), 0.7 * text, _WHITE)
        return drawn

    def _remember(self, tracks: NDArray[np.void]) -> None:
        """Append the middle of each box's lower edge to its trail; remove old trails."""
        for row in tracks:
            if not row["flags"] & FLAG_PREDICTED:
                key = int(row["track_id"])
                foot = np.array([row["x"], row["y"] + 0.5 * row["height"]], dtype=np.float64)
                self._trails.setdefault(key, deque(maxlen=TRAIL_FRAMES)).append(foot)
                self._seen[key] = self._frame
        old = [k for k, at in self._seen.items() if self._frame - at > TRAIL_MAX_AGE_FRAMES]
        for key in old:
            del self._seen[key], self._trails[key]

    def _with_lanes(self, image: Image, lane_map: LaneMap | None, scale: float) -> Image:
        """A copy of the image with the lanes in the colour of their direction."""
        if lane_map is None or not lane_map.lanes or self._homography is None:
            return image.copy()
        if self._layer is None or self._lanes_of is not lane_map:
            self._lanes_of, self._layer = lane_map, np.zeros_like(image)
            self._draw_lanes(self._layer, lane_map.lanes, scale)
        return np.asarray(cv2.addWeighted(image, 1.0, self._layer, LANE_OPACITY, 0.0), np.uint8)

    def _draw_lanes(self, layer: Image, lanes: Sequence[Lane], scale: float) -> None:
        group = direction_groups(lanes)
        thin = max(round(scale), 1)
        for lane in lanes:
            colour = _DIRECTIONS[group[lane.lane_id] % len(_DIRECTIONS)]
            outline = self._pixels(np.vstack((lane.left_m, lane.right_m[::-1])), layer)
            centre = self._pixels(lane.centerline_m, layer)
            if len(outline) < 3 or len(centre) < 2:
                continue
            if lane.status == "confirmed":
                cv2.fillPoly(layer, [_fixed(outline)], colour, cv2.LINE_AA, _SHIFT)
            cv2.polylines(layer, [_fixed(outline)], True, _WHITE, thin, cv2.LINE_AA, _SHIFT)
            self._draw_arrow(layer, lane, scale)

    def _draw_arrow(self, layer: Image, lane: Lane, scale: float) -> None:
        """An arrow along the direction of travel, with number, direction and width."""
        x, y, heading = lane.middle
        middle, step = np.array([x, y]), 3.0 * np.array([np.cos(heading), np.sin(heading)])
        ends = self._pixels(np.stack((middle - step, middle + step)), layer)
        if len(ends) == 2:
            start, tip = (tuple(map(int, np.rint(end))) for end in ends)
            cv2.arrowedLine(
                layer, start, tip, _WHITE, max(round(2 * scale), 1), cv2.LINE_AA, 0, 0.4
            )
            text = f"{lane.lane_id} {compass(lane.heading_deg)} {lane.width_m:.1f} m"
            size = 0.5 * _text_scale(scale)
            cv2.putText(layer, text, tip, _FONT, size, _WHITE, max(round(scale), 1), cv2.LINE_AA)

    def _pixels(self, ground_m: NDArray[np.float64], image: Image) -> NDArray[np.float64]:
        """(M, 2) pixels of those ground points (N, 2) that lie in or near the image."""
        assert self._homography is not None  # without one no lanes are drawn
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = self._homography.to_pixel(ground_m)
        size = np.array([image.shape[1], image.shape[0]])
        near = np.all((pixel > -size) & (pixel < 2 * size), axis=1)  # NaN is not
        return pixel[near]


def id_colour(track_id: int) -> Colour:
    """A bright colour for each id, far from those of the ids before it (golden angle)."""
    red, green, blue = colorsys.hsv_to_rgb((0.618034 * track_id) % 1.0, 0.65, 1.0)
    return round(255 * blue), round(255 * green), round(255 * red)


def _draw_box(image: Image, row: np.void, speed_m_s: float | None, scale: float) -> None:
    predicted = bool(row["flags"] & FLAG_PREDICTED)
    colour = _GREY if predicted else id_colour(int(row["track_id"]))
    half = np.array([row["width"], row["height"]]) / 2
    centre = np.array([row["x"], row["y"]])
    low, high = np.rint(centre - half).astype(int), np.rint(centre + half).astype(int)
    corners = (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))
    thickness = 1 if predicted else max(round(2 * scale), 1)
    cv2.rectangle(image, *corners, color=colour, thickness=thickness)
    letters = _text_scale(scale)
    if predicted or row["height"] < MIN_LABEL_PX * letters:
        return
    text = f"{row['track_id']} {_NAMES.get(int(row['class_id']), '')}".strip()
    if speed_m_s is not None and np.isfinite(speed_m_s):
        text += f" {3.6 * speed_m_s:.0f} km/h"
    above = (corners[0][0], corners[0][1] - round(4 * scale))
    write_text(image, text, above, 0.42 * letters, colour)


def _text_scale(scale: float) -> float:
    return max(scale, LEAST_TEXT_SCALE)


def _fixed(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.asarray(np.rint(points * 2**_SHIFT), np.int32).reshape(-1, 1, 2)


def draw_segments(image: Image, segments: RoadSegments) -> Image:
    """The image with the heat map of detections over it and the road segments outlined."""
    size = (image.shape[1], image.shape[0])
    strength = np.log1p(segments.heat)
    strength = strength / max(float(strength.max()), 1e-6)
    level = cv2.resize(strength, size, interpolation=cv2.INTER_LINEAR)
    heat = cv2.applyColorMap(np.asarray(255 * level, dtype=np.uint8), cv2.COLORMAP_INFERNO)
    share = (HEAT_SHARE * np.sqrt(level))[..., None]
    drawn = (image * (1.0 - share) + heat * share).astype(np.uint8)
    outlines = [np.rint(contour).astype(np.int32)[:, None] for contour in segments.contours]
    for colour, width in ((_DARK, 5), (_WHITE, 2)):
        cv2.polylines(drawn, outlines, True, colour, width, cv2.LINE_AA)
    return np.asarray(drawn, dtype=np.uint8)


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a .png or .jpg.

    Raises:
        InputFileError: It can't be written there.
    """
    _, data = cv2.imencode(path.suffix, image)
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise InputFileError(str(path), error.strerror or str(error), "a place to write") from None


def write_text(
    image: NDArray[np.uint8],
    text: str,
    at: tuple[int, int],
    size: float,
    colour: tuple[int, int, int],
    thickness: int = 1,
) -> None:
    """Draw `text` with a black rim, its lower left corner `at`, into `image`.

    The rim is the same text drawn around: since OpenCV 5 thicker letters are also wider, so a thick
    black text would not lie behind a thin coloured one.
    """
    step = max(round(size), 1)
    for dx, dy in itertools.product((-step, 0, step), repeat=2):
        place = (at[0] + dx, at[1] + dy)
        cv2.putText(image, text, place, _FONT, size, _BLACK, thickness, cv2.LINE_AA)
    cv2.putText(image, text, at, _FONT, size, colour, thickness, cv2.LINE_AA)


def text_width(text: str, size: float, thickness: int = 1) -> int:
    """Pixels that `write_text` takes from left to right, the rim included."""
    return int(cv2.getTextSize(text, _FONT, size, thickness)[0][0]) + 2 * max(round(size), 1)
