"""What an encoding lost in one round is added to the vector of the next."""

from __future__ import annotations

import numpy as np

from geoorbit_ros.federated.encodings.encoding import Encoding
from geoorbit_ros.federated.layout import Vector


class ErrorFeedback:
    """Remembers the difference between what was meant and what was sent.

    Karimireddy et al., "Error feedback fixes SignSGD and other gradient compression schemes", ICML
    2019: with it, a biased encoding such as top-k reaches what no encoding reaches.

    Args:
        encoding: What sends.
        size: Length of the vectors.

    Attributes:
        residual: What has not been sent yet, shape (size,).
    """

    def __init__(self, encoding: Encoding, size: int) -> None:
        self.encoding = encoding
        self.residual: Vector = np.zeros(size, np.float32)

    def encode(self, vector: Vector) -> bytes:
        """Bytes of this vector and of what earlier ones are owed."""
        meant = vector + self.residual
        data = self.encoding.encode(meant)
        self.residual = meant - self.encoding.decode(data, len(meant))
        return data
