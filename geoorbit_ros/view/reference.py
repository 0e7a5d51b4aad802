"""A reference picture of a view: patches of it are found again in later pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.view.motion_fit import MotionFit, fit_motion
from geoorbit_ros.view.picture import Grey, Matrix, moved, warped_back

HALF_PX = 10
"""Half a patch's side, less the middle: 21 px of a picture 640 px wide. Chosen: smaller ones are
found at wrong places at night, larger ones take more time and hold more traffic."""
PATCHES = 60
"""Most patches. Chosen: half of them, behind traffic, still give a tenth of a pixel; more take
more time."""
CELLS = (6, 4)
"""Cells across and down of which each has its share of the patches. Chosen: more bring in walls
without a corner, fewer leave all patches in one tree."""
CORNER_MIN = 1.2e-4
"""Least eigenvalue of a corner (Shi and Tomasi 1994) as `cv2.cornerMinEigenVal` scales it for
pictures from 0 to 1. Chosen: noise of four grey levels has none, faint lines at dusk have some."""
LEAST_CORNERS = 14
"""A picture with fewer shows nothing that can be recognised: dark, covered, fogged. Chosen: more
calls a foggy day blind, fewer look for a view in a black picture."""
SAME_SCORE = 0.6
"""Correlation from which a patch is found. Chosen: unrelated patches reach it in one of ten
places searched, and then lie anywhere; higher loses patches in rain."""
BENT = 0.02
"""A motion that turns or stretches by more is taken out of the picture before patches are looked
for. Chosen: the edge of a patch moves by 0.2 px; larger finds fewer, smaller takes more time."""
FLAT_PX = 0.1
"""A guess that lies nearer to whole pixels, anywhere, is tried without moving the picture. Chosen:
the parabola through three correlations errs by a third of a pixel half-way between two of them,
and hardly near to one; smaller moves the picture more often, which takes time."""


@dataclass(frozen=True, slots=True)
class Match:
    """How a picture lies on a reference.

    Attributes:
        motion: (3, 3) pixels of the view's origin to pixels of the picture.
        sigma_px: 1-sigma of a pixel after the motion, in the mean over the picture.
        inliers: Patches that moved this way.
        share: Of all patches.
    """

    motion: Matrix
    sigma_px: float
    inliers: int
    share: float


class Reference:
    """A picture in the coordinates of its view's origin, and its patches.

    Args:
        picture: Grey, without vehicles as far as possible.

    Attributes:
        picture: The same.
        points: (N, 2) middles of the patches, whole pixels.
    """

    def __init__(self, picture: Grey) -> None:
        self.picture = picture
        self.points = corners(picture)
        self._patches = [_window(picture, x, y, 0) for x, y in self.points.astype(int).tolist()]

    @cached_property
    def edges(self) -> Reference:
        """The same by the strength of its edges: what is left when light or camera mode change."""
        return Reference(edge_picture(self.picture))

    def match(
        self, picture: Grey, start: Matrix, radius: int, *, every: int = 1, first: int = 0
    ) -> MotionFit | None:
        """The motion of a picture near a first guess.

        Args:
            picture: Of the same size.
            start: The guess.
            radius: How many pixels patches may lie away from it.
            every: Look for one of so many patches only.
            first: From which on.

        Returns:
            None where too few patches agree.
        """
        points, patches = self.points[first::every], self._patches[first::every]
        guess = moved(start, points)
        bent = np.abs(start[:2, :2] - np.eye(2)).max() > BENT
        if bent:
            picture, guess = warped_back(picture, start), points
        flat = np.abs(guess - np.rint(guess)).max(initial=0.0) <= FLAT_PX
        base = np.rint(guess) if flat else guess
        height, width = picture.shape
        reach = HALF_PX + radius
        inside = (base >= reach).all(axis=1) & (base < [width - reach, height - reach]).all(axis=1)
        same: list[int] = []
        near: list[tuple[float, ...]] = []  # place of the best, and scores about it
        for k, at in zip(np.flatnonzero(inside).tolist(), base[inside].tolist(), strict=True):
            around = (
                _window(picture, int(at[0]), int(at[1]), radius)
                if flat
                else _about(picture, at, reach)
            )
            score = cv2.matchTemplate(around, patches[k], cv2.TM_CCOEFF_NORMED)
            _, best, _, (x, y) = cv2.minMaxLoc(score)
            if best < SAME_SCORE or not (0 < x < 2 * radius and 0 < y < 2 * radius):
                continue  # it would lie farther away, if it is the patch at all
            same.append(k)
            row, column = score[y].tolist(), score[:, x].tolist()
            near.append((x, y, *row[x - 1 : x + 2], *column[y - 1 : y + 2]))
        found = base[same] + (_peaks(near) - radius)
        if bent:
            found = moved(start, found)
        return fit_motion(points[same], found, len(points), picture.shape, start)


def corners(picture: Grey) -> NDArray[np.float64]:
    """(N, 2) the best corners, spread over the picture."""
    strength = cv2.cornerMinEigenVal(picture.astype(np.float32) / 255.0, 7)
    rows, columns = strength.shape
    margin = HALF_PX + 2
    chosen: list[tuple[float, int, int]] = []
    each = -(-PATCHES // (CELLS[0] * CELLS[1]))
    for top, bottom in _cells(margin, rows - margin, CELLS[1]):
        for left, right in _cells(margin, columns - margin, CELLS[0]):
            cell = strength[top:bottom, left:right].copy()
            for _ in range(each):
                _, value, _, (x, y) = cv2.minMaxLoc(cell)
                if value < CORNER_MIN:
                    break
                chosen.append((value, left + x, top + y))
                cell[max(y - HALF_PX, 0) : y + HALF_PX, max(x - HALF_PX, 0) : x + HALF_PX] = 0.0
    best = sorted(chosen, reverse=True)[:PATCHES]
    return np.array([(x, y) for _, x, y in best], dtype=np.float64).reshape(-1, 2)


def edge_picture(picture: Grey) -> Grey:
    """Strength of a picture's edges, whatever side of them is bright."""
    right = cv2.Sobel(picture, cv2.CV_32F, 1, 0)
    down = cv2.Sobel(picture, cv2.CV_32F, 0, 1)
    strength = cv2.magnitude(right, down)
    local = cv2.GaussianBlur(strength, (0, 0), 16.0) + 8.0
    return np.asarray(np.clip(64.0 * strength / local, 0.0, 255.0), np.uint8)


def _cells(first: int, last: int, count: int) -> list[tuple[int, int]]:
    edge = np.linspace(first, max(last, first + count), count + 1).astype(int).tolist()
    return list(pairwise(edge))


def _window(picture: Grey, x: int, y: int, more: int) -> Grey:
    reach = HALF_PX + more
    return picture[y - reach : y + reach + 1, x - reach : x + reach + 1]


def _about(picture: Grey, at: Sequence[float], reach: int) -> Grey:
    """The window about a place between pixels."""
    side = 2 * reach + 1
    return np.asarray(cv2.getRectSubPix(picture, (side, side), (at[0], at[1])), np.uint8)


def _peaks(near: Sequence[tuple[float, ...]]) -> NDArray[np.float64]:
    """(N, 2) where scores are greatest: the tops of parabolas through three of them each way.

    Args:
        near: (N,) x and y of the best score; scores left of it, there and right; above, there and
            below.
    """
    rows = np.array(near, np.float64).reshape(-1, 2 + 3 + 3)
    before, middle, after = rows[:, 2:].reshape(-1, 2, 3).transpose(2, 0, 1)
    bend = before - 2.0 * middle + after
    away = np.where(bend < 0.0, 0.5 * (before - after) / np.minimum(bend, -1e-12), 0.0)
    return np.asarray(rows[:, :2] + away)
