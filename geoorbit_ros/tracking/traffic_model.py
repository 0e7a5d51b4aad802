"""What a tracker learns: how vehicles move, which scores last, how steady the image is."""

from __future__ import annotations

import math
import statistics
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.tracking.motion_model import MEAN, RATE, VARIANCE, MotionNoise

Array = NDArray[np.float64]

CAPACITY = 2000
"""Samples that are kept, the latest ones: half a minute of dense traffic, minutes of sparse.
Chosen: more take time, fewer forget quiet lanes."""
REACH = 2.0
"""1-sigma of the neighbourhood in sizes of the new box: about a lane. Chosen: larger mixes lanes,
smaller finds no samples."""
WIDE_WEIGHT = 1.0
"""Samples that the wide prior counts for, because a vehicle may do what none did before. Chosen:
larger learns later, smaller loses such a vehicle."""


class Flow:
    """Samples of the motion of confirmed tracks.

    Arrays are (4, N): x, y in pixels and the logarithms of width and height, as in `motion_model`.
    """

    def __init__(self) -> None:
        self._place, self._rate = np.empty((2, CAPACITY)), np.empty((4, CAPACITY))
        self._count = 0

    def add(self, state: Array) -> None:
        """Remember states (5, 4, N)."""
        state = state[:, :, -CAPACITY:]
        slot = (self._count + np.arange(state.shape[2])) % CAPACITY
        self._place[:, slot], self._rate[:, slot] = state[MEAN, :2], state[RATE]
        self._count += state.shape[2]

    def expect(self, box: Array, noise: MotionNoise) -> tuple[Array, Array]:
        """Mean (4, M) and variance (4, M) of the rates of vehicles first seen in boxes (4, M).

        They are those of the mixture of the wide prior and the samples nearby, each weighted by its
        distance. Where both directions pass, the mixture is wide again.
        """
        wide = noise.rate_variance(box)
        held = min(self._count, CAPACITY)
        if not held:
            return np.zeros_like(box), wide
        apart = self._place[:, None, :held] - box[:2, :, None]
        squared = (apart * apart).sum(axis=0) / (REACH**2 * box[2] * box[3])[:, None]
        weight = np.exp(-0.5 * squared)
        rate = self._rate[:, :held]
        total = WIDE_WEIGHT + weight.sum(axis=1)
        mean = rate @ weight.T / total
        square = (WIDE_WEIGHT * wide + (rate * rate) @ weight.T) / total
        return mean, square - mean * mean


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
        self._right, self._wrong = np.full(2, PRIOR_RIGHT), np.zeros(2)

    def trusted(self, hidden: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(N,) whether predictions at places that are `hidden` (N,) or not may be shown."""
        share = self._right / (self._right + self._wrong)
        return np.asarray((share >= LEAST_SHARE)[hidden.astype(np.intp)])

    def learn(self, predicted_frames: Array, right: bool) -> None:
        """Take predictions that proved right or wrong.

        Args:
            predicted_frames: (2, N) how often tracks were predicted in the open and hidden.
            right: Whether they came back, or ended.
        """
        count = predicted_frames.sum(axis=1)
        fade = np.exp(-count.sum() / MEMORY)
        self._right, self._wrong = fade * self._right, fade * self._wrong
        if right:
            self._right += count
        else:
            self._wrong += count


def hidden(box: Array, detections: Array) -> NDArray[np.bool_]:
    """(N,) which boxes (4, N) lie behind detections (4, M); x, y, width, height of both."""
    if not detections.size:
        return np.zeros(box.shape[1], dtype=bool)
    half, other = 0.5 * box[2:, :, None], 0.5 * detections[2:, None, :]
    apart = np.abs(box[:2, :, None] - detections[:2, None, :])
    shared = np.maximum(np.minimum(half + other - apart, 2.0 * np.minimum(half, other)), 0.0)
    share = shared.prod(axis=0).max(axis=1) / (box[2] * box[3])
    return np.asarray(share >= HIDDEN_SHARE)


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


def log_odds(score: Array) -> Array:
    """Log-odds of a probability, within what a detector's rounding can tell."""
    inside = np.minimum(np.maximum(score, 1e-4), 1.0 - 1e-4)
    return np.asarray(np.log(inside / (1.0 - inside)))


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
        middle = (np.arange(SCORE_BINS) + 0.5) / 2.0 - 6.0
        spread = np.exp(-0.5 * (middle / 2.5) ** 2)
        lasting = 1.0 / (1.0 + np.exp(log_odds(np.array(neutral)) - middle))
        self._lasting, self._ended = spread * lasting, spread * (1.0 - lasting)
        # What the normalisation takes from the ratio of the counts below.
        self._offset = float(np.log(self._lasting.sum() / self._ended.sum()))
        self._lasting *= PRIOR_TRACKS / self._lasting.sum()
        self._ended *= PRIOR_TRACKS / self._ended.sum()
        self._observed = self._lasting.copy()
        self._evidence: Array | None = None

    @staticmethod
    def bin_of(score: Array) -> NDArray[np.int64]:
        """(N,) bin of each score."""
        place = ((log_odds(score) + 6.0) * 2.0).astype(np.int64)
        return np.minimum(np.maximum(place, 0), SCORE_BINS - 1)

    def evidence(self, bins: NDArray[np.int64]) -> Array:
        """(N,) log-likelihood ratio of scores (bins): of tracks that last, against others."""
        if self._evidence is None:
            self._evidence = _log_ratio(self._lasting, self._ended)
        return self._evidence[bins]

    def doubt(self, bins: NDArray[np.int64]) -> Array:
        """(N,) cost of scores that false boxes have more often than vehicles followed for long."""
        ratio = _log_ratio(self._observed, self._ended)[bins]
        return np.asarray(DOUBT_COST * np.maximum(-ratio, 0.0))

    def observe(self, bins: NDArray[np.int64]) -> None:
        """Take (N,) bins of the scores of detections that continued tracks that last."""
        self._observed *= math.exp(-OBSERVATION_WEIGHT * len(bins) / OBSERVATION_MEMORY)
        self._observed += OBSERVATION_WEIGHT * np.bincount(bins, minlength=SCORE_BINS)

    @property
    def prior(self) -> float:
        """Log-odds that a new track lasts."""
        share = math.log(self._lasting.sum() / self._ended.sum())
        return min(PRIOR_WEIGHT * max(share, -2.0), MAX_PRIOR) + self._offset

    def learn(self, bins: NDArray[np.int64], lasted: bool) -> None:
        """Take K tracks.

        Args:
            bins: (`KEPT_SCORES`, K) bins of their first scores, -1 for none.
            lasted: Whether they lasted, or ended early.
        """
        self._evidence = None
        fade = math.exp(-bins.shape[1] / TRACK_MEMORY)
        self._lasting *= fade
        self._ended *= fade
        known = bins >= 0
        weight = np.broadcast_to(1.0 / np.maximum(known.sum(axis=0), 1), bins.shape)
        counts = np.bincount(bins[known], weight[known], SCORE_BINS)
        if lasted:
            self._lasting += counts
        else:
            self._ended += counts


def _log_ratio(lasting: Array, ended: Array) -> Array:
    """(`SCORE_BINS`,) log-likelihood ratio, bounded, of two histograms of scores."""
    smooth = np.array([0.25, 0.5, 0.25])
    of_lasting = np.convolve(lasting, smooth, "same") / lasting.sum()
    ratio = np.log(of_lasting / (np.convolve(ended, smooth, "same") / ended.sum()))
    return np.asarray(np.minimum(np.maximum(ratio, -MAX_EVIDENCE), MAX_EVIDENCE))


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

    def learn(self, predicted: Array, measured: Array, variance: Array) -> None:
        """Take K pairs of predictions (5, 4, K) and measurements (4, K) with their variances."""
        count = predicted.shape[2]
        if not count:
            return
        error = measured[:2] - predicted[MEAN, :2]
        square = (error * error / (predicted[VARIANCE, :2] + variance[:2])).sum(axis=0)
        surprise = math.log(max(statistics.median(square.tolist()), 1e-3) / MEDIAN_SQUARE)
        share = ADAPTION * min(count, FULL_VEHICLES) / FULL_VEHICLES
        log_factor = self._log_factor + share * min(max(surprise, -2.0), 2.0)
        self._log_factor = min(max(log_factor, 0.0), 2.0 * math.log(MAX_NOISE))
        factor = math.exp(0.5 * self._log_factor)
        self.noise = replace(self._still, acceleration=self._still.acceleration * factor)
