"""The updates of the open round, on their way to one aggregate."""

from __future__ import annotations

from geoorbit_ros.federated.client_update import ClientUpdate
from geoorbit_ros.federated.layout import Vector
from geoorbit_ros.federated.strategies.collection import Aggregate, Collection

_LOSS_BITS = 40


class OpenRound:
    """Collects until the server ends the round.

    Args:
        collection: The strategy's.
    """

    def __init__(self, collection: Collection) -> None:
        self._collection = collection
        self._loss_sum = self._loss_weight = 0

    @property
    def number(self) -> int:
        """Updates so far."""
        return self._collection.number

    def add(self, update: ClientUpdate, vector: Vector, weight: float) -> None:
        """Take an update that was admitted."""
        self._collection.add(update.client, vector, weight)
        # Whole numbers, so that the mean does not depend on the order of arrival either.
        self._loss_sum += round(update.loss * 2**_LOSS_BITS) * update.sample_count
        self._loss_weight += update.sample_count

    def result(self) -> tuple[Aggregate, float]:
        """The aggregate, shape (size,), and the mean loss by number of examples."""
        loss = self._loss_sum / self._loss_weight / 2**_LOSS_BITS
        return self._collection.result(), loss
