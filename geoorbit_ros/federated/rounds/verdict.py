"""Whether a model is used: only if it is better than the defaults on the validation clients.

Each validation client compares the lanes that it finds with the model's theta and with the default
theta, both against its own reference: its gain is ln(L_total + 1) of the first minus that of the
second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

STANDARD_ERRORS = 2.0
"""With normal gains a useless model passes by chance in 2.3 % of cases. Chosen: more keeps good
models out for longer, less lets useless ones in."""
MIN_VALIDATION_CLIENTS = 2
"""One gain has no spread, and so no standard error."""
GAIN_LIMIT = 4.0
"""Gains count up to here, a factor of 55 in the loss. Chosen: larger lets one lost scene or one
false report decide alone, smaller ignores real differences."""
_BITS = 30
"""Resolution of the sums, 2^-30. Chosen: finer than the float32 in which gains are sent."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the validation clients together say of a model.

    Attributes:
        accepted: Whether it is used. It is when its mean gain is more than `STANDARD_ERRORS`
            standard errors below zero, and below zero for more than half of the clients: a gain
            that may be chance does not replace the defaults, and a minority that reports false
            gains can not bring in a bad model.
        gain: Mean gain; negative is better.
        error: Standard error of that mean.
        clients: How many compared.
    """

    accepted: bool
    gain: float
    error: float
    clients: int


NOT_VALIDATED = Verdict(True, float("nan"), float("nan"), 0)
"""No client validates: the model is used."""


@dataclass(slots=True)
class GainSums:
    """Gains of one model, as whole numbers: their sums do not depend on the order of arrival.

    Attributes:
        clients: How many gains.
        better: How many of them below zero.
        total: Their sum, times 2^30.
        squares: The sum of their squares, times 2^30.
    """

    clients: int = 0
    better: int = 0
    total: int = 0
    squares: int = 0

    @classmethod
    def of(cls, gains: Iterable[float]) -> GainSums:
        """The sums of these gains."""
        sums = cls()
        for gain in gains:
            sums.add(gain)
        return sums

    @classmethod
    def of_sums(cls, sums: Iterable[float]) -> GainSums:
        """From sums of `gain_terms` over cameras."""
        clients, better, total, squares = sums
        return cls(
            round(clients),
            round(better),
            round(total * GAIN_LIMIT * 2**_BITS),
            round(squares * GAIN_LIMIT**2 * 2**_BITS),
        )

    def add(self, gain: float) -> None:
        """Take the gain of one client; NaN does not count."""
        count, better, total, square = gain_terms(gain)
        self.clients += round(count)
        self.better += round(better)
        self.total += round(total * GAIN_LIMIT * 2**_BITS)
        self.squares += round(square * GAIN_LIMIT**2 * 2**_BITS)

    def verdict(self) -> Verdict | None:
        """What follows; None with fewer than `MIN_VALIDATION_CLIENTS`."""
        if self.clients < MIN_VALIDATION_CLIENTS:
            return None
        mean = self.total / 2**_BITS / self.clients
        square = self.squares / 2**_BITS / self.clients
        variance = max(square - mean**2, 0.0) * self.clients / (self.clients - 1)
        error = math.sqrt(variance / self.clients)
        accepted = mean + STANDARD_ERRORS * error < 0.0 and 2 * self.better > self.clients
        return Verdict(accepted, mean, error, self.clients)


def gain_terms(gain: float) -> tuple[float, float, float, float]:
    """What one camera adds to the sums, each within ±1: a gain, below zero, its value, its square.

    In units of `GAIN_LIMIT`. All are zero for NaN, which does not count.
    """
    if math.isnan(gain):
        return 0.0, 0.0, 0.0, 0.0
    part = min(max(gain / GAIN_LIMIT, -1.0), 1.0)
    return 1.0, float(part < 0.0), part, part**2


def is_validation_client(client: int, divisor: int) -> bool:
    """Whether a client validates: all do where the divisor is 1, none where it is 0."""
    return divisor > 0 and client % divisor == 0


def is_training_client(client: int, divisor: int) -> bool:
    """Whether a client's updates go into the model; where the divisor is 1, those of all do."""
    return divisor <= 1 or client % divisor != 0


def validation_divisor(
    clients: Iterable[int], validate_every: int, least: int = MIN_VALIDATION_CLIENTS
) -> int:
    """The number whose multiples among the clients' numbers are nearest to one in so many.

    Clients' numbers are hashes, so none is favoured, and this one number tells every client which
    of them validate.

    Args:
        clients: Numbers of all clients.
        validate_every: One in so many validates; 0: none.
        least: Fewest validation clients.

    Returns:
        The divisor for `is_validation_client`; 1, all train and validate, where there would be too
        few.
    """
    numbers = tuple(clients)
    if validate_every == 0:
        return 0
    wanted = len(numbers) // validate_every
    if validate_every == 1 or wanted < least:
        return 1

    def miss(divisor: int) -> int:
        return abs(sum(number % divisor == 0 for number in numbers) - wanted)

    return min(range(2, 4 * validate_every + 2), key=lambda divisor: (miss(divisor), divisor))
