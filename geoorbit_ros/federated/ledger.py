"""Who has answered which round: fixed memory for all members, whoever answers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray


class Ledger:
    """One row per member of the roster.

    Args:
        members: Their numbers, ascending.

    Attributes:
        members: As given.
        answered: (M,) last round that each one's update was taken for, 0: none.
        utility: (M,) usefulness of that update (`Selection.choose`); NaN: none yet.
    """

    def __init__(self, members: Sequence[int]) -> None:
        self.members = tuple(members)
        self._row = {member: row for row, member in enumerate(self.members)}
        self.answered: NDArray[np.int64] = np.zeros(len(self.members), np.int64)
        self.utility: NDArray[np.float64] = np.full(len(self.members), np.nan)

    def last(self, member: int) -> int:
        """Last round that the member's update was taken for."""
        return int(self.answered[self._row[member]])

    def of(self, members: Sequence[int]) -> NDArray[np.float64]:
        """Utility of these members, in their order."""
        return self.utility[[self._row[member] for member in members]]

    def note(self, member: int, round_number: int, utility: float = float("nan")) -> None:
        """An update was taken."""
        row = self._row[member]
        self.answered[row] = round_number
        self.utility[row] = utility

    def take_over(
        self, members: Iterable[int], answered: Iterable[int], utility: Iterable[float]
    ) -> None:
        """Take rows from a checkpoint; members who left the roster meanwhile are dropped."""
        for member, number, value in zip(members, answered, utility, strict=True):
            if member in self._row:
                self.note(member, int(number), float(value))
