"""Runs the nodes of one process of a fleet on one executor, with a heartbeat for its supervisor."""

from __future__ import annotations

import ctypes
import inspect
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.node import Node

from geoorbit_ros.core.errors import GeoOrbitError, ParameterError
from geoorbit_ros.fleet.plan import SECRETS_VARIABLE, NodePlan, ProcessPlan
from geoorbit_ros.fleet.supervisor import HEARTBEAT_PERIOD_S
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.diagnostics import Diagnostics
from geoorbit_ros.nodes.support.process import run_nodes

GIVE_BACK_PERIOD_S = 60.0
"""Between two returns of free memory. Chosen: larger, processes stay bigger for longer; smaller,
the milliseconds that it takes come more often."""


class FreeMemory:
    """Gives pages without content back to the system, every now and then.

    A map's derivation takes a few megabytes and leaves them scattered over the heap. glibc returns
    only the heap's end by itself; `malloc_trim(3)` returns whole free pages anywhere.

    Args:
        period_s: Between two times.
    """

    def __init__(self, period_s: float = GIVE_BACK_PERIOD_S) -> None:
        self._period_s = period_s
        self._due_s = time.monotonic() + period_s
        # Another C library than glibc has no such function, and manages without.
        try:
            self._trim: Callable[[int], int] | None = ctypes.CDLL(None).malloc_trim
        except AttributeError:
            self._trim = None

    def give_back_if_due(self) -> bool:
        """Whether it was time to; takes some milliseconds then."""
        now = time.monotonic()
        if now < self._due_s:
            return False
        self._due_s = now + self._period_s
        if self._trim is not None:
            self._trim(0)
        return True


class Heartbeat:
    """Writes to a pipe once a second, from the loop that spins the nodes.

    Args:
        descriptor: Writing end of the pipe.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._due_s = 0.0

    def beat(self) -> bool:
        """Show that the loop turns; False when the supervisor has gone."""
        now = time.monotonic()
        if now < self._due_s:
            return True
        self._due_s = now + HEARTBEAT_PERIOD_S
        try:
            os.write(self._descriptor, b".")
        except BrokenPipeError:
            return False
        return True


def node_class(executable: str) -> type[GeoOrbitNode[Any]]:
    """The node behind an executable's name.

    Raises:
        ParameterError: There is none.
    """
    try:
        module = import_module(f"geoorbit_ros.nodes.{executable}")
    except ModuleNotFoundError as error:
        raise ParameterError("node", f"'{executable}'", "an executable of geoorbit_ros") from error
    for _, found in inspect.getmembers(module, inspect.isclass):
        if issubclass(found, GeoOrbitNode) and found is not GeoOrbitNode:
            node: type[GeoOrbitNode[Any]] = found
            if node.name == executable:
                return node
    raise ParameterError("node", f"'{executable}'", f"a node class in {module.__name__}")


class AbsentNode(GeoOrbitNode[None]):
    """Stands in for an optional node that can't start, and says why on /diagnostics.

    Args:
        name: Of the node that can't start.
        namespace: Its namespace; None: that of the command line.
        why: What its start raised.
    """

    def __init__(self, name: str, namespace: str | None, why: GeoOrbitError) -> None:
        Node.__init__(self, name, namespace=namespace)
        self.done = self.told_to_end = False
        self.diagnostics = Diagnostics(self)
        self.diagnostics.add_check(lambda: f"does not run: {why}")
        self.get_logger().error(f"does not run, and its camera goes on without it: {why}")


def made_or_absent(
    make: type[GeoOrbitNode[Any]], namespace: str | None, overrides: Any
) -> GeoOrbitNode[Any]:
    """A node; where it is optional and can't start, one that says so in its place.

    Raises:
        GeoOrbitError: A node that is not optional can't start.
    """
    try:
        return make(namespace=namespace, overrides=overrides)
    except GeoOrbitError as error:
        if not make.optional:
            raise
        return AbsentNode(make.name, namespace, error)


def run_group(plan: ProcessPlan, heartbeat: Heartbeat) -> int:
    """Start the plan's nodes and spin them until told to end, or until the supervisor is gone.

    Returns:
        Exit status: 0 when told to end, 2 with one sentence when a node can't start.
    """
    makers = [partial(_make, node) for node in plan.nodes]
    free_memory = FreeMemory()

    def goes_on(_: Sequence[GeoOrbitNode[Any]]) -> bool:
        free_memory.give_back_if_due()
        return heartbeat.beat()

    return run_nodes(makers, goes_on, [])


def _make(plan: NodePlan) -> GeoOrbitNode[Any]:
    make = node_class(plan.executable)
    return made_or_absent(make, plan.namespace or None, plan.parameters)


def run_plan(plan_file: str, descriptor: str) -> int:
    """What `python -m geoorbit_ros.nodes.support.fleet_process PLAN.json DESCRIPTOR` does."""
    secrets = json.loads(os.environ.pop(SECRETS_VARIABLE, "{}"))
    plan = ProcessPlan.from_json(Path(plan_file).read_text(encoding="utf-8"), plan_file, secrets)
    return run_group(plan, Heartbeat(int(descriptor)))


if __name__ == "__main__":
    sys.exit(run_plan(*sys.argv[1:]))
