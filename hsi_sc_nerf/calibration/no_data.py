"""Counts that stand for "no data" and must not be taken for light."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Num


def no_data(counts: Num[np.ndarray, "*shape"], ignore_value: float | None) -> Bool[np.ndarray, "*shape"] | None:
    """Which counts are no data: the header's ``data ignore value``, and floats that are not finite.

    None where all are data: then nothing of the counts' size is kept, and of whole numbers nothing is looked at.
    """
    missing = ~np.isfinite(counts) if counts.dtype.kind == "f" else None
    if ignore_value is not None:
        ignored = counts == ignore_value
        missing = ignored if missing is None else missing | ignored
    return missing if missing is not None and missing.any() else None


def filled(
    counts: Num[np.ndarray, "lines samples bands"], ignore_value: float | None
) -> Num[np.ndarray, "lines samples bands"]:
    """The counts, with the mean of an element's other lines in place of no data; 0 where it has none at all."""
    missing = no_data(counts, ignore_value)
    if missing is None:
        return counts
    total = counts.sum(axis=0, dtype=np.float64, where=~missing)
    mean = total / np.maximum((~missing).sum(axis=0), 1)
    return np.where(missing, mean.astype(counts.dtype), counts)
