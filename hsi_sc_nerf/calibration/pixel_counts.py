"""How many values of a frame were clipped or flagged, by band."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Int

# How many times a uint8 can be counted up.
_COUNTABLE = 255


@dataclass(frozen=True, eq=False)
class Tally:
    """How many of a frame's values were clipped or flagged, in each of the kept bands (those of the packed cube).

    Each value is counted once: a dead element is nothing else, no data is not saturated, and what is flagged is not
    clipped. A value is clipped where that changes it by half a packed unit or more.

    Attributes:
        clipped_low: raised to the lower bound.
        clipped_high: lowered to the upper bound.
        saturated: flagged because the reading is saturated.
        dead: flagged because the detector's element is dead.
        no_data: flagged because the file says that there is no data, or because a float is not finite.
    """

    clipped_low: Int[np.ndarray, "kept"]
    clipped_high: Int[np.ndarray, "kept"]
    saturated: Int[np.ndarray, "kept"]
    dead: Int[np.ndarray, "kept"]
    no_data: Int[np.ndarray, "kept"]

    @property
    def flagged(self) -> Int[np.ndarray, "kept"]:
        """Values that are no measurement."""
        return self.saturated + self.dead + self.no_data

    @staticmethod
    def total(tallies: Iterable[Tally]) -> Tally:
        """The sum over frames (at least one)."""
        listed = list(tallies)
        return Tally(**{f.name: np.sum([getattr(t, f.name) for t in listed], axis=0) for f in fields(Tally)})


class Counter:
    """Counts, for each element of a line, in how many lines it was marked; without widening every mark."""

    def __init__(self, bands: int, samples: int) -> None:
        self._total = np.zeros((bands, samples), np.int64)
        self._recent = np.zeros((bands, samples), np.uint8)
        self._lines = 0

    def add(self, marked: Bool[np.ndarray, "bands samples"]) -> None:
        """Count one line."""
        np.add(self._recent, marked.view(np.uint8), out=self._recent)
        self._lines += 1
        if self._lines == _COUNTABLE:
            self._flush()

    def by_band(self, without: Int[np.ndarray, "elements"]) -> Int[np.ndarray, "bands"]:
        """Sum over the samples, some (flat) elements left out."""
        self._flush()
        self._total.reshape(-1)[without] = 0
        return self._total.sum(axis=1)

    def _flush(self) -> None:
        self._total += self._recent
        self._recent[:] = 0
        self._lines = 0
