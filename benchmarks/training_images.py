"""Labelled films and images, cut and changed at random, for training the vehicle network.

A folder holds films with `truth/NAME.csv` and `truth/NAME.unsure.csv` as `benchmarks/clips.py`
reads them (a sixth column `class` is optional), or images `images/NAME.jpg` with
`labels/NAME.txt` in YOLO's format and, beside them, `classes.txt` with one class of the network, or
`vehicle`, per line.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.detection.motion.background_samples import most_usual
from geoorbit_ros.detection.network.channels import (
    CHANNELS,
    LARGEST_SCALE,
    PAST_S,
    STRIDE_PX,
    WORK_AREA_PX,
    channels,
)
from vehicle_network import CLASSES

Array = NDArray[np.float32]
Image = NDArray[np.uint8]

CROP = (288, 192)
"""Width and height of what is trained on."""
KEPT_WIDTH_PX = 960
"""Wider images are kept at this width."""
FILMS = (".mp4", ".avi", ".m4v", ".mkv", ".mov", ".wmv", ".webm")
MEDIAN_IMAGES = 31
SCALES = (0.5, 2.0)
"""Range of scales, beside that at which the detector works."""
OF_EVEN_SIZE, HEIGHTS_PX, WIDEST_SCALES = 0.5, (8.0, 110.0), (0.35, 3.5)
"""In so many examples one vehicle gets a height of this range, small and large ones equally often,
as far as that takes no scale beyond the third."""
ON_VEHICLES = 0.75
"""Share of cuts that have a vehicle; the others are anywhere."""
NO_ROAD, NO_PAST, NEITHER = 0.1, 0.1, 0.25
"""Shares of examples without these channels: the first image, single images, standing vehicles."""
OTHER_ROAD = 0.08
"""Share of examples in which the empty road shows another image of the film: as long as a detector
does not know it, the road has vehicles on it."""
LEAST_PX = 5.0
"""Boxes that are less high than this at the network's scale are neither right nor wrong."""
LEAST_SEEN, LEAST_INSIDE = 0.02, 0.4
"""So are boxes of which more than the first and less than the second share is inside the cut."""
UNKNOWN = -1
"""Class of a box that has none of the network's."""


@dataclass(frozen=True)
class Example:
    """One labelled image.

    Attributes:
        image: (H, W, 3) uint8.
        road: The empty road, or None.
        past: The image shortly before, or None.
        boxes: (N, 5) left, top, right, bottom in pixels and class.
        unsure: (M, 4) regions that are neither right nor wrong.
        scale: Factor at which the detector works on such images.
    """

    image: Image
    road: Image | None
    past: Image | None
    boxes: Array
    unsure: Array
    scale: float


def read_examples(folder: Path) -> Iterator[list[Example]]:
    """The examples of each film of a folder, and of all of its images together."""
    for path in sorted(f for f in folder.iterdir() if f.suffix.lower() in FILMS):
        truth = _table(folder / "truth" / f"{path.stem}.csv")
        if truth:
            yield _film(path, truth, _table(folder / "truth" / f"{path.stem}.unsure.csv"))
    if (folder / "images").is_dir():
        yield list(_images(folder))


def _table(file: Path) -> dict[int, Array]:
    """(N, 5) boxes and classes by frame."""
    found: dict[int, list[list[float]]] = defaultdict(list)
    if file.exists():
        with file.open(newline="", encoding="utf-8") as lines:
            for row in csv.DictReader(lines):
                boxes = found[int(row["frame"])]
                if row["x1"]:
                    sides = [float(row[name]) for name in ("x1", "y1", "x2", "y2")]
                    boxes.append([*sides, float(row.get("class") or UNKNOWN)])
    return {frame: np.array(rows, np.float32).reshape(-1, 5) for frame, rows in found.items()}


def _film(path: Path, truth: dict[int, Array], unsure: dict[int, Array]) -> list[Example]:
    video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS)
    gap = max(round((rate if 1.0 < rate < 130.0 else 25.0) * PAST_S), 1)
    last = max(truth)
    step = max((last + 1) // MEDIAN_IMAGES, 1)
    wanted = set(truth) | {number - gap for number in truth} | set(range(step // 2, last, step))
    views: dict[int, Image] = {}
    factor = 1.0
    for number in range(last + 1):
        if not video.grab():
            break
        if number in wanted:
            image = video.retrieve()[1]
            factor = min(KEPT_WIDTH_PX / image.shape[1], 1.0)
            small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
            views[number] = np.asarray(small, np.uint8)
    for_road = [views[k] for k in range(step // 2, last, step) if k in views]
    road = most_usual(for_road[:MEDIAN_IMAGES])
    scale, none = _work_scale(road), np.zeros((0, 5), np.float32)
    found = []
    for k in sorted(truth.keys() & views.keys()):
        boxes, left_out = _scaled(truth[k], factor), _scaled(unsure.get(k, none), factor)
        found.append(
            Example(views[k], road, views.get(k - gap, views[k]), boxes, left_out[:, :4], scale)
        )
    return found


def _images(folder: Path) -> Iterator[Example]:
    names = (folder / "classes.txt").read_text(encoding="utf-8").split()
    numbers = [CLASSES.index(n) if n in CLASSES else UNKNOWN for n in names]
    for path in sorted((folder / "images").iterdir()):
        labels = folder / "labels" / f"{path.stem}.txt"
        image = cv2.imread(str(path))
        if image is None or not labels.exists():
            continue
        factor = min(KEPT_WIDTH_PX / image.shape[1], 1.0)
        small = np.asarray(
            cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
        height, width = small.shape[:2]
        boxes = []
        for line in labels.read_text(encoding="utf-8").splitlines():
            parts = line.split()
            if len(parts) == 5:
                kind, x, y, w, h = (float(part) for part in parts)
                sides = [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
                sides = [s * (width, height)[k % 2] for k, s in enumerate(sides)]
                boxes.append([*sides, numbers[int(kind)]])
        rows = np.array(boxes, np.float32).reshape(-1, 5)
        yield Example(small, None, None, rows, np.zeros((0, 4), np.float32), _work_scale(small))


def _work_scale(image: Image) -> float:
    pixels = image.shape[0] * image.shape[1]
    return float(min((WORK_AREA_PX / pixels) ** 0.5, LARGEST_SCALE))


def _scaled(rows: Array, factor: float) -> Array:
    scaled = rows.copy()
    scaled[:, :4] *= factor
    return scaled


def cut(
    example: Example, others: list[Example], random: np.random.Generator
) -> tuple[Image, Array, Array]:
    """A random cut of an example at a random scale, its colours changed: input, boxes, unsure."""
    part = _random_part(example, random)
    road, past = _random_views(example, others, random)
    views = [_view(v, part) for v in (example.image, road, past) if v is not None]
    seen, *rest = _recoloured(views, random)
    new_road = rest.pop(0) if road is not None else None
    new_past = rest.pop(0) if past is not None else None
    stack = channels(seen, new_road, new_past)
    offset, factor = np.array([part.left, part.top] * 2), np.array([part.across, part.down] * 2)
    boxes = example.boxes.copy()
    boxes[:, :4] = (boxes[:, :4] - offset) * factor
    unsure = (example.unsure - offset) * factor
    if random.random() < 0.5:
        stack = np.ascontiguousarray(stack[:, ::-1])
        boxes[:, [0, 2]] = CROP[0] - boxes[:, [2, 0]]
        unsure[:, [0, 2]] = CROP[0] - unsure[:, [2, 0]]
    return stack, *_inside(boxes, unsure)


@dataclass(frozen=True)
class _Part:
    """A part of an image: upper left corner in pixels, and the scales at which it is shown."""

    left: float
    top: float
    across: float
    down: float


def _random_part(example: Example, random: np.random.Generator) -> _Part:
    boxes = example.boxes
    chosen = boxes[random.integers(len(boxes))] if len(boxes) else None
    scale = example.scale * np.exp(random.uniform(*np.log(SCALES)))
    if chosen is not None and random.random() < OF_EVEN_SIZE:
        wanted = np.exp(random.uniform(*np.log(HEIGHTS_PX))) / max(chosen[3] - chosen[1], 1.0)
        scale = float(np.clip(wanted, *(example.scale * np.array(WIDEST_SCALES))))
    aspect = np.exp(random.uniform(-0.12, 0.12))
    scales = np.array([scale * aspect, scale / aspect])
    whole = np.array([example.image.shape[1], example.image.shape[0]])
    side = CROP / scales
    corner = random.uniform(0.0, np.maximum(whole - side, 1.0))
    if chosen is not None and random.random() < ON_VEHICLES:
        corner = 0.5 * (chosen[:2] + chosen[2:4]) - side * random.uniform(0.1, 0.9, 2)
    corner = np.clip(corner, np.minimum(0.0, whole - side), np.maximum(0.0, whole - side))
    return _Part(*corner.tolist(), *scales.tolist())


def _random_views(
    example: Example, others: list[Example], random: np.random.Generator
) -> tuple[Image | None, Image | None]:
    """The empty road and the past, or what a detector has in their place."""
    chance = random.random()
    if chance < NEITHER:
        return None, None
    road = None if chance < NEITHER + NO_ROAD else example.road
    past = None if NEITHER + NO_ROAD <= chance < NEITHER + NO_ROAD + NO_PAST else example.past
    if road is not None and random.random() < OTHER_ROAD:
        road = others[random.integers(len(others))].image
    return road, past


def _inside(boxes: Array, unsure: Array) -> tuple[Array, Array]:
    """Boxes as far as they are in the cut, and those that are hardly there as unsure ones."""
    border = [*CROP, *CROP]
    inside = boxes.copy()
    inside[:, :4] = np.clip(boxes[:, :4], 0, border)
    area = np.clip(boxes[:, 2:4] - boxes[:, :2], 1e-3, None).prod(axis=1)
    share = np.clip(inside[:, 2:4] - inside[:, :2], 0, None).prod(axis=1) / area
    there = share > LEAST_SEEN
    good = (share >= LEAST_INSIDE) & (inside[:, 3] - inside[:, 1] >= LEAST_PX)
    left_out = inside[there & ~good][:, :4]
    unsure = np.vstack((np.clip(unsure, 0, border), left_out)).astype(np.float32)
    return inside[there & good], unsure


def _view(image: Image, part: _Part) -> Image:
    """A part of an image at the size of the cut; beyond the image it is black."""
    scales = np.array([part.across, part.down])
    left, top = part.left, part.top
    if scales.prod() >= 1.0:
        # Pixels are squares: the middle of the first one is at a half, in the image and in the cut.
        x, y = 0.5 * (scales - 1.0) - scales * [left, top]
        matrix = np.array([[part.across, 0.0, x], [0.0, part.down, y]])
        return np.asarray(cv2.warpAffine(image, matrix, CROP, flags=cv2.INTER_LINEAR), np.uint8)
    height, width = image.shape[:2]
    side = CROP / scales
    a, b = max(int(left), 0), max(int(top), 0)
    c, d = min(int(np.ceil(left + side[0])), width), min(int(np.ceil(top + side[1])), height)
    size = np.maximum(np.rint((np.array([c, d]) - [a, b]) * scales), 1).astype(int)
    small = cv2.resize(image[b:d, a:c], size.tolist(), interpolation=cv2.INTER_AREA)
    right, down = np.rint((np.array([a, b]) - [left, top]) * scales)
    moved = np.array([[1.0, 0.0, right], [0.0, 1.0, down]])
    return np.asarray(cv2.warpAffine(small, moved, CROP, flags=cv2.INTER_NEAREST), np.uint8)


def _recoloured(views: list[Image], random: np.random.Generator) -> list[Image]:
    """All views in another light and seen by another camera, the same for all but the noise."""
    if random.random() < 0.8:
        gamma = np.exp(random.uniform(-0.5, 0.5))
        if random.random() < 0.15:
            gamma = random.uniform(1.6, 2.6)
        gain, lift = random.uniform(0.6, 1.25), random.uniform(-20, 20)
        tint = random.uniform(0.85, 1.15, 3)
        steps = np.arange(256)[:, None] / 255.0
        table = np.clip(255.0 * steps**gamma * gain * tint + lift, 0, 255).astype(np.uint8)
        views = [np.asarray(cv2.LUT(v, table.reshape(1, 256, 3)), np.uint8) for v in views]
    if random.random() < 0.3:
        share = 1.0 if random.random() < 0.5 else random.random()
        views = [_greyer(v, share) for v in views]
    if random.random() < 0.25:
        sigma = random.uniform(0.4, 1.3)
        views = [np.asarray(cv2.GaussianBlur(v, (0, 0), sigma), np.uint8) for v in views]
    if random.random() < 0.4:
        spread = random.uniform(1, 9)
        for k in [0] + ([len(views) - 1] if len(views) == 3 else []):
            noise = spread * random.standard_normal(views[k].shape, np.float32)
            views[k] = np.clip(views[k] + noise, 0, 255).astype(np.uint8)
    if random.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(random.integers(20, 70))]
        for k in [0] + ([len(views) - 1] if len(views) == 3 else []):
            coded = cv2.imencode(".jpg", views[k], quality)[1]
            views[k] = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    return views


def _greyer(image: Image, share: float) -> Image:
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.addWeighted(grey, share, image, 1.0 - share, 0), np.uint8)


def targets(boxes: Array, unsure: Array) -> tuple[Array, Array, Array]:
    """What the network should say of a cut, at its cells of `STRIDE_PX` pixels.

    Returns:
        (2, rows, columns): how much a middle a cell is (Gaussians over the boxes), and whether it
        counts; (5, rows, columns): distances to the sides in cells, and the weight of these;
        (rows, columns): class.
    """
    columns, rows = CROP[0] // STRIDE_PX, CROP[1] // STRIDE_PX
    heat = np.zeros((2, rows, columns), np.float32)
    heat[1] = 1.0
    sides = np.zeros((5, rows, columns), np.float32)
    kind = np.full((rows, columns), UNKNOWN, np.float32)
    for x, y, r, b in unsure / STRIDE_PX:
        heat[1, max(int(y), 0) : int(np.ceil(b)), max(int(x), 0) : int(np.ceil(r))] = 0.0
    best = np.zeros((rows, columns), np.float32)
    at_x, at_y = np.arange(columns) + 0.5, np.arange(rows) + 0.5
    for x, y, r, b, name in boxes / np.array([STRIDE_PX] * 4 + [1.0]):
        cx, cy = (x + r) / 2, (y + b) / 2
        spread_x, spread_y = max(0.13 * (r - x), 0.55), max(0.13 * (b - y), 0.55)
        k, j = min(int(cx), columns - 1), min(int(cy), rows - 1)
        bell = np.exp(-((at_x - k - 0.5) ** 2) / (2 * spread_x**2))[None] * np.exp(
            -((at_y - j - 0.5) ** 2) / (2 * spread_y**2)
        )[:, None].astype(np.float32)
        heat[0] = np.maximum(heat[0], bell)
        near = (bell > 0.4) & (bell > best)
        best[near] = bell[near]
        heat[1][bell > 0.3] = 1.0
        jj, kk = np.nonzero(near)
        distances = np.stack([at_x[kk] - x, at_y[jj] - y, r - at_x[kk], b - at_y[jj]])
        sides[:4, jj, kk] = np.maximum(distances, 0.1)
        sides[4, jj, kk] = bell[jj, kk] / max(len(jj), 1)
        kind[jj, kk] = name
    return heat, sides, kind


def batch(
    films: list[list[Example]],
    weights: NDArray[np.float64],
    count: int,
    random: np.random.Generator,
) -> tuple[NDArray[np.uint8], Array, Array, Array]:
    """So many random cuts and their targets."""
    images = np.empty((count, CROP[1], CROP[0], CHANNELS), np.uint8)
    parts = []
    for k in range(count):
        film = films[random.choice(len(films), p=weights)]
        images[k], boxes, unsure = cut(film[random.integers(len(film))], film, random)
        parts.append(targets(boxes, unsure))
    heat, sides, kind = (np.stack(part) for part in zip(*parts, strict=True))
    return images, heat, sides, kind
