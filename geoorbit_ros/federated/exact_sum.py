"""Sums of vectors that do not depend on the order of their summands, not even in the last bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FRACTION_BITS = 40
"""Resolution of the sum: 2^-40, a thousandth of what float32 resolves near 0.01."""
MAX_SUMMAND = 2.0**42
MAX_SUMMANDS = 1 << 20


class ExactSum:
    """Adds float64 vectors as whole and fractional parts in 64-bit integers.

    Floating-point addition is not associative; integer addition is. Each summand is rounded once,
    by itself, to a multiple of 2^-40. Its memory is that of two vectors, however many are added.

    Args:
        size: Length of the vectors.
    """

    def __init__(self, size: int) -> None:
        self.whole = np.zeros(size, np.int64)
        self.fraction = np.zeros(size, np.int64)
        self.number = 0

    def add(self, vector: NDArray[np.float64]) -> None:
        """Add one vector of shape (size,), each magnitude below 2^42.

        Raises:
            OverflowError: More than 2^20 summands, or one that is too large.
        """
        whole = np.rint(vector)
        if self.number == MAX_SUMMANDS or not np.max(np.abs(whole), initial=0.0) < MAX_SUMMAND:
            raise OverflowError(f"summand {self.number} of {MAX_SUMMANDS}, each below 2^42")
        self.whole += whole.astype(np.int64)
        self.fraction += np.rint((vector - whole) * 2.0**FRACTION_BITS).astype(np.int64)
        self.number += 1

    def value(self) -> NDArray[np.float64]:
        """The sum, shape (size,)."""
        carry = self.fraction >> FRACTION_BITS
        rest = self.fraction - (carry << FRACTION_BITS)
        return (self.whole + carry).astype(np.float64) + rest / 2.0**FRACTION_BITS
