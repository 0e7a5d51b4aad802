"""Stands in for an optional node that can't start, so that its camera starts without it."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from geoorbit_ros.core.errors import GeoOrbitError
from geoorbit_ros.nodes.support.base import GeoOrbitNode
from geoorbit_ros.nodes.support.diagnostics import Diagnostics


class AbsentNode(GeoOrbitNode[None]):
    """Says on /diagnostics once a second why the node of its name does not run.

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
