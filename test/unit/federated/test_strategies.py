"""Each strategy against arrays worked out by hand from its paper's equations."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from geoorbit_ros.core.plugins import registered
from geoorbit_ros.federated.errors import FederationError
from geoorbit_ros.federated.strategies.collection import ExactSum
from geoorbit_ros.federated.strategies.coordinate_wise import FedMedian, TrimmedMean
from geoorbit_ros.federated.strategies.fedbuff import FedBuff
from geoorbit_ros.federated.strategies.fedprox import FedProx, proximal_gradient
from geoorbit_ros.federated.strategies.multi_krum import MultiKrum
from geoorbit_ros.federated.strategies.server_optimizers import FedAdam, FedAvgM
from geoorbit_ros.federated.strategies.strategy import (
    FedAvg,
    Strategy,
    StrategySettings,
    make_strategy,
)

Rows = Sequence[Sequence[float]]


def row(*values: float) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def change(strategy: Strategy, rows: Rows, samples: Sequence[int] = ()) -> NDArray[np.float64]:
    """The model's change after one round with these updates, all in time."""
    collection = strategy.collection(len(rows[0]))
    for client, (row, count) in enumerate(zip(rows, samples or [1] * len(rows), strict=True)):
        collection.add(client, np.array(row, np.float32), strategy.weight(count, 0))
    assert collection.number == len(rows)
    return strategy.step(collection.result())


def test_fedavg_weighs_by_examples() -> None:
    # (1·1 + 3·5) / 4 and (1·2 + 3·(-2)) / 4
    np.testing.assert_array_equal(change(FedAvg(), [[1, 2], [5, -2]], [1, 3]), [4, -1])


def test_fedprox_aggregates_as_fedavg_and_pulls_clients_back() -> None:
    strategy = FedProx(0.25)
    np.testing.assert_array_equal(change(strategy, [[1, 2], [5, -2]], [1, 3]), [4, -1])
    assert strategy.proximal_mu == 0.25
    weights, start = row(3, -1), row(1, 1)
    np.testing.assert_array_equal(proximal_gradient(weights, start, 0.25), [0.5, -0.5])


def test_fedavgm_keeps_its_momentum() -> None:
    strategy = FedAvgM(momentum=0.5, learning_rate=2.0)
    np.testing.assert_array_equal(change(strategy, [[4, 0]]), [8, 0])  # v = 4
    np.testing.assert_array_equal(change(strategy, [[2, 2]]), [8, 4])  # v = 0.5·4 + 2, 2
    np.testing.assert_array_equal(change(strategy, [[0, 0]]), [4, 2])  # v = 2, 1


def test_fedadam_divides_by_the_root_of_the_second_moment() -> None:
    strategy = FedAdam(learning_rate=1.0, beta_1=0.5, beta_2=0.75, tau=0.5)
    # m = 0.5·4 = 2, v = 0.25·16 = 4, 2 / (2 + 0.5)
    np.testing.assert_allclose(change(strategy, [[4.0]]), [0.8])
    # m = 0.5·2 + 0 = 1, v = 0.75·4 = 3
    np.testing.assert_allclose(change(strategy, [[0.0]]), [1 / (3**0.5 + 0.5)])


def test_fedmedian_takes_the_middle_weight_by_weight() -> None:
    rows = [[1, 10], [2, -5], [900, 0]]
    np.testing.assert_array_equal(change(FedMedian(), rows, [1, 1, 1000]), [2, 0])
    np.testing.assert_array_equal(change(FedMedian(), [*rows, [4, 2]]), [3, 1])


def test_trimmed_mean_drops_both_ends_weight_by_weight() -> None:
    rows = [[1, 9], [2, 1], [3, 2], [-100, 3], [100, -9]]
    np.testing.assert_array_equal(change(TrimmedMean(0.2), rows), [2, 2])
    np.testing.assert_array_equal(change(TrimmedMean(0.0), [[1, 3], [3, 5]]), [2, 4])


def test_multi_krum_takes_the_mean_of_those_with_near_neighbours() -> None:
    # n = 5, f = 1: two nearest neighbours each. Squared distances on a line give the scores
    # 0: 1+4, 1: 1+1, 2: 1+1, 3: 1+4, 50: 47²+48²; the best four are 0 to 3.
    np.testing.assert_array_equal(change(MultiKrum(0.2), [[0], [1], [2], [3], [50]]), [1.5])
    # f = 2 needs 7 updates: the two colluders are each other's only near neighbour of four.
    rows = [[0], [1], [2], [3], [4], [70], [70]]
    np.testing.assert_array_equal(change(MultiKrum(0.3), rows), [2])


def test_multi_krum_in_blocks_is_multi_krum(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.random.default_rng(0).normal(size=(40, 6)).tolist()
    whole = change(MultiKrum(0.25), rows)
    monkeypatch.setattr("geoorbit_ros.federated.strategies.multi_krum._BLOCK", 7)
    np.testing.assert_allclose(change(MultiKrum(0.25), rows), whole)


def test_fedbuff_counts_stale_updates_less_and_divides_by_their_number() -> None:
    strategy = FedBuff(buffer_size=2, learning_rate=0.5)
    assert strategy.buffer_size == 2
    collection = strategy.collection(1)
    collection.add(1, row(8), strategy.weight(999, 0))
    collection.add(2, row(8), strategy.weight(1, 3))  # 1/√4
    np.testing.assert_array_equal(strategy.step(collection.result()), [0.5 * (8 + 4) / 2])


@pytest.mark.parametrize("name", registered("strategy"))
def test_the_order_of_updates_does_not_change_a_single_bit(name: str) -> None:
    generator = np.random.default_rng(3)
    updates = generator.normal(0, 1, (7, 5)).astype(np.float32) * np.float32(
        10.0 ** generator.integers(-6, 3, (7, 1))
    )
    samples = generator.integers(1, 1000, 7).tolist()
    results = set()
    for order in itertools.islice(itertools.permutations(range(7)), 0, 5040, 100):
        strategy = make_strategy(name, StrategySettings())
        collection = strategy.collection(5)
        for k in order:
            collection.add(k, updates[k], strategy.weight(samples[k], k % 3))
        results.add(strategy.step(collection.result()).tobytes())
    assert len(results) == 1


@pytest.mark.parametrize("name", registered("strategy"))
def test_a_restored_strategy_goes_on_with_the_same_bits(name: str) -> None:
    rounds = np.random.default_rng(4).normal(size=(6, 4, 3)).tolist()
    whole = make_strategy(name)
    expected = [change(whole, rows) for rows in rounds]
    first = make_strategy(name)
    for rows in rounds[:3]:
        change(first, rows)
    second = make_strategy(name)
    second.restore(first.state())
    np.testing.assert_array_equal([change(second, rows) for rows in rounds[3:]], expected[3:])


@pytest.mark.parametrize("name", ["fedmedian", "trimmed_mean", "multi_krum"])
@settings(max_examples=30)
@given(
    honest=arrays(np.float32, (7, 3), elements=st.floats(-1, 1, width=32)),
    lies=arrays(np.float32, (3, 3), elements=st.floats(-1000, 1000, width=32)),
)
def test_three_false_updates_of_ten_move_nothing_out_of_the_honest_range(
    name: str, honest: NDArray[np.float32], lies: NDArray[np.float32]
) -> None:
    found = change(make_strategy(name), [*honest.tolist(), *lies.tolist()])
    if name == "multi_krum":  # keeps n - f; a lie it keeps is as near as an honest update is
        assert np.abs(found).max() <= 1 + 3 * np.sqrt(7 * 3 * 4) / 7
    else:
        low, high = honest.min(0), honest.max(0)
        assert ((found >= low - 1e-6) & (found <= high + 1e-6)).all()


def test_settings_out_of_range_name_the_setting() -> None:
    for arguments, word in (
        (("trimmed_mean", StrategySettings(byzantine_share=0.5)), "byzantine_share"),
        (("fedavgm", StrategySettings(momentum=1.0)), "momentum"),
        (("fedprox", StrategySettings(proximal_mu=-1.0)), "proximal_mu"),
        (("fedbuff", StrategySettings(buffer_size=0)), "buffer_size"),
    ):
        with pytest.raises(FederationError, match=word):
            make_strategy(*arguments)


@given(arrays(np.float64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.floats(-1e9, 1e9)))
def test_an_exact_sum_is_the_sum(vectors: NDArray[np.float64]) -> None:
    total = ExactSum(3)
    for vector in vectors:
        total.add(vector)
    np.testing.assert_allclose(total.value(), vectors.sum(0), rtol=1e-12, atol=1e-5)
    backwards = ExactSum(3)
    for vector in vectors[::-1]:
        backwards.add(vector)
    assert backwards.value().tobytes() == total.value().tobytes()


@pytest.mark.parametrize("bad", [2.0**43, np.nan, np.inf])
def test_an_exact_sum_refuses_what_it_can_not_hold(bad: float) -> None:
    with pytest.raises(OverflowError):
        ExactSum(1).add(np.array([bad]))
