"""The updates of the open round, on their way to one aggregate, and the gains that are reported."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoorbit_ros.federated.payloads.client_update import ClientUpdate
from geoorbit_ros.federated.payloads.model_layout import Vector
from geoorbit_ros.federated.rounds.verdict import GainSums
from geoorbit_ros.federated.strategies.collection import Aggregate, Collection

_LOSS_BITS = 40
"""Resolution of summed losses, 2^-40. Chosen: finer than the float32 in which they are sent."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What comes of a round.

    Attributes:
        aggregate: Aggregated update of the training clients, shape (size,); zeros without any.
        loss: Their mean loss, by number of examples; NaN without any.
        training_clients: How many they are.
        gains: What all gains of the round's model add up to.
    """

    aggregate: Aggregate
    loss: float
    training_clients: int
    gains: GainSums


class OpenRound:
    """Collects until the server ends the round.

    Args:
        collection: The strategy's.
        size: Number of weights.

    Attributes:
        gains: Gains of the open round's model.
        heard: Validation clients, those without a gain included.
    """

    def __init__(self, collection: Collection, size: int) -> None:
        self._collection, self._size = collection, size
        self._loss_sum = self._loss_weight = 0
        self.gains, self.heard = GainSums(), 0

    @property
    def number(self) -> int:
        """Updates so far."""
        return self._collection.number

    def add(self, update: ClientUpdate, vector: Vector, weight: float) -> None:
        """Take an update that passed the checks."""
        self._collection.add(update.client, vector, weight)
        # Whole numbers, so that the mean does not depend on the order of arrival either.
        self._loss_sum += round(update.loss * 2**_LOSS_BITS) * update.sample_count
        self._loss_weight += update.sample_count

    def add_gain(self, update: ClientUpdate) -> None:
        """Take the gain that a validation client reports."""
        self.gains.add(update.gain)
        self.heard += 1

    def outcome(self) -> Outcome:
        """What the updates and gains so far come to."""
        if self.number == 0:
            return Outcome(np.zeros(self._size), float("nan"), 0, self.gains)
        loss = self._loss_sum / self._loss_weight / 2**_LOSS_BITS
        return Outcome(self._collection.result(), loss, self.number, self.gains)
