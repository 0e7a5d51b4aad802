"""Whether a model is used at all: only if cameras say that it serves them better than defaults do.

Each judge compares the lanes it finds with the model's theta and with the default theta, both
against its own reference: its gain is ln(L_total + 1) of the first minus that of the second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

STANDARD_ERRORS = 2.0
MIN_JUDGES = 2
"""Fewer have no spread that chance could be told by."""
GAIN_LIMIT = 4.0
"""Gains count up to here, a factor of 55: neither one lost scene nor one liar decides alone."""
_BITS = 30


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the judges say of a model.

    Attributes:
        accepted: Whether it is used. It is when its mean gain is more than `STANDARD_ERRORS`
            standard errors below zero, and below zero for more than half of the judges: what can't
            be told from chance is not worth leaving the defaults for, and a minority that lies
            can't bring in a model that is good for nobody.
        gain: Mean gain; negative is better.
        error: Standard error of that mean.
        judges: How many compared.
    """

    accepted: bool
    gain: float
    error: float
    judges: int


NOBODY_ASKED = Verdict(True, float("nan"), float("nan"), 0)
"""Nobody was to judge: the model is used as it is."""


@dataclass(slots=True)
class Ballot:
    """Gains of one model, as whole numbers: their sums do not depend on the order of arrival.

    Attributes:
        judges: How many gains.
        better: How many of them below zero.
        total: Their sum, times 2^30.
        squares: The sum of their squares, times 2^30.
    """

    judges: int = 0
    better: int = 0
    total: int = 0
    squares: int = 0

    @classmethod
    def of(cls, gains: Iterable[float]) -> Ballot:
        """A ballot with these gains."""
        ballot = cls()
        for gain in gains:
            ballot.add(gain)
        return ballot

    @classmethod
    def of_sums(cls, sums: Iterable[float]) -> Ballot:
        """From sums of `shares` over cameras."""
        judges, better, total, squares = sums
        return cls(
            round(judges),
            round(better),
            round(total * GAIN_LIMIT * 2**_BITS),
            round(squares * GAIN_LIMIT**2 * 2**_BITS),
        )

    def add(self, gain: float) -> None:
        """Take one judge's gain; NaN abstains."""
        count, better, total, square = shares(gain)
        self.judges += round(count)
        self.better += round(better)
        self.total += round(total * GAIN_LIMIT * 2**_BITS)
        self.squares += round(square * GAIN_LIMIT**2 * 2**_BITS)

    def verdict(self) -> Verdict | None:
        """What follows; None with fewer than `MIN_JUDGES`."""
        if self.judges < MIN_JUDGES:
            return None
        mean = self.total / 2**_BITS / self.judges
        square = self.squares / 2**_BITS / self.judges
        variance = max(square - mean**2, 0.0) * self.judges / (self.judges - 1)
        error = math.sqrt(variance / self.judges)
        accepted = mean + STANDARD_ERRORS * error < 0.0 and 2 * self.better > self.judges
        return Verdict(accepted, mean, error, self.judges)


def shares(gain: float) -> tuple[float, float, float, float]:
    """What one camera adds to a ballot, each within ±1: a gain, below zero, its value, its square.

    In units of `GAIN_LIMIT`. All are zero for NaN, which abstains.
    """
    if math.isnan(gain):
        return 0.0, 0.0, 0.0, 0.0
    part = min(max(gain / GAIN_LIMIT, -1.0), 1.0)
    return 1.0, float(part < 0.0), part, part**2


def is_judge(client: int, divisor: int) -> bool:
    """Whether a client judges: all do where the divisor is 1, nobody where it is 0."""
    return divisor > 0 and client % divisor == 0


def is_teacher(client: int, divisor: int) -> bool:
    """Whether a client's updates go into the model: judges' do not, except where all judge."""
    return divisor <= 1 or client % divisor != 0


def judge_divisor(clients: Iterable[int], judge_every: int, least: int = MIN_JUDGES) -> int:
    """The number whose multiples among the clients' numbers are nearest to one in so many.

    Clients' numbers are hashes, so nobody is favoured, and the one number says to everybody who
    judges.

    Args:
        clients: Numbers of all clients.
        judge_every: One in so many is to judge; 0: nobody.
        least: Fewest judges.

    Returns:
        The divisor for `is_judge`; 1, all teach and judge, where so few would be too few.
    """
    numbers = tuple(clients)
    if judge_every == 0:
        return 0
    wanted = len(numbers) // judge_every
    if judge_every == 1 or wanted < least:
        return 1

    def miss(divisor: int) -> int:
        return abs(sum(number % divisor == 0 for number in numbers) - wanted)

    return min(range(2, 4 * judge_every + 2), key=lambda divisor: (miss(divisor), divisor))
