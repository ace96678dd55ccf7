"""Limit of blank: how large a region may be that two captures of one day show without any change.

Two trainings differ in ways that one pair of days cannot tell from a change: in the hollow of a stem, in the water
index of an existing bruise. As in chemical analysis (Currie 1968; CLSI EP17), such pairs are blanks, and what is no
larger than they show is not called detected. The statistic is the largest region of all quantities of a pair: a false
change is a region, and one in any quantity is one too many (as the largest cluster in Nichols and Holmes 2002).
"""

from __future__ import annotations

LIMIT_M2 = 1.4e-4
"""Largest region in 99 of 100 blanks, by an exponential tail through the blanks of `docs/validation/change.md`."""
LIMIT_PART = 0.0087
"""The same as a part of the surface that was seen: what makes such regions, such as a hollow, is larger on larger
objects. On smaller ones, patches of one size make regions of one size."""


def limit_of_blank_m2(seen_m2: float) -> float:
    """Area up to which a region is no evidence of a change, without a second capture of the first day.

    Args:
        seen_m2: area of the surface that was seen on both days.

    Example:
        >>> f"{limit_of_blank_m2(0.0050):.2e} {limit_of_blank_m2(0.0500):.2e}"
        '1.40e-04 4.35e-04'
    """
    return max(LIMIT_M2, LIMIT_PART * seen_m2)
