"""What all nodes share: typed parameters, diagnostics, lossless publishing."""

from __future__ import annotations

import functools
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from geoorbit_ros.core.errors import GeoOrbitError, MessageError, disk_fault
from geoorbit_ros.nodes.support.diagnostics import Diagnostics
from geoorbit_ros.parameters import NodeParameters, undeclared

PUBLISH_TIMEOUT_S = 30.0
"""How long a publisher that keeps everything waits for readers that are behind. Chosen: larger, a
reader that hangs is reported later; smaller, one that is busy for a while loses messages."""

Struct = TypeVar("Struct")


def failure(error: Exception, place: str) -> GeoOrbitError:
    """What ended a piece of work, with the line of code, in one sentence."""
    if isinstance(error, GeoOrbitError):
        return error
    frames = traceback.extract_tb(error.__traceback__)
    where = f" in {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
    found = f"{type(error).__name__}{where}: {error}"
    return GeoOrbitError(place, found, "work without a mistake; please report this one")


class GeoOrbitNode(Node, Generic[Struct]):
    """A node with parameters from `params/<name>.yaml` and diagnostics.

    A subclass sets `name` and `struct` and does its work in `setup`.

    Args:
        context: ROS context; default: the global one.
        namespace: Camera namespace; default: from the command line.
        overrides: Parameter values that go before the schema's defaults.

    Attributes:
        name: Name of the node and of its schema.
        struct: Frozen dataclass of the parameters.
        optional: Whether the nodes of its process go on where this one fails: what it does is no
            part of seeing. What failed is told on /diagnostics.
        done: Set by a node whose process may end.
        told_to_end: Set by a signal: what is being waited for is not worth the wait any more.

    Raises:
        GeoOrbitError: A parameter, or a file that one names, can't be used.
    """

    name: str
    struct: type[Struct]
    optional = False

    def __init__(
        self,
        *,
        context: Context | None = None,
        namespace: str | None = None,
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        values = [Parameter(key, value=value) for key, value in (overrides or {}).items()]
        super().__init__(
            self.name, context=context, namespace=namespace, parameter_overrides=values
        )
        self.done = self.told_to_end = False
        try:
            self._checked = NodeParameters(self, self.struct, self.name, self.on_parameters)
            for sentence in undeclared(self.name, self, self._parameter_overrides):
                self.get_logger().warning(sentence)
            self.diagnostics = Diagnostics(self, self.diagnostic_values)
            self.setup()
        except GeoOrbitError:
            self.destroy_node()
            raise

    def setup(self) -> None:
        """Read files, create publishers and subscriptions."""
        raise NotImplementedError

    @property
    def p(self) -> Struct:
        """The parameters as they stand."""
        return self._checked.value

    @property
    def camera_id(self) -> str:
        """The namespace without slashes at its ends."""
        return str(self.get_namespace()).strip("/")

    def on_parameters(self, changed: Struct) -> None:
        """Called with new parameters when one is set; may raise ParameterError to refuse."""

    def diagnostic_values(self) -> Mapping[str, object]:
        """This node's own values on /diagnostics."""
        return {}

    def close(self) -> None:
        """Finish what the node was doing, before it is destroyed."""

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *rest: Any, **named: Any
    ) -> Any:
        """As rclpy's; see `_watched_over`."""
        return super().create_subscription(
            msg_type, topic, self._watched_over(callback), *rest, **named
        )

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., None], *rest: Any, **named: Any
    ) -> Any:
        """As rclpy's; see `_watched_over`."""
        return super().create_timer(timer_period_sec, self._watched_over(callback), *rest, **named)

    def _watched_over(self, callback: Callable[..., None]) -> Callable[..., None]:
        """A callback that a full disk, and where the node is optional no failure, ends."""

        @functools.wraps(callback)
        def guarded(*given: Any) -> None:
            try:
                callback(*given)
            except ExternalShutdownException:
                raise
            except Exception as error:
                fault: GeoOrbitError | None = None
                if isinstance(error, OSError):
                    fault = disk_fault(error)
                if fault is None and self.optional:
                    fault = failure(error, f"node '{self.get_fully_qualified_name()}'")
                if fault is None:
                    raise
                self.diagnostics.refuse(fault)

        return guarded

    def publish_stream(self, publisher: Publisher, cdr: bytes) -> None:
        """Publish serialised bytes; where every message is kept, wait for readers behind.

        Raises:
            MessageError: Readers that stay behind for half a minute.
            ExternalShutdownException: The process was told to end while readers were behind.
        """
        deadline = time.monotonic() + PUBLISH_TIMEOUT_S
        while True:
            try:
                publisher.publish(cdr)
                break
            except RuntimeError as error:  # rclpy's RCLError: the history is full
                if not self.context.ok() or "cannot publish data" not in str(error):
                    raise
                if self.told_to_end:
                    raise ExternalShutdownException from error
                if time.monotonic() > deadline:
                    found = f"readers behind for {PUBLISH_TIMEOUT_S:g} s"
                    raise MessageError(publisher.topic, found, "readers that keep up") from error
                time.sleep(0.01)
        self.diagnostics.published += 1
