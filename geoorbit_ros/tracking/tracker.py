"""The tracker: detections of one camera, frame by frame, become tracks with lasting ids.

Two-stage association by confidence is ByteTrack's (Zhang et al. 2022, arXiv:2110.06864); predicting
from the last observation instead of from accumulated predictions is OC-SORT's (Cao et al. 2023,
arXiv:2203.14360, section 4.1).
"""

from __future__ import annotations

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
    Pairs,
    assign,
    candidate_pairs,
    complete_cut_boxes,
)
from geoorbit_ros.tracking.motion_model import MEAN, MotionNoise, correct_in_doubt, predict, start
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.track_table import FrameDetections, TrackTable, prepare
from geoorbit_ros.tracking.traffic_model import (
    KEPT_SCORES,
    Flow,
    PredictionGate,
    ScoreModel,
    UnsteadyMotion,
    hidden,
    log_odds,
)

Array = NDArray[np.float64]

GAP_COST = 3.0
"""Cost of a second unobserved: the longer, the more likely the vehicle is gone and this another.
Chosen: larger loses vehicles behind trucks, smaller gives their ids to others."""
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
        self._needed = float(
            log_odds(np.array(self._p.confirm_score)) - log_odds(np.array(self._p.birth_score))
        )
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
        self._tracks = TrackTable()
        self._flow = Flow()
        self._gate = PredictionGate()
        self._scores = ScoreModel(self._p.birth_score)
        self._motion = UnsteadyMotion(MotionNoise())
        self._stamp_ns: int | None = None
        self._weight = 1.0

    @property
    def alive(self) -> int:
        """Confirmed tracks, unobserved ones included."""
        return int(np.count_nonzero(self._tracks.track_id))

    @property
    def lost(self) -> int:
        """Confirmed tracks that were not observed in the last frame."""
        tracks = self._tracks
        return int(np.count_nonzero((tracks.track_id > 0) & (tracks.missed > 0)))

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
        found = prepare(detections, self._p, noise)
        self._count(detections, found)
        tracks = self._tracks
        self._end(self._expired(tracks.elapsed_s(stamp_ns)))
        elapsed_s = tracks.elapsed_s(stamp_ns)
        predicted = predict(tracks.state, elapsed_s, noise)
        partner = self._associate(stamp_ns, predicted, elapsed_s, found)
        hit = np.flatnonzero(partner >= 0)
        of_hit = partner[hit]
        self.counts.recovered += int(
            np.count_nonzero((elapsed_s[hit] > self._p.predict_s) & (tracks.track_id[hit] > 0))
        )
        tracks.missed += 1
        measured, variance = self._measured(predicted[MEAN][:, hit], hit, of_hit, found)
        known = tracks.hits[hit] >= KEPT_SCORES
        self._motion.learn(predicted[:, :, hit[known]], measured[:, known], variance[:, known])
        state = correct_in_doubt(predicted[:, :, hit], measured, variance)
        self._weigh(partner, found)
        # A vehicle that enters piece by piece shows no speed: its motion begins with a whole box.
        anew = tracks.entering[hit]
        state[:, :, anew] = self._start(found, of_hit[anew])
        self._gate.learn(tracks.predicted_frames[:, hit], right=True)
        before_s = tracks.observed_s()[hit]
        tracks.observe(hit, stamp_ns, state, found, of_hit)
        due = tracks.observed_s()[hit] // FLOW_S > before_s // FLOW_S
        self._flow.add(state[:, :, due & (tracks.track_id[hit] > 0) & ~anew])
        left = self._outside(predicted)
        predicted = predicted[:, :, ~left]
        self._end(left)
        self._begin(stamp_ns, found, partner)
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

    def _count(self, detections: NDArray[np.void], found: FrameDetections) -> None:
        self.counts.frames += 1
        self.counts.detections += len(detections)
        self.counts.unusable += found.unusable
        self.counts.weak += len(detections) - found.unusable - len(found)

    def _associate(
        self, stamp_ns: int, predicted: Array, elapsed_s: Array, found: FrameDetections
    ) -> NDArray[np.intp]:
        """(N,) detection that continues each track, -1 for none."""
        tracks = self._tracks
        partner = np.full(len(tracks), -1, dtype=np.intp)
        if not len(tracks) or not len(found):
            return partner
        pairs = candidate_pairs(
            predicted,
            GAP_COST * elapsed_s,
            tracks.track_id > 0,
            tracks.class_id,
            ~tracks.entering,
            found,
            self._scores.doubt(found.score_bin) + WEAK_COST * ~found.strong,
            (self._p.image_width, self._p.image_height),
        )
        of_strong = found.strong[pairs.detection]
        _settle(partner, pairs.where(of_strong), LEAVE_COST)
        doubtful_s = (stamp_ns - tracks.sure_ns) * 1e-9
        trusted = (elapsed_s < WEAK_GAP_S) & (doubtful_s < WEAK_S)
        open_weak = ~of_strong & (partner[pairs.track] < 0) & trusted[pairs.track]
        if open_weak.any():
            _settle(partner, pairs.where(open_weak), LEAVE_COST)
        return partner

    def _measured(
        self, mean: Array, hit: NDArray[np.intp], of_hit: NDArray[np.intp], found: FrameDetections
    ) -> tuple[Array, Array]:
        """Measurements (4, H) of the tracks `hit` and their variances, cut boxes completed."""
        measured, variance = found.measured[:, of_hit], found.variance[:, of_hit]
        cut = found.cut[of_hit] & ~self._tracks.entering[hit]
        if cut.any():
            size = (self._p.image_width, self._p.image_height)
            measured[:, cut], variance[:, cut] = complete_cut_boxes(
                mean[:, cut], measured[:, cut], variance[:, cut], size
            )
        return measured, variance

    def _weigh(self, partner: NDArray[np.intp], found: FrameDetections) -> None:
        """Take what this frame says for and against each track being a vehicle."""
        tracks = self._tracks
        hit = np.flatnonzero(partner >= 0)
        of_hit = partner[hit]
        bins = found.score_bin[of_hit]
        says = self._scores.evidence(bins) + self._per_hit
        says[~found.strong[of_hit]] = 0.0
        tracks.evidence[hit] += self._weight * says
        unseen = (partner < 0) & (tracks.track_id == 0)
        tracks.evidence[unseen] -= self._weight * MISS_EVIDENCE
        early = tracks.hits[hit] < KEPT_SCORES
        tracks.score_bins[tracks.hits[hit[early]], hit[early]] = bins[early]
        lasting = hit[tracks.hits[hit] == LASTING_HITS - 1]
        if len(lasting):
            self._scores.learn(tracks.score_bins[:, lasting], lasted=True)
        self._scores.observe(bins[tracks.hits[hit] >= LASTING_HITS])

    def _confirm(self) -> None:
        tracks = self._tracks
        sure = (tracks.evidence >= self._needed) | (tracks.observed_s() >= CONFIRM_S)
        fresh = np.flatnonzero((tracks.track_id == 0) & (tracks.missed == 0) & sure)
        if len(fresh):
            if self._next_id + len(fresh) - 1 > MAX_ID:
                self._next_id = 1
            tracks.track_id[fresh] = self._next_id + np.arange(len(fresh))
            self._next_id += len(fresh)
            self.counts.births += len(fresh)

    def _expired(self, elapsed_s: Array) -> NDArray[np.bool_]:
        """(N,) tracks that have been unobserved for too long."""
        tracks = self._tracks
        expired = elapsed_s > self._p.max_gap_s
        if len(tracks) > MAX_TRACKS:
            longest = np.argsort(-elapsed_s, kind="stable")
            expired[longest[: len(tracks) - MAX_TRACKS]] = True
        return expired

    def _outside(self, predicted: Array) -> NDArray[np.bool_]:
        """(N,) unobserved tracks that have left the image."""
        x, y = predicted[MEAN, 0], predicted[MEAN, 1]
        if not self._p.image_width:
            return np.zeros(len(x), dtype=bool)
        outside = (x < 0.0) | (x > self._p.image_width) | (y < 0.0) | (y > self._p.image_height)
        return np.asarray(outside & (self._tracks.missed > 0))

    def _end(self, ended: NDArray[np.bool_]) -> None:
        if ended.any():
            tracks = self._tracks
            self._gate.learn(tracks.predicted_frames[:, ended], right=False)
            early = ended & (tracks.hits <= EARLY_HITS) & ~tracks.cut
            if early.any():
                self._scores.learn(tracks.score_bins[:, early], lasted=False)
            self.counts.deaths += int(np.count_nonzero(ended & (self._tracks.track_id > 0)))
            self._tracks.keep(~ended)

    def _begin(self, stamp_ns: int, found: FrameDetections, partner: NDArray[np.intp]) -> None:
        free = found.score >= self._p.birth_score
        free[partner[partner >= 0]] = False
        new = np.flatnonzero(free)
        if len(new):
            state = self._start(found, new)
            started = TrackTable.started(stamp_ns, state, found, new, self._scores)
            started.evidence *= self._weight
            self._tracks.append(started)

    def _start(self, found: FrameDetections, which: NDArray[np.intp]) -> Array:
        """(5, 4, K) states of vehicles seen for the first time in detections `which`."""
        box = found.box[:, which]
        return start(box, found.variance[:, which], *self._flow.expect(box, self._motion.noise))

    def _output(self, stamp_ns: int, predicted: Array, found: FrameDetections) -> NDArray[np.void]:
        """Rows to publish; `predicted` (5, 4, K) holds the states of the first K tracks."""
        tracks = self._tracks
        seen = np.flatnonzero((tracks.track_id > 0) & (tracks.missed == 0))
        unseen, boxes = self._predicted_boxes(stamp_ns, predicted, found)
        shown = np.concatenate([seen, unseen])
        flags = np.where(tracks.cut[shown], FLAG_TRUNCATED, 0)
        flags[len(seen) :] = FLAG_PREDICTED
        rows = np.empty(len(shown), PIXEL_TRACK_DTYPE)
        box = np.concatenate([tracks.box[:, seen], boxes], axis=1)
        rows["x"], rows["y"], rows["width"], rows["height"] = box
        rows["score"], rows["class_id"] = tracks.score[shown], tracks.class_id[shown]
        rows["track_id"], rows["flags"] = tracks.track_id[shown], flags
        return rows[np.argsort(tracks.track_id[shown])]

    def _predicted_boxes(
        self, stamp_ns: int, predicted: Array, found: FrameDetections
    ) -> tuple[NDArray[np.intp], Array]:
        """Unobserved tracks (U,) that may be shown, and the boxes (4, U) to show."""
        tracks = self._tracks
        trusted_s = np.minimum(PREDICTED_SHARE * tracks.observed_s(), self._p.predict_s)
        recent = (tracks.missed > 0) & (tracks.elapsed_s(stamp_ns) <= trusted_s)
        unseen = np.flatnonzero((tracks.track_id > 0) & recent)
        box = predicted[MEAN][:, unseen]
        box[2:] = np.exp(box[2:])
        behind = hidden(box, found.box)
        tracks.predicted_frames[behind.astype(np.intp), unseen] += 1.0
        trusted = self._gate.trusted(behind)
        return unseen[trusted], box[:, trusted]


def _settle(partner: NDArray[np.intp], pairs: Pairs, limit: float) -> None:
    """Write the cheapest assignment of `pairs` into `partner`."""
    chosen = assign(pairs.track, pairs.detection, pairs.cost, limit)
    partner[pairs.track[chosen]] = pairs.detection[chosen]


def outside_image(rows: NDArray[np.void], width: int, height: int) -> tuple[float, float] | None:
    """Right- and lowermost middle of `DETECTION_DTYPE` boxes where it lies outside the image."""
    if not len(rows):
        return None
    x, y = float(rows["x"].max()), float(rows["y"].max())
    return (x, y) if x > width or y > height else None
