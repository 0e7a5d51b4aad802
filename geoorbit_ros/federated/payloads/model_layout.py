"""The model as named tensors, as one vector, and as a number that identifies it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoorbit_ros.federated.errors import FederationError, PayloadError, Refusal

Tensors = dict[str, NDArray[np.float32]]
"""Weights and biases of a model by name, in a fixed order."""
Vector = NDArray[np.float32]
"""All tensors one after the other, row by row: shape (size,)."""

MAX_SIZE = 1 << 24
"""Most weights of a model. Chosen: larger lets a payload make its reader allocate more, smaller
excludes larger models; the one in use has 179."""


@dataclass(frozen=True, slots=True)
class ModelLayout:
    """Names and shapes of a model's tensors.

    Attributes:
        names: One per tensor.
        shapes: Dimensions of each.
    """

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.shapes) or len(set(self.names)) != len(self.names):
            found = f"{len(self.shapes)} shapes for the names {', '.join(self.names)[:80]}"
            raise PayloadError(Refusal.SHAPE, "model layout", found, "one name per tensor")
        if not 0 < self.size <= MAX_SIZE:
            found = f"{self.size} weights"
            raise PayloadError(Refusal.SHAPE, "model layout", found, f"1 to {MAX_SIZE}")

    @classmethod
    def of(cls, tensors: Mapping[str, NDArray[np.float32]]) -> ModelLayout:
        """The layout of these tensors, in their order."""
        return cls(tuple(tensors), tuple(tuple(map(int, t.shape)) for t in tensors.values()))

    @property
    def size(self) -> int:
        """Number of weights."""
        return sum(math.prod(shape) for shape in self.shapes)

    def flatten(self, tensors: Mapping[str, NDArray[np.float32]]) -> Vector:
        """Tensors of this layout as one vector.

        Raises:
            FederationError: Other names or shapes.
        """
        found = ModelLayout.of(tensors)
        if found != self:
            raise FederationError("tensors", found.describe(), self.describe())
        parts = [np.asarray(t, np.float32).ravel() for t in tensors.values()]
        return np.concatenate(parts)

    def unflatten(self, vector: Vector) -> Tensors:
        """The tensors in a vector of shape (size,), as copies."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        parts = np.split(vector, ends[:-1])
        return {
            name: part.reshape(shape).astype(np.float32)
            for name, part, shape in zip(self.names, parts, self.shapes, strict=True)
        }

    def describe(self) -> str:
        """Names and shapes in one line."""
        pairs = zip(self.names, self.shapes, strict=True)
        return ", ".join(f"{name} {'x'.join(map(str, shape))}" for name, shape in pairs)

    def digest(self, vector: Vector, run: int) -> int:
        """A 32-bit number that identifies a model's exact bits in one run of a federation.

        It notices mistakes; attacks are what signatures are for.
        """
        text = f"{run};{self.describe()};".encode()
        raw = np.ascontiguousarray(vector, "<f4").tobytes()
        return int.from_bytes(hashlib.sha256(text + raw).digest()[:4], "little")
