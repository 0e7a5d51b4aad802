"""Real processes under attack, on this machine alone, and what the attacks report."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.node import Node

LIMIT_S = 30.0
"""Longest wait for anything."""


@dataclass(frozen=True)
class Finding:
    """What one attack did.

    Attributes:
        row: What is attacked.
        damage: 0 when nothing was hurt; what 1 means is in `what`.
        what: The figures behind it.
    """

    row: str
    damage: float
    what: str


class Victim:
    """One node in a process of its own.

    Attributes:
        process: The process.
        log: Where its output goes.
    """

    def __init__(
        self, executable: str, folder: Path, namespace: str = "", **parameters: object
    ) -> None:
        self.log = folder / f"{executable}{namespace.replace('/', '.')}.log"
        given = [part for n, value in parameters.items() for part in ("-p", f"{n}:={value}")]
        names = ["-r", f"__ns:={namespace}"] if namespace else []
        command = [sys.executable, "-m", f"geoorbit_ros.nodes.{executable}", "--ros-args"]
        with self.log.open("ab") as log:
            # Elsewhere: `-m` looks for modules in the working folder first.
            self.process = subprocess.Popen(
                [*command, *names, *given], stdout=log, stderr=log, cwd=folder
            )

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self.process.poll() is None

    @property
    def text(self) -> str:
        """What it has said so far."""
        return self.log.read_text(errors="replace")

    @property
    def resident_mb(self) -> float:
        """Its memory."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS"))

    def fill_disk(self, full: bool) -> None:
        """Let every write of the process to a file fail, or work again."""
        hard = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE)[1]
        soft = 0 if full else hard
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (soft, hard))

    def end(self) -> None:
        """Stop it."""
        if self.alive:
            self.process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(LIMIT_S)
        if self.alive:
            self.process.kill()
            self.process.wait()


@contextmanager
def victims() -> Iterator[Callable[..., Victim]]:
    """Makes victims and ends them all."""
    made: list[Victim] = []

    def make(*given: Any, **named: Any) -> Victim:
        made.append(Victim(*given, **named))
        return made[-1]

    try:
        yield make
    finally:
        for victim in made:
            victim.end()


class Attacker:
    """A node that sends whatever it likes."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self.node = Node("attacker", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def publisher(self, kind: type, topic: str, qos: Any) -> Any:
        """A publisher that somebody listens to."""
        made = self.node.create_publisher(kind, topic, qos)
        wait(lambda: made.get_subscription_count() > 0, self)
        return made

    def spin(self, duration_s: float = 0.02) -> None:
        """Let messages come and go."""
        self._executor.spin_once(timeout_sec=duration_s)

    def close(self) -> None:
        """Leave the network."""
        self.node.destroy_node()
        self._context.try_shutdown()


def wait(
    met: Callable[[], bool], attacker: Attacker | None = None, limit_s: float = LIMIT_S
) -> bool:
    """Whether a condition was met in time."""
    end_s = time.monotonic() + limit_s
    while not met():
        if time.monotonic() > end_s:
            return False
        if attacker is not None:
            attacker.spin()
        else:
            time.sleep(0.02)
    return True


def bounded(command: Sequence[str], limit_s: float, memory_mb: int) -> tuple[int, float, str]:
    """Run a command within limits: exit status (-1 out of time), seconds, what it said."""

    def limit() -> None:
        size = memory_mb << 20
        resource.setrlimit(resource.RLIMIT_AS, (size, size))

    begin_s = time.monotonic()
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=limit_s,
            preexec_fn=limit,
            check=False,
            cwd="/",
        )
    except subprocess.TimeoutExpired:
        return -1, time.monotonic() - begin_s, "out of time"
    return done.returncode, time.monotonic() - begin_s, done.stdout + done.stderr


def use_free_domain() -> None:
    """A ROS domain of this machine alone, for this process and those that it starts."""
    from geoorbit_ros.nodes.support.composition import DomainClaim

    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(DomainClaim().domain_id)
