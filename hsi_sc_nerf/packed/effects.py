"""The effects that a session calls for, each by its evidence (docs/validation/effects.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

CERTAIN = 3.0
"""Multiple of the noise that the evidence of an effect has to exceed."""
EFFECT_COLUMNS = ("effect", "found", "evidence", "noise", "threshold", "unit")
"""Columns of a table; a sentence may follow."""


@dataclass(frozen=True)
class Effect:
    """One effect: how strong it is in a session, and whether it is to be simulated.

    Attributes:
        name: as in `hsi-sc-nerf simulate`, where both have the effect.
        present: the decision.
        evidence: how strong the effect is; None where it could not be measured.
        noise: standard deviation of what is found where the effect is absent, in the same unit; None if unknown.
        threshold: the effect is present where the evidence exceeds it; None where something else decided.
        unit: of these three.
        sentence: what is so, and what follows from it.
    """

    name: str
    present: bool
    evidence: float | None
    noise: float | None
    threshold: float | None
    unit: str
    sentence: str


def effect_rows(effects: Sequence[Effect]) -> list[list[str]]:
    """Rows of a table under `EFFECT_COLUMNS`."""

    def text(value: float | None) -> str:
        return "-" if value is None else f"{value:.2g}" if abs(value) >= 1e-4 else "0"

    return [
        [
            effect.name,
            "yes" if effect.present else "no",
            *(text(value) for value in (effect.evidence, effect.noise, effect.threshold)),
            effect.unit,
        ]
        for effect in effects
    ]
