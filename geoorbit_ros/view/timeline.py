"""What happened to a camera's view, as stretches of time and in sentences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from geoorbit_ros.core.lanes import ViewNote
from geoorbit_ros.view.looks import MAIN_VIEW, Blindness, ViewLook, ViewState

QUICK_S = 3.0
"""A move that was mostly complete after this time is a bump, a slower one a drift."""
GREW_SHARE = 0.6
"""So much of its size it must have had by then. Chosen: a bumped pole creeps on a little."""

_BLIND = {
    Blindness.NO_PATTERN: "the image shows nothing: dark, covered, dirty or fogged",
    Blindness.FROZEN: "the image is frozen",
    Blindness.REPEATED: "the stream repeats what it has shown before",
}


@dataclass(frozen=True, slots=True)
class ViewStretch:
    """A time in which the view was in one state.

    Attributes:
        first_ns: Stamp of its beginning.
        last_ns: Stamp of its last look so far.
        state: The state.
        view: Number of the view.
        blindness: Why it is blind.
        moved_px: How far the view lies away at its last look.
        right_px: To the right, in the middle of the image.
        down_px: Downwards.
        first_moved_px: How far it lay away in its first seconds.
        sway_px: Largest sway.
        found_s: How long after its beginning the view was found where it lies now.
    """

    first_ns: int
    last_ns: int
    state: ViewState
    view: int = MAIN_VIEW
    blindness: Blindness = Blindness.NONE
    moved_px: float = 0.0
    right_px: float = 0.0
    down_px: float = 0.0
    first_moved_px: float = 0.0
    sway_px: float = 0.0
    found_s: float = 0.0

    @property
    def troubled(self) -> bool:
        """Whether a person should know: the view is not where it was calibrated."""
        return self.state in (ViewState.MOVED, ViewState.OTHER_VIEW, ViewState.BLIND)

    @property
    def held(self) -> bool:
        """Whether the image does not show the lanes, which stay as they were before."""
        return self.state in (ViewState.OTHER_VIEW, ViewState.BLIND)

    @property
    def told(self) -> bool:
        """Whether it is worth a sentence."""
        return self.troubled or self.state is ViewState.SHAKING

    def sentence(self, time_text: Callable[[int], str], *, goes_on: bool = False) -> str:
        """What happened, with times as `time_text` writes a stamp; `goes_on`: without an end."""
        since = time_text(self.first_ns)
        until = f"since {since}" if goes_on else f"{since} to {time_text(self.last_ns)}"
        if self.state is ViewState.BLIND:
            return f"{_BLIND.get(self.blindness, 'the image is blind')} ({until})"
        if self.state is ViewState.OTHER_VIEW:
            return f"the camera shows another view from {since} on"
        if self.view != MAIN_VIEW:
            return f"the camera shows view {self.view} ({until})"
        if self.state is ViewState.MOVED:
            return self._move(since)
        if self.state is ViewState.SHAKING:
            return f"the camera shakes by {self.sway_px:.1f} px ({until})"
        return f"the view is {self.state.name.lower().replace('_', ' ')} ({until})"

    def _move(self, since: str) -> str:
        across, down = round(self.right_px), round(self.down_px)
        sideways = f"{abs(across)} px to the {'right' if across > 0 else 'left'}"
        by = f"{sideways} and {abs(down)} px {'down' if down > 0 else 'up'}"
        drifted = self.first_moved_px < GREW_SHARE * self.moved_px
        what = "drifted" if drifted else "moved"
        found = "followed" if drifted else f"found again within {max(self.found_s, 0.1):.1f} s"
        return f"the image has {what} by {self.moved_px:.0f} px ({by}) from {since} on, {found}"


def stretch_of(
    first_ns: int,
    last_ns: int,
    state: str,
    blindness: str,
    view: int,
    moved_px: float,
    right_px: float,
    down_px: float,
    sway_px: float,
    found_s: float,
) -> ViewStretch:
    """A stretch as a database has it, with the names of its states."""
    return ViewStretch(
        first_ns,
        last_ns,
        ViewState[state.upper()],
        view,
        Blindness[blindness.upper()],
        moved_px,
        right_px,
        down_px,
        moved_px,
        sway_px,
        found_s,
    )


def clock_text(stamp_ns: int) -> str:
    """A stamp as the time of day, for logs: UTC."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%H:%M:%S")


def utc_text(stamp_ns: int) -> str:
    """A stamp with its day, for files."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


MOST_STRETCHES = 1000
"""Of a camera that runs for months, so many are remembered."""


class ViewTimeline:
    """Joins looks to stretches.

    Attributes:
        stretches: In time order; the last goes on.
    """

    def __init__(self) -> None:
        self.stretches: list[ViewStretch] = []

    def add(self, look: ViewLook) -> bool:
        """Take a look; whether a new stretch began."""
        last = self.stretches[-1] if self.stretches else None
        same = last is not None and (last.state, last.blindness) == (look.state, look.blindness)
        if look.state is not ViewState.OTHER_VIEW:  # which gets its number after a while
            same = same and last is not None and last.view == look.view
        right, down = _shift(look)
        if last is not None and same:
            quick = look.stamp_ns - last.first_ns <= QUICK_S * 1e9
            self.stretches[-1] = replace(
                last,
                first_moved_px=look.moved_px if quick else last.first_moved_px,
                last_ns=look.stamp_ns,
                view=look.view,
                moved_px=look.moved_px,
                right_px=right,
                down_px=down,
                sway_px=max(last.sway_px, look.sway_px),
            )
            return False
        first_ns = min(max(look.since_ns, last.first_ns if last else 0), look.stamp_ns)
        if last is not None:
            self._shorten(first_ns)
        found_s = (look.stamp_ns - first_ns) / 1e9
        del self.stretches[: -MOST_STRETCHES + 1]
        self.stretches.append(
            ViewStretch(
                first_ns,
                look.stamp_ns,
                look.state,
                look.view,
                look.blindness,
                look.moved_px,
                right,
                down,
                look.moved_px,
                look.sway_px,
                found_s,
            )
        )
        return True

    def note(self, time_text: Callable[[int], str]) -> ViewNote | None:
        """What lanes that are published now should say of the view."""
        last = self.stretches[-1] if self.stretches else None
        if last is None or not last.troubled:
            return None
        return ViewNote(last.held, last.first_ns, last.sentence(time_text, goes_on=True))

    def told(self) -> list[ViewStretch]:
        """The stretches that a person should know of."""
        return [stretch for stretch in self.stretches if stretch.told]

    def _shorten(self, end_ns: int) -> None:
        """The state began before it was noticed: what was told since then gives way."""
        while self.stretches and self.stretches[-1].first_ns >= end_ns and len(self.stretches) > 1:
            self.stretches.pop()
        last = self.stretches[-1]
        self.stretches[-1] = replace(last, last_ns=max(min(last.last_ns, end_ns), last.first_ns))


def _shift(look: ViewLook) -> tuple[float, float]:
    """By how many pixels the middle of the image lies to the right and down."""
    if look.state is not ViewState.MOVED:
        return 0.0, 0.0
    middle = (np.array(look.size) - 1.0) / 2
    mapped = look.motion @ [*middle, 1.0]
    right, down = (mapped[:2] / mapped[2] - middle).tolist()
    return right, down
