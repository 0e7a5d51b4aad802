"""Starts nodes, spins them, ends them: what every executable does around its node."""

from __future__ import annotations

import ctypes
import errno
import gc
import hashlib
import signal
import socket
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from geoorbit_ros.core.addresses import masked_text
from geoorbit_ros.core.errors import GeoOrbitError, ParameterError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.parameters import parameter_help

SPIN_TIMEOUT_S = 0.2
"""How long a signal may go unnoticed at most. Chosen: larger, a node ends later; smaller, an idle
node wakes the processor more often."""

SIGNALS = (signal.SIGINT, signal.SIGTERM)

LEAVE_LIMIT_S = 10.0
"""Time in which the middleware must have taken leave of the others. Chosen: with twenty nodes that
end at once on two busy processors it takes two seconds."""


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


def run_node(make: type[GeoOrbitNode[Any]], args: Sequence[str] | None = None) -> int:
    """Start one node and spin it until it is done or the process is told to end.

    `--help` shows its parameters and starts nothing.

    Returns:
        Exit status: 0 when done or after SIGINT or SIGTERM, 2 with one sentence on standard error
        when something the user gave can't be used.
    """
    words = remove_ros_args(["node", *args] if args is not None else sys.argv)[1:]
    if {"--help", "-h"} & set(words):
        print(parameter_help(make.name, (make.__doc__ or "").partition("\n\n")[0]))
        return 0
    if words:
        expected = "--ros-args and what follows it, or --help"
        print(ParameterError(f"node '{make.name}'", f"'{words[0]}'", expected), file=sys.stderr)
        return 2
    return run_nodes([make], lambda nodes: not nodes[0].done, args)


def run_nodes(
    makers: Sequence[Callable[[], GeoOrbitNode[Any]]],
    goes_on: Callable[[Sequence[GeoOrbitNode[Any]]], bool],
    args: Sequence[str] | None = None,
) -> int:
    """As `run_node`, for several nodes on one executor, while `goes_on` says so of them."""
    nodes: list[GeoOrbitNode[Any]] = []
    received: list[int] = []

    def note(number: int, _: object) -> None:
        received.append(number)
        for node in nodes:
            node.told_to_end = True

    def told_to_end() -> bool:
        return bool(received)

    for number in SIGNALS:
        signal.signal(number, note)
    try:
        with ExitStack() as stack:
            _make(stack, makers, nodes, told_to_end, args)
            if not told_to_end():
                _spin(nodes, lambda: not told_to_end() and goes_on(nodes))
    except ExternalShutdownException:
        return 0
    except GeoOrbitError as error:
        print(masked_text(str(error)), file=sys.stderr)
        return 2
    finally:
        for number in SIGNALS:  # while it ends, Python puts back the default, which is to kill
            signal.signal(number, signal.SIG_IGN)
    return 0


def _make(
    stack: ExitStack,
    makers: Sequence[Callable[[], GeoOrbitNode[Any]]],
    nodes: list[GeoOrbitNode[Any]],
    told_to_end: Callable[[], bool],
    args: Sequence[str] | None,
) -> None:
    """Make the nodes; `stack` takes them down, the last one first."""
    stack.callback(rclpy.try_shutdown)
    # Signals only set a flag, which is looked at between two callbacks. rclpy's own handler would
    # end the context at once, also in the middle of a callback or while a node is made, and what
    # uses the context then fails or aborts the process.
    no_signals = SignalHandlerOptions.NO
    rclpy.init(args=None if args is None else list(args), signal_handler_options=no_signals)
    for make in makers:
        if told_to_end():
            return
        nodes.append(node := make())
        if len(nodes) == 1:  # the participant of all nodes goes with the last one that is destroyed
            leave = ExitStack()
            stack.callback(leave.close)
            stack.callback(node.destroy_node)
            stack.callback(leave.enter_context, _leaving_in_time())
        else:
            stack.callback(node.destroy_node)
        stack.callback(node.close)
        stack.enter_context(_name_claimed(node))


class _TimerNotice(ctypes.Structure):
    """`struct sigevent` of Linux with 64 bits (man 3 sigevent)."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("number", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("reserved", ctypes.c_char * 32),
    )


_BY_THREAD = 2
"""SIGEV_THREAD: a new thread calls the function with the value."""
_MONOTONIC = 1
"""CLOCK_MONOTONIC."""


@contextmanager
def _leaving_in_time() -> Iterator[None]:
    """End the process if what is done here takes longer than `LEAVE_LIMIT_S`.

    Everything of a node's own is closed by then: the status is that which it would have been.
    Fast DDS 2.14 can spin for ever in `DomainParticipant::set_listener` when a participant ends
    while it hears that others do, 1 of 700 nodes where twenty end at once; rclpy holds the
    interpreter's lock meanwhile, so that no handler and no thread of Python runs. A timer of the
    operating system calls `_exit` instead.
    """
    failed = not isinstance(sys.exception(), ExternalShutdownException | None)
    libc = ctypes.CDLL(None)
    end = ctypes.cast(libc["_exit"], ctypes.c_void_p)
    notice = _TimerNotice(value=2 * failed, kind=_BY_THREAD, function=end)
    timer = ctypes.c_void_p()
    made = hasattr(libc, "timer_create") and not libc.timer_create(
        _MONOTONIC, ctypes.byref(notice), ctypes.byref(timer)
    )
    if made:
        seconds, fraction = divmod(LEAVE_LIMIT_S, 1.0)
        due = (ctypes.c_long * 4)(0, 0, int(seconds), int(1e9 * fraction))  # struct itimerspec
        libc.timer_settime(timer, 0, due, None)
    try:
        yield
    finally:
        if made:
            libc.timer_delete(timer)


def _name_claimed(node: GeoOrbitNode[Any]) -> socket.socket:
    """Hold a node's name in its domain on this machine: two of one name mix their messages.

    An abstract Unix socket (man 7 unix) marks it, as the middleware's reach ends where the network
    namespace does; the kernel removes it when the process ends.

    Raises:
        ParameterError: A node of that name runs already.
    """
    name, domain_id = node.get_fully_qualified_name(), node.context.get_domain_id()
    # Names may be longer than an address (108 bytes, man 7 unix), and alike at their beginning.
    digest = hashlib.sha256(name.encode()).hexdigest()
    address = f"\0geoorbit node {domain_id} {digest}"
    mark = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        mark.bind(address)
        mark.listen()
    except OSError as error:
        if error.errno != errno.EADDRINUSE:  # a system without such sockets: nobody can be told
            return mark
        owner = "another process"
        mark.setblocking(False)  # many may have asked before, and nobody answers them
        with suppress(OSError):
            mark.connect(address)
            who = mark.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
            owner = f"process {struct.unpack('3i', who)[0]}"
        mark.close()
        place, found = f"node '{name}' of domain {domain_id}", f"{owner}, which has this name"
        expected = "another name or namespace (-r __ns:=/CAMERA), or the end of that process"
        raise ParameterError(place, found, expected) from None
    return mark


def _spin(nodes: Sequence[GeoOrbitNode[Any]], go_on: Callable[[], bool]) -> None:
    executor = make_executor()
    for node in nodes:
        executor.add_node(node)
    # What lives from here on stays: the collector need not look through it in the middle of a
    # frame, which takes tens of milliseconds with all that is imported.
    gc.collect()
    gc.freeze()
    while go_on():
        executor.spin_once(timeout_sec=SPIN_TIMEOUT_S)
