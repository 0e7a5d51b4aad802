"""The shipped f of the triplet loss: lanes apart, pieces of one lane together."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.resources import share_path
from geoorbit_ros.learning.embedding_training import random_triplets, train
from geoorbit_ros.learning.lane_embedding import SHIPPED, read_embedding, shipped_embedding


def test_other_lanes_lie_farther_away_than_pieces_of_the_same_lane() -> None:
    f = shipped_embedding()
    anchor, positive, negative = random_triplets(np.random.default_rng(12345), 2000)
    near = np.sum((f.embed(anchor) - f.embed(positive)) ** 2, axis=1)
    far = np.sum((f.embed(anchor) - f.embed(negative)) ** 2, axis=1)
    assert np.mean(near < far) > 0.995


@pytest.mark.parametrize("length_m", [60.0, 120.0, 200.0])
def test_squared_distances_grow_with_the_offset_in_lane_spacings(length_m: float) -> None:
    f = shipped_embedding()
    line = np.column_stack([np.linspace(-length_m / 2, length_m / 2, 64), np.zeros(64)])[None]
    offset = np.array([0.5, 1.0, 2.0, 3.5, 7.0, 15.0])
    moved = np.concatenate([line + np.array([0.0, d]) for d in offset])
    distance = np.sum((f.embed(moved) - f.embed(line)) ** 2, axis=1)
    assert np.all(np.diff(distance) > 0.0)
    assert 0.5 < distance[offset == 3.5][0] < 1.5


def test_training_is_repeatable_and_never_collapses() -> None:
    first, second = train(seed=3, steps=20), train(seed=3, steps=20)
    assert all(first[name].tobytes() == second[name].tobytes() for name in first)
    assert np.abs(first["output.weight"]).max() > 1e-3


def test_broken_weights_are_refused(tmp_path: Path) -> None:
    content = json.loads(share_path(SHIPPED).read_text())
    for broken in ({}, {**content, "output.bias": [1.0]}, {**content, "output.bias": [None] * 8}):
        path = tmp_path / "f.json"
        path.write_text(json.dumps(broken))
        with pytest.raises(InputFileError, match=r"f\.json"):
            read_embedding(path)
