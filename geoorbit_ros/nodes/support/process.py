"""Starts nodes, spins them, ends them: what every executable does around its node."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode

SPIN_TIMEOUT_S = 0.2
"""How long a signal may go unnoticed at most. Chosen: larger, a node ends later; smaller, an idle
node wakes the processor more often."""

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def make_executor(context: Context | None = None) -> Executor:
    """The events executor, which costs a quarter of the usual one per message; else that.

    Call `spin_once` with a time-out: without one, that of rclpy 7.1.6 does not return. It also
    can't call subscription callbacks that take a MessageInfo.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # ROS installations from before it was added
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def run_node(make: Callable[[], GeoOrbitNode[Any]], args: Sequence[str] | None = None) -> int:
    """Start one node and spin it until it is done or the process is told to end.

    Returns:
        Exit status: 0 when done or after SIGINT or SIGTERM, 2 with one sentence on standard error
        when something the user gave can't be used.
    """
    return run_nodes([make], lambda nodes: not nodes[0].done, args)


def run_nodes(
    makers: Sequence[Callable[[], GeoOrbitNode[Any]]],
    goes_on: Callable[[Sequence[GeoOrbitNode[Any]]], bool],
    args: Sequence[str] | None = None,
) -> int:
    """As `run_node`, for several nodes on one executor, while `goes_on` says so of them."""
    received: list[int] = []

    def told_to_end() -> bool:
        return bool(received)  # where a function begins, Python runs the handlers that are due

    for number in SIGNALS:
        # rclpy's handler ends the context, then calls this one. Python's own would raise
        # KeyboardInterrupt, also inside the clean-up of the C++ executor, which then aborts: a
        # Ctrl-C under `ros2 launch` reaches a node twice.
        signal.signal(number, lambda received_number, _: received.append(received_number))
    try:
        with ExitStack() as stack:
            _spin(stack, makers, lambda nodes: not told_to_end() and goes_on(nodes), args)
    except ExternalShutdownException:
        return 0
    except Exception as error:
        # Told to end while a node is being made or taken down, its context is gone and anything
        # may fail.
        if told_to_end():
            reason = next(iter(str(error).splitlines()), "")
            print(f"told to end; {type(error).__name__}: {reason}", file=sys.stderr)
            return 0
        if isinstance(error, GeoOrbitError):
            print(error, file=sys.stderr)
            return 2
        raise
    finally:
        for number in SIGNALS:  # while it ends, Python puts back the default, which is to kill
            signal.signal(number, signal.SIG_IGN)
    return 0


def _spin(
    stack: ExitStack,
    makers: Sequence[Callable[[], GeoOrbitNode[Any]]],
    goes_on: Callable[[Sequence[GeoOrbitNode[Any]]], bool],
    args: Sequence[str] | None,
) -> None:
    """Make the nodes and spin them; `stack` takes them down, the last one first."""
    nodes: list[GeoOrbitNode[Any]] = []
    stack.callback(rclpy.try_shutdown)
    rclpy.init(args=None if args is None else list(args))
    executor = make_executor()
    for make in makers:
        node = make()
        stack.callback(node.destroy_node)
        stack.callback(node.close)
        nodes.append(node)
        executor.add_node(node)
    # What lives from here on stays: the collector need not look through it in the middle of a
    # frame, which takes tens of milliseconds with all that is imported.
    gc.collect()
    gc.freeze()
    while rclpy.ok() and goes_on(nodes):
        executor.spin_once(timeout_sec=SPIN_TIMEOUT_S)
