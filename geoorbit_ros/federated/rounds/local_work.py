"""What a client's local training is given, and what it gives back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.payloads.model_layout import Tensors


@dataclass(frozen=True, slots=True)
class TrainingOrder:
    """What local training is given beside the tensors.

    Attributes:
        round: The round, also the seed of random numbers: the same round gives the same update.
        proximal_mu: FedProx's penalty weight, see `strategies.fedprox.proximal_gradient`; 0: none.
        train: Whether to train; else the model is only validated.
        validate: Whether to compare the model with the defaults.
    """

    round: int
    proximal_mu: float
    train: bool = True
    validate: bool = False


@dataclass(frozen=True, slots=True)
class LocalResult:
    """What local training gives back.

    Attributes:
        delta: New minus old value of every tensor; nothing from a validation client.
        sample_count: Examples behind it; 0 from a validation client.
        loss: Composite loss of the model as it came, before training.
        gain: What `verdict` says; NaN where nothing was compared.
    """

    delta: Mapping[str, NDArray[np.float32]]
    sample_count: int
    loss: float
    gain: float = float("nan")


Train = Callable[[Tensors, TrainingOrder], LocalResult]
"""Local training; it may take as long as it likes."""


@dataclass(frozen=True, slots=True)
class Work:
    """What a client has to do about a broadcast.

    Attributes:
        round: The round.
        model: Digest of the model to start from.
        tensors: That model.
        order: For local training.
        ready: The update, when it was already made: it only has to be sent again.
    """

    round: int
    model: int
    tensors: Tensors
    order: TrainingOrder
    ready: bytes = b""
