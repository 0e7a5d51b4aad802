"""Assignment: the optimum over all ways to pair, whatever the order of the candidates."""

from __future__ import annotations

import itertools
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geoorbit_ros.tracking.association import Pair, assign

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
def test_no_other_pairing_is_cheaper(pairs: dict[tuple[int, int], float], random: Random) -> None:
    items = list(pairs.items())
    random.shuffle(items)
    chosen = assign([Pair(track, found, cost) for (track, found), cost in items], LIMIT)
    tracks, detections = ({pair[k] for pair in chosen} for k in (0, 1))
    assert len(tracks) == len(detections) == len(chosen)
    assert all(pairs[pair.track, pair.detection] == pair.cost < LIMIT for pair in chosen)
    assert sum(LIMIT - pair.cost for pair in chosen) == pytest.approx(gain_of_best(pairs))
