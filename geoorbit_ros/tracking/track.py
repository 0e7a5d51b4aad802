"""Detections of one frame as the tracker uses them, and the tracks that it continues with them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.tables import DETECTION_DTYPE
from geoorbit_ros.tracking.motion_model import (
    Four,
    MotionNoise,
    State,
    measurement_variance,
    measurements,
)
from geoorbit_ros.tracking.parameters import TrackerParameters
from geoorbit_ros.tracking.traffic_model import ScoreModel

BORDER_RATIO = 0.01
"""Boxes that end within 1 % of the image from its border are cut by it, as in `box_projector`.
Chosen: detectors end cut boxes some pixels early; larger marks whole boxes as cut."""
CUT_FACTOR = 10.0
"""Variance of a cut box relative to a whole one: its centre and size aren't the vehicle's. Chosen:
smaller lets a vehicle that enters seem to come nearer."""
MAX_DETECTIONS = 1000
"""More in a frame are no traffic; the most confident are taken. Bounds memory."""


Sides = tuple[bool, bool]
"""Whether the image border at the low and at the high end of an axis cuts a box."""


@dataclass(slots=True)
class Detection:
    """A vehicle as the detector saw it.

    Attributes:
        box: x, y of the centre, width, height in pixels.
        measured: See `motion_model.measurements`.
        variance: Of `measured`.
        score: Confidence.
        score_bin: Its bin, see `ScoreModel`.
        strong: Whether it is confident.
        class_id: COCO class.
        cut_across: Whether the image's left and right borders cut the box; never where the image's
            size is unknown.
        cut_along: Whether its upper and lower borders do.
        cut: Whether any does.
    """

    box: Four
    measured: Four
    variance: Four
    score: float
    score_bin: int
    strong: bool
    class_id: int
    cut_across: Sides
    cut_along: Sides
    cut: bool


def prepare(
    rows: NDArray[np.void], parameters: TrackerParameters, noise: MotionNoise
) -> tuple[list[Detection], int]:
    """Detections that can be used and are not too weak, the same for any order of the rows.

    Args:
        rows: (M,) `DETECTION_DTYPE`.
        parameters: Of the tracker.
        noise: How exact boxes are.

    Returns:
        The most confident first, and the number of rows left out because a number isn't finite or
        the box has no area.
    """
    usable = [row for row in rows.tolist() if _usable(row)]
    low_score = parameters.low_score
    kept = [row for row in usable if row[_SCORE] >= low_score]
    kept.sort(key=_most_confident_first)
    found = [_detection(row, parameters, noise) for row in kept[:MAX_DETECTIONS]]
    return found, len(rows) - len(usable)


_Row = tuple[float, float, float, float, float, int]
assert DETECTION_DTYPE.names == ("x", "y", "width", "height", "score", "class_id")
_SCORE = 4


def _usable(row: _Row) -> bool:
    return math.isfinite(sum(row)) and row[2] > 0.0 and row[3] > 0.0


def _most_confident_first(row: _Row) -> tuple[float, ...]:
    x, y, width, height, score, class_id = row
    return -score, x, y, width, height, class_id


def _detection(row: _Row, parameters: TrackerParameters, noise: MotionNoise) -> Detection:
    x, y, width, height, score, class_id = row
    box = x, y, width, height
    variance = measurement_variance(box, noise)
    cut_across = _cut(x, width, parameters.image_width)
    cut_along = _cut(y, height, parameters.image_height)
    cut = any(cut_across) or any(cut_along)
    if cut:
        a, b, c, d = variance
        variance = CUT_FACTOR * a, CUT_FACTOR * b, CUT_FACTOR * c, CUT_FACTOR * d
    return Detection(
        box,
        measurements(box),
        variance,
        score,
        ScoreModel.bin_of(score),
        score >= parameters.high_score,
        class_id,
        cut_across,
        cut_along,
        cut,
    )


def _cut(middle: float, size: float, extent_px: int) -> Sides:
    if not extent_px:
        return False, False
    border, half = BORDER_RATIO * extent_px, 0.5 * size
    return middle - half < border, middle + half > extent_px - border


@dataclass(slots=True)
class Track:
    """A vehicle, or what looks like one, through the frames.

    Attributes:
        state: Motion at the last observation, see `motion_model`.
        box: Last observed box: x, y, width, height in pixels.
        born_ns: Time of the first observation.
        stamp_ns: Time of the last observation.
        sure_ns: Time of the last observation by a confident detection.
        class_id: Class with the most votes.
        lead: Its lead over the others, in votes weighted by confidence and area.
        score: Confidence of the last observation.
        cut: Whether the image border cut the last box.
        entering: Whether the border cut all boxes so far.
        evidence: Log-odds that the track is a vehicle.
        score_bins: Bins of its first scores, see `ScoreModel`.
        overlap: How far it began in the box of another vehicle, see `OverlapModel`.
        track_id: 0 until the track is confirmed.
        hits: Observations.
        missed: Frames since the last observation.
        predicted_open: Of these, those in which it was predicted in the open.
        predicted_hidden: Those in which it was predicted behind another vehicle.
    """

    state: State
    box: Four
    born_ns: int
    stamp_ns: int
    sure_ns: int
    class_id: int
    lead: float
    score: float
    cut: bool
    entering: bool
    evidence: float
    score_bins: list[int]
    overlap: int = 0
    track_id: int = 0
    hits: int = 1
    missed: int = 0
    predicted_open: int = 0
    predicted_hidden: int = 0

    @classmethod
    def started(cls, stamp_ns: int, state: State, found: Detection, evidence: float) -> Self:
        """An unconfirmed track in `state`, observed for the first time in detection `found`."""
        return cls(
            state=state,
            box=found.box,
            born_ns=stamp_ns,
            stamp_ns=stamp_ns,
            sure_ns=stamp_ns,
            class_id=found.class_id,
            lead=found.score * (found.box[2] * found.box[3]),
            score=found.score,
            cut=found.cut,
            entering=found.cut,
            evidence=evidence,
            score_bins=[found.score_bin],
        )

    @property
    def observed_s(self) -> float:
        """Time from the first observation to the last."""
        return (self.stamp_ns - self.born_ns) * 1e-9

    def elapsed_s(self, stamp_ns: int) -> float:
        """Time since the last observation."""
        return (stamp_ns - self.stamp_ns) * 1e-9

    def observe(self, stamp_ns: int, state: State, found: Detection) -> None:
        """The track is seen in detection `found` and has `state` now."""
        self.state, self.box = state, found.box
        self.stamp_ns = stamp_ns
        if found.strong:
            self.sure_ns = stamp_ns
        self.hits += 1
        self.missed = self.predicted_open = self.predicted_hidden = 0
        self.score, self.cut = found.score, found.cut
        self.entering = self.entering and found.cut
        # The majority vote of Boyer and Moore (1981): one candidate and its lead are enough. The
        # nearer a vehicle, the better it shows what it is.
        votes = found.score * (found.box[2] * found.box[3])
        if found.class_id == self.class_id:
            self.lead += votes
        elif votes > self.lead:
            self.class_id, self.lead = found.class_id, votes - self.lead
        else:
            self.lead -= votes
