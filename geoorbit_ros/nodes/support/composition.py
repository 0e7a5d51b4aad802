"""Several nodes in one process, on one executor, in a ROS context of their own."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Mapping
from itertools import count
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.process import SIGNALS, make_executor

_FIRST, _LAST = 1, 100
"""Domain 0 is the default one; from 102 on Linux hands the ports out to others."""
_tries = count(os.getpid())
_BASE, _GAIN = 7400, 250
"""Discovery port of a domain: OMG DDS-RTPS 2.5, section 9.6.2.3."""


class DomainClaim:
    """A ROS domain in which no participant runs on this machine, kept until it is closed.

    Processes that start at the same moment never get the same one: an abstract Unix socket
    (man 7 unix) marks it as taken, and the kernel removes it when the process ends.

    Attributes:
        domain_id: The domain.

    Raises:
        GeoOrbitError: All are taken.
    """

    def __init__(self) -> None:
        number = _LAST - _FIRST + 1
        for _ in range(number):
            self.domain_id = _FIRST + next(_tries) % number
            self._mark = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                try:  # participants share this port among themselves, but not with a plain socket
                    self._mark.bind(f"\0geoorbit ROS domain {self.domain_id}")
                    probe.bind(("", _BASE + _GAIN * self.domain_id))
                except OSError:
                    self._mark.close()
                    continue
            return
        raise GeoOrbitError("ROS domains", f"{_FIRST} to {_LAST} in use", "a free one")

    def close(self) -> None:
        """Leave the domain to others."""
        self._mark.close()


STEP_S = 0.05
"""How long one spin waits at most. Chosen: larger, Ctrl-C and conditions are noticed later."""

AnyNode = TypeVar("AnyNode", bound=Node)
AnyGeoOrbitNode = TypeVar("AnyGeoOrbitNode", bound=GeoOrbitNode[Any])


class Composition:
    """A context manager that holds nodes, spins them and takes them down again.

    SIGINT and SIGTERM raise KeyboardInterrupt where the nodes are spun, and not in the middle of a
    callback or of the middleware.

    Args:
        domain_id: ROS domain; None takes a free one that only this machine can see.
        quiet: Whether the nodes log warnings and errors only.
    """

    def __init__(self, domain_id: int | None = None, *, quiet: bool = False) -> None:
        self._claim: DomainClaim | None = None
        if domain_id is None:
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            self._claim = DomainClaim()
            domain_id = self._claim.domain_id
        self.domain_id, self._quiet = domain_id, quiet
        self.context = Context()
        no_signals = SignalHandlerOptions.NO
        rclpy.init(
            args=[], context=self.context, domain_id=domain_id, signal_handler_options=no_signals
        )
        self._executor = make_executor(self.context)
        self._nodes: list[Node] = []
        self._told_to_end = False
        main = threading.current_thread() is threading.main_thread()
        # An interruption that got lost comes again as SIGALRM (`cli/signals.py`).
        told_by = (*SIGNALS, signal.SIGALRM) if main else ()
        self._handlers = {n: signal.signal(n, self._note) for n in told_by}

    def _note(self, *_: object) -> None:
        self._told_to_end = True

    def add(self, node: AnyNode) -> AnyNode:
        """Take over a node made with this composition's `context`."""
        self._nodes.append(node)
        self._executor.add_node(node)
        return node

    def make(
        self, node_class: type[AnyGeoOrbitNode], namespace: str, overrides: Mapping[str, object]
    ) -> AnyGeoOrbitNode:
        """A new node of this composition.

        Raises:
            GeoOrbitError: As the node's constructor.
        """
        if self._quiet:
            set_logger_level(f"{namespace}.{node_class.name}", LoggingSeverity.WARN)
        return self.add(node_class(context=self.context, namespace=namespace, overrides=overrides))

    def spin(self, timeout_s: float = STEP_S) -> None:
        """Do what is due, or wait for it; errors of callbacks come out here.

        Raises:
            KeyboardInterrupt: The process was told to end.
        """
        self._executor.spin_once(timeout_sec=timeout_s)
        if self._told_to_end:
            self._told_to_end = False
            raise KeyboardInterrupt

    def wait(
        self,
        met: Callable[[], bool],
        timeout_s: float,
        what: str,
        progress: Callable[[], int] = int,
    ) -> None:
        """Spin until a condition is met.

        Args:
            met: The condition.
            timeout_s: Longest time without progress.
            what: What is waited for, as words for the error.
            progress: A number that changes while things go forward.

        Raises:
            GeoOrbitError: The time is up.
        """
        seen, deadline = progress(), time.monotonic() + timeout_s
        while not met():
            self.spin()
            if progress() != seen:
                seen, deadline = progress(), time.monotonic() + timeout_s
            elif time.monotonic() > deadline:
                names = ", ".join(node.get_name() for node in self._nodes)
                raise GeoOrbitError(f"nodes {names}", f"nothing for {timeout_s:g} s", what)

    def close(self) -> None:
        """Let the nodes finish, then destroy them and the context."""
        try:
            for node in self._nodes:
                if isinstance(node, GeoOrbitNode):
                    node.close()
        finally:
            self._executor.shutdown()
            for node in self._nodes:
                node.destroy_node()
            self.context.try_shutdown()
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
            if self._claim is not None:
                self._claim.close()

    def __enter__(self) -> Composition:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
