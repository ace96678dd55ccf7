"""What was found of a session.

A finding of a check has a level, one sentence, and the figures behind it. Whether a session has an effect is decided
by its evidence (docs/validation/effects.md).
"""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from hsi_sc_nerf.errors import InputError

Level = Literal["green", "amber", "red"]
"""green: as it should be; amber: usable, and worth a look; red: results would be wrong."""

CERTAIN = 3.0
"""Multiple of the noise that the evidence of an effect has to exceed."""
INSPECTION_NAME = "inspection.json"
"""File that findings of a session are kept in."""
EFFECT_COLUMNS = ("effect", "found", "evidence", "noise", "threshold", "unit")
"""Columns of a table; a sentence may follow."""


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        name: name of the check, in lower case with hyphens; ``--accept`` takes it.
        level: how serious it is.
        sentence: what is so, and for amber and red what to do; one sentence.
        values: the measured figures behind it, ready for JSON.
    """

    name: str
    level: Level
    sentence: str
    values: Mapping[str, object] = field(default_factory=dict)


def refuse_red(findings: Iterable[Finding], accepted: Collection[str] = ()) -> None:
    """Stop at findings that would spoil the results.

    Args:
        accepted: names of checks whose red findings the user accepts.

    Raises:
        InputError: a red finding is not accepted; the message names all of them.

    Example:
        >>> refuse_red([Finding("white", "red", "The white reference is one of the frames.")], accepted=["white"])
    """
    refused = [finding for finding in findings if finding.level == "red" and finding.name not in accepted]
    if refused:
        sentences = " ".join(finding.sentence for finding in refused)
        accept = " ".join(f"--accept {name}" for name in dict.fromkeys(finding.name for finding in refused))
        raise InputError(f"{sentences} (To go on in spite of this: {accept}.)")


def names_in_short(names: Sequence[str], most: int = 6) -> str:
    """Names in a sentence; of many the first ones and their number."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def leave_out(names: Sequence[str]) -> str:
    """The options that leave captures out, ready for a shell."""
    return " ".join(f"--exclude {shlex.quote(name)}" for name in names)


def judged(name: str, value: float, limits: tuple[float, float], sentence: str, advice: str) -> Finding:
    """The finding on a value: green up to the first limit, amber up to the second, red above.

    Args:
        limits: limits of green and of amber, in the value's unit.
        sentence: what is so, without a full stop.
        advice: what to do, given unless it is green.
    """
    good, usable = limits
    level: Level = "green" if value <= good else "amber" if value <= usable else "red"
    return Finding(name, level, f"{sentence}{'' if level == 'green' else f'; {advice}'}.", {"value": float(value)})


@dataclass(frozen=True)
class EffectEvidence:
    """One effect: how strong it is in a session, and whether it is to be simulated.

    Attributes:
        name: as in `hsi-sc-nerf simulate`, where both have the effect.
        present: the decision.
        evidence: how strong the effect is; None where it could not be measured.
        noise: standard deviation of what is found where the effect is absent, in the same unit; None if unknown.
        threshold: the effect is present where the evidence exceeds it; None where something else decided.
        unit: unit of these three.
        sentence: what is so, and what follows from it.
    """

    name: str
    present: bool
    evidence: float | None
    noise: float | None
    threshold: float | None
    unit: str
    sentence: str


def effect_rows(effects: Sequence[EffectEvidence]) -> list[list[str]]:
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
