"""Sentences that people read: right numbers, right grammar."""

from __future__ import annotations

import numpy as np
import pytest

from geoorbit_ros.core.lanes import Lane, Status
from geoorbit_ros.metrics.score import score_lanes
from geoorbit_ros.report.text import (
    compass,
    missing_sentence,
    number,
    score_sentences,
    summary_sentence,
)


def lane(
    lane_id: int,
    y_m: float = 0.0,
    status: Status = "confirmed",
    vehicles: float = 9.0,
    more: int = 0,
) -> Lane:
    line = np.array([[0.0, y_m], [50.0, y_m], [100.0, y_m]])
    return Lane(lane_id, line, line + 1.7, line - 1.7, 3.4, 0.1, 0.9, status, vehicles, more)


@pytest.mark.parametrize(
    ("heading", "name"), [(0, "N"), (22, "N"), (23, "NE"), (90, "E"), (247, "SW"), (359, "N")]
)
def test_compass(heading: float, name: str) -> None:
    assert compass(heading) == name


def test_numbers_have_no_negative_zero_and_dashes_for_unknown() -> None:
    assert number(-0.001) == "0.00"
    assert number(-0.001, signed=True) == "+0.00"
    assert number(float("nan")) == "–"
    assert number(1.25, 1) in ("1.2", "1.3")


def test_what_is_missing() -> None:
    assert missing_sentence(lane(5, status="tentative", vehicles=3.2, more=4)) == (
        "Lane 5 is tentative after 3 vehicles: about 4 more vehicles will confirm it."
    )
    assert missing_sentence(lane(6, status="tentative", vehicles=1.0, more=1)) == (
        "Lane 6 is tentative after 1 vehicle: about 1 more vehicle will confirm it."
    )
    assert "does not show clearly" in missing_sentence(lane(7, status="tentative"))


def test_summary() -> None:
    assert summary_sentence([lane(1)]) == "1 lane confirmed (1 towards E)."
    mixed = [lane(1), lane(2), lane(3, status="tentative")]
    assert summary_sentence(mixed) == "2 lanes confirmed (2 towards E), 1 tentative."
    assert summary_sentence([]) == "0 lanes confirmed."


def test_score_sentences_name_every_kind_of_error() -> None:
    truth = [lane(1), lane(2, 3.5, vehicles=5.0), lane(3, 7.0), lane(4, 30.0, vehicles=1.0)]
    detected = [
        lane(10, 0.1),
        lane(11, 7.0, status="tentative"),
        lane(12, 60.0),
        lane(13, 80.0, status="tentative"),
    ]
    text = "\n".join(score_sentences(score_lanes(detected, truth)))
    assert "2 of 4 lanes found, 1 of them confirmed; 1 invented" in text
    assert "Missed with 3 to 7 vehicles: lane 2." in text
    assert "Missed with fewer than 3 vehicles: lane 4." in text
    assert "Busy but not confirmed: lane 3." in text
    assert "Invented: detected lane 12." in text
    assert "Tentative without a true lane: detected lane 13." in text
    assert "Missed with 8" not in text
