"""The views of a whole recording, known once all of its images have been looked at."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.lanes import ViewNote
from geoorbit_ros.view.compensation import ViewAt, ViewMotions
from geoorbit_ros.view.looks import MAIN_VIEW, NO_VIEW, ViewLook, ViewState
from geoorbit_ros.view.timeline import ViewStretch, ViewTimeline
from geoorbit_ros.view.watch import ViewWatch

SPARSE = 8
"""Of an image, every so many pixels across and down tell whether it is the same as another."""
LONGEST_GAP_S = 2.0
"""Looks farther apart don't count as time with a view."""


class ViewRecord:
    """Looks at a recording's images in time order; afterwards says where each of them lay."""

    def __init__(self) -> None:
        self._watch = ViewWatch()
        self._looks: list[ViewLook] = []
        self._timeline = ViewTimeline()
        self._motions: ViewMotions | None = None

    def add(self, stamp_ns: int, image: NDArray[np.uint8]) -> ViewAt:
        """Take an image (H, W, 3); how it lies, as far as is known without later ones."""
        size = (image.shape[1], image.shape[0])
        if self._motions is None:
            self._motions = ViewMotions(size, math.inf)
        self._watch.note(stamp_ns, image[::SPARSE, ::SPARSE].tobytes())
        if self._watch.due(stamp_ns):
            look = self._watch.look(stamp_ns, image)
            self._looks.append(look)
            self._motions.add(look)
            self._timeline.add(look)
        return self._motions.at(stamp_ns)

    @property
    def eventful(self) -> bool:
        """Whether any image lies elsewhere than the first ones, or shows nothing that is known."""
        still = np.eye(3)
        return any(
            not look.usable or look.view != MAIN_VIEW or not np.array_equal(look.motion, still)
            for look in self._looks
        )

    @property
    def told(self) -> list[ViewStretch]:
        """What a person should know of."""
        return self._timeline.told()

    def note(self, time_text: Callable[[int], str]) -> ViewNote | None:
        """What lanes should say of the view at the recording's end."""
        last = self._timeline.stretches[-1] if self._timeline.stretches else None
        if last is None or (last.view == self.main_view and last.state is ViewState.OTHER_VIEW):
            return None
        return self._timeline.note(time_text)

    @property
    def main_view(self) -> int:
        """Number of the view that is seen for the longest time."""
        seen_s: defaultdict[int, float] = defaultdict(float)
        for look, after in zip(self._looks, self._looks[1:], strict=False):
            if look.usable and look.view != NO_VIEW:
                gap_s = (after.stamp_ns - look.stamp_ns) / 1e9
                seen_s[look.view] += min(gap_s, LONGEST_GAP_S)
        return max(seen_s, key=lambda view: (seen_s[view], -view), default=MAIN_VIEW)

    @property
    def other_views(self) -> bool:
        """Whether more than one view is seen, or a time without any."""
        return any(look.view != MAIN_VIEW for look in self._looks)

    def span_ns(self) -> tuple[int, int]:
        """First and last look at the main view."""
        main = self.main_view
        stamps = [look.stamp_ns for look in self._known() if look.usable and look.view == main]
        return (stamps[0], stamps[-1]) if stamps else (0, 0)

    def _known(self) -> Iterator[ViewLook]:
        """The looks; the view is not taken for granted where it was lost for longer than a look."""
        following = [*self._looks[1:], None][: len(self._looks)]
        for look, after in zip(self._looks, following, strict=True):
            lost = not look.measured and after is not None and not after.usable
            yield replace(look, sigma_px=math.inf, view=NO_VIEW) if lost else look

    def motions(self) -> Iterator[ViewLook]:
        """The looks, with the view that is seen longest as the calibrated one."""
        main = self.main_view
        for look in self._known():
            if look.view == main:
                yield replace(look, view=MAIN_VIEW)
            else:
                yield replace(look, view=NO_VIEW, sigma_px=math.inf)
