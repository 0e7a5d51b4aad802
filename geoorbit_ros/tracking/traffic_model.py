"""What a tracker learns: how vehicles move, which tracks last, how steady the image is."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from geoorbit_ros.tracking.motion_model import MEAN, RATE, Four, MotionNoise, State

CAPACITY = 1000
"""Samples that are kept, the latest ones: a quarter minute of dense traffic, minutes of sparse.
Chosen: twice as many take longer and change no score by 0.01, fewer forget quiet lanes."""
REACH = 2.0
"""1-sigma of the neighbourhood in sizes of the new box: about a lane. Chosen: larger mixes lanes,
smaller finds no samples."""
WIDE_WEIGHT = 1.0
"""Samples that the wide prior counts for, because a vehicle may do what none did before. Chosen:
larger learns later, smaller loses such a vehicle."""


class Flow:
    """Samples of the motion of confirmed tracks."""

    def __init__(self) -> None:
        # x, y, x^2 + y^2, one: the squared distance from any place is a sum of these.
        self._places = np.empty((4, CAPACITY))
        # One, the rates, and their squares: the sums of a mixture are made of these.
        self._moments = np.empty((9, CAPACITY))
        self._count = 0

    def add(self, state: State) -> None:
        """Remember a state."""
        slot = self._count % CAPACITY
        x, y = state[0][MEAN], state[1][MEAN]
        rates = [axis[RATE] for axis in state]
        self._places[:, slot] = x, y, x * x + y * y, 1.0
        self._moments[:, slot] = [1.0, *rates, *(rate * rate for rate in rates)]
        self._count += 1

    def expect(self, box: Four, noise: MotionNoise) -> tuple[Four, Four]:
        """Mean and variance of the rates of a vehicle first seen in a box x, y, width, height.

        They are those of the mixture of the wide prior and the samples nearby, each weighted by its
        distance. Where both directions pass, the mixture is wide again.
        """
        wide = noise.rate_variance(box)
        held = min(self._count, CAPACITY)
        if not held:
            return (0.0, 0.0, 0.0, 0.0), wide
        x, y, width, height = box
        scale = 0.5 / (REACH**2 * width * height)
        terms = np.array([2.0 * x, 2.0 * y, -1.0, -(x * x + y * y)]) * scale
        weight = np.exp(terms @ self._places[:, :held])
        total, *sums = (self._moments[:, :held] @ weight).tolist()
        total += WIDE_WEIGHT
        mean = [rate / total for rate in sums[:4]]
        variance = [
            (WIDE_WEIGHT * prior + square) / total - rate * rate
            for prior, square, rate in zip(wide, sums[4:], mean, strict=True)
        ]
        return _four(mean), _four(variance)


def _four(values: list[float]) -> Four:
    x, y, width, height = values
    return x, y, width, height


HIDDEN_SHARE = 0.5
"""A place that one detection covers to this share is hidden; others are in the open. Chosen: most
of the vehicle is then out of sight."""
PRIOR_RIGHT = 5.0
"""Right predictions that a tracker is credited with at its start. Chosen: more show wrong
predictions for longer, fewer show none after one error."""
LEAST_SHARE = 0.75
"""Share of predictions that must have been right for the next ones to be shown (docs/tracking.md).
Chosen: larger hides useful ones, smaller shows wrong ones."""
MEMORY = 2000.0
"""Predictions after which what was before counts 1/e: some minutes of usual traffic. Chosen: more
adapt to another detector later, fewer are noisier."""


class PredictionGate:
    """Counts of predictions that proved right and wrong, in the open and hidden."""

    def __init__(self) -> None:
        self._right, self._wrong = [PRIOR_RIGHT, PRIOR_RIGHT], [0.0, 0.0]

    def trusted(self, hidden: bool) -> bool:
        """Whether predictions at places that are `hidden` or not may be shown."""
        right, wrong = self._right[hidden], self._wrong[hidden]
        return right / (right + wrong) >= LEAST_SHARE

    def learn(self, in_the_open: int, hidden: int, right: bool) -> None:
        """Take predictions that proved right or wrong.

        Args:
            in_the_open: How often a track was predicted in the open.
            hidden: How often behind another vehicle.
            right: Whether it came back, or ended.
        """
        if not in_the_open + hidden:
            return
        fade = math.exp(-(in_the_open + hidden) / MEMORY)
        self._right = [fade * count for count in self._right]
        self._wrong = [fade * count for count in self._wrong]
        counts = self._right if right else self._wrong
        counts[False] += in_the_open
        counts[True] += hidden


def is_hidden(box: Four, found: Iterable[Four]) -> bool:
    """Whether a box x, y, width, height lies behind one of others."""
    return covered_share(box, found) >= HIDDEN_SHARE


def covered_share(box: Four, others: Iterable[Four]) -> float:
    """Largest share of a box x, y, width, height that another one covers."""
    x, y, width, height = box
    most = 0.0
    for other_x, other_y, other_width, other_height in others:
        shared_x = min(0.5 * (width + other_width) - abs(x - other_x), width, other_width)
        shared_y = min(0.5 * (height + other_height) - abs(y - other_y), height, other_height)
        if shared_x > 0.0 and shared_y > 0.0:
            most = max(most, shared_x * shared_y)
    return most / (width * height)


COVERED_LIMITS = (0.2, 0.6)
"""Shares of a new box within a followed vehicle's that part "beside", "partly in" and "in" it.
Chosen on KITTI tracking, the simulated scenes and rendered films: with one limit or three there are
more false tracks."""
PRIOR_STARTS = 1.0
"""Tracks of each kind, in each of these, that the model is credited with at its start. Chosen: more
learn a detector's false boxes later."""


class OverlapModel:
    """What it says against a new track that it began in the box of a vehicle already followed.

    One detector sees a lorry's cab and load as two for a few images; another finds every car of a
    dense row. So the tracks that lasted and those that ended early tell what an overlap is worth,
    as in `ScoreModel`. It never speaks for a track: the vehicle in front or behind explains the
    box.
    """

    def __init__(self) -> None:
        kinds = len(COVERED_LIMITS) + 1
        self._lasting, self._ended = [PRIOR_STARTS] * kinds, [PRIOR_STARTS] * kinds

    @staticmethod
    def kind_of(share: float) -> int:
        """Kind of a covered share: 0 beside other vehicles, 1 partly in one, 2 in it."""
        return sum(share >= limit for limit in COVERED_LIMITS)

    def evidence(self, kind: int) -> float:
        """Log-odds that a start of this kind takes from those of one beside other vehicles."""
        odds = self._lasting[kind] / self._ended[kind]
        beside = self._lasting[0] / self._ended[0]
        return min(max(math.log(odds / beside), -MAX_EVIDENCE), 0.0)

    def learn(self, kind: int, lasted: bool) -> None:
        """Take a track that began so, and lasted or ended early."""
        kept = math.exp(-1.0 / TRACK_MEMORY)
        self._lasting = [kept * count for count in self._lasting]
        self._ended = [kept * count for count in self._ended]
        (self._lasting if lasted else self._ended)[kind] += 1.0


SCORE_BINS = 24
"""Bins of a score's log-odds from -6 to 6. Chosen: more need more tracks to fill."""
KEPT_SCORES = 3
"""A track teaches with its first scores: those that decide whether it is confirmed. Chosen."""
PRIOR_TRACKS = 5.0
"""Tracks of each kind that the model is credited with at its start. Chosen on KITTI tracking and
the simulated scenes (docs/tracking.md): more learn a detector's scores later, fewer are noisier."""
TRACK_MEMORY = 1000.0
"""Tracks after which what was before counts 1/e. Chosen: some minutes of dense traffic."""
MAX_EVIDENCE = 3.0
"""Most that one score says for or against a vehicle, as log-odds of 20 to 1. Chosen: larger lets
one wild score decide."""
OBSERVATION_WEIGHT = 0.1
"""What a score of a track that lasts teaches, in tracks: the next ones are much the same. Chosen:
larger learns from a few vehicles what all look like."""
OBSERVATION_MEMORY = 3000.0
"""Observations, in tracks, after which what was before counts 1/e. Chosen."""
DOUBT_COST = 5.0
"""Cost of a detection for each unit of log-likelihood by which its score is rather a false box's.
Two would be its likelihood. Chosen on KITTI tracking and the simulated scenes: larger loses far
vehicles, smaller lets false boxes continue tracks."""
PRIOR_WEIGHT = 3.0
"""Weight of the share of tracks that last. Chosen on the same data: larger waits longer where a
detector sees many false boxes, smaller shows more of them."""
MAX_PRIOR = 2.0
"""Most that this share says for a new track, as log-odds. Chosen: with 3 a film at 25 images per
second has a quarter more short false tracks, with less vehicles are shown later."""


def log_odds(score: float) -> float:
    """Log-odds of a probability, within what a detector's rounding can tell."""
    inside = min(max(score, 1e-4), 1.0 - 1e-4)
    return math.log(inside / (1.0 - inside))


class ScoreModel:
    """What a detection's score says about whether a track lasts, learnt from those that did.

    Detectors differ: one gives 0.6 to vehicles, another to leaves. A vehicle is seen again and
    again; most false boxes are gone after a few frames. So the scores with which tracks begin that
    lasted, and that ended early, tell what a score is worth: the likelihood ratio of a sequential
    test (Wald 1945; Blackman and Popoli 1999, section 6.2, for tracks).

    Args:
        neutral: The score that says nothing before anything was learnt.
    """

    def __init__(self, neutral: float) -> None:
        middles = [(k + 0.5) / 2.0 - 6.0 for k in range(SCORE_BINS)]
        spread = [math.exp(-0.5 * (middle / 2.5) ** 2) for middle in middles]
        share = [1.0 / (1.0 + math.exp(log_odds(neutral) - middle)) for middle in middles]
        lasting = [s * share_lasting for s, share_lasting in zip(spread, share, strict=True)]
        ended = [s * (1.0 - share_lasting) for s, share_lasting in zip(spread, share, strict=True)]
        # What the normalisation takes from the ratio of the counts below.
        self._offset = math.log(sum(lasting) / sum(ended))
        self._lasting = _Histogram(lasting)
        self._ended = _Histogram(ended)
        self._observed = _Histogram(lasting)
        self._evidence: dict[int, float] = {}

    @staticmethod
    def bin_of(score: float) -> int:
        """Bin of a score."""
        return min(max(int((log_odds(score) + 6.0) * 2.0), 0), SCORE_BINS - 1)

    def evidence(self, score_bin: int) -> float:
        """Log-likelihood ratio of a score (its bin): of tracks that last, against others."""
        known = self._evidence.get(score_bin)
        if known is None:
            known = self._evidence[score_bin] = _log_ratio(self._lasting, self._ended, score_bin)
        return known

    def doubt(self, score_bin: int) -> float:
        """Cost of a score that false boxes have more often than vehicles followed for long."""
        return DOUBT_COST * max(-_log_ratio(self._observed, self._ended, score_bin), 0.0)

    def observe(self, score_bins: Sequence[int]) -> None:
        """Take bins of the scores of detections that continued tracks that last."""
        if score_bins:
            self._observed.fade(OBSERVATION_WEIGHT * len(score_bins) / OBSERVATION_MEMORY)
            for score_bin in score_bins:
                self._observed.add(score_bin, OBSERVATION_WEIGHT)

    @property
    def prior(self) -> float:
        """Log-odds that a new track lasts."""
        share = math.log(self._lasting.total / self._ended.total)
        return min(PRIOR_WEIGHT * max(share, -2.0), MAX_PRIOR) + self._offset

    def learn(self, score_bins: Sequence[int], lasted: bool) -> None:
        """Take a track.

        Args:
            score_bins: Bins of its first scores, at most `KEPT_SCORES`.
            lasted: Whether it lasted, or ended early.
        """
        self._evidence.clear()
        self._lasting.fade(1.0 / TRACK_MEMORY)
        self._ended.fade(1.0 / TRACK_MEMORY)
        for score_bin in score_bins:
            (self._lasting if lasted else self._ended).add(score_bin, 1.0 / len(score_bins))


class _Histogram:
    """Counts of scores by bin; the older ones fade.

    Args:
        shape: What it begins with, up to a factor: `PRIOR_TRACKS` altogether.
    """

    def __init__(self, shape: Sequence[float]) -> None:
        # A zero at each end: smoothing needs no special case there.
        self._counts = [0.0, *(PRIOR_TRACKS * value / sum(shape) for value in shape), 0.0]
        self.total = PRIOR_TRACKS

    def fade(self, share: float) -> None:
        """Let what was before count exp(-`share`) times as much."""
        kept = math.exp(-share)
        self._counts = [kept * count for count in self._counts]
        self.total *= kept

    def add(self, score_bin: int, weight: float) -> None:
        """Count one score."""
        self._counts[score_bin + 1] += weight
        self.total += weight

    def share(self, score_bin: int) -> float:
        """Share of the scores about here: a quarter of each neighbouring bin and half of this."""
        before, here, after = self._counts[score_bin : score_bin + 3]
        return (0.25 * before + 0.5 * here + 0.25 * after) / self.total


def _log_ratio(lasting: _Histogram, ended: _Histogram, score_bin: int) -> float:
    """Log-likelihood ratio of a score, bounded."""
    ratio = math.log(lasting.share(score_bin) / ended.share(score_bin))
    return min(max(ratio, -MAX_EVIDENCE), MAX_EVIDENCE)


MEDIAN_SQUARE = 1.386
"""Median of the chi-square distribution with 2 degrees of freedom: 2 ln 2."""
ADAPTION = 0.1
"""Share of a frame's surprise that the noise takes over, with five vehicles or more. Chosen: larger
follows single frames, smaller is late when a camera begins to shake."""
FULL_VEHICLES = 5
"""Vehicles of a frame whose median error can be trusted. Chosen."""
MAX_NOISE = 10.0
"""Most that the random change of speed grows. Chosen: a car's camera at ten frames per second needs
three to five (KITTI tracking)."""


class UnsteadyMotion:
    """How much less steadily vehicles move in the image than on a road seen by a still camera.

    A camera that shakes, pans or drives moves all boxes. Then predictions are farther off than
    their spread says; the random change of speed grows until the median error fits (Mehra 1970,
    adaptive Kalman filtering). It never falls below that of a still camera.
    """

    def __init__(self, noise: MotionNoise) -> None:
        self._still = self.noise = noise
        self._log_factor = 0.0

    def learn(self, surprises: Sequence[float]) -> None:
        """Take a frame: `surprise` of each vehicle observed."""
        count = len(surprises)
        if not count:
            return
        surprise = math.log(max(statistics.median(surprises), 1e-3) / MEDIAN_SQUARE)
        share = ADAPTION * min(count, FULL_VEHICLES) / FULL_VEHICLES
        log_factor = self._log_factor + share * min(max(surprise, -2.0), 2.0)
        log_factor = min(max(log_factor, 0.0), 2.0 * math.log(MAX_NOISE))
        if log_factor != self._log_factor:
            self._log_factor = log_factor
            factor = math.exp(0.5 * log_factor)
            self.noise = replace(self._still, acceleration=self._still.acceleration * factor)


def surprise(predicted: State, measured: Four, variance: Four) -> float:
    """Squared distance in 1-sigma errors of a predicted and a measured middle of a box."""
    (x, _, x_variance, *_), (y, _, y_variance, *_) = predicted[:2]
    dx, dy = measured[0] - x, measured[1] - y
    return dx * dx / (x_variance + variance[0]) + dy * dy / (y_variance + variance[1])
