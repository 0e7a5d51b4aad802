"""One camera's share of training: gradient steps on L_param, in torch.

    L_param = sum over p of |theta_p - theta*_p|^2      (the paper, section IV-C)

Theta is compared in the unit cube, so that each parameter counts the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from geoorbit_ros.core.errors import ParameterError
from geoorbit_ros.learning.meta_learner import DEFAULT_LOGIT, MetaLearner, Tensors
from geoorbit_ros.learning.parameter_space import PARAMETER_NAMES


@dataclass(frozen=True, slots=True)
class Examples:
    """What there is to learn from.

    Attributes:
        features: (N, F) scene features.
        targets: (N, P) theta*, in the unit cube.
    """

    features: NDArray[np.float64]
    targets: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.features)


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How one camera, or the centre, trains between two rounds.

    Attributes:
        steps: Gradient steps per round, on all examples at once.
        learning_rate: Of plain gradient descent. Neither momentum nor adaptive steps: their state
            would have to stay on the camera between rounds, and FedAvg assumes none.
        weight_decay: Pull of all weights, not of biases, towards zero: towards one theta for all.
        feature_noise: Standard deviation of the noise added to the features at every step. There
            are fewer cameras than the network has weights; noise as large as the differences
            between cameras keeps it from memorising them (Bishop 1995, Training with
            noise is equivalent to Tikhonov regularization).
    """

    steps: int = 10
    learning_rate: float = 0.3
    weight_decay: float = 1e-3
    feature_noise: float = 1.0

    def __post_init__(self) -> None:
        if self.steps < 1 or not self.learning_rate > 0.0 or not self.weight_decay >= 0.0:
            raise ParameterError("training settings", self, "steps and learning rate above 0")


def parameter_loss(learner: MetaLearner, examples: Examples) -> NDArray[np.float64]:
    """(N,) L_param of each example."""
    gap = learner.predict_unit(examples.features) - examples.targets
    return np.asarray(np.sum(gap**2, axis=1))


def train_locally(
    tensors: Mapping[str, NDArray[np.float32]],
    examples: Examples,
    settings: TrainingSettings | None = None,
    proximal: float = 0.0,
    seed: int = 0,
) -> tuple[Tensors, int, dict[str, float]]:
    """Gradient steps from phi on some examples.

    Args:
        tensors: phi, which is not changed.
        examples: The camera's; at least one.
        settings: Steps, learning rate, weight decay.
        proximal: mu of FedProx (Li et al. 2020): adds mu/2 |phi - phi_0|^2 to the loss.
        seed: Of the noise on the features.

    Returns:
        New minus old phi, the number of examples, and `parameter_loss` before and after.
    """
    chosen = settings or TrainingSettings()
    before = MetaLearner.from_tensors(tensors)
    start = {name: torch.from_numpy(value.copy()) for name, value in before.weights.items()}
    phi = {name: value.clone().requires_grad_() for name, value in start.items()}
    features = torch.tensor(examples.features, dtype=torch.float32)
    targets = torch.tensor(examples.targets, dtype=torch.float32)
    optimiser = torch.optim.SGD(phi.values(), chosen.learning_rate)
    random = np.random.default_rng([seed, 16])
    for _ in range(chosen.steps):
        noise = chosen.feature_noise * random.standard_normal(examples.features.shape)
        blurred = features + torch.tensor(noise, dtype=torch.float32)
        loss = (forward(phi, blurred) - targets).square().sum(1).mean()
        for name, value in phi.items():
            if name.endswith("weight"):
                loss = loss + 0.5 * chosen.weight_decay * value.square().sum()
            if proximal:
                loss = loss + 0.5 * proximal * (value - start[name]).square().sum()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    delta = {name: (value.detach() - start[name]).numpy() for name, value in phi.items()}
    after = MetaLearner.from_tensors({name: tensors[name] + value for name, value in delta.items()})
    metrics = {
        "parameter_loss_before": float(parameter_loss(before, examples).mean()),
        "parameter_loss": float(parameter_loss(after, examples).mean()),
    }
    return delta, len(examples), metrics


def forward(phi: Mapping[str, torch.Tensor], features: torch.Tensor) -> torch.Tensor:
    """(B, P) theta in the unit cube: `MetaLearner.predict_unit`, differentiable."""
    hidden = torch.tanh(features @ phi["hidden.weight"].T + phi["hidden.bias"])
    logit = hidden @ phi["heads.weight"].T + phi["heads.bias"]
    offset = torch.tensor(DEFAULT_LOGIT, dtype=torch.float32)
    assert offset.shape == (len(PARAMETER_NAMES),)
    return torch.sigmoid(logit + offset)
