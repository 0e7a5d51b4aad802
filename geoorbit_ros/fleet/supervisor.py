"""Keeps the processes of a fleet running: start in order, heartbeat, restart, stop in time.

No ROS in here: a process shows that it lives by writing to a pipe from the loop that spins its
nodes, so that one that hangs is told from one that is busy.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from geoorbit_ros.core.addresses import masked_text
from geoorbit_ros.fleet.plan import SECRETS_VARIABLE, ProcessPlan

ALLOCATOR = {
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_MMAP_THRESHOLD_": "1048576",
    "MALLOC_TRIM_THRESHOLD_": "1048576",
}
"""Of glibc (mallopt(3)), unless the environment says otherwise. By itself it takes ever larger
blocks from the heap, where tables that live for a minute leave holes between those that last: a
camera grew by 2.5 MB a minute. With fixed thresholds it stays flat, for 4 % more processor time."""

HEARTBEAT_PERIOD_S = 1.0
"""Between two signs of life. Chosen: a part of `Timing.heartbeat_s`, so that some may be late."""
LOG_BYTES = 5_000_000
"""A log file that is larger is set aside as `.1`, also while its process writes. Chosen: larger
costs disk, smaller loses what happened before."""
LOG_PERIOD_S = 10.0
"""Between two looks at the sizes of the logs. Chosen: a process that says the same again and again
writes a megabyte in this time; larger lets the disk fill."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long things may take.

    Attributes:
        heartbeat_s: Without a heartbeat for this long a process hangs, and is replaced.
        start_s: For the first heartbeat: imports on a busy machine, a twin that loads its network.
        first_back_off_s: From an end to the next start; doubled each time it ends again …
        last_back_off_s: … up to this.
        steady_s: After this long alive, the next end is a first one again.
        interrupt_s: From Ctrl-C to SIGTERM when all is stopped, from the beginning.
        kill_s: The same to SIGKILL. The promise is that five seconds are enough.
    """

    heartbeat_s: float = 8.0
    start_s: float = 60.0
    first_back_off_s: float = 0.5
    last_back_off_s: float = 30.0
    steady_s: float = 30.0
    interrupt_s: float = 3.0
    kill_s: float = 4.5


EXIT_REFUSED = 2
"""Status of a process whose nodes can't start with what the user gave (`run_nodes`)."""
LAST_LINE_BYTES = 2000
"""How much of a log's end is searched for the last thing a process said. Chosen: a few lines."""


class State(Enum):
    """Of a process; REFUSED: what the user gave it can't be used, so that it never ran."""

    WAITING = "waiting"
    STARTING = "starting"
    RUNNING = "running"
    REFUSED = "refused"
    STOPPED = "stopped"


@dataclass
class Member:
    """One process of the fleet.

    Attributes:
        plan: What runs in it.
        state: What it does.
        ran: Whether it ever ran.
        restarts: How often it was replaced.
        last_end: Why it last ended, as words; empty: it never did.
        process: The running one, None between two.
        pipe: Descriptor on which its heartbeats come in; -1: none.
        since_s: When it was started (monotonic clock, as the next three).
        beat_s: Its last heartbeat.
        back_off_s: Pause before its next start.
        due_s: When it starts next.
    """

    plan: ProcessPlan
    state: State = State.WAITING
    ran: bool = False
    restarts: int = 0
    last_end: str = ""
    process: subprocess.Popen[bytes] | None = None
    pipe: int = -1
    since_s: float = 0.0
    beat_s: float = 0.0
    back_off_s: float = 0.0
    due_s: float = 0.0


class Supervisor:
    """Runs the processes of a fleet.

    Args:
        plans: In the order in which they start. Those that are marked `first` are waited for; at
            most one per core is starting at a time, so that none is taken for hanging.
        output: Folder; logs go to `logs/<process>.log` in it, plans to `plans/`.
        environment: Variables that go before this process's own.
        on_event: Told process and sentence whenever one starts, ends or is replaced.
        command: How to run a plan: called with the plan's file and the heartbeat's descriptor.
        timing: How long things may take.
    """

    def __init__(
        self,
        plans: Sequence[ProcessPlan],
        output: Path,
        environment: Mapping[str, str] | None = None,
        on_event: Callable[[str, str], None] = lambda _name, _text: None,
        command: Callable[[Path, int], list[str]] | None = None,
        timing: Timing | None = None,
    ) -> None:
        self.members = {plan.name: Member(plan) for plan in plans}
        self._output = output
        # What the ROS wheels leave in the environment is right for this same interpreter.
        own = {"PYTHONUNBUFFERED": "1", **(environment or {})}
        self._environment = {**ALLOCATOR, **os.environ, **own}
        self._on_event = on_event
        self._command = command or group_command
        self._timing = timing or Timing()
        self._at_once = os.cpu_count() or 1
        self._rotation_s = 0.0
        self._selector = selectors.DefaultSelector()
        for folder in ("logs", "plans"):
            (output / folder).mkdir(parents=True, exist_ok=True)

    @property
    def all_running(self) -> bool:
        """Whether every process has shown that it lives."""
        return all(member.state is State.RUNNING for member in self.members.values())

    @property
    def settled(self) -> bool:
        """Whether every process runs or was refused."""
        known = (State.RUNNING, State.REFUSED)
        return all(member.state in known for member in self.members.values())

    @property
    def refused(self) -> tuple[str, ...]:
        """Processes that can't start with what the user gave."""
        return tuple(n for n, member in self.members.items() if member.state is State.REFUSED)

    def step(self, timeout_s: float) -> None:
        """Do what is due: start, replace, take heartbeats. Returns after `timeout_s` at most."""
        for key, _ in self._selector.select(timeout_s):
            self._take_heartbeat(key.data)
        now = time.monotonic()
        if now >= self._rotation_s:
            self._rotation_s = now + LOG_PERIOD_S
            for name in self.members:
                rotate(self._output / "logs" / f"{name}.log")
        for member in self.members.values():
            self._watch(member, now)
        members = self.members.values()
        free = self._at_once - sum(m.state is State.STARTING for m in members)
        for member in members:
            if member.state is State.WAITING and free > 0 and now >= member.due_s:
                self._start(member, now)
                free -= 1
            # A member that is being replaced does not hold up the others.
            held = member.state in (State.WAITING, State.STARTING) and member.restarts == 0
            if member.plan.first and held:
                break

    def stop(self) -> None:
        """End all processes: SIGINT first, then SIGTERM, then SIGKILL, within `Timing.kill_s`."""
        alive = [m for m in self.members.values() if m.process and m.process.poll() is None]
        started = time.monotonic()
        for member in alive:
            # Python itself prints a traceback for SIGINT before the node's first line is reached.
            starting = member.state is State.STARTING
            _signal(member, signal.SIGTERM if starting else signal.SIGINT)
        timing = self._timing
        steps = ((timing.interrupt_s, signal.SIGTERM), (timing.kill_s, signal.SIGKILL))
        for deadline_s, number in steps:
            while any(m.process and m.process.poll() is None for m in alive):
                if time.monotonic() - started > deadline_s:
                    break
                self._selector.select(0.05)
            for member in alive:
                if member.process and member.process.poll() is None:
                    self._on_event(member.plan.name, f"did not end; {number.name}")
                    _signal(member, number)
        for member in self.members.values():
            if member.process:
                member.process.wait()
            self._close_pipe(member)
            member.state = State.STOPPED
        self._selector.close()

    def _start(self, member: Member, now: float) -> None:
        name = member.plan.name
        plan_file = self._output / "plans" / f"{name}.json"
        plan_file.write_text(member.plan.to_json(), encoding="utf-8")
        plan_file.chmod(0o600)
        secrets = member.plan.secrets()
        environment = {**self._environment, SECRETS_VARIABLE: json.dumps(secrets)}
        log_file = self._output / "logs" / f"{name}.log"
        rotate(log_file)
        read_end, write_end = os.pipe()
        os.set_blocking(read_end, False)
        with log_file.open("ab") as log:
            # A group of its own: Ctrl-C reaches this process first, which ends them in order. Not a
            # session of its own: Linux shares the processor among sessions before it looks at
            # priorities, and what works in the background would count as much as what is live.
            member.process = subprocess.Popen(
                self._command(plan_file, write_end),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment if secrets else self._environment,
                pass_fds=(write_end,),
                process_group=0,
            )
        os.close(write_end)
        member.pipe, member.since_s, member.beat_s = read_end, now, now
        member.state = State.STARTING
        self._selector.register(read_end, selectors.EVENT_READ, member)
        self._on_event(name, f"started, process {member.process.pid}")

    def _take_heartbeat(self, member: Member) -> None:
        beats = os.read(member.pipe, 4096)
        if not beats:  # the other end is closed; `_watch` finds out why
            self._selector.unregister(member.pipe)
            return
        member.beat_s = time.monotonic()
        if member.state is State.STARTING:
            member.state, member.ran = State.RUNNING, True
            self._on_event(
                member.plan.name, f"running after {member.beat_s - member.since_s:.1f} s"
            )

    def _watch(self, member: Member, now: float) -> None:
        process = member.process
        if process is None or member.state in (State.WAITING, State.REFUSED):
            return
        status = process.poll()
        if status is None:
            starting = member.state is State.STARTING
            limit = self._timing.start_s if starting else self._timing.heartbeat_s
            if now - member.beat_s <= limit:
                return
            _signal(member, signal.SIGKILL)
            process.wait()
            reason = f"no heartbeat for {limit:g} s, ended by force"
        else:
            reason = f"ended by {signal.Signals(-status).name}" if status < 0 else f"exit {status}"
        said = masked_text(self._last_line(member.plan.name))
        hint = "" if status is None or status < 0 else f": {said}"
        # Refused before it ever ran: that is the user's to change, and would be refused again. One
        # that has run before may find its port or file in use for a moment.
        if status == EXIT_REFUSED and not member.ran:
            self._close_pipe(member)
            member.process, member.state, member.last_end = None, State.REFUSED, reason
            self._on_event(member.plan.name, f"can't start{hint}; it is left out")
            return
        if now - member.since_s > self._timing.steady_s:
            member.back_off_s = 0.0
        member.back_off_s = max(member.back_off_s, self._timing.first_back_off_s)
        self._close_pipe(member)
        member.process, member.state, member.last_end = None, State.WAITING, reason
        member.restarts += 1
        member.due_s = now + member.back_off_s
        self._on_event(member.plan.name, f"{reason}{hint}; again in {member.back_off_s:g} s")
        member.back_off_s = min(2.0 * member.back_off_s, self._timing.last_back_off_s)

    def _last_line(self, name: str) -> str:
        """The last thing that a process said."""
        with (self._output / "logs" / f"{name}.log").open("rb") as log:
            log.seek(max(log.seek(0, os.SEEK_END) - LAST_LINE_BYTES, 0))
            lines = log.read().decode(errors="replace").split("\n")
        return next(
            (line.strip() for line in reversed(lines) if line.strip()), "nothing in its log"
        )

    def _close_pipe(self, member: Member) -> None:
        if member.pipe >= 0:
            with contextlib.suppress(KeyError):  # its end was seen, so it is no longer watched
                self._selector.unregister(member.pipe)
            os.close(member.pipe)
            member.pipe = -1


def rotate(log_file: Path) -> None:
    """Set a log aside as `.1` once it is longer than `LOG_BYTES`; who writes it goes on.

    It is copied and emptied, not renamed: its process holds it open, to append. What is written
    between the two is lost, a millisecond's. A full disk leaves it without a copy.
    """
    with contextlib.suppress(FileNotFoundError):
        if log_file.stat().st_size <= LOG_BYTES:
            return
        with contextlib.suppress(OSError):
            shutil.copyfile(log_file, log_file.with_suffix(".log.1"))
        with contextlib.suppress(OSError):
            os.truncate(log_file, 0)


def group_command(plan_file: Path, heartbeat_fd: int) -> list[str]:
    """Run a plan's nodes in a process of their own."""
    module = "geoorbit_ros.nodes.support.fleet_process"
    return [sys.executable, "-m", module, str(plan_file), str(heartbeat_fd)]


def _signal(member: Member, number: signal.Signals) -> None:
    """Send a signal to a process and what it started itself."""
    if member.process:
        with contextlib.suppress(ProcessLookupError):  # it ended in between
            os.killpg(member.process.pid, number)
