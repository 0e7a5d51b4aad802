from collections.abc import Iterable
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.core.cdr import stamp_of
from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.core.tables import PIXEL_TRACK_DTYPE
from geoorbit_ros.storage.bag_reader import BagMessage
from geoorbit_ros.storage.playback import Playback, begun_at, endless, played_topics
from geoorbit_ros.storage.pointcloud2 import MESSAGE_TYPE, encode_table

SECOND_NS = 10**9


def recording(times_s: Iterable[float]) -> list[BagMessage]:
    return [BagMessage("/c/t", "T", round(t * SECOND_NS), b"%d" % k) for k, t in enumerate(times_s)]


def play(playback: Playback, step_s: float, limit: int = 10**6) -> list[tuple[float, BagMessage]]:
    """(wall time, message) until the end, asked every `step_s`."""
    played, wall_s = [], 100.0
    while not playback.finished:
        played += [(wall_s - 100.0, message) for message in playback.due(wall_s, limit)]
        wall_s += step_s
    return played


times = st.lists(st.floats(0, 50), min_size=1, max_size=40).map(sorted)


@given(times, st.floats(0.1, 100), st.floats(0.001, 1), st.integers(1, 5))
def test_all_messages_in_order_none_before_its_time(
    times_s: list[float], rate: float, step_s: float, limit: int
) -> None:
    step_s = max(step_s, 0.02 / rate)
    played = play(Playback(recording(times_s), rate), step_s, limit)
    assert [message for _, message in played] == recording(times_s)
    for wall_s, message in played:
        assert wall_s * rate >= (message.time_ns / SECOND_NS - times_s[0]) - 1e-6


@given(times, st.floats(0.1, 100), st.floats(0.001, 1))
def test_without_a_limit_each_comes_at_the_first_chance(
    times_s: list[float], rate: float, step_s: float
) -> None:
    step_s = max(step_s, 0.02 / rate)
    for wall_s, message in play(Playback(recording(times_s), rate), step_s):
        due_s = (message.time_ns / SECOND_NS - times_s[0]) / rate
        assert wall_s <= due_s + step_s * 1.001 + 1e-6


def test_rate_zero_is_limited_by_the_taker_alone() -> None:
    playback = Playback(recording(range(1000)), rate=0.0)
    assert len(list(playback.due(0.0, 400))) == 400
    assert len(list(playback.due(0.0, 400))) == 400
    assert len(list(playback.due(0.0, 400))) == 200
    assert playback.finished


def test_messages_held_back_by_the_limit_slow_playback_down() -> None:
    playback = Playback(recording(range(100)))
    assert len(list(playback.due(0.0, 1))) == 1
    assert list(playback.due(50.0, 0)) == []
    # The fifty seconds are not made up for: only what is due next comes.
    assert len(list(playback.due(50.0, 100))) == 1


def test_holding_stops_the_time() -> None:
    playback = Playback(recording(range(10)))
    assert len(list(playback.due(0.0, 9))) == 1
    playback.hold()
    assert list(playback.due(100.0, 9)) == []
    assert len(list(playback.due(101.0, 9))) == 1


def test_long_silences_are_cut() -> None:
    played = play(Playback(recording([0, 1, 1000, 1001]), 1.0, max_gap_s=5.0), 0.5)
    assert [wall_s for wall_s, _ in played] == pytest.approx([0, 1, 6, 7])


@given(times, st.floats(0.5, 50), st.floats(0.5, 100))
def test_the_recordings_time_never_runs_back_nor_past_the_next_message(
    times_s: list[float], rate: float, max_gap_s: float
) -> None:
    playback = Playback(recording(times_s), rate, max_gap_s)
    seen, wall_s = 0, 0.0
    while not playback.finished:
        for message in playback.due(wall_s, 10**6):
            assert playback.time_ns >= message.time_ns
        assert seen <= playback.time_ns <= round(times_s[-1] * SECOND_NS)
        seen = playback.time_ns
        wall_s += 0.1


@given(times, st.floats(0, 60))
def test_an_offset_leaves_out_the_beginning(times_s: list[float], offset_s: float) -> None:
    playback = Playback(recording(times_s), 0.0, start_offset_s=offset_s)
    start_ns = round(times_s[0] * SECOND_NS)
    expected = [m for m in recording(times_s) if m.time_ns - start_ns >= offset_s * SECOND_NS]
    assert list(playback.due(0.0, 10**6)) == expected


@pytest.mark.parametrize(
    ("topics", "camera_id", "expected"),
    [
        (["/n/tracks_px", "/n/a/b", "/tf"], "south", ["/south/tracks_px", "/south/a/b", "/tf"]),
        (["/north/tracks_px"], "", ["/north/tracks_px"]),
        (["/site/pole/tracks_px", "/site/x"], "south", ["/south/tracks_px", "/site/x"]),
        (["/tracks_px", "/x"], "south", ["/south/tracks_px", "/x"]),
        (["/north/image", "/tf"], "south", ["/south/image", "/tf"]),
        (["/a/tracks_px", "/b/tracks_px", "/b/x"], "b", ["/b/tracks_px", "/b/x"]),
    ],
)  # fmt: skip
def test_only_the_cameras_name_changes(
    topics: list[str], camera_id: str, expected: list[str]
) -> None:
    assert list(played_topics(topics, camera_id, "bag").values()) == expected


def test_two_cameras_are_never_played_as_one() -> None:
    with pytest.raises(ParameterError, match="cameras a, b: found c, expected the name of one"):
        played_topics(["/a/tracks_px", "/b/tracks_px"], "c", "bag")


def stamped(time_ns: int, stamp_ns: int) -> BagMessage:
    empty = np.empty(0, PIXEL_TRACK_DTYPE)
    return BagMessage("/c/tracks_px", MESSAGE_TYPE, time_ns, encode_table(stamp_ns, "c", empty))


def stamps(messages: Iterable[BagMessage]) -> list[int]:
    return [stamp_of(message.cdr) for message in messages]


DAY_NS = 86_400 * SECOND_NS


@pytest.mark.parametrize("received_ns", [0, 20_000 * DAY_NS])
def test_a_simulations_first_stamp_of_zero_is_a_time(received_ns: int) -> None:
    """Recorded with the simulation's clock, or with the computer's."""
    recording = [stamped(received_ns + t * SECOND_NS, t * SECOND_NS) for t in range(3)]
    now = 20_500 * DAY_NS
    assert stamps(begun_at(recording, now)) == [now + t * SECOND_NS for t in range(3)]
    twice = list(islice(endless(lambda: recording), 6))
    assert stamps(twice) == [t * SECOND_NS for t in range(6)]


def test_a_stamp_of_zero_means_none_where_others_are_of_today() -> None:
    today = 20_000 * DAY_NS
    recording = [stamped(today, 0), stamped(today + SECOND_NS, today + SECOND_NS - 5)]
    assert stamps(begun_at(recording, today + DAY_NS)) == [0, today + DAY_NS + SECOND_NS - 5]
    assert stamps(islice(endless(lambda: recording), 3))[2] == 0
