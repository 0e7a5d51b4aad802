"""The learned feature mapping f of centrelines, for the paper's L_center; numpy only."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.errors import InputFileError
from geoorbit_ros.core.resources import share_path

Array = NDArray[np.float64]

POINTS = 16
"""Points of a centreline that the network sees; part of the shipped weights."""
INPUT_SCALE_M = (50.0, 10.0)
"""Metres along and across the road that make one unit of input."""
HIDDEN, FEATURES = 32, 8
"""Sizes of the layers; part of the shipped weights."""
LAYERS = ("hidden.weight", "hidden.bias", "output.weight", "output.bias")
SHIPPED = "params/learning/lane_embedding.json"


@dataclass(frozen=True, slots=True)
class LaneEmbeddingNet:
    """f: 16 points of a centreline in the road frame -> 8 features, one hidden layer of ReLU.

    It was trained with triplets (`learning/embedding_training.py`) so that two pieces of one lane
    lie together however their ends were cut, and neighbouring lanes lie apart: their squared
    distance is 1 on average. Squared distances are therefore in squared lane spacings.

    Attributes:
        weights: Arrays by the names in `LAYERS`.
    """

    weights: dict[str, Array]

    def embed(self, line_m: Array) -> Array:
        """(B, 8) features of (B, S, 2) centrelines, metres in the road frame."""
        w = self.weights
        hidden = network_input(line_m) @ w["hidden.weight"].T + w["hidden.bias"]
        return np.asarray(np.maximum(hidden, 0.0) @ w["output.weight"].T + w["output.bias"])


def network_input(line_m: Array) -> Array:
    """(B, 2 * POINTS) inputs of (B, S, 2) centrelines."""
    at = np.round(np.linspace(0.0, line_m.shape[1] - 1.0, POINTS)).astype(np.int64)
    return np.asarray((line_m[:, at] / np.array(INPUT_SCALE_M)).reshape(len(line_m), -1))


@cache
def shipped_embedding() -> LaneEmbeddingNet:
    """The f that every table of this package uses: the same for every model compared."""
    return read_embedding(share_path(SHIPPED))


def read_embedding(path: Path) -> LaneEmbeddingNet:
    """Read weights from JSON: nested lists by layer name.

    Raises:
        InputFileError: Not such a file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        weights = {name: np.array(content[name], dtype=np.float64) for name in LAYERS}
    except (ValueError, KeyError, TypeError) as error:
        raise InputFileError(str(path), error, "weights of a lane embedding") from error
    shapes = ((HIDDEN, 2 * POINTS), (HIDDEN,), (FEATURES, HIDDEN), (FEATURES,))
    for name, shape in zip(LAYERS, shapes, strict=True):
        if weights[name].shape != shape or not np.isfinite(weights[name]).all():
            found = f"{name} of shape {weights[name].shape}"
            raise InputFileError(str(path), found, f"finite numbers of shape {shape}")
    return LaneEmbeddingNet(weights)
