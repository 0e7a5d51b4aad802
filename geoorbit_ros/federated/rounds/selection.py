"""Which clients a round is for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import FederationError

SELECTIONS = ("random", "round_robin", "importance")


class Selection(Protocol):
    """Chooses clients; the same arguments give the same choice, also after a restart."""

    def choose(
        self, clients: Sequence[int], number: int, round_number: int, utility: NDArray[np.float64]
    ) -> tuple[int, ...]:
        """Choose clients for a round.

        Args:
            clients: All members, ascending.
            number: How many to choose, at most `len(clients)`.
            round_number: The round, from 1.
            utility: What is known of each client's last update, in the order of `clients`: its loss
                times the root of its number of examples. NaN where it never sent one.

        Returns:
            Chosen clients, ascending.
        """


class RandomSelection:
    """Every client with the same probability (McMahan et al. 2017)."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def choose(
        self, clients: Sequence[int], number: int, round_number: int, utility: NDArray[np.float64]
    ) -> tuple[int, ...]:
        """See `Selection.choose`."""
        generator = np.random.default_rng([self._seed, round_number])
        return tuple(sorted(generator.choice(clients, number, replace=False).tolist()))


class RoundRobinSelection:
    """One after the other, in turn."""

    def choose(
        self, clients: Sequence[int], number: int, round_number: int, utility: NDArray[np.float64]
    ) -> tuple[int, ...]:
        """See `Selection.choose`."""
        start = (round_number - 1) * number
        return tuple(sorted(clients[(start + k) % len(clients)] for k in range(number)))


class ImportanceSelection:
    """Clients with larger losses and more examples are chosen more often.

    Probabilities follow the statistical utility of Lai et al., "Oort", OSDI 2021, section 4.2: the
    loss times the root of the number of examples. A client of which nothing is known counts as the
    most useful one, and no probability falls below a tenth of that, because losses change.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def choose(
        self, clients: Sequence[int], number: int, round_number: int, utility: NDArray[np.float64]
    ) -> tuple[int, ...]:
        """See `Selection.choose`."""
        known = utility[np.isfinite(utility)]
        highest = float(np.max(known, initial=0.0)) or 1.0
        value = np.maximum(np.nan_to_num(utility, nan=highest), 0.1 * highest)
        generator = np.random.default_rng([self._seed, round_number])
        chosen = generator.choice(clients, number, replace=False, p=value / value.sum())
        return tuple(sorted(chosen.tolist()))


def make_selection(name: str, seed: int) -> Selection:
    """A selection by name.

    Raises:
        FederationError: No selection has this name.
    """
    if name == "random":
        return RandomSelection(seed)
    if name == "round_robin":
        return RoundRobinSelection()
    if name == "importance":
        return ImportanceSelection(seed)
    raise FederationError("selection", repr(name), " or ".join(SELECTIONS))
