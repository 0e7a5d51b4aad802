"""The meta-learner: bounded, the same with and without torch, and it learns."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from geoorbit_ros.core.errors import InputFileError, TableError
from geoorbit_ros.lanes.parameters import BOUNDS, LaneParameters
from geoorbit_ros.learning.features import FEATURE_NAMES
from geoorbit_ros.learning.local_training import (
    Examples,
    TrainingSettings,
    forward,
    parameter_loss,
    train_locally,
)
from geoorbit_ros.learning.meta_learner import MetaLearner, load_model, save_model, tensor_shapes
from geoorbit_ros.learning.parameter_space import (
    DEFAULT_UNIT,
    PARAMETER_NAMES,
    from_unit,
    to_unit,
)


def random_learner(seed: int, scale: float = 1.0) -> MetaLearner:
    random = np.random.default_rng(seed)
    return MetaLearner.from_tensors(
        {name: scale * random.standard_normal(shape) for name, shape in tensor_shapes().items()}
    )


def some_examples(count: int = 30, seed: int = 3) -> Examples:
    random = np.random.default_rng(seed)
    features = random.uniform(-2, 2, (count, len(FEATURE_NAMES)))
    targets = 1 / (1 + np.exp(-features[:, : len(PARAMETER_NAMES)]))
    return Examples(features, targets)


@given(st.integers(0, 1000), st.floats(0.01, 100.0))
@settings(max_examples=25, deadline=None)
def test_predictions_are_within_bounds(seed: int, scale: float) -> None:
    features = np.random.default_rng(seed).uniform(-3, 3, len(FEATURE_NAMES))
    theta = random_learner(seed, scale).predict(features)
    for name, (low, high) in BOUNDS.items():
        assert low <= getattr(theta, name) <= high


def test_inference_without_torch_is_torch_to_a_millionth() -> None:
    learner = random_learner(1)
    features = np.random.default_rng(2).uniform(-3, 3, (200, len(FEATURE_NAMES)))
    phi = {name: torch.from_numpy(value) for name, value in learner.weights.items()}
    by_torch = forward(phi, torch.tensor(features, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(learner.predict_unit(features), by_torch, atol=1e-6)


def test_inference_does_not_import_torch() -> None:
    code = (
        "import sys, geoorbit_ros.learning.meta_learner, geoorbit_ros.learning.features;"
        " sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_an_untrained_learner_is_the_baseline() -> None:
    learner = MetaLearner.untrained(seed=5)
    features = np.random.default_rng(0).uniform(-3, 3, len(FEATURE_NAMES))
    np.testing.assert_allclose(learner.predict_unit(features), DEFAULT_UNIT)
    theta, default = learner.predict(features), LaneParameters()
    for name in BOUNDS:
        assert getattr(theta, name) == pytest.approx(getattr(default, name))


def test_the_unit_cube_maps_to_the_bounds_and_back() -> None:
    for corner, index in ((0.0, 0), (1.0, 1)):
        theta = from_unit([corner] * len(PARAMETER_NAMES))
        for name, bounds in BOUNDS.items():
            assert getattr(theta, name) == pytest.approx(bounds[index])
    for unit in np.random.default_rng(1).uniform(size=(20, len(PARAMETER_NAMES))):
        np.testing.assert_allclose(to_unit(from_unit(unit)), unit, atol=1e-12)


def test_parameter_loss_is_the_papers_sum_of_squares() -> None:
    learner, examples = random_learner(4), some_examples(3)
    expected = [
        sum((a - b) ** 2 for a, b in zip(theta, target, strict=True))
        for theta, target in zip(
            learner.predict_unit(examples.features), examples.targets, strict=True
        )
    ]
    np.testing.assert_allclose(parameter_loss(learner, examples), expected)


def test_training_lowers_the_loss_and_is_repeatable() -> None:
    examples, start = some_examples(), MetaLearner.untrained(0)
    settings_ = TrainingSettings(steps=300, feature_noise=0.0)
    delta, count, metrics = train_locally(start.tensors(), examples, settings_)
    assert count == len(examples)
    assert metrics["parameter_loss"] < 0.25 * metrics["parameter_loss_before"]
    again, _, _ = train_locally(start.tensors(), examples, settings_)
    assert all(delta[name].tobytes() == again[name].tobytes() for name in delta)


def test_one_gradient_step_averaged_over_cameras_is_the_central_step() -> None:
    examples, start = some_examples(12), random_learner(6).tensors()
    one = TrainingSettings(steps=1, feature_noise=0.0)
    central, _, _ = train_locally(start, examples, one)
    parts = [
        train_locally(start, Examples(examples.features[[k]], examples.targets[[k]]), one)[0]
        for k in range(len(examples))
    ]
    for name, value in central.items():
        average = np.mean([part[name] for part in parts], axis=0)
        np.testing.assert_allclose(average, value, atol=1e-6)


def test_the_proximal_term_holds_training_back() -> None:
    examples, start = some_examples(), random_learner(7).tensors()
    size = [
        sum(float(np.sum(v**2)) for v in train_locally(start, examples, None, mu)[0].values())
        for mu in (0.0, 1.0)
    ]
    assert size[1] < 0.8 * size[0]


def test_a_saved_model_is_the_same_model(tmp_path: Path) -> None:
    learner = random_learner(8)
    save_model(learner, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    assert list(loaded.weights) == list(learner.weights)
    assert all(loaded.weights[n].tobytes() == learner.weights[n].tobytes() for n in loaded.weights)
    (tmp_path / "model.npz").write_bytes(b"PK no model")
    with pytest.raises(InputFileError, match="model"):
        load_model(tmp_path / "model.npz")


def test_weights_of_another_shape_are_refused() -> None:
    tensors = random_learner(9).tensors()
    with pytest.raises(TableError, match=r"heads\.bias"):
        MetaLearner.from_tensors({**tensors, "heads.bias": np.zeros(7, np.float32)})
    with pytest.raises(TableError, match="finite"):
        MetaLearner.from_tensors({**tensors, "hidden.bias": tensors["hidden.bias"] * np.nan})
