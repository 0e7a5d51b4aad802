"""What counts as a double: a second vehicle that goes where a true one goes."""

from __future__ import annotations

import numpy as np
import pytest
from made_twin import made_network

from geoorbit_ros.roadnet.network import RoadNetwork, load_network
from geoorbit_ros.scenes.simulate import START_NS
from geoorbit_ros.scenes.traffic import STEP_S, TrafficRecord
from geoorbit_ros.twin.placement import TwinStep
from scores.twin_truth import LaneTruth

STEPS, SPEED_MPS = 10, 20.0


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> RoadNetwork:
    return load_network(made_network(tmp_path_factory.mktemp("net")))


@pytest.fixture
def record(network: RoadNetwork) -> TrafficRecord:
    """One vehicle, that drives along `east_0`."""
    step = np.arange(STEPS)
    begin = network.line(network.number["east_0"])[0] + (20.0, 0.0)
    xy = begin + np.column_stack([SPEED_MPS * STEP_S * step, np.zeros(STEPS)])
    nothing, one = np.zeros(STEPS), np.zeros(STEPS, np.int64)
    size = np.array([[4.6, 1.8, 1.5]])
    return TrafficRecord(
        step, one, xy, nothing, nothing + SPEED_MPS, one, [("east", 0)], ["car"], size
    )


def twin_step(number: int, xy: np.ndarray) -> TwinStep:
    count = len(xy)
    ids, zero, flat = np.arange(count), np.zeros(count, np.int64), np.zeros(count)
    stamp_ns = START_NS + round(number * STEP_S * 1e9)
    pairs = np.zeros((count, 2))
    seen = np.ones(count, dtype=np.bool_)
    return TwinStep(
        stamp_ns, ids, xy, flat, pairs, pairs, flat, zero, zero, zero, seen, zero, xy, flat, 0.0
    )


def test_a_vehicle_that_goes_along_is_a_double_and_one_that_stands_is_false(
    network: RoadNetwork, record: TrafficRecord
) -> None:
    """Whatever its track says of its speed; in its first step it may be either, and is a double."""
    beside = np.array([1.0, 0.5])
    stands = record.xy[5] + beside
    for second, doubled in (
        (list(record.xy + beside), STEPS),
        ([stands] * STEPS, 0),
    ):
        truth = LaneTruth(record, network)
        for k, (first, other) in enumerate(zip(record.xy, second, strict=True)):
            truth.count(twin_step(k, np.array([first, other])))
        assert truth.score.doubled == doubled
    late = LaneTruth(record, network)
    late.count(twin_step(5, np.array([record.xy[5], stands])))
    assert late.score.doubled == 1
