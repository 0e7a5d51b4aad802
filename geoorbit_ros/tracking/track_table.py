"""Detections of one frame, and all tracks of one camera, as arrays with a column for each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.tracking.motion_model import MotionNoise, measurement_variance, measurements
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.traffic_model import KEPT_SCORES, ScoreModel

Array = NDArray[np.float64]


BORDER_RATIO = 0.01
"""Boxes that end within 1 % of the image from its border are cut by it, as in `box_projector`.
Chosen: detectors end cut boxes some pixels early; larger marks whole boxes as cut."""
CUT_FACTOR = 10.0
"""Variance of a cut box relative to a whole one: its centre and size aren't the vehicle's. Chosen:
smaller lets a vehicle that enters seem to come nearer."""
MAX_DETECTIONS = 1000
"""More in a frame are no traffic; the most confident are taken. Bounds memory."""


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """M detections.

    Attributes:
        box: (4, M) x, y, width, height in pixels.
        measured: (4, M) see `motion_model.measurements`.
        variance: (4, M) of `measured`.
        score: (M,) confidence.
        score_bin: (M,) its bin, see `ScoreModel`.
        strong: (M,) whether it is confident.
        class_id: (M,) COCO class.
        cut: (M,) whether the image border cuts the box; False where the image's size is unknown.
        unusable: Detections left out because a number isn't finite or the box has no area.
    """

    box: Array
    measured: Array
    variance: Array
    score: Array
    score_bin: NDArray[np.int64]
    strong: NDArray[np.bool_]
    class_id: NDArray[np.int64]
    cut: NDArray[np.bool_]
    unusable: int

    def __len__(self) -> int:
        return len(self.score)


def prepare(
    rows: NDArray[np.void], parameters: TrackerParameters, noise: MotionNoise
) -> FrameDetections:
    """Detections that can be used and are not too weak, the same for any order of the rows."""
    names = ("x", "y", "width", "height", "score")
    value = np.array([rows[name] for name in names], dtype=np.float64).reshape(5, -1)
    usable = np.isfinite(value).all(axis=0) & (value[2] > 0.0) & (value[3] > 0.0)
    keep = np.flatnonzero(usable & (value[4] >= parameters.low_score))
    value, kind = value[:, keep], rows["class_id"][keep].astype(np.int64)
    order = np.lexsort((kind, value[3], value[2], value[1], value[0], -value[4]))[:MAX_DETECTIONS]
    value, kind = value[:, order], kind[order]
    box = value[:4]
    variance = measurement_variance(box, noise)
    cut = _cut(box, parameters.image_width, parameters.image_height)
    variance[:, cut] *= CUT_FACTOR
    unusable = len(rows) - int(np.count_nonzero(usable))
    score, strong = value[4], value[4] >= parameters.high_score
    bins = ScoreModel.bin_of(score)
    found = measurements(box)
    return FrameDetections(box, found, variance, score, bins, strong, kind, cut, unusable)


def _cut(box: Array, image_width: int, image_height: int) -> NDArray[np.bool_]:
    if not image_width:
        return np.zeros(box.shape[1], dtype=bool)
    size = np.array([[image_width], [image_height]])
    border, half = BORDER_RATIO * size, 0.5 * box[2:]
    return np.asarray(((box[:2] - half < border) | (box[:2] + half > size - border)).any(axis=0))


def _integers() -> NDArray[np.int64]:
    return np.empty(0, np.int64)


@dataclass(slots=True)
class TrackTable:
    """N tracks in the order of their birth.

    Attributes:
        state: (5, 4, N) motion at the last observation, see `motion_model`.
        box: (4, N) last observed box: x, y, width, height in pixels.
        born_ns: (N,) time of the first observation.
        stamp_ns: (N,) time of the last observation.
        sure_ns: (N,) time of the last observation by a confident detection.
        track_id: (N,) 0 until the track is confirmed.
        hits: (N,) observations.
        missed: (N,) frames since the last observation.
        class_id: (N,) class with the most votes.
        lead: (N,) its lead over the others, in votes weighted by confidence and area.
        score: (N,) confidence of the last observation.
        cut: (N,) whether the image border cut the last box.
        entering: (N,) whether the border cut all boxes so far.
        evidence: (N,) log-odds that the track is a vehicle.
        score_bins: (3, N) bins of its first scores, -1 for none, see `ScoreModel`.
        predicted_frames: (2, N) frames since the last observation in which it was predicted in the
            open and hidden.
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
    evidence: Array = field(default_factory=lambda: np.empty(0))
    score_bins: NDArray[np.int64] = field(default_factory=lambda: np.empty((3, 0), np.int64))
    predicted_frames: Array = field(default_factory=lambda: np.empty((2, 0)))

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
        cls,
        stamp_ns: int,
        state: Array,
        found: FrameDetections,
        which: NDArray[np.intp],
        scores: ScoreModel,
    ) -> TrackTable:
        """Unconfirmed tracks in `state`, observed for the first time in detections `which`."""
        zeros = np.zeros(len(which), np.int64)
        score = found.score[which]
        bins = np.full((KEPT_SCORES, len(which)), -1)
        bins[0] = found.score_bin[which]
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
            lead=score * found.box[2:, which].prod(axis=0),
            score=score,
            cut=found.cut[which],
            entering=found.cut[which],
            evidence=scores.evidence(bins[0]) + scores.prior,
            score_bins=bins,
            predicted_frames=np.zeros((2, len(which))),
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
        self.predicted_frames[:, which] = 0.0
        score = found.score[partner]
        self.score[which] = score
        self.cut[which] = found.cut[partner]
        self.entering[which] &= found.cut[partner]
        # The majority vote of Boyer and Moore (1981): one candidate and its lead are enough. The
        # nearer a vehicle, the better it shows what it is.
        kind, votes = found.class_id[partner], score * found.box[2:, partner].prod(axis=0)
        lead = self.lead[which] + np.where(self.class_id[which] == kind, votes, -votes)
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
