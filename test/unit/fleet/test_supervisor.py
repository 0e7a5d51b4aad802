"""Processes that end or hang come back; all of them are gone when the supervisor stops."""

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from geoorbit_ros.fleet import supervisor
from geoorbit_ros.fleet.plan import ProcessPlan
from geoorbit_ros.fleet.supervisor import State, Supervisor, Timing

QUICK = Timing(
    heartbeat_s=2.0, start_s=60.0, first_back_off_s=0.05, last_back_off_s=0.2, kill_s=60.0,
    interrupt_s=30.0,
)  # fmt: skip
DEADLINE_S = 120.0

# What a process does; `beat` writes one heartbeat.
BEHAVIOURS = {
    "steady": "while True: beat(); time.sleep(0.02)",
    "hangs": "beat(); time.sleep(60)",
    "mute": "time.sleep(60)",
    "fails": "beat(); print('no such camera', flush=True); sys.exit(2)",
    "refused": "print('no such camera', flush=True); sys.exit(2)",
    "later": "f = sys.argv[2]\nran = os.path.exists(f)\n"
    "if not ran: open(f, 'w').close(); beat()\nsys.exit(2)",
    "tells": "say = os.environ\n"
    "print(say['MALLOC_ARENA_MAX'], say['MALLOC_TRIM_THRESHOLD_'], flush=True)\n"
    "while True: beat(); time.sleep(0.02)",
    "stubborn": "signal.signal(2, signal.SIG_IGN); signal.signal(15, signal.SIG_IGN)\n"
    "while True: beat(); time.sleep(0.02)",
}
PROGRAM = "import os, signal, sys, time\ndef beat(): os.write(int(sys.argv[1]), b'.')\n"

Make = Callable[..., Supervisor]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[Supervisor] = []

    def build(*names: str, timing: Timing = QUICK, first: Sequence[str] = ()) -> Supervisor:
        def command(plan_file: Path, descriptor: int) -> list[str]:
            behaviour = BEHAVIOURS[plan_file.stem.partition("_")[0]]
            mark = str(plan_file.with_suffix(".ran"))
            return [sys.executable, "-c", PROGRAM + behaviour, str(descriptor), mark]

        made.append(
            Supervisor(
                [ProcessPlan(name, (), first=name in first) for name in names],
                tmp_path,
                on_event=lambda name, text: events.append((name, text)),
                command=command,
                timing=timing,
            )
        )
        return made[-1]

    events.clear()
    yield build
    for one in made:
        one.stop()


events: list[tuple[str, str]] = []


def run_until(supervisor: Supervisor, met: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not met():
        assert time.monotonic() < deadline, events
        supervisor.step(0.02)


def process_of(supervisor: Supervisor, name: str) -> int:
    process = supervisor.members[name].process
    assert process is not None
    return process.pid


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_what_others_need_runs_before_they_start(make: Make) -> None:
    supervisor = make("steady_a", "steady_b", "steady_c", first=["steady_a", "steady_b"])
    run_until(supervisor, lambda: supervisor.all_running)
    order = [name for name, text in events if "running" in text or text.startswith("started")]
    assert order == ["steady_a"] * 2 + ["steady_b"] * 2 + ["steady_c"] * 2


def test_what_is_refused_before_it_ran_is_told_once_and_holds_up_nobody(make: Make) -> None:
    supervisor = make("refused_a", "steady_b", first=["refused_a"])
    run_until(supervisor, lambda: supervisor.settled)
    for _ in range(20):
        supervisor.step(0.02)
    assert supervisor.refused == ("refused_a",)
    assert not supervisor.all_running
    told = [text for name, text in events if name == "refused_a"]
    assert told[1:] == ["can't start: no such camera; it is left out"]


def test_what_ran_before_is_started_again_whatever_it_says(make: Make) -> None:
    supervisor = make("later_a")
    run_until(supervisor, lambda: supervisor.members["later_a"].restarts >= 3)
    assert supervisor.refused == ()


def test_no_more_processes_start_at_once_than_there_are_cores(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    supervisor = make(*(f"steady_{k}" for k in range(5)))
    run_until(supervisor, lambda: supervisor.all_running)
    starting = most = 0
    for _, text in events:
        starting += 1 if text.startswith("started") else -1
        most = max(most, starting)
    assert most == 2


def test_memory_goes_back_unless_the_environment_says_otherwise(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MALLOC_ARENA_MAX", "7")
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    supervisor = make("tells")
    run_until(supervisor, lambda: supervisor.all_running)
    assert (tmp_path / "logs" / "tells.log").read_text().endswith("7 1048576\n")


def test_a_killed_process_comes_back_and_the_others_stay(make: Make) -> None:
    supervisor = make("steady_a", "steady_b")
    run_until(supervisor, lambda: supervisor.all_running)
    victim, other = process_of(supervisor, "steady_a"), process_of(supervisor, "steady_b")
    os.kill(victim, signal.SIGKILL)
    member = supervisor.members["steady_a"]
    run_until(supervisor, lambda: member.restarts == 1 and supervisor.all_running)
    assert process_of(supervisor, "steady_a") != victim
    assert process_of(supervisor, "steady_b") == other
    assert member.last_end == "ended by SIGKILL"


@pytest.mark.parametrize("behaviour", ["hangs", "mute"])
def test_a_process_without_heartbeat_is_replaced(make: Make, behaviour: str) -> None:
    supervisor = make(behaviour, timing=Timing(0.3, 0.6, 0.05, 0.1, 30.0, 0.2, 0.4))
    run_until(supervisor, lambda: supervisor.members[behaviour].restarts >= 1)
    assert "no heartbeat" in supervisor.members[behaviour].last_end


def test_a_process_that_keeps_failing_is_tried_ever_more_rarely(make: Make, tmp_path: Path) -> None:
    supervisor = make("fails")
    run_until(supervisor, lambda: supervisor.members["fails"].restarts == 4)
    pauses = [text.rpartition("again in ")[2] for _, text in events if "again in" in text]
    assert pauses == ["0.05 s", "0.1 s", "0.2 s", "0.2 s"]
    assert "exit 2: no such camera; again" in events[-1][1]
    assert (tmp_path / "logs" / "fails.log").read_text().count("no such camera") == 4


def test_a_failing_process_holds_up_only_those_that_were_never_up(make: Make) -> None:
    supervisor = make("fails", "steady", first=["fails"])
    run_until(supervisor, lambda: supervisor.members["steady"].state is State.RUNNING)


@pytest.mark.parametrize("behaviour", ["steady", "hangs", "stubborn"])
def test_stop_ends_every_process_by_force_if_it_must(make: Make, behaviour: str) -> None:
    forced = behaviour == "stubborn"
    timing = replace(QUICK, interrupt_s=0.5, kill_s=1.0) if forced else QUICK
    supervisor = make(f"{behaviour}_a", f"{behaviour}_b", timing=timing)
    run_until(supervisor, lambda: supervisor.all_running)
    pids = [process_of(supervisor, name) for name in supervisor.members]
    supervisor.stop()
    assert all(is_gone(pid) for pid in pids)
    said = [text for _, text in events if "did not end" in text]
    for number in ("SIGTERM", "SIGKILL"):
        assert said.count(f"did not end; {number}") == (2 if forced else 0)


def test_the_default_times_keep_the_promises() -> None:
    timing = Timing()
    assert timing.kill_s < 5.0
    assert timing.first_back_off_s < 1.0


def test_a_log_is_set_aside_while_its_process_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "LOG_BYTES", 1000)
    log = tmp_path / "north.log"
    with log.open("ab", buffering=0) as writer:  # as a process holds it
        for k in range(5):
            writer.write(b"%d" % k * 600)
            supervisor.rotate(log)
            assert log.stat().st_size <= 1000
    assert log.read_bytes() == b"4" * 600
    assert log.with_suffix(".log.1").read_bytes() == b"2" * 600 + b"3" * 600
    supervisor.rotate(tmp_path / "none.log")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    log.write_bytes(b"x" * 2000)
    monkeypatch.setattr("shutil.copyfile", full)
    supervisor.rotate(log)
    assert log.stat().st_size == 0


def test_the_supervisor_looks_at_the_logs_of_all(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    monkeypatch.setattr(supervisor, "rotate", lambda file: looked.append(file.name))
    make("steady_1", "steady_2").step(0.0)
    assert {"steady_1.log", "steady_2.log"} <= set(looked)
