"""Holds a camera's images against its reference view, a few times a second."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.view.looks import FIRST_FOUND, MAIN_VIEW, NO_VIEW, Blindness, ViewLook, ViewState
from geoorbit_ros.view.movement import Movement
from geoorbit_ros.view.picture import Grey, in_image, picture_of, reduction
from geoorbit_ros.view.place import Place
from geoorbit_ros.view.reference import LEAST_CORNERS, Match, corners
from geoorbit_ros.view.repeats import RepeatWatch

PERIODS_S = (0.36, 0.46, 0.41)
"""Time between looks, in turn. Chosen: at 720p they take little more than 1 % of a core, and a bump
is noticed within a second; with one period a sway of that frequency would look like none."""
SHAKING_PERIODS_S = (0.16, 0.24, 0.2)
"""The same at a camera that shakes, where its swing says what is between them. Chosen: a swing of
2 Hz that keeps its phase for a few seconds is known to a third of its size; shorter takes more
time."""
LOST_LOOKS = 2
"""So many looks without the view before its pixels are given up. Chosen: a lorry in front of the
camera hides it for one; more lets wrong pixels through."""
SEARCH_S, LATE_SEARCH_S = 0.9, 3.0
"""Time between two thorough searches for a view that was lost, at first and later. Chosen: each
takes a tenth of a second."""
LATE_S = 20.0
"""When a search is late."""
OTHER_S = 1.5
"""Another view is told after so long. Chosen: a lorry that fills the image for a moment is none."""
STAYS_S = 6.0
"""A picture that stands still for so long becomes a view of its own, to be recognised. Chosen:
longer than a camera stops on its way."""
MOST_VIEWS = 16
"""Views that are remembered. Chosen: more than a camera has presets; of those found by themselves
the oldest goes."""

MOST_SIZES = 3
"""Of so many sizes of images the views are remembered: a stray image of another size, or a camera
that is set to another one for a while, does not make what it shows afterwards the calibrated view.
"""


class ViewWatch:
    """Tells of each look what the image shows and how it lies on its reference view.

    Args:
        places: Views that are known already. Where the camera's own is none of them, the first
            picture that shows no known view is taken for it.
        size: (width, height) of the images that these are of.
        repeats_allowed: Whether the source is a recording that is played again and again.

    Attributes:
        places: All views.
    """

    def __init__(
        self,
        places: Sequence[Place] = (),
        size: tuple[int, int] | None = None,
        *,
        repeats_allowed: bool = False,
    ) -> None:
        self.places = list(places)
        self._current: Place | None = self._main
        self._repeats = None if repeats_allowed else RepeatWatch()
        self._blindness = Blindness.NONE
        self._candidate: tuple[int, Place] | None = None
        self._movement = Movement()
        self._turn = 0
        self._size = size if places else None
        self._of_size: dict[tuple[int, int], list[Place]] = {}
        self._restart()

    @property
    def size(self) -> tuple[int, int] | None:
        """(width, height) of the images; None before the first."""
        return self._size

    @property
    def _main(self) -> Place | None:
        """The camera's own view."""
        return next((place for place in self.places if place.number == MAIN_VIEW), None)

    def _restart(self) -> None:
        self._looked_ns: int | None = None
        self._lost_since_ns: int | None = None
        self._searched_ns: int | None = None
        self._lost = 0
        self._last = ViewLook(0)

    def due(self, stamp_ns: int) -> bool:
        """Whether the image of this time should be looked at."""
        last = self._looked_ns
        period_s = (SHAKING_PERIODS_S if self._movement.shaking else PERIODS_S)[self._turn]
        return last is None or not 0 <= stamp_ns - last < 0.98 * period_s * 1e9

    def note(self, stamp_ns: int, data: bytes | memoryview) -> None:
        """Take the bytes of every image, also of those that are not looked at."""
        if self._repeats is not None:
            self._blindness = self._repeats.add(stamp_ns, zlib.crc32(data))

    def look(self, stamp_ns: int, image: NDArray[np.uint8]) -> ViewLook:
        """Look at an image (H, W, 3), or (H, W) of grey."""
        step = reduction(image.shape[1])
        size = (image.shape[1], image.shape[0])
        return self.look_at(stamp_ns, picture_of(image, step), size)

    def look_at(self, stamp_ns: int, picture: Grey, size: tuple[int, int]) -> ViewLook:
        """Look at the picture of an image of a size, where a decoder has reduced it already."""
        if self._size != size:
            if self._size is not None:
                self._of_size[self._size] = self.places
                self.places = self._of_size.pop(size, [])
                self._current, self._candidate = self._main, None
                if len(self._of_size) >= MOST_SIZES:
                    del self._of_size[next(iter(self._of_size))]
            self._size = size
            self._movement = Movement()
            self._restart()
        if self._looked_ns is not None and stamp_ns <= self._looked_ns:
            self._restart()
        self._looked_ns, self._turn = stamp_ns, (self._turn + 1) % len(PERIODS_S)
        blindness = self._blindness
        if self._repeats is not None and blindness is Blindness.NONE:
            blindness = self._repeats.look(stamp_ns, picture)
        if blindness is not Blindness.NONE:
            self._last = self._blind(stamp_ns, blindness)
        else:
            self._last = self._held_against(stamp_ns, picture, reduction(size[0]))
        self._last = replace(self._last, size=size)
        return self._last

    def _first(self, stamp_ns: int, picture: Grey) -> ViewLook:
        if len(corners(picture)) < LEAST_CORNERS:
            return self._blind(stamp_ns, Blindness.NO_PATTERN)
        self._current = Place.beginning(MAIN_VIEW, stamp_ns, picture)
        self.places.append(self._current)
        return ViewLook(stamp_ns, since_ns=stamp_ns)

    def _held_against(self, stamp_ns: int, picture: Grey, step: int) -> ViewLook:
        place, match = self._current, None
        if place is None and not self.places:
            return self._first(stamp_ns, picture)
        if place is not None:
            shaking = self._movement.shaking
            match = place.look(stamp_ns, picture, search=0, shaking=shaking)
        if match is None:
            if len(corners(picture)) < LEAST_CORNERS:
                return self._without(stamp_ns, picture, empty=True)
            place, match = self._recognised(stamp_ns, picture)
        if place is None or match is None:
            return self._without(stamp_ns, picture, empty=False)
        if place is not self._current or self._lost >= LOST_LOOKS:
            self._movement.restart(kept=place is self._current)
        self._current, self._candidate = place, None
        self._lost, self._lost_since_ns = 0, None
        assert self._size is not None
        motion = in_image(match.motion, step)
        seen = self._movement.add(stamp_ns, motion, step * match.sigma_px, self._size)
        state = seen.state
        if not place.settled and place.number == MAIN_VIEW and state is ViewState.STEADY:
            state = ViewState.UNKNOWN
        if place.number >= FIRST_FOUND:
            state = ViewState.OTHER_VIEW
        return ViewLook(
            stamp_ns,
            state,
            place.number,
            seen.motion,
            seen.sigma_px,
            seen.sway_px,
            seen.moved_px,
            seen.since_ns,
        )

    def _recognised(self, stamp_ns: int, picture: Grey) -> tuple[Place | None, Match | None]:
        """The view that a picture shows, the present one first."""
        search = self._search(stamp_ns)
        if self._current is not None:
            match = self._current.look(stamp_ns, picture, search=search)
            if match is not None:
                return self._current, match
        if search > 1:
            for place in self.places:
                if place is not self._current:
                    match = place.look(stamp_ns, picture, search=2)
                    if match is not None:
                        return place, match
        return None, None

    def _search(self, stamp_ns: int) -> int:
        """How far to look for the view: thoroughly at once when it is lost, then now and then."""
        searched, lost = self._searched_ns, self._lost_since_ns
        late = lost is not None and stamp_ns - lost > LATE_S * 1e9
        period_s = LATE_SEARCH_S if late else SEARCH_S
        if searched is None or lost is None or stamp_ns - searched >= period_s * 1e9:
            return 2
        return 0 if late else 1

    def _without(self, stamp_ns: int, picture: Grey, *, empty: bool) -> ViewLook:
        """A look at a picture in which no known view was found."""
        if self._main is None and not empty:
            return self._first(stamp_ns, picture)
        if self._search(stamp_ns) > 1:
            self._searched_ns = stamp_ns
        self._lost += 1
        self._lost_since_ns = self._lost_since_ns or stamp_ns
        before = self._last
        if self._lost < LOST_LOOKS and before.usable and not math.isnan(before.sigma_px):
            sigma_px = math.hypot(before.sigma_px, 1.0)
            return ViewLook(
                stamp_ns,
                before.state,
                before.view,
                before.motion,
                sigma_px,
                before.sway_px,
                before.moved_px,
                before.since_ns,
                measured=False,
            )
        if empty:
            self._candidate = None
            return self._blind(stamp_ns, Blindness.NO_PATTERN)
        lost_ns = self._lost_since_ns
        main = self._main
        if main is not None and not main.settled:
            if stamp_ns - lost_ns >= OTHER_S * 1e9:  # its only picture was mostly vehicles
                self.places.remove(main)
                self._current, self._lost, self._lost_since_ns = None, 0, None
            return ViewLook(stamp_ns, since_ns=stamp_ns)
        self._learn_view(stamp_ns, picture)
        other = stamp_ns - lost_ns >= OTHER_S * 1e9
        state = ViewState.OTHER_VIEW if other else ViewState.UNKNOWN
        return ViewLook(stamp_ns, state, NO_VIEW, sigma_px=math.inf, since_ns=lost_ns)

    def _blind(self, stamp_ns: int, why: Blindness) -> ViewLook:
        before = self._last
        since_ns = before.since_ns if before.blindness is why else stamp_ns
        state = ViewState.BLIND
        return ViewLook(
            stamp_ns, state, NO_VIEW, sigma_px=math.inf, since_ns=since_ns, blindness=why
        )

    def _learn_view(self, stamp_ns: int, picture: Grey) -> None:
        """A picture that stays becomes a view, so that it is recognised when it comes back."""
        if self._candidate is not None:
            begin_ns, place = self._candidate
            if place.look(stamp_ns, picture, search=0) is None:
                self._candidate = None
            elif stamp_ns - begin_ns >= STAYS_S * 1e9:
                self._remember(place)
                return
        if self._candidate is None:
            self._candidate = (stamp_ns, Place.beginning(NO_VIEW, stamp_ns, picture))

    def _remember(self, place: Place) -> None:
        place.number = max(FIRST_FOUND, *(known.number + 1 for known in self.places))
        found = [known for known in self.places if known.number >= FIRST_FOUND]
        if len(self.places) >= MOST_VIEWS and found:
            self.places.remove(found[0])
        self.places.append(place)
        self._current, self._candidate = place, None
        self._movement.restart(kept=False)
