"""Assignment: the optimum over all ways to pair, whatever the order of the candidates."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.tracking.association import assign

LIMIT = 10.0
costs = st.dictionaries(
    st.tuples(st.integers(0, 3), st.integers(0, 3)), st.floats(-5.0, 15.0), max_size=10
)


def gain_of_best(pairs: dict[tuple[int, int], float]) -> float:
    """The most that any one-to-one pairing saves against leaving all alone, by trying all."""
    best = 0.0
    for columns in itertools.permutations(range(4)):
        best = max(best, sum(max(LIMIT - pairs.get(p, LIMIT), 0.0) for p in enumerate(columns)))
    return best


@given(costs, st.randoms(use_true_random=False))
def test_no_other_pairing_is_cheaper(
    pairs: dict[tuple[int, int], float], random: np.random.Generator
) -> None:
    items = list(pairs.items())
    random.shuffle(items)
    row = np.array([key[0] for key, _ in items], dtype=np.intp)
    column = np.array([key[1] for key, _ in items], dtype=np.intp)
    cost = np.array([value for _, value in items])
    chosen = assign(row, column, cost, LIMIT)
    assert len(np.unique(row[chosen])) == len(np.unique(column[chosen])) == len(chosen)
    assert (cost[chosen] < LIMIT).all()
    assert (LIMIT - cost[chosen]).sum() == pytest.approx(gain_of_best(pairs))
