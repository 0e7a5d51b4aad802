"""The tracker: detections of one camera, frame by frame, become tracks with lasting ids.

Two-stage association by confidence is ByteTrack's (Zhang et al. 2022, arXiv:2110.06864); predicting
from the last observation instead of from accumulated predictions is OC-SORT's (Cao et al. 2023,
arXiv:2203.14360, section 4.1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core import plugins
from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.plugin_methods import Returns, WrongResult, what
from geoorbit_ros.core.tables import (
    DETECTION_DTYPE,
    FLAG_PREDICTED,
    FLAG_TRUNCATED,
    PIXEL_TRACK_DTYPE,
    RANGES,
    range_fault,
    table_fault,
)
from geoorbit_ros.tracking.association import (
    LEAVE_COST,
    WEAK_COST,
    assign,
    candidate_pairs,
    complete_cut_box,
)
from geoorbit_ros.tracking.motion_model import (
    MEAN,
    Four,
    MotionNoise,
    State,
    box_of,
    correct_in_doubt,
    predict,
    start,
)
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.track import Detection, Track, prepare
from geoorbit_ros.tracking.traffic_model import (
    KEPT_SCORES,
    Flow,
    OverlapModel,
    PredictionGate,
    ScoreModel,
    UnsteadyMotion,
    covered_share,
    is_hidden,
    log_odds,
    surprise,
)

WEAK_GAP_S = 0.8
"""Weak detections continue tracks that were observed this recently. Chosen: longer lets false boxes
take over lost tracks, shorter loses far vehicles."""
WEAK_S = 8.0
"""They do so for at most this long without a confident detection: a weak box that stays for ever is
no vehicle. Chosen on `off_ramp_diverge`, seed 5, where such a box was followed for half a
minute."""
PREDICTED_SHARE = 0.3
"""A track is predicted for at most this share of the time that it was observed. Chosen: larger
shows wrong predictions of short tracks, smaller shows fewer right ones."""
FLOW_S = 0.3
"""A track tells how traffic moves once in this time. Chosen: shorter fills the memory with one slow
vehicle, longer learns later."""
LASTING_HITS = 10
"""Observations of a track that lasts. Chosen: fewer take repeated false boxes for vehicles, more
learn later."""
EARLY_HITS = 5
"""A track that ends with at most so many observations, away from the border, ended early. Chosen on
KITTI tracking and the scenes: with 2 repeated false boxes teach nothing."""
MISS_EVIDENCE = 1.0
"""What a frame without detection says against an unconfirmed track. Chosen: larger loses vehicles
that a detector sees now and then."""
EVIDENCE_S = 0.09
"""What is seen sooner after the image before says less: a false box is there again in the next one.
Chosen: ten images per second each count fully; larger shows vehicles later, smaller shows false
boxes."""
CONFIRM_S = 5.0
"""A track observed for so long is confirmed whatever its scores: what stays and moves as predicted
is something. Chosen: shorter shows false boxes, longer hides vehicles with low scores."""
MAX_TRACKS = 2000
"""More at once are no traffic; those unobserved longest are dropped. Bounds memory."""
MAX_ID = 2**31 - 1
"""Largest id that the int32 field `track_id` holds."""


@dataclass(slots=True)
class TrackerCounts:
    """What has happened so far.

    Attributes:
        frames: Frames given.
        detections: Detections given.
        unusable: Of these, not finite or without area.
        weak: Of these, too weak to count.
        births: Tracks confirmed.
        deaths: Confirmed tracks that ended.
        recovered: Confirmed tracks observed again after `predict_s` or more.
    """

    frames: int = 0
    detections: int = 0
    unusable: int = 0
    weak: int = 0
    births: int = 0
    deaths: int = 0
    recovered: int = 0


@runtime_checkable
class VehicleTracker(Protocol):
    """Gives the detections of one camera lasting ids, frame by frame.

    A plug-in with a class method `from_settings` is made from `TrackerParameters`, any other
    without arguments.
    """

    @property
    def counts(self) -> TrackerCounts:
        """What has happened so far."""

    @property
    def alive(self) -> int:
        """Confirmed tracks, unobserved ones included."""

    @property
    def lost(self) -> int:
        """Confirmed tracks that were not observed in the last frame."""

    def update(self, stamp_ns: int, detections: NDArray[np.void]) -> NDArray[np.void]:
        """Take one frame of `DETECTION_DTYPE`, later than the one before.

        Returns:
            `PIXEL_TRACK_DTYPE`, ordered by id.
        """

    def reset(self) -> None:
        """Forget all tracks, for a source that starts again; ids go on."""


def make_tracker(
    name: str = "kalman", parameters: TrackerParameters | None = None
) -> VehicleTracker:
    """A fresh tracker, by its registered name or as `FILE.py:CLASS`.

    Raises:
        ParameterError: No tracker has this name, or the file has no such class.
    """
    return plugins.make(
        "tracker",
        name,
        VehicleTracker,  # type: ignore[type-abstract]
        parameters or TrackerParameters(),
        returns={
            "update": Returns(
                f"(N,) rows of PIXEL_TRACK_DTYPE, {RANGES}, each track_id above 0 and once",
                _check_tracks,
            ),
            "counts": Returns("a TrackerCounts", _check_counts),
            "alive": Returns("a whole number", _check_number),
            "lost": Returns("a whole number", _check_number),
        },
    )


def _check_tracks(_: object, __: tuple[Any, ...], rows: NDArray[np.void]) -> NDArray[np.void]:
    if fault := table_fault(rows, PIXEL_TRACK_DTYPE) or range_fault(rows):
        raise WrongResult(fault)
    track_id = rows["track_id"]
    if len(track_id) and track_id.min() <= 0:
        raise WrongResult(f"track_id {track_id.min()}")
    ids, times = np.unique(track_id, return_counts=True)
    if (times > 1).any():
        raise WrongResult(f"track_id {ids[np.argmax(times)]} in {times.max()} rows")
    return rows


def _check_counts(_: object, __: object, counts: object) -> TrackerCounts:
    if not isinstance(counts, TrackerCounts):
        raise WrongResult(what(counts))
    return counts


def _check_number(_: object, __: object, number: object) -> object:
    if isinstance(number, bool) or not isinstance(number, int | np.integer):
        raise WrongResult(repr(number))
    return number


@plugins.register("tracker", "kalman")
class Tracker:
    """Follows all vehicles of one camera at once.

    The result depends on stamps and boxes alone: not on the order of detections within a frame,
    not on when it is computed. Ids are given in the order of confirmation and never again, also
    after `reset`.

    Args:
        parameters: See `TrackerParameters`.

    Attributes:
        counts: What has happened so far.
    """

    def __init__(self, parameters: TrackerParameters | None = None) -> None:
        self._p = parameters or TrackerParameters()
        self._needed = log_odds(self._p.confirm_score) - log_odds(self._p.birth_score)
        self._per_hit = self._needed / max(self._p.confirm_hits - 1, 1)
        self._next_id = self._p.first_id
        self.counts = TrackerCounts()
        self.reset()

    @classmethod
    def from_settings(cls, parameters: TrackerParameters) -> Self:
        """A tracker with these parameters."""
        return cls(parameters)

    def reset(self) -> None:
        """Forget all tracks, for a source that starts again; ids go on."""
        self._tracks: list[Track] = []
        self._flow = Flow()
        self._gate = PredictionGate()
        self._scores = ScoreModel(self._p.birth_score)
        self._overlaps = OverlapModel()
        self._motion = UnsteadyMotion(MotionNoise())
        self._stamp_ns: int | None = None
        self._weight = 1.0

    @property
    def alive(self) -> int:
        """Confirmed tracks, unobserved ones included."""
        return sum(track.track_id > 0 for track in self._tracks)

    @property
    def lost(self) -> int:
        """Confirmed tracks that were not observed in the last frame."""
        return sum(track.track_id > 0 and track.missed > 0 for track in self._tracks)

    def update(self, stamp_ns: int, detections: NDArray[np.void]) -> NDArray[np.void]:
        """Take one frame.

        Args:
            stamp_ns: Capture time, later than that of the frame before.
            detections: (M,) `DETECTION_DTYPE`, in any order.

        Returns:
            `PIXEL_TRACK_DTYPE`, ordered by id: the detection of every confirmed track, and the
            predicted box, flagged, of those unobserved for at most `predict_s`. The class is the
            one that the track was given most often.

        Raises:
            TableError: Rows of another dtype, or a stamp not later than the one before.
        """
        self._check(stamp_ns, detections)
        noise = self._motion.noise
        found, unusable = prepare(detections, self._p, noise)
        self._count(len(detections), unusable, len(found))
        self._end(self._expired(stamp_ns))
        elapsed_s = [track.elapsed_s(stamp_ns) for track in self._tracks]
        predicted = [
            predict(track.state, elapsed, noise)
            for track, elapsed in zip(self._tracks, elapsed_s, strict=True)
        ]
        partner = self._associate(stamp_ns, predicted, elapsed_s, found)
        self._observe(stamp_ns, predicted, found, partner)
        left = self._outside(predicted)
        if left:
            predicted = [state for i, state in enumerate(predicted) if i not in left]
            self._end(left)
        self._begin(stamp_ns, found, set(partner.values()))
        self._hold_against_neighbours()
        self._confirm()
        return self._output(stamp_ns, predicted, found)

    def _check(self, stamp_ns: int, detections: NDArray[np.void]) -> None:
        if detections.dtype != DETECTION_DTYPE:
            raise TableError("detections", detections.dtype.names, f"{DETECTION_DTYPE.names}")
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            found = f"stamp {stamp_ns} ns after {self._stamp_ns} ns"
            raise TableError("detections", found, "stamps that increase")
        if self._stamp_ns is not None:
            self._weight = min((stamp_ns - self._stamp_ns) / 1e9 / EVIDENCE_S, 1.0)
        self._stamp_ns = stamp_ns

    def _count(self, given: int, unusable: int, used: int) -> None:
        self.counts.frames += 1
        self.counts.detections += given
        self.counts.unusable += unusable
        self.counts.weak += given - unusable - used

    def _associate(
        self,
        stamp_ns: int,
        predicted: Sequence[State],
        elapsed_s: Sequence[float],
        found: Sequence[Detection],
    ) -> dict[int, int]:
        """Track to the detection that continues it."""
        of_bin = {
            score_bin: self._scores.doubt(score_bin)
            for score_bin in {each.score_bin for each in found}
        }
        doubt = [of_bin[each.score_bin] + (0.0 if each.strong else WEAK_COST) for each in found]
        pairs = candidate_pairs(self._tracks, predicted, elapsed_s, found, doubt)
        strong = assign([pair for pair in pairs if found[pair.detection].strong], LEAVE_COST)
        partner = {pair.track: pair.detection for pair in strong}
        weak = [
            pair
            for pair in pairs
            if not found[pair.detection].strong
            and pair.track not in partner
            and elapsed_s[pair.track] < WEAK_GAP_S
            and (stamp_ns - self._tracks[pair.track].sure_ns) * 1e-9 < WEAK_S
        ]
        partner.update((pair.track, pair.detection) for pair in assign(weak, LEAVE_COST))
        return partner

    def _observe(
        self,
        stamp_ns: int,
        predicted: Sequence[State],
        found: Sequence[Detection],
        partner: Mapping[int, int],
    ) -> None:
        """Take what this frame says of each track: where it is, and whether it is a vehicle."""
        surprises: list[float] = []
        lasting: list[int] = []
        for i, (track, ahead) in enumerate(zip(self._tracks, predicted, strict=True)):
            if i not in partner:
                track.missed += 1
                if not track.track_id:
                    track.evidence -= self._weight * MISS_EVIDENCE
                continue
            detection = found[partner[i]]
            measured, variance = detection.measured, detection.variance
            if detection.cut and not track.entering:
                measured, variance = complete_cut_box(ahead, detection)
            if track.hits >= KEPT_SCORES:
                surprises.append(surprise(ahead, measured, variance))
            self._weigh(track, detection)
            if track.hits >= LASTING_HITS:
                lasting.append(detection.score_bin)
            # A vehicle that enters piece by piece shows no speed: its motion begins with a whole
            # box.
            anew = track.entering
            state = self._start(detection) if anew else correct_in_doubt(ahead, measured, variance)
            if track.track_id and track.elapsed_s(stamp_ns) > self._p.predict_s:
                self.counts.recovered += 1
            self._gate.learn(track.predicted_open, track.predicted_hidden, right=True)
            before_s = track.observed_s
            track.observe(stamp_ns, state, detection)
            due = track.observed_s // FLOW_S > before_s // FLOW_S
            if due and track.track_id and not anew:
                self._flow.add(state)
        self._scores.observe(lasting)
        self._motion.learn(surprises)

    def _weigh(self, track: Track, detection: Detection) -> None:
        """Take what a detection says for or against its track being a vehicle."""
        if detection.strong:
            says = self._scores.evidence(detection.score_bin) + self._per_hit
            track.evidence += self._weight * says
        if track.hits < KEPT_SCORES:
            track.score_bins.append(detection.score_bin)
        if track.hits == LASTING_HITS - 1:
            self._scores.learn(track.score_bins, lasted=True)
            self._overlaps.learn(track.overlap, lasted=True)

    def _hold_against_neighbours(self) -> None:
        """Take what new tracks' overlap with vehicles already followed says of them."""
        seen = [track for track in self._tracks if not track.missed]
        new = [track for track in seen if not track.track_id and track.hits <= KEPT_SCORES]
        followed = [track.box for track in seen if track.track_id] if new else []
        for track in new:
            kind = self._overlaps.kind_of(covered_share(track.box, followed))
            if kind > track.overlap:
                evidence = self._overlaps.evidence
                track.evidence += evidence(kind) - evidence(track.overlap)
                track.overlap = kind

    def _confirm(self) -> None:
        for track in self._tracks:
            if track.track_id or track.missed:
                continue
            if track.evidence >= self._needed or track.observed_s >= CONFIRM_S:
                track.track_id = self._next_id
                self._next_id = self._next_id % MAX_ID + 1
                self.counts.births += 1

    def _expired(self, stamp_ns: int) -> set[int]:
        """Tracks that have been unobserved for too long."""
        oldest_ns = stamp_ns - self._p.max_gap_s * 1e9
        expired = {i for i, track in enumerate(self._tracks) if track.stamp_ns < oldest_ns}
        if len(self._tracks) > MAX_TRACKS:
            longest = sorted(range(len(self._tracks)), key=lambda i: self._tracks[i].stamp_ns)
            expired.update(longest[: len(self._tracks) - MAX_TRACKS])
        return expired

    def _outside(self, predicted: Sequence[State]) -> set[int]:
        """Unobserved tracks that have left the image."""
        width, height = self._p.image_width, self._p.image_height
        if not width:
            return set()
        return {
            i
            for i, (x, y, *_) in enumerate(predicted)
            if self._tracks[i].missed and not (0.0 <= x[MEAN] <= width and 0.0 <= y[MEAN] <= height)
        }

    def _end(self, ended: Set[int]) -> None:
        if not ended:
            return
        for i in sorted(ended):
            track = self._tracks[i]
            self._gate.learn(track.predicted_open, track.predicted_hidden, right=False)
            if track.hits <= EARLY_HITS and not track.cut:
                self._scores.learn(track.score_bins, lasted=False)
                self._overlaps.learn(track.overlap, lasted=False)
            self.counts.deaths += track.track_id > 0
        self._tracks = [track for i, track in enumerate(self._tracks) if i not in ended]

    def _begin(self, stamp_ns: int, found: Sequence[Detection], taken: Set[int]) -> None:
        prior = self._scores.prior
        for j, detection in enumerate(found):
            if detection.score >= self._p.birth_score and j not in taken:
                evidence = self._weight * (self._scores.evidence(detection.score_bin) + prior)
                state = self._start(detection)
                self._tracks.append(Track.started(stamp_ns, state, detection, evidence))

    def _start(self, detection: Detection) -> State:
        """State of a vehicle seen for the first time."""
        expected = self._flow.expect(detection.box, self._motion.noise)
        return start(detection.box, detection.variance, *expected)

    def _output(
        self, stamp_ns: int, predicted: Sequence[State], found: Sequence[Detection]
    ) -> NDArray[np.void]:
        """Rows to publish; `predicted` holds the states of the first tracks."""
        rows = []
        for i, track in enumerate(self._tracks):
            if not track.track_id:
                continue
            box, flags = track.box, FLAG_TRUNCATED if track.cut else 0
            if track.missed:
                trusted_s = min(PREDICTED_SHARE * track.observed_s, self._p.predict_s)
                if track.elapsed_s(stamp_ns) > trusted_s:
                    continue
                box, flags = box_of(predicted[i]), FLAG_PREDICTED
                if not self._is_shown(track, box, found):
                    continue
            rows.append((*box, track.score, track.class_id, track.track_id, flags))
        rows.sort(key=_by_id)
        return np.array(rows, PIXEL_TRACK_DTYPE)

    def _is_shown(self, track: Track, box: Four, found: Sequence[Detection]) -> bool:
        """Whether a predicted box is; counts the prediction."""
        behind = is_hidden(box, (detection.box for detection in found))
        track.predicted_hidden += behind
        track.predicted_open += not behind
        return self._gate.trusted(behind)


_Row = tuple[float, float, float, float, float, int, int, int]


def _by_id(row: _Row) -> int:
    return row[6]


def outside_image(rows: NDArray[np.void], width: int, height: int) -> tuple[float, float] | None:
    """Right- and lowermost middle of `DETECTION_DTYPE` boxes where it lies outside the image."""
    if not len(rows):
        return None
    x, y = float(rows["x"].max()), float(rows["y"].max())
    return (x, y) if x > width or y > height else None
