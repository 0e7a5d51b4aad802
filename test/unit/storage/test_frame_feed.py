"""The thread between a camera and the caller that takes its frames, and its pace."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from geoorbit_ros.storage.frames.feed import FrameFeed, LiveFrames, Pace, Thinning
from geoorbit_ros.storage.frames.source import FrameSource, FrameSourceError, StampedImage

LIMIT_S = 60.0
PERIOD_NS = 40_000_000


class Numbered(FrameSource):
    """Frames whose stamps are 1, 2, … periods; announces each, and waits where it must."""

    def __init__(self, count: int, *, live: bool = False, gate_at: int | None = None) -> None:
        super().__init__("numbered")
        self.live, self.count, self.gate_at = live, count, gate_at
        self.gate, self.at_gate = threading.Event(), threading.Event()

    def __iter__(self) -> Iterator[StampedImage]:
        for k in range(1, self.count + 1):
            if k == self.gate_at:
                self.at_gate.set()
                self.gate.wait(LIMIT_S)
            yield k * PERIOD_NS, np.zeros((1, 1, 3), np.uint8)

    def close(self) -> None:
        super().close()
        self.gate.set()


def numbers(feed: FrameFeed) -> list[int]:
    taken = []
    while not feed.finished:
        frame = feed.take(LIMIT_S)
        if frame is not None:
            taken.append(frame[0] // PERIOD_NS)
    return taken


def test_a_recording_at_rate_zero_loses_nothing() -> None:
    feed = FrameFeed(Numbered(200), rate=0.0, depth=2)
    feed.start()
    assert numbers(feed) == list(range(1, 201))
    assert (feed.captured, feed.dropped, feed.error) == (200, 0, None)


def test_a_live_source_drops_the_oldest_and_counts() -> None:
    source = Numbered(51, live=True, gate_at=51)
    feed = FrameFeed(source, depth=3)
    feed.start()
    assert source.at_gate.wait(LIMIT_S)
    assert (feed.captured, feed.dropped) == (50, 47)
    source.gate.set()
    taken = numbers(feed)
    assert taken[-1] == 51
    assert taken == sorted(set(taken)), "in order, none twice"
    assert len(taken) + feed.dropped == 51


def test_a_loop_goes_on_with_stamps_one_period_apart() -> None:
    feed = FrameFeed(Numbered(3), rate=0.0, loop=True)
    feed.start()
    taken = [feed.take(LIMIT_S) for _ in range(8)]
    assert feed.stop()
    assert [frame[0] for frame in taken if frame] == [k * PERIOD_NS for k in range(1, 9)]


def test_a_recording_can_be_stamped_as_if_it_were_live(monkeypatch: pytest.MonkeyPatch) -> None:
    # Frame 3 is held up for ten seconds; the next are due one period apart again.
    steady_s = iter([0.0, 0.04, 10.0, 10.04])
    clock = SimpleNamespace(monotonic=lambda: next(steady_s))
    monkeypatch.setattr("geoorbit_ros.storage.frames.feed.time", clock)
    wall_ns = iter([5_000_000_000, 15_000_000_000])
    feed = FrameFeed(Numbered(4), depth=4, clock_ns=lambda: next(wall_ns))
    feed.start()
    assert numbers(feed) == [125, 126, 375, 376]


def test_stamps_of_a_recording_that_is_played_faster_do_not_go_back_after_a_hold_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # At a hundred times the speed, frame 3 is held up for a second: its stamp is far ahead by then.
    steady_s = iter([0.0, 0.0004, 1.0, 1.0004])
    clock = SimpleNamespace(monotonic=lambda: next(steady_s))
    monkeypatch.setattr("geoorbit_ros.storage.frames.feed.time", clock)
    wall_ns = iter([5_000_000_000, 5_000_000_000 + 30_000_000])
    feed = FrameFeed(Numbered(4), rate=100.0, depth=4, clock_ns=lambda: next(wall_ns))
    feed.start()
    assert numbers(feed) == [125, 126, 127, 128]


def test_at_rate_zero_the_first_frame_has_the_clocks_time() -> None:
    feed = FrameFeed(Numbered(3), rate=0.0, clock_ns=lambda: 5_000_000_000)
    feed.start()
    assert numbers(feed) == [125, 126, 127]


def test_a_live_source_is_never_looped() -> None:
    feed = FrameFeed(Numbered(2, live=True), loop=True, depth=5)
    feed.start()
    assert numbers(feed) == [1, 2]


def test_a_fault_ends_the_feed_and_is_kept() -> None:
    class Broken(Numbered):
        def __iter__(self) -> Iterator[StampedImage]:
            yield from super().__iter__()
            raise FrameSourceError("here", "nothing", "something")

    feed = FrameFeed(Broken(2), rate=0.0)
    feed.start()
    assert numbers(feed) == [1, 2]
    assert isinstance(feed.error, FrameSourceError)


@pytest.mark.parametrize("rate", [0.0, 1e-6])
def test_stopping_ends_a_feed_that_waits_to_hand_on_or_for_a_frames_time(rate: float) -> None:
    source = Numbered(100)
    feed = FrameFeed(source, rate=rate, depth=1)
    feed.start()
    assert feed.take(LIMIT_S) is not None
    assert feed.stop()


def test_stopping_a_source_that_hangs_returns_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("geoorbit_ros.storage.frames.feed.STOP_TIMEOUT_S", 0.05)

    class Deaf(Numbered):
        def close(self) -> None:
            """Does not hear it."""

    source = Deaf(1, gate_at=1)
    feed = FrameFeed(source)
    feed.start()
    assert source.at_gate.wait(LIMIT_S)
    assert not feed.stop()
    source.gate.set()


def test_nothing_to_take_returns_in_time() -> None:
    source = Numbered(1, gate_at=1)
    feed = FrameFeed(source)
    feed.start()
    assert feed.take(0.01) is None
    assert not feed.finished
    assert feed.stop()


@pytest.mark.parametrize("rate", [0.5, 1.0, 10.0])
def test_frames_are_due_at_their_distance_divided_by_the_rate(rate: float) -> None:
    pace, wall_s = Pace(rate), 100.0
    for k in range(10):
        expected_s = k * PERIOD_NS / 1e9 / rate
        assert pace.wait_s(7 + k * PERIOD_NS, wall_s) == pytest.approx(expected_s, abs=1e-9)


def test_rate_zero_waits_for_nothing() -> None:
    pace = Pace(0.0)
    assert [pace.wait_s(k * 10**12, 0.0) for k in range(3)] == [0.0, 0.0, 0.0]


def test_a_little_late_is_made_up_and_a_long_hold_up_is_not() -> None:
    pace = Pace(1.0)
    second = 10**9
    assert pace.wait_s(0, 0.0) == 0.0
    assert pace.wait_s(second, 1.5) == 0.0
    assert pace.wait_s(2 * second, 1.5) == pytest.approx(0.5), "half a second was made up"
    assert pace.wait_s(3 * second, 100.0) == 0.0
    assert pace.wait_s(4 * second, 100.0) == pytest.approx(1.0), "no burst of 97 s"


def test_long_silences_are_cut() -> None:
    pace = Pace(1.0)
    pace.wait_s(0, 0.0)
    assert pace.wait_s(3600 * 10**9, 0.0) == 5.0
    assert pace.wait_s(3601 * 10**9, 5.0) == pytest.approx(1.0)


@pytest.mark.parametrize(("fps", "max_fps"), [(30.0, 10.0), (25.0, 10.0), (30.0, 29.0)])
def test_thinning_keeps_the_rate_asked_for_evenly(fps: float, max_fps: float) -> None:
    thinning = Thinning(max_fps)
    stamps = (np.arange(3000) * 1e9 / fps).astype(np.int64)
    kept = stamps[[thinning.keep(int(stamp)) for stamp in stamps]]
    duration_s = 3000 / fps
    assert len(kept) == pytest.approx(duration_s * max_fps, rel=0.01)
    assert np.diff(kept).max() <= 1e9 / max_fps + 1e9 / fps
    assert thinning.left_out == 3000 - len(kept)


def test_jitter_at_full_rate_drops_nothing() -> None:
    thinning, random = Thinning(25.0), np.random.default_rng(3)
    stamps = (np.arange(500) / 25.0 + random.uniform(-0.004, 0.004, 500)) * 1e9
    assert all(thinning.keep(int(stamp)) for stamp in stamps)


def test_thinning_goes_on_after_a_gap_and_after_a_step_back() -> None:
    thinning = Thinning(10.0)
    assert [thinning.keep(t * 10**6) for t in (0, 50, 100, 90_000, 90_050, 90_100)] == [
        True,
        False,
        True,
        True,
        False,
        True,
    ]
    assert thinning.keep(0), "the clock was set back"
    assert not thinning.keep(50 * 10**6)


def test_live_frames_keep_their_time_of_arrival_while_the_taker_is_busy() -> None:
    source = Numbered(51, live=True, gate_at=51)
    frames = iter(LiveFrames(source))
    first = next(frames)  # and now the taker works on it, while fifty come
    assert source.at_gate.wait(LIMIT_S)
    source.gate.set()
    rest = [stamp_ns // PERIOD_NS for stamp_ns, _ in frames]
    assert rest[-1] == 51
    assert len(rest) <= 4, "the newest, not all that came"
    assert first[0] // PERIOD_NS < rest[0]


def test_a_second_iteration_of_live_frames_goes_on() -> None:
    class Counted(Numbered):
        opened = 0

        def __iter__(self) -> Iterator[StampedImage]:
            self.opened += 1
            return super().__iter__()

    source = Counted(2, live=True)
    with LiveFrames(source) as live:
        assert next(iter(live))[0] == PERIOD_NS
        assert [stamp_ns for stamp_ns, _ in live] == [2 * PERIOD_NS]
    assert source.opened == 1


def test_what_ends_live_frames_is_raised() -> None:
    class Broken(Numbered):
        def __iter__(self) -> Iterator[StampedImage]:
            yield from super().__iter__()
            raise FrameSourceError("here", "nothing", "something")

    with pytest.raises(FrameSourceError):
        list(LiveFrames(Broken(1, live=True)))
