"""What the watch says about one image, and the table in which it travels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.view.picture import Matrix


class ViewState(IntEnum):
    """What the image shows."""

    UNKNOWN = 0
    """Nothing can be said yet, or the view is being looked for."""
    STEADY = 1
    """A known view, where it was."""
    SHAKING = 2
    """A known view that moves to and fro."""
    MOVED = 3
    """A known view that has been moved, by a bump or slowly."""
    OTHER_VIEW = 4
    """Something that no known view shows, or a view without a calibration."""
    BLIND = 5
    """Nothing that could be recognised, or images that are no live ones."""


class Blindness(IntEnum):
    """Why the watch calls an image blind."""

    NONE = 0
    NO_PATTERN = 1
    """Dark, covered, dirty or fogged."""
    FROZEN = 2
    """The same image again and again."""
    REPEATED = 3
    """A sequence of images that has been shown before."""


MAIN_VIEW = 0
"""Number of the view of the camera's own calibration."""
FIRST_FOUND = 100
"""Number of the first view that was found by itself; those below have a name and a calibration."""
NO_VIEW = -1
"""Where no known view is seen."""

_MOTION = tuple(f"m{row}{column}" for row in range(3) for column in range(3))
VIEW_DTYPE = np.dtype(
    [
        *((name, "<f8") for name in _MOTION),
        ("sigma_px", "<f4"),
        ("sway_px", "<f4"),
        ("moved_px", "<f4"),
        ("since_s", "<f4"),
        ("view", "<i4"),
        ("state", "<i4"),
        ("blindness", "<i4"),
        ("width", "<i4"),
        ("height", "<i4"),
    ]
)
"""`view`, one row per look; see `ViewLook`. `since_s` is how long ago the state began; `width` and
`height` are those of the image."""


@dataclass(frozen=True, slots=True)
class ViewLook:
    """One look at a camera's image.

    Attributes:
        stamp_ns: Capture time of the image.
        state: What it shows.
        view: Number of the view; 0 is the camera's own, `NO_VIEW` none that is known.
        motion: (3, 3) pixel of the reference view to pixel of this image.
        sigma_px: 1-sigma of a pixel after the motion. NaN while nothing is known, infinite where
            pixels must not be used.
        sway_px: 1-sigma of the image's movement to and fro.
        moved_px: By how much the image lies away from the reference view, in the mean over it.
        since_ns: Since when the state holds.
        blindness: Why, where it is blind.
        measured: False where the view was not found, once, and the look before still holds.
        size: (width, height) of the image in pixels; zeros where nobody says.
    """

    stamp_ns: int
    state: ViewState = ViewState.UNKNOWN
    view: int = MAIN_VIEW
    motion: Matrix = field(default_factory=lambda: np.eye(3))
    sigma_px: float = math.nan
    sway_px: float = 0.0
    moved_px: float = 0.0
    since_ns: int = 0
    blindness: Blindness = Blindness.NONE
    measured: bool = True
    size: tuple[int, int] = (0, 0)

    @property
    def usable(self) -> bool:
        """Whether pixels of the image can be laid on the view's reference."""
        return not math.isinf(self.sigma_px)

    def row(self) -> NDArray[np.void]:
        """(1,) `VIEW_DTYPE`."""
        row = np.zeros(1, VIEW_DTYPE)
        for name, value in zip(_MOTION, self.motion.ravel(), strict=True):
            row[name] = value
        for name in ("sigma_px", "sway_px", "moved_px", "view", "state", "blindness"):
            row[name] = getattr(self, name)
        row["width"], row["height"] = self.size
        row["since_s"] = (self.stamp_ns - self.since_ns) / 1e9
        return row


def look_of(stamp_ns: int, rows: NDArray[np.void], place: str) -> ViewLook:
    """The look in a table of one row.

    Raises:
        TableError: Another number of rows, or numbers that can't be.
    """
    if len(rows) != 1:
        raise TableError(place, f"{len(rows)} rows", "one row")
    row = rows[0]
    motion = np.array([row[name] for name in _MOTION]).reshape(3, 3)
    if not (np.isfinite(motion).all() and abs(np.linalg.det(motion)) > 1e-6):
        raise TableError(place, "a motion that can't be inverted", "a 3x3 matrix between images")
    try:
        state, blindness = ViewState(int(row["state"])), Blindness(int(row["blindness"]))
    except ValueError as error:
        raise TableError(place, str(error), "a state that is known") from None
    sigma_px, sway_px, moved_px, since_s = (
        float(row[name]) for name in ("sigma_px", "sway_px", "moved_px", "since_s")
    )
    since_ns = stamp_ns - round(since_s * 1e9) if math.isfinite(since_s) else stamp_ns
    view = int(row["view"])
    size = int(row["width"]), int(row["height"])
    return ViewLook(
        *(stamp_ns, state, view, motion, sigma_px, sway_px, moved_px, since_ns, blindness),
        size=size,
    )
