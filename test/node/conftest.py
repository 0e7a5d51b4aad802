"""Nodes under test live in a ROS domain of their own, spun by conditions with deadlines."""

from collections.abc import Iterator

import pytest

from geoorbit_ros.nodes.support.composition import Composition


@pytest.fixture
def nodes() -> Iterator[Composition]:
    with Composition(quiet=True) as composition:
        yield composition
