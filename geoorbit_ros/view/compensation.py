"""From pixels of an image, however the camera moved, to pixels of the view that was calibrated."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import FLAG_GROUND_POINT, FLAG_TRUNCATED
from geoorbit_ros.view.looks import MAIN_VIEW, NO_VIEW, ViewLook, ViewState
from geoorbit_ros.view.picture import Matrix, displacement, moved, size_of_move
from geoorbit_ros.view.sway import LEAST_LOOKS, Swing, find_swing

MEMORY_S = 30.0
"""Looks are kept for so long. Chosen: longer than detector and tracker are ever behind."""
FOLLOWS_S = 0.5
"""Looks farther apart than this say nothing about the time between them where the view moved."""
LINE_SHARE = 0.5
"""1-sigma error of a straight line between two looks at a camera that sways, as a share of its
sway: between looks 0.2 s apart a swing of 2 Hz leaves it by 0.7 of its size at most."""
SWING_S, SWING_EVERY_S = 6.0, 1.0
"""How the camera swings is found from so long, anew each second. Chosen: shorter does not know the
frequency, longer is of another gust."""
SWING_LOOKS = 10
"""Looks before an image that say where it lay, besides the one after. Chosen: two seconds; more
take more time."""
SWING_SIGMA_PX = 0.12
"""1-sigma of a look at a camera that shakes, at 1280 px width, measured in rendered films."""
JUMP_PX = 2.0
"""A steady view that lies so much elsewhere at the next look, at 1280 px width, was bumped at some
time between them: those images are not used. Chosen: as `movement.MOVED_PX`."""
WAIT_S = 0.4
"""Frames of a camera that shakes wait so long for the look after them. Chosen: the watch looks
every 0.2 s then; longer delays them more when it is behind."""
SILENT_S = 10.0
"""The last look holds for so long when no other follows."""
BORDER_PX = 1.0
"""Boxes that end so near to the border of the image are cut by it."""


@dataclass(frozen=True, slots=True)
class ViewAt:
    """How the image of one time lies.

    Attributes:
        usable: Whether its pixels can be used at all.
        view: Number of the view.
        to_reference: (3, 3) pixel of the image to pixel of the view's reference.
        sigma_px: 1-sigma of a pixel after that.
    """

    usable: bool = True
    view: int = MAIN_VIEW
    to_reference: Matrix | None = None
    sigma_px: float = 0.0


AS_IT_IS = ViewAt()
"""While nothing is known of the view."""
UNUSABLE = ViewAt(usable=False, view=NO_VIEW)


class ViewMotions:
    """Looks by time, and the image's motion at any time between them.

    Args:
        image_size: (width, height) in pixels.
        memory_s: Looks are kept for so long.
    """

    def __init__(self, image_size: tuple[int, int], memory_s: float = MEMORY_S) -> None:
        self._size, self._memory_s = image_size, memory_s
        self._unit = image_size[0] / 1280.0
        self._looks: list[ViewLook] = []  # a deque is slow to search in
        self._second = -1
        self._swings: tuple[Swing, Swing] | None = None

    def add(self, look: ViewLook) -> None:
        """Take a look; one that is not later than the last begins anew."""
        if self._looks and look.stamp_ns <= self._looks[-1].stamp_ns:
            self._looks.clear()
        self._looks.append(look)
        if look.stamp_ns - self._looks[0].stamp_ns > self._memory_s * 1e9:
            oldest_ns = look.stamp_ns - round(self._memory_s * 1e9)
            del self._looks[: bisect_right(self._looks, oldest_ns, key=_stamp)]

    @property
    def latest(self) -> ViewLook | None:
        """The newest look."""
        return self._looks[-1] if self._looks else None

    def must_wait(self, stamp_ns: int, newest_ns: int) -> bool:
        """Whether a frame should wait for the next look, as the camera shakes.

        Args:
            stamp_ns: Of the frame.
            newest_ns: Of the newest frame that has come.
        """
        look = self.latest
        shakes = look is not None and look.stamp_ns < stamp_ns and self._shakes(look)
        return shakes and newest_ns - stamp_ns < WAIT_S * 1e9

    def at(self, stamp_ns: int) -> ViewAt:
        """The image's motion at a time."""
        k = bisect_right(self._looks, stamp_ns, key=_stamp)
        before = self._looks[k - 1] if k else None
        after = self._looks[k] if k < len(self._looks) else None
        if before is not None and before.stamp_ns == stamp_ns:
            return self._of(before, before.sigma_px)
        if before is None or after is None:
            only = before or after
            if only is None or abs(stamp_ns - only.stamp_ns) > SILENT_S * 1e9:
                return AS_IT_IS
            return self._of(only, math.hypot(only.sigma_px, only.sway_px))
        if not (before.usable and after.usable) or before.view != after.view:
            return UNUSABLE
        return self._between(k, stamp_ns)

    def _between(self, k: int, stamp_ns: int) -> ViewAt:
        """At a time before the k-th look and after the one before."""
        before, after = self._looks[k - 1], self._looks[k]
        span_ns = after.stamp_ns - before.stamp_ns
        step_px = size_of_move(after.motion @ np.linalg.inv(before.motion), self._size)
        far = span_ns > FOLLOWS_S * 1e9
        jumped = step_px > JUMP_PX * self._unit and not self._shakes(before)
        if jumped or (far and step_px > JUMP_PX * self._unit):
            return UNUSABLE
        share = (stamp_ns - before.stamp_ns) / span_ns
        motion = (1.0 - share) * before.motion + share * after.motion
        left_px = 0.0
        if self._shakes(before):
            left_px = LINE_SHARE * before.sway_px
            if (swung := self._swung(k, stamp_ns)) is not None:
                motion, left_px = swung
        sigma_px = math.hypot(max(before.sigma_px, after.sigma_px), left_px)
        if far:
            sigma_px = math.hypot(sigma_px, before.sway_px)
        return _view_at(before.view, motion, sigma_px)

    def _swung(self, k: int, stamp_ns: int) -> tuple[Matrix, float] | None:
        """The motion by how the camera swings, and its 1-sigma; None where that is not known."""
        near = self._looks[max(k - SWING_LOOKS, 0) : k + 1]
        swings = self._swings_at(stamp_ns, near[-1].view)
        if swings is None or not all(look.usable and look.view == near[0].view for look in near):
            return None
        time_s = np.array([(look.stamp_ns - stamp_ns) / 1e9 for look in near])
        motions = np.stack([look.motion for look in near])
        middle, motion, variance = motions.mean(axis=0), motions.mean(axis=0), 0.0
        for row, swing in enumerate(swings):
            weight, left = swing.weights(time_s)
            motion[row] += weight @ (motions[:, row] - middle[row])
            variance = max(variance, left)
        return motion, math.sqrt(variance)

    def _swings_at(self, stamp_ns: int, view: int) -> tuple[Swing, Swing] | None:
        """How the camera swings across and down, from looks of before this second."""
        step_ns = round(SWING_EVERY_S * 1e9)
        second = stamp_ns // step_ns
        if self._second != second:
            first_ns, last_ns = second * step_ns - round(SWING_S * 1e9), second * step_ns
            first, last = (bisect_right(self._looks, ns, key=_stamp) for ns in (first_ns, last_ns))
            looks = [k for k in self._looks[first:last] if k.usable and k.view == view]
            self._second, self._swings = second, self._found(looks)
        return self._swings

    def _found(self, looks: list[ViewLook]) -> tuple[Swing, Swing] | None:
        if len(looks) < LEAST_LOOKS:
            return None
        time_s = np.array([(look.stamp_ns - looks[0].stamp_ns) / 1e9 for look in looks])
        place = np.array([displacement(look.motion, self._size)[0] for look in looks])
        sigma_px = SWING_SIGMA_PX * self._unit
        across, down = (find_swing(time_s, axis, sigma_px) for axis in place.T)
        return None if across is None or down is None else (across, down)

    def _shakes(self, look: ViewLook) -> bool:
        return look.state is ViewState.SHAKING or look.sway_px > 0.8 * self._unit

    @staticmethod
    def _of(look: ViewLook, sigma_px: float) -> ViewAt:
        if not look.usable:
            return UNUSABLE
        if math.isnan(look.sigma_px):
            return AS_IT_IS
        return _view_at(look.view, look.motion, sigma_px)


def _stamp(look: ViewLook) -> int:
    return look.stamp_ns


def _view_at(view: int, motion: Matrix, sigma_px: float) -> ViewAt:
    sigma_px = 0.0 if math.isnan(sigma_px) else sigma_px
    if np.array_equal(motion, np.eye(3)):
        return ViewAt(True, view, None, sigma_px)
    return ViewAt(True, view, np.asarray(np.linalg.inv(motion), np.float64), sigma_px)


def boxes_in_reference(
    rows: NDArray[np.void], to_reference: Matrix | None, image_size: tuple[int, int]
) -> NDArray[np.void]:
    """Boxes of an image where they would be in the reference view.

    The middles of their edges are moved, so that a turned box does not grow. Boxes that the border
    of this image cuts are flagged: in the reference they may lie inside. Those that would lie
    outside of it are left out.

    Args:
        rows: (N,) `PIXEL_TRACK_DTYPE`, or another table with boxes and flags.
        to_reference: As in `ViewAt`; None leaves the boxes where they are.
        image_size: (width, height).
    """
    if to_reference is None or not len(rows):
        return rows
    x, y, width, height = (rows[name].astype(np.float64) for name in ("x", "y", "width", "height"))
    half = np.stack([width, height]) / 2
    low, high = np.stack([x, y]) - half, np.stack([x, y]) + half
    size = np.array(image_size, np.float64)[:, None]
    cut = ((low < BORDER_PX) | (high > size - BORDER_PX)).any(axis=0)
    ends = [(low[0], y), (high[0], y), (x, low[1]), (x, high[1])]
    left, right, top, bottom = (moved(to_reference, np.column_stack(end)) for end in ends)
    out = rows.copy()
    out["x"], out["width"] = (left[:, 0] + right[:, 0]) / 2, right[:, 0] - left[:, 0]
    out["y"], out["height"] = (top[:, 1] + bottom[:, 1]) / 2, bottom[:, 1] - top[:, 1]
    flagged = cut & ((rows["flags"] & FLAG_GROUND_POINT) == 0)
    out["flags"][flagged] |= np.uint32(FLAG_TRUNCATED)
    inside = (right[:, 0] > 0) & (bottom[:, 1] > 0) & (left[:, 0] < size[0]) & (top[:, 1] < size[1])
    return np.asarray(out[inside])


def image_in_reference(image: NDArray[np.uint8], at: ViewAt) -> NDArray[np.uint8] | None:
    """An image (H, W, 3) as the camera's own view shows it; None where it shows another.

    What the image does not show is black.
    """
    if not at.usable or at.view != MAIN_VIEW:
        return None
    if at.to_reference is None:
        return image
    size = (image.shape[1], image.shape[0])
    return np.asarray(cv2.warpPerspective(image, at.to_reference, size), np.uint8)
