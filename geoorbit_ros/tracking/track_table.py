"""All tracks of one camera as arrays, one column per track."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.tracking.frame_detections import FrameDetections

Array = NDArray[np.float64]


def _integers() -> NDArray[np.int64]:
    return np.empty(0, np.int64)


@dataclass(slots=True)
class TrackTable:
    """N tracks in the order of their birth.

    Attributes:
        state: (5, 4, N) motion at the last observation, see `motion`.
        box: (4, N) last observed box: x, y, width, height in pixels.
        born_ns: (N,) time of the first observation.
        stamp_ns: (N,) time of the last observation.
        sure_ns: (N,) time of the last observation by a confident detection.
        track_id: (N,) 0 until the track is confirmed.
        hits: (N,) observations.
        missed: (N,) frames since the last observation.
        class_id: (N,) class with the most votes.
        lead: (N,) its lead over the others, in votes weighted by confidence.
        score: (N,) confidence of the last observation.
        cut: (N,) whether the image border cut the last box.
        entering: (N,) whether the border cut all boxes so far.
        foreseen: (2, N) frames since the last observation in which it was predicted in the open and
            hidden.
    """

    state: Array = field(default_factory=lambda: np.empty((5, 4, 0)))
    box: Array = field(default_factory=lambda: np.empty((4, 0)))
    born_ns: NDArray[np.int64] = field(default_factory=_integers)
    stamp_ns: NDArray[np.int64] = field(default_factory=_integers)
    sure_ns: NDArray[np.int64] = field(default_factory=_integers)
    track_id: NDArray[np.int64] = field(default_factory=_integers)
    hits: NDArray[np.int64] = field(default_factory=_integers)
    missed: NDArray[np.int64] = field(default_factory=_integers)
    class_id: NDArray[np.int64] = field(default_factory=_integers)
    lead: Array = field(default_factory=lambda: np.empty(0))
    score: Array = field(default_factory=lambda: np.empty(0))
    cut: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    entering: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    foreseen: Array = field(default_factory=lambda: np.empty((2, 0)))

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def elapsed_s(self, stamp_ns: int) -> Array:
        """(N,) time since the last observation of each."""
        return np.asarray((stamp_ns - self.stamp_ns) * 1e-9, dtype=np.float64)

    def observed_s(self) -> Array:
        """(N,) time from the first to the last observation of each."""
        return np.asarray((self.stamp_ns - self.born_ns) * 1e-9, dtype=np.float64)

    @classmethod
    def started(
        cls, stamp_ns: int, state: Array, found: FrameDetections, which: NDArray[np.intp]
    ) -> TrackTable:
        """Unconfirmed tracks in `state`, observed for the first time in detections `which`."""
        zeros = np.zeros(len(which), np.int64)
        score = found.score[which]
        return cls(
            state=state,
            box=found.box[:, which],
            born_ns=zeros + stamp_ns,
            stamp_ns=zeros + stamp_ns,
            sure_ns=zeros + stamp_ns,
            track_id=zeros,
            hits=zeros + 1,
            missed=zeros.copy(),
            class_id=found.class_id[which],
            lead=score.copy(),
            score=score,
            cut=found.cut[which],
            entering=found.cut[which],
            foreseen=np.zeros((2, len(which))),
        )

    def observe(
        self,
        which: NDArray[np.intp],
        stamp_ns: int,
        state: Array,
        found: FrameDetections,
        partner: NDArray[np.intp],
    ) -> None:
        """Tracks `which` are seen in detections `partner` and have `state` (5, 4, K) now."""
        self.state[:, :, which] = state
        self.box[:, which] = found.box[:, partner]
        self.stamp_ns[which] = stamp_ns
        self.sure_ns[which[found.strong[partner]]] = stamp_ns
        self.hits[which] += 1
        self.missed[which] = 0
        self.foreseen[:, which] = 0.0
        score = found.score[partner]
        self.score[which] = score
        self.cut[which] = found.cut[partner]
        self.entering[which] &= found.cut[partner]
        # The majority vote of Boyer and Moore (1981): one candidate and its lead are enough.
        kind = found.class_id[partner]
        lead = self.lead[which] + np.where(self.class_id[which] == kind, score, -score)
        self.class_id[which] = np.where(lead < 0.0, kind, self.class_id[which])
        self.lead[which] = np.abs(lead)

    def keep(self, which: NDArray[np.bool_]) -> None:
        """Drop all other tracks."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name)[..., which])

    def append(self, other: TrackTable) -> None:
        """Add tracks at the end."""
        for name in self.__slots__:
            both = (getattr(self, name), getattr(other, name))
            setattr(self, name, np.concatenate(both, axis=-1))
