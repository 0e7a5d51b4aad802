"""Boxes to the road through a view that moves: the one place where moved pixels are put back."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.calibration.box_projector import BoxProjector
from geoorbit_ros.calibration.elementwise import worst_sigma
from geoorbit_ros.view.compensation import ViewAt, ViewMotions, boxes_in_reference
from geoorbit_ros.view.looks import MAIN_VIEW, ViewLook

_NONE: Mapping[int, BoxProjector] = MappingProxyType({})


class ViewProjector:
    """Projects frames in time order; those that show no calibrated view are left out.

    Args:
        projector: Of the camera's own view.
        others: Of other views, by their number.
        memory_s: Looks are kept for so long; None: as long as a live graph needs them.

    Attributes:
        motions: The looks.
        left_out: Frames that were left out.
    """

    def __init__(
        self,
        projector: BoxProjector,
        others: Mapping[int, BoxProjector] = _NONE,
        memory_s: float | None = None,
    ) -> None:
        self._projectors = {MAIN_VIEW: projector, **others}
        self._size = projector.image_size
        memory = {} if memory_s is None else {"memory_s": memory_s}
        self.motions = ViewMotions(self._size, **memory)
        self._waiting: deque[tuple[int, NDArray[np.void]]] = deque()
        self.left_out = 0

    def reset(self) -> None:
        """Forget tracks and waiting frames, for a source that starts again."""
        self._waiting.clear()
        for projector in self._projectors.values():
            projector.reset()

    def shows(self, look: ViewLook) -> bool:
        """Whether a look's image shows a view that is calibrated."""
        return look.usable and look.view in self._projectors

    @property
    def fault(self) -> str | None:
        """Why there are no tracks, while the image shows no calibrated view."""
        look = self.motions.latest
        if look is None or self.shows(look):
            return None
        state = look.state.name.lower().replace("_", " ")
        return f"no tracks, lanes are held: the view is {state} (node view_watch says why)"

    def take(self, stamp_ns: int, rows: NDArray[np.void]) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Take a frame of `PIXEL_TRACK_DTYPE`; those that are done, `TRACK_DTYPE`.

        A frame of a camera that shakes waits a moment for the look after it.
        """
        self._waiting.append((stamp_ns, rows))
        return self.done()

    def look(self, look: ViewLook) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Take a look; the frames that waited for it."""
        self.motions.add(look)
        return self.done()

    def done(self) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Stamp and ground tracks of waiting frames whose motion is known."""
        while self._waiting:
            stamp_ns, rows = self._waiting[0]
            if self.motions.must_wait(stamp_ns, self._waiting[-1][0]):
                return
            self._waiting.popleft()
            ground = self.project(stamp_ns, rows)
            if ground is not None:
                yield stamp_ns, ground

    def project(self, stamp_ns: int, rows: NDArray[np.void]) -> NDArray[np.void] | None:
        """Ground tracks of a frame; None where it must be left out.

        Args:
            stamp_ns: Capture time, later than that of the frame before.
            rows: (N,) `PIXEL_TRACK_DTYPE`, pixels of this image.
        """
        at = self.motions.at(stamp_ns)
        projector = self._projectors.get(at.view)
        if not at.usable or projector is None:
            self.left_out += 1
            return None
        boxes = boxes_in_reference(rows, at.to_reference, self._size)
        return _less_sure(projector.project(stamp_ns, boxes), projector, at)


def _less_sure(ground: NDArray[np.void], projector: BoxProjector, at: ViewAt) -> NDArray[np.void]:
    """Ground tracks with the error that the view's motion adds."""
    if not at.sigma_px or not len(ground):
        return ground
    plane = projector.homography
    pixel = plane.to_pixel(np.column_stack([ground["x"], ground["y"]]).astype(np.float64))
    metres = plane.jacobian(np.nan_to_num(pixel))
    worst = worst_sigma((metres @ metres.transpose(0, 2, 1)).transpose(1, 2, 0))
    added = np.where(np.isfinite(pixel).all(axis=1), at.sigma_px * worst, 0.0)
    ground["sigma"] = np.hypot(ground["sigma"], added)
    return ground
