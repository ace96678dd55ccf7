"""The count at which a sensor saturates, told from its readings alone.

The candidate is the largest reading T of the elements that follow the light. What speaks against it is that the
largest reading is often just the brightest pixel, and that an even background without noise gives it to many. So T is
where readings saturate if one of these holds:

1. T is where digitisers stop (2^k - 1, the same shifted up to 16 bits, the data type's largest), ``FEWEST`` readings
   or more are there, and more than at the next lower reading.
2. Readings pile up at T: more than at the ``BELOW`` counts under it together. Two neighbours along a line are then
   both at T in most pairs that have one there; and that says something, because among other bright readings equal
   neighbours are rare (there is noise, which only stopping removes).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Num

FEWEST = 3
BELOW = 10
PILE = 20
"""Fewest pairs of neighbours at T by which the second rule can hold."""
BRIGHT = 0.5
"""Readings above this share of T are bright."""


def saturation_counts(
    cubes: Sequence[Num[np.ndarray, "lines samples bands"]], live: Bool[np.ndarray, "samples bands"]
) -> float | None:
    """The count from which readings of the live elements are saturated; None where nothing saturates (see above)."""
    if not live.any():
        return None
    top = max(float(cube.max(axis=0)[live].max()) for cube in cubes)
    at_top = sum(int(np.count_nonzero(line[live] == top)) for cube in cubes for line in cube)
    if top in _digital_limits(cubes[0].dtype):
        return top if at_top >= FEWEST and at_top > _at_next_below(cubes, live, top) else None
    return top if at_top >= PILE and _piles_up(cubes, live, top, at_top) else None


def _digital_limits(dtype: np.dtype) -> set[float]:
    """Where digitisers stop."""
    limits = {float(2**bits - 1) for bits in range(8, 33)}
    limits |= {float((2**bits - 1) << (16 - bits)) for bits in (10, 12, 14)}
    return limits | ({float(np.iinfo(dtype).max)} if np.issubdtype(dtype, np.integer) else set())


def _at_next_below(
    cubes: Sequence[Num[np.ndarray, "lines samples bands"]], live: Bool[np.ndarray, "samples bands"], top: float
) -> int:
    """How many readings have the largest value under ``top``."""
    largest, number = -np.inf, 0
    for cube in cubes:
        for line in cube:
            below = line[live]
            below = below[below < top]
            if len(below) and below.max() >= largest:
                number = int(np.count_nonzero(below == below.max())) + (number if below.max() == largest else 0)
                largest = float(below.max())
    return number


def _piles_up(
    cubes: Sequence[Num[np.ndarray, "lines samples bands"]],
    live: Bool[np.ndarray, "samples bands"],
    top: float,
    at_top: int,
) -> bool:
    """The second rule."""
    pairs_live = live[1:] & live[:-1]
    just_below = top_pairs = top_both = bright_pairs = bright_equal = 0
    for cube in cubes:
        for line in cube:
            just_below += int(np.count_nonzero(live & (line < top) & (line >= top - BELOW)))
            one, other = line[1:][pairs_live], line[:-1][pairs_live]
            either, both = (one == top) | (other == top), (one == top) & (other == top)
            top_pairs += int(np.count_nonzero(either))
            top_both += int(np.count_nonzero(both))
            bright = ~either & (np.minimum(one, other) > BRIGHT * top)
            bright_pairs += int(np.count_nonzero(bright))
            bright_equal += int(np.count_nonzero(bright & (one == other)))
    if at_top <= just_below or top_both < PILE or 4 * bright_pairs < top_pairs:
        return False
    share_top, share_bright = top_both / top_pairs, bright_equal / bright_pairs
    return share_top > 0.5 and share_top > 3.0 * share_bright
