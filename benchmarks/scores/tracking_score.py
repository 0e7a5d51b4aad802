"""How well tracks follow the true vehicles: HOTA, IDF1, MOTA.

HOTA: Luiten et al. 2021, "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV
129, sections 4 and 5. IDF1: Ristani et al. 2016, "Performance Measures and a Data Set for
Multi-Target, Multi-Camera Tracking". MOTA: Bernardin and Stiefelhagen 2008, "Evaluating Multiple
Object Tracking Performance: The CLEAR MOT Metrics". Boxes are compared by intersection over union.

`trackers.eval` of the package `trackers` (2.6.1, Apache-2.0) gives the same numbers to 1e-15. It is
not used, because it requires `opencv-python`, which overwrites our `opencv-python-headless`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from geoorbit_ros.core.tables import Frames
from scores.detection_score import box_corners, box_iou

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ALPHAS = np.arange(1, 20) * 0.05
"""Overlaps from 0.05 to 0.95 over which HOTA is averaged (section 4.4)."""
MATCH_IOU = 0.5
"""Overlap that IDF1 and MOTA ask for."""
_ROUNDING = 1e-9
"""Overlaps this much below a threshold reach it: rounding."""


@dataclass(frozen=True, slots=True)
class TrackingScore:
    """Scores of one sequence; shares from 0 to 1, MOTA may be negative.

    Attributes:
        hota: Geometric mean of `det_a` and `ass_a`, averaged over `ALPHAS`.
        det_a: Detection accuracy: matches / (matches + misses + false boxes).
        ass_a: Association accuracy, a mean over all matches.
        loc_a: Mean overlap of the matches.
        idf1: F1 of boxes under the best one-to-one mapping of tracks to vehicles.
        mota: 1 - (misses + false boxes + identity switches) / true boxes.
        id_switches: Times that a vehicle's match changed its id.
        misses: True boxes without a match at `MATCH_IOU`.
        false_boxes: Result boxes without a match at `MATCH_IOU`.
        true_boxes: All true boxes.
        true_tracks: True ids.
        result_tracks: Ids in the result.
    """

    hota: float
    det_a: float
    ass_a: float
    loc_a: float
    idf1: float
    mota: float
    id_switches: int
    misses: int
    false_boxes: int
    true_boxes: int
    true_tracks: int
    result_tracks: int


@dataclass(slots=True)
class _Sequence:
    """Frames with ids as indices 0…, and the overlap of all boxes in each."""

    truth: list[Index] = field(default_factory=list)
    result: list[Index] = field(default_factory=list)
    overlap: list[Array] = field(default_factory=list)
    truth_count: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    result_count: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))


def score_tracks(truth: Frames, result: Frames) -> TrackingScore:
    """Compare a tracker's output with the truth.

    Args:
        truth: `PIXEL_TRACK_DTYPE` rows with true ids; hidden vehicles count when they are there.
        result: `PIXEL_TRACK_DTYPE` rows of the same recording; frames belong together by stamp.
    """
    sequence = _align(truth, result)
    hota, det_a, ass_a, loc_a = _hota(sequence)
    matches, switches = _clear(sequence)
    boxes, found = int(sequence.truth_count.sum()), int(sequence.result_count.sum())
    misses, false_boxes = boxes - matches, found - matches
    return TrackingScore(
        hota=hota,
        det_a=det_a,
        ass_a=ass_a,
        loc_a=loc_a,
        idf1=_idf1(sequence),
        mota=1.0 - (misses + false_boxes + switches) / max(boxes, 1),
        id_switches=switches,
        misses=misses,
        false_boxes=false_boxes,
        true_boxes=boxes,
        true_tracks=len(sequence.truth_count),
        result_tracks=len(sequence.result_count),
    )


def _align(truth: Frames, result: Frames) -> _Sequence:
    sequence = _Sequence()
    ids = [np.unique(frames.rows["track_id"], return_inverse=True) for frames in (truth, result)]
    sequence.truth_count = np.bincount(ids[0][1], minlength=len(ids[0][0]))
    sequence.result_count = np.bincount(ids[1][1], minlength=len(ids[1][0]))
    corners = [box_corners(frames.rows) for frames in (truth, result)]
    for stamp in np.union1d(truth.stamp_ns, result.stamp_ns):
        a, b = _rows_at(truth, stamp), _rows_at(result, stamp)
        sequence.truth.append(ids[0][1][a])
        sequence.result.append(ids[1][1][b])
        sequence.overlap.append(box_iou(corners[0][a], corners[1][b]))
    return sequence


def _rows_at(frames: Frames, stamp_ns: int) -> slice:
    k = int(np.searchsorted(frames.stamp_ns, stamp_ns))
    if k == len(frames) or frames.stamp_ns[k] != stamp_ns:
        return slice(0, 0)
    return slice(int(frames.offset[k]), int(frames.offset[k + 1]))


def _hota(sequence: _Sequence) -> tuple[float, float, float, float]:
    """HOTA, DetA, AssA, LocA, each averaged over `ALPHAS`."""
    alignment = _alignment(sequence)
    found = [
        _best(alignment[np.ix_(truth, result)] * overlap, truth, result, overlap)
        for truth, result, overlap in zip(
            sequence.truth, sequence.result, sequence.overlap, strict=True
        )
    ]
    of_truth, of_result, overlap = (np.concatenate(part) for part in zip(*found, strict=True))
    boxes = int(sequence.truth_count.sum() + sequence.result_count.sum())
    results = len(sequence.result_count)
    scores = []
    for alpha in ALPHAS:
        hit = overlap >= alpha - _ROUNDING
        if not hit.any():
            scores.append((0.0, 0.0, 0.0, 1.0))  # a mean overlap of no match is no fault
            continue
        pair, together = np.unique(of_truth[hit] * results + of_result[hit], return_counts=True)
        either = (
            sequence.truth_count[pair // results] + sequence.result_count[pair % results] - together
        )
        det_a = hit.sum() / (boxes - hit.sum())
        ass_a = (together * together / either).sum() / hit.sum()
        scores.append((np.sqrt(det_a * ass_a), det_a, ass_a, overlap[hit].mean()))
    hota, det_a, ass_a, loc_a = np.mean(scores, axis=0).tolist()
    return hota, det_a, ass_a, loc_a


def _alignment(sequence: _Sequence) -> Array:
    """(G, R) Jaccard index of true and result tracks with soft matches.

    It decides which of several overlapping boxes is matched, in favour of the tracks that fit over
    the whole sequence (HOTA, section 4.3).
    """
    together = np.zeros((len(sequence.truth_count), len(sequence.result_count)))
    for truth, result, overlap in zip(
        sequence.truth, sequence.result, sequence.overlap, strict=True
    ):
        either = overlap.sum(axis=0)[None, :] + overlap.sum(axis=1)[:, None] - overlap
        together[np.ix_(truth, result)] += overlap / np.maximum(either, 1e-12)
    either = sequence.truth_count[:, None] + sequence.result_count[None, :] - together
    return np.asarray(together / np.maximum(either, 1e-12))


def _best(value: Array, truth: Index, result: Index, overlap: Array) -> tuple[Index, Index, Array]:
    """The one-to-one matches of highest value: ids of both sides and overlap."""
    row, column = linear_sum_assignment(value, maximize=True)
    return truth[row], result[column], overlap[row, column]


def _idf1(sequence: _Sequence) -> float:
    together = np.zeros((len(sequence.truth_count), len(sequence.result_count)))
    for truth, result, overlap in zip(
        sequence.truth, sequence.result, sequence.overlap, strict=True
    ):
        row, column = np.nonzero(overlap >= MATCH_IOU - _ROUNDING)
        together[truth[row], result[column]] += 1  # an id is at most once in a frame
    # Minimising misses and false boxes over mappings, with tracks left alone allowed, is
    # maximising the boxes they share: each shared one spares one miss and one false box.
    row, column = linear_sum_assignment(together, maximize=True)
    boxes = int(sequence.truth_count.sum() + sequence.result_count.sum())
    return float(2.0 * together[row, column].sum() / max(boxes, 1))


def _clear(sequence: _Sequence) -> tuple[int, int]:
    """Matches and identity switches; a match of the frame before is kept where it still holds."""
    before = np.full(len(sequence.truth_count), -1, dtype=np.intp)  # in the previous frame
    latest = before.copy()  # whenever it was matched last
    matches = switches = 0
    for truth, result, overlap in zip(
        sequence.truth, sequence.result, sequence.overlap, strict=True
    ):
        held = before[truth][:, None] == result[None, :]
        value = np.where(overlap >= MATCH_IOU - _ROUNDING, 1000.0 * held + overlap, 0.0)
        row, column = linear_sum_assignment(value, maximize=True)
        good = value[row, column] > 0.0
        now, ids = truth[row[good]], result[column[good]]
        switches += int(((latest[now] >= 0) & (latest[now] != ids)).sum())
        matches += len(now)
        before[:] = -1
        before[now] = latest[now] = ids
    return matches, switches
