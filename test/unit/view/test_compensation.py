"""Pixels of a moved image lie where the calibrated view has them; unsure times are left out."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from geoorbit_ros.core.errors import TableError
from geoorbit_ros.core.tables import FLAG_TRUNCATED, PIXEL_TRACK_DTYPE
from geoorbit_ros.view.compensation import ViewMotions, boxes_in_reference, image_in_reference
from geoorbit_ros.view.looks import VIEW_DTYPE, Blindness, ViewLook, ViewState, look_of
from geoorbit_ros.view.picture import shifted
from geoorbit_ros.view.timeline import ViewTimeline
from geoorbit_ros.view.watch import SHAKING_PERIODS_S

Array = NDArray[np.float64]

SIZE = (1280, 720)
SECOND = 10**9


def boxes(*corners: tuple[float, float, float, float]) -> NDArray[np.void]:
    rows = np.zeros(len(corners), PIXEL_TRACK_DTYPE)
    for row, (left, top, right, bottom) in zip(rows, corners, strict=True):
        row["x"], row["y"] = (left + right) / 2, (top + bottom) / 2
        row["width"], row["height"] = right - left, bottom - top
    return rows


def look(
    time_s: float,
    right_px: float = 0.0,
    state: ViewState = ViewState.STEADY,
    sigma_px: float = 0.1,
    sway_px: float = 0.0,
    view: int = 0,
) -> ViewLook:
    stamp_ns = round(time_s * SECOND)
    motion = shifted(right_px, 0.0)
    return ViewLook(stamp_ns, state, view, motion, sigma_px, sway_px, abs(right_px), stamp_ns)


def motions(*looks: ViewLook) -> ViewMotions:
    found = ViewMotions(SIZE)
    for each in looks:
        found.add(each)
    return found


def right_at(found: ViewMotions, time_s: float) -> float:
    at = found.at(round(time_s * SECOND))
    assert at.usable
    return 0.0 if at.to_reference is None else -float(at.to_reference[0, 2])


def test_boxes_go_back_by_their_edges_and_keep_their_size_when_turned() -> None:
    turn = np.eye(3)
    turn[:2, :2] = [[math.cos(0.02), -math.sin(0.02)], [math.sin(0.02), math.cos(0.02)]]
    rows = boxes((600, 300, 700, 360))
    back = boxes_in_reference(rows, turn, SIZE)
    assert back["width"][0] == pytest.approx(100.0, abs=0.1)
    assert back["height"][0] == pytest.approx(60.0, abs=0.1)
    moved = boxes_in_reference(rows, shifted(-14.0, 3.0), SIZE)
    assert (moved["x"][0], moved["y"][0]) == (636.0, 333.0)


def test_a_box_that_the_image_cuts_stays_cut_inside_the_reference() -> None:
    back = boxes_in_reference(boxes((0, 300, 50, 340), (100, 300, 150, 340)), shifted(40, 0), SIZE)
    assert (back["flags"] & FLAG_TRUNCATED > 0).tolist() == [True, False]


def test_nothing_known_changes_nothing() -> None:
    rows = boxes((0, 300, 50, 340))
    assert motions().at(5).to_reference is None
    assert boxes_in_reference(rows, None, SIZE) is rows


def test_between_two_looks_a_shaking_camera_is_on_its_way() -> None:
    shaking = ViewState.SHAKING
    found = motions(look(1.0, -3.0, shaking, sway_px=3.0), look(1.1, 3.0, shaking, sway_px=3.0))
    assert right_at(found, 1.05) == pytest.approx(0.0, abs=1e-9)
    assert right_at(found, 1.075) == pytest.approx(1.5)
    assert found.at(round(1.05 * SECOND)).sigma_px > 0.5
    assert found.must_wait(round(1.15 * SECOND), round(1.2 * SECOND))
    assert not found.must_wait(round(1.15 * SECOND), round(1.9 * SECOND))


def looked_at(swing: Callable[[float], float], until_s: float) -> ViewMotions:
    """A camera that shakes, looked at as the watch does, with the error of its looks."""
    rng = np.random.default_rng(3)
    periods = itertools.cycle(SHAKING_PERIODS_S)
    times = [1.0]
    while times[-1] < until_s:
        times.append(times[-1] + next(periods))
    shaking = ViewState.SHAKING
    return motions(*(look(t, swing(t) + rng.normal(0.0, 0.1), shaking, sway_px=4.0) for t in times))


def errors(
    found: ViewMotions, swing: Callable[[float], float], times_s: Array
) -> tuple[Array, Array]:
    """Errors at times, and their sigma as it is said."""
    off = np.array([right_at(found, t) - swing(t) for t in times_s.tolist()])
    sigma = np.array([found.at(round(t * SECOND)).sigma_px for t in times_s.tolist()])
    return off, sigma


@pytest.mark.parametrize("frequency_hz", [0.4, 1.1, 2.0, 3.1])
def test_a_steady_swing_is_known_between_the_looks(frequency_hz: float) -> None:
    def swing(time_s: float) -> float:
        return 5.6 * math.sin(2.0 * math.pi * frequency_hz * time_s)

    off, sigma = errors(looked_at(swing, 12.0), swing, np.arange(8.0, 11.5, 0.037))
    assert np.sqrt((off**2).mean()) < 0.4
    assert sigma.max() < 1.0


@pytest.mark.parametrize(("frequency_hz", "damping"), [(0.6, 0.02), (1.4, 0.02), (2.0, 0.1)])
def test_the_error_of_a_sway_in_gusts_is_as_large_as_it_is_said_to_be(
    frequency_hz: float, damping: float
) -> None:
    """An oscillator that is kicked at random, half a minute of it."""
    rng, step_s = np.random.default_rng(1), 0.01
    omega, place, speed = 2.0 * math.pi * frequency_hz, 0.0, 0.0
    places = []
    for kick in rng.normal(size=9000).tolist():
        speed += (-2.0 * damping * omega * speed - omega**2 * place) * step_s + kick
        place += speed * step_s
        places.append(place)
    course = 4.0 * np.array(places[5000:]) / np.std(places[5000:])

    def swing(time_s: float) -> float:
        return float(np.interp(time_s, np.arange(len(course)) * step_s, course))

    off, sigma = errors(looked_at(swing, 39.0), swing, np.arange(8.0, 38.0, 0.04))
    assert 0.55 < (np.abs(off) < sigma).mean() < 0.85
    assert np.sqrt((off**2).mean()) < np.std(course)


def test_before_the_swing_is_known_its_size_is_part_of_the_error() -> None:
    shaking = ViewState.SHAKING
    found = motions(look(1.0, -3.0, shaking, sway_px=3.0), look(1.2, 3.0, shaking, sway_px=3.0))
    assert found.at(round(1.1 * SECOND)).sigma_px > 1.4


def test_the_sway_is_no_error_of_an_image_that_was_looked_at() -> None:
    found = motions(look(1.0, -3.0, ViewState.SHAKING, sway_px=3.0))
    assert found.at(SECOND).sigma_px == 0.1
    assert found.at(SECOND + 10**7).sigma_px > 3.0


def test_images_around_a_bump_are_left_out() -> None:
    found = motions(look(1.0), look(1.3, 14.0), look(1.6, 14.0))
    assert right_at(found, 1.0) == 0.0
    assert not found.at(round(1.15 * SECOND)).usable
    assert right_at(found, 1.45) == 14.0


def test_times_without_the_view_are_left_out() -> None:
    lost = look(2.0, state=ViewState.BLIND, sigma_px=math.inf, view=-1)
    found = motions(look(1.0), lost, look(3.0))
    assert [found.at(round(t * SECOND)).usable for t in (1.0, 1.5, 2.5, 3.0, 3.1)] == [
        *(True, False, False, True, True),
    ]


def test_a_steady_view_does_not_hold_frames_back() -> None:
    assert not motions(look(1.0)).must_wait(2 * SECOND, 2 * SECOND)


def test_an_image_of_another_view_is_none_of_the_road() -> None:
    image = np.zeros((720, 1280, 3), np.uint8)
    image[300:310, 600:610] = 255
    found = motions(look(1.0, 20.0), look(5.0, view=3))
    back = image_in_reference(image, found.at(1 * SECOND))
    assert back is not None
    assert back[305, 585].tolist() == [255, 255, 255]
    assert image_in_reference(image, found.at(5 * SECOND)) is None


def test_looks_travel_as_tables() -> None:
    sent = look(7.0, 14.0, ViewState.MOVED, 0.25, 0.5, 2)
    got = look_of(sent.stamp_ns, sent.row(), "view")
    assert np.array_equal(got.motion, sent.motion)
    assert (got.state, got.view, got.sigma_px, got.sway_px) == (ViewState.MOVED, 2, 0.25, 0.5)
    assert got.blindness is Blindness.NONE
    for broken in (np.zeros(0, VIEW_DTYPE), np.zeros(1, VIEW_DTYPE)):
        with pytest.raises(TableError):
            look_of(0, broken, "view")
    unknown = sent.row()
    unknown["state"] = 77
    with pytest.raises(TableError):
        look_of(0, unknown, "view")


def test_a_bump_is_one_sentence_with_its_time_and_size() -> None:
    timeline = ViewTimeline()
    for k in range(10):
        timeline.add(look(k))
    for k in range(10, 20):
        timeline.add(look(k, 14.0, ViewState.MOVED))
    [told] = timeline.told()
    sentence = told.sentence(lambda ns: f"{ns / SECOND:.0f} s")
    assert "moved by 14 px (14 px to the right" in sentence
    assert "from 10 s on" in sentence
