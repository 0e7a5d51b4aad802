"""One place that a camera looks at: its reference pictures, and how they follow the light."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from geoorbit_ros.view.picture import Grey, Matrix, warped_back
from geoorbit_ros.view.reference import Match, Reference
from geoorbit_ros.view.registration import find, follow

FIRST_S = 8.0
"""The first reference is the median of pictures of so long. Chosen: longer than a vehicle takes
to drive on by its length in slow traffic; longer makes the view known later."""
FIRST_SPACING_S = 0.8
"""Time between those pictures: eleven of them."""
SPACING_S = 5.0
"""Time between the pictures of which later references are the median."""
MEDIAN_OF = 11
"""So many of them, of a minute. Chosen: more follow the light later, fewer show queues."""
FEW_SHARE = 0.55
"""Where a smaller share of the patches is found, in the mean of a minute, a picture of now is made
another reference. Chosen: larger makes one in each jam, smaller loses the view at dusk before."""
LEAST_SHARE = 0.2
"""But not where a smaller share is found: what is not surely the same view teaches nothing."""
SURE_SIGMA_PX = 0.15
"""Nor while the motion is less sure than this, in pixels of a picture: a reference that lies wrong
is wrong for good."""
BETWEEN_S = 60.0
"""Least time between two new references. Chosen: dusk takes half an hour."""
MOST_REFERENCES = 8
"""Day, sun from both sides, dusk, night, rain, snow. The first stays; of the others the one goes
that has not been used for longest."""
BETTER = 1.15
"""Another reference is taken when it finds this many times as many patches. Chosen: larger stays
with a poor one, smaller changes to and fro."""


@dataclass(slots=True)
class Place:
    """References of one view, all in the same coordinates.

    A new reference is laid on the older ones before it is used: a slow drift is never taken for
    the view itself.

    Attributes:
        number: Of the view.
        references: The first comes first.
        motion: Where the latest picture lay.
    """

    number: int
    references: list[Reference] = field(default_factory=list)
    motion: Matrix = field(default_factory=lambda: np.eye(3))
    settled: bool = False
    _best: int = 0
    _turn: int = 0
    _looks: int = 0
    _begin_ns: int | None = None
    _kept_ns: int = 0
    _renewed_ns: int = 0
    _kept: deque[tuple[Grey, Matrix]] = field(default_factory=lambda: deque(maxlen=MEDIAN_OF))
    _middles: list[Matrix] = field(default_factory=list)
    _shares: deque[float] = field(default_factory=lambda: deque(maxlen=MEDIAN_OF))

    @staticmethod
    def beginning(number: int, stamp_ns: int, picture: Grey) -> Place:
        """A view of which one picture is known, with the vehicles in it."""
        place = Place(number, [Reference(picture)], _begin_ns=stamp_ns)
        place._keep(stamp_ns, picture)
        return place

    def look(
        self, stamp_ns: int, picture: Grey, *, search: int, shaking: bool = False
    ) -> Match | None:
        """Where a picture lies; None where it does not show the view.

        Args:
            stamp_ns: Capture time.
            picture: The picture.
            search: 0: near the last one; 1: also elsewhere; 2: thoroughly.
            shaking: Whether the camera shakes.
        """
        best = self.references[self._best]
        self._looks += 1
        turn = None if self._keeps(stamp_ns) else self._looks
        match = follow(best, picture, self.motion, turn=turn, shaking=shaking)
        if (match is None or match.share < FEW_SHARE) and len(self.references) > 1:
            match = self._other_reference(picture, match)
        if match is None and search:
            match = self._anywhere(picture, thorough=search > 1)
        if match is not None:
            self.motion = match.motion
            self._learn(stamp_ns, picture, match)
        return match

    def _other_reference(self, picture: Grey, match: Match | None) -> Match | None:
        """The motion by one more reference, another at each look."""
        self._turn = (self._turn + 1) % len(self.references)
        if self._turn == self._best:
            return match
        other = follow(self.references[self._turn], picture, self.motion)
        if other is None or (match is not None and other.inliers < BETTER * match.inliers):
            return match
        self._best = self._turn
        return other

    def _anywhere(self, picture: Grey, *, thorough: bool) -> Match | None:
        last = len(self.references) - 1
        order = [self._best, *(k for k in range(last, -1, -1) if k != self._best)]
        for k in order if thorough else order[:1]:
            match = find(self.references[k], picture, self.motion, thorough=thorough)
            if match is not None:
                self._best = k
                return match
        return None

    def _learn(self, stamp_ns: int, picture: Grey, match: Match) -> None:
        """Keep pictures for a new reference, and make one when the old ones show too little."""
        if not self.settled:
            self._middles.append(self.motion)
        if not self._keeps(stamp_ns):
            return
        if match.sigma_px > SURE_SIGMA_PX or match.share < LEAST_SHARE:
            return
        self._keep(stamp_ns, picture)
        self._shares.append(match.share)
        begin_ns = self._begin_ns if self._begin_ns is not None else stamp_ns
        self._begin_ns = begin_ns
        if not self.settled:
            if stamp_ns - begin_ns >= FIRST_S * 1e9 and len(self._kept) >= 5:
                self._settle()
                self._renewed_ns = stamp_ns
            return
        full = len(self._shares) == MEDIAN_OF
        due = stamp_ns - self._renewed_ns >= BETWEEN_S * 1e9
        if full and due and float(np.mean(self._shares)) < FEW_SHARE:
            self._renewed_ns = stamp_ns
            self._add(Reference(_median([warped_back(p, m) for p, m in self._kept])))

    def _keeps(self, stamp_ns: int) -> bool:
        """Whether the picture of this time is kept, if it is surely of this view."""
        spacing_s = SPACING_S if self.settled else FIRST_SPACING_S
        return not 0 <= stamp_ns - self._kept_ns < spacing_s * 1e9

    def _keep(self, stamp_ns: int, picture: Grey) -> None:
        self._kept.append((picture, self.motion))
        self._kept_ns = stamp_ns

    def _settle(self) -> None:
        """The view is what all pictures so far show, and lies where they lie in the middle.

        A camera that sways shows its first picture at the end of a swing as well as in the middle.
        """
        # Looks of a camera that shakes are dense; the few before that would weigh too much by time.
        # Turn and zoom, too: the first picture, with its vehicles in it, shows both a little wrong.
        centre = np.mean(self._middles, axis=0)
        from_centre = [(p, m @ np.linalg.inv(centre)) for p, m in self._kept]
        self.references = [Reference(_median([warped_back(p, m) for p, m in from_centre]))]
        self.motion = self.motion @ np.linalg.inv(centre)
        self.settled, self._best = True, 0
        self._kept.clear()
        self._middles.clear()
        self._shares.clear()

    def _add(self, reference: Reference) -> None:
        if len(reference.points) < MOST_REFERENCES:
            return
        if len(self.references) == MOST_REFERENCES:
            del self.references[1 if self._best != 1 else 2]
        self.references.append(reference)
        self._best = len(self.references) - 1


def _median(pictures: list[Grey]) -> Grey:
    return np.asarray(np.median(np.stack(pictures), axis=0), np.uint8)
