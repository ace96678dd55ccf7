"""Tensors: NumPy arrays with Open3D's two methods."""

from __future__ import annotations

import numpy as np


class Tensor:
    """An array."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = np.asarray(array)

    @classmethod
    def from_numpy(cls, array: np.ndarray) -> Tensor:
        """The array as a tensor; nothing is copied."""
        return cls(array)

    def numpy(self) -> np.ndarray:
        """The tensor as an array."""
        return self.array
