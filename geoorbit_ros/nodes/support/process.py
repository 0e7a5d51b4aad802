"""Starts nodes, spins them, ends them: what every executable does around its node."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode

SPIN_TIMEOUT_S = 0.2
"""How long a signal may go unnoticed at most."""

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
    nodes: list[GeoOrbitNode[Any]] = []
    told_to_end: list[int] = []
    for number in SIGNALS:
        # rclpy's handler ends the context, then calls this one. Python's own would raise
        # KeyboardInterrupt, also inside the clean-up of the C++ executor, which then aborts: a
        # Ctrl-C under `ros2 launch` reaches a node twice.
        signal.signal(number, lambda received, _: told_to_end.append(received))
    try:
        rclpy.init(args=None if args is None else list(args))
        executor = make_executor()
        for make in makers:
            nodes.append(make())
            executor.add_node(nodes[-1])
        # What lives from here on stays: the collector need not look through it in the middle of a
        # frame, which takes tens of milliseconds with all that is imported.
        gc.collect()
        gc.freeze()
        while rclpy.ok() and not told_to_end and goes_on(nodes):
            executor.spin_once(timeout_sec=SPIN_TIMEOUT_S)
    except ExternalShutdownException:
        pass
    except GeoOrbitError as error:
        print(error, file=sys.stderr)
        return 2
    except Exception as error:
        # Told to end while a node was being made, its context is gone and anything may fail.
        if not told_to_end:
            raise
        print(f"ended while starting ({type(error).__name__}: {error})", file=sys.stderr)
    finally:
        for node in reversed(nodes):
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
        for number in SIGNALS:  # while it ends, Python puts back the default, which is to kill
            signal.signal(number, signal.SIG_IGN)
    return 0
