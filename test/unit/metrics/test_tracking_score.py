"""HOTA, IDF1 and MOTA against values computed by hand from their definitions."""

from dataclasses import asdict

import numpy as np
import pytest

from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE, Frames, frames_from_rows
from scores.detection_score import box_corners, box_iou
from scores.tracking_score import score_tracks


def frames_of(*tables: list[tuple[int, float]]) -> Frames:
    """One frame per table of (id, x): boxes of 20 x 10 px in a row."""
    rows = [(x, 50.0, 20.0, 10.0, 1.0, 2, identity, 0) for table in tables for identity, x in table]
    stamps = np.repeat(np.arange(1, len(tables) + 1), [len(table) for table in tables])
    return frames_from_rows(stamps, np.array(rows, PIXEL_TRACK_DTYPE))


TWO = frames_of(*[[(1, 100.0), (2, 200.0)]] * 3)


def test_the_truth_scores_one() -> None:
    score = score_tracks(TWO, TWO)
    assert (score.hota, score.det_a, score.ass_a, score.loc_a) == pytest.approx((1, 1, 1, 1))
    assert (score.idf1, score.mota, score.id_switches) == (1.0, 1.0, 0)


def test_one_vehicle_whose_id_changes_after_the_first_of_three_frames() -> None:
    result = frames_of([(10, 100.0), (20, 200.0)], *[[(10, 100.0), (30, 200.0)]] * 2)
    score = score_tracks(TWO, result)
    # Three matches of vehicle 1 with 3/3, one of vehicle 2 with 1/3, two with 2/3.
    assert score.ass_a == pytest.approx((3 + 1 / 3 + 2 * 2 / 3) / 6)
    assert score.det_a == pytest.approx(1.0)
    assert score.hota == pytest.approx(np.sqrt(7 / 9))
    assert score.idf1 == pytest.approx(2 * (3 + 2) / (6 + 6))
    assert score.id_switches == 1
    assert score.mota == pytest.approx(1 - 1 / 6)


def test_a_missed_and_a_false_box() -> None:
    result = frames_of([(10, 100.0), (20, 200.0)], [(10, 100.0)], [(10, 100.0), (99, 400.0)])
    score = score_tracks(TWO, result)
    # Four matches, two misses, one false box; vehicle 2 shares 1 of its 3 boxes.
    assert score.det_a == pytest.approx(4 / 7)
    assert score.ass_a == pytest.approx((3 + 1 / 3) / 4)
    assert score.idf1 == pytest.approx(2 * 4 / (6 + 5))
    assert score.mota == pytest.approx(1 - 3 / 6)
    assert (score.misses, score.false_boxes, score.id_switches) == (2, 1, 0)


def test_boxes_that_are_half_off_match_at_small_overlaps_only() -> None:
    # 20 px wide, 5 px off: overlap 15/25 = 0.6, so 12 of the 19 thresholds hold.
    result = frames_of(*[[(1, 105.0), (2, 205.0)]] * 3)
    score = score_tracks(TWO, result)
    assert score.hota == pytest.approx(12 / 19)
    assert score.idf1 == 1.0
    # 10 px off: overlap 1/3, no match at one half.
    far = score_tracks(TWO, frames_of(*[[(1, 110.0), (2, 210.0)]] * 3))
    assert (far.idf1, far.mota) == (0.0, -1.0)
    assert far.hota == pytest.approx(6 / 19)


def test_swapped_ids_are_seen_by_association_and_not_by_detection() -> None:
    swap = frames_of([(1, 100.0), (2, 200.0)], *[[(2, 100.0), (1, 200.0)]] * 2)
    score = score_tracks(TWO, swap)
    assert score.det_a == pytest.approx(1.0)
    assert score.id_switches == 2
    # Each track holds 1 box of one vehicle and 2 of the other: 1/(3+3-1) and 2/(3+3-2).
    assert score.ass_a == pytest.approx((2 * 1 / 5 + 4 * 2 / 4) / 6)
    assert score.idf1 == pytest.approx(2 * 4 / 12)


def test_no_result_and_no_truth() -> None:
    nothing = Frames(np.array([1]), np.array([0, 0]), np.empty(0, PIXEL_TRACK_DTYPE))
    missed = score_tracks(TWO, nothing)
    assert (missed.hota, missed.idf1, missed.mota, missed.misses) == (0.0, 0.0, 0.0, 6)
    false = score_tracks(nothing, TWO)
    assert (false.hota, false.idf1, false.false_boxes) == (0.0, 0.0, 6)


def test_renaming_and_reordering_change_nothing() -> None:
    random = np.random.default_rng(2)
    tables = [[(i, 30.0 * i + float(random.normal(0, 4))) for i in range(6)] for _ in range(20)]
    truth = frames_of(*[[(i, 30.0 * i) for i in range(6)]] * 20)
    score = score_tracks(truth, frames_of(*tables))
    other = [[(1000 - 7 * i, x) for i, x in reversed(table)] for table in tables]
    again = score_tracks(truth, frames_of(*other))
    assert asdict(again) == pytest.approx(asdict(score))
    assert 0.4 < score.hota < 0.9


def test_overlap_of_boxes() -> None:
    rows = np.zeros(3, PIXEL_TRACK_DTYPE)
    rows["x"], rows["width"], rows["height"] = [0.0, 5.0, 50.0], 10.0, 4.0
    corners = box_corners(rows)
    assert corners[0].tolist() == [-5.0, -2.0, 5.0, 2.0]
    assert box_iou(corners, corners) == pytest.approx(
        np.array([[1, 1 / 3, 0], [1 / 3, 1, 0], [0, 0, 1]])
    )
