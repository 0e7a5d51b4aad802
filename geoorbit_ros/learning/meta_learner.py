"""The meta-learner f_phi: scene features in, lane-estimator parameters out. Inference, numpy only.

A two-layer perceptron with one shared hidden layer and one bounded head per parameter (the paper,
section III-A): h = tanh(W x + b), u_p = sigmoid(w_p . h + b_p + c_p), theta_p = u_p scaled to p's
range. c_p is the constant at which an all-zero head gives p's default, so an untrained learner is
the fixed-parameter baseline, and shrinking weights leads back to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.core.array_file import read_arrays
from geoorbit_ros.core.errors import InputFileError, TableError
from geoorbit_ros.lanes.parameters import LaneParameters
from geoorbit_ros.learning.features import FEATURE_NAMES
from geoorbit_ros.learning.parameter_space import DEFAULT_UNIT, PARAMETER_NAMES, from_unit
from geoorbit_ros.storage.atomic import atomic_output

Tensors = dict[str, NDArray[np.float32]]
"""phi: weights and biases by name, in a fixed order."""

HIDDEN_UNITS = 8
"""Chosen: more fit the training cameras better and unseen ones worse, and cost bytes in each
round."""
DEFAULT_LOGIT = np.log(DEFAULT_UNIT) - np.log1p(-DEFAULT_UNIT)
"""(P,) c_p."""


def tensor_shapes(
    features: int = len(FEATURE_NAMES),
    parameters: int = len(PARAMETER_NAMES),
    hidden: int = HIDDEN_UNITS,
) -> dict[str, tuple[int, ...]]:
    """Names and shapes of phi's tensors, in their order on the wire."""
    return {
        "hidden.weight": (hidden, features),
        "hidden.bias": (hidden,),
        "heads.weight": (parameters, hidden),
        "heads.bias": (parameters,),
    }


@dataclass(frozen=True, slots=True)
class MetaLearner:
    """f_phi.

    Attributes:
        weights: phi, by the names of `tensor_shapes`.
        feature_names: Its inputs, in order.
        parameter_names: Its heads, in order.

    Raises:
        TableError: A tensor is missing, of another shape, or not finite.
    """

    weights: Tensors
    feature_names: tuple[str, ...] = FEATURE_NAMES
    parameter_names: tuple[str, ...] = field(default=PARAMETER_NAMES)

    def __post_init__(self) -> None:
        hidden = len(self.weights.get("hidden.bias", ()))
        shapes = tensor_shapes(len(self.feature_names), len(self.parameter_names), hidden)
        if list(self.weights) != list(shapes):
            raise TableError("meta-learner", f"tensors {list(self.weights)}", f"{list(shapes)}")
        for name, shape in shapes.items():
            value = self.weights[name]
            if value.shape != shape or not np.isfinite(value).all():
                found = f"'{name}' of shape {value.shape}, finite: {np.isfinite(value).all()}"
                raise TableError("meta-learner", found, f"finite numbers of shape {shape}")

    @classmethod
    def untrained(cls, seed: int = 0, hidden: int = HIDDEN_UNITS) -> MetaLearner:
        """A learner that predicts the defaults for every scene; its hidden layer is random."""
        random = np.random.default_rng([seed, 15])
        shapes = tensor_shapes(hidden=hidden)
        weights = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        first = shapes["hidden.weight"]
        bound = np.sqrt(6.0 / sum(first))  # Glorot and Bengio 2010, for tanh
        weights["hidden.weight"] = random.uniform(-bound, bound, first).astype(np.float32)
        return cls(weights)

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, NDArray[np.floating]]) -> MetaLearner:
        """The learner with these weights; `tensors`' inverse.

        Raises:
            TableError: A tensor is missing, of another shape, or not finite.
        """
        return cls({name: np.asarray(value, np.float32) for name, value in tensors.items()})

    def tensors(self) -> Tensors:
        """A copy of phi."""
        return {name: value.copy() for name, value in self.weights.items()}

    def predict_unit(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Theta in the unit cube, (P,) for (F,) features or (B, P) for (B, F)."""
        w = {name: value.astype(np.float64) for name, value in self.weights.items()}
        hidden = np.tanh(features @ w["hidden.weight"].T + w["hidden.bias"])
        logit = hidden @ w["heads.weight"].T + w["heads.bias"] + DEFAULT_LOGIT
        return np.asarray(1.0 / (1.0 + np.exp(-logit)))

    def predict(self, features: NDArray[np.float64]) -> LaneParameters:
        """Detection parameters for one scene's (F,) features, always inside their bounds."""
        return from_unit(self.predict_unit(features))


_FEATURES, _PARAMETERS = "feature_names", "parameter_names"
"""Keys of the names in a model file."""


def save_model(learner: MetaLearner, path: Path) -> None:
    """Write phi with the names of its inputs and outputs to one .npz file."""
    with atomic_output(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            **{
                _FEATURES: np.array(learner.feature_names),
                _PARAMETERS: np.array(learner.parameter_names),
                **learner.weights,
            },  # type: ignore[arg-type]
        )


def load_model(path: Path) -> MetaLearner:
    """Read what `save_model` wrote.

    Raises:
        InputFileError: Not such a file, or a model for other features or parameters.
    """
    try:
        arrays = read_arrays(path, "a model written by geoorbit train")
        names = [tuple(arrays.pop(key).tolist()) for key in (_FEATURES, _PARAMETERS)]
        learner = MetaLearner.from_tensors(arrays)
    except (OSError, ValueError, KeyError, TableError) as error:
        raise InputFileError(str(path), error, "a model written by geoorbit train") from error
    expected = [learner.feature_names, learner.parameter_names]
    if names != expected:
        raise InputFileError(str(path), f"a model of {names}", f"one of {expected}")
    return learner
