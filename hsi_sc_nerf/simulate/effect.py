"""The base of all effects, their random numbers, and finding effects among those of a scene."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import numpy as np


class Effect:
    """A departure from a matte object, even light and a perfect sensor.

    An effect is a frozen dataclass whose fields are its settings.
    """

    name: ClassVar[str]
    """Name in scene files."""


def effect_rng(seed: int, effect: Effect, *exposure: int) -> np.random.Generator:
    """Random generator of one effect, for one exposure or, without ``exposure``, for the whole session.

    It depends on the scene's seed, the effect's name and the exposure only. Other effects and the order in which
    frames are simulated do not change it.
    """
    # The length is part of the seed because NumPy ignores trailing zeros of a seed.
    return np.random.default_rng([seed, zlib.crc32(effect.name.encode()), len(exposure), *exposure])


Kind = TypeVar("Kind", bound=Effect)


def of_kind(effects: Sequence[Effect], kind: type[Kind]) -> tuple[Kind, ...]:
    """The effects of one class, in order."""
    return tuple(effect for effect in effects if isinstance(effect, kind))


def find_effect(effects: Sequence[Effect], kind: type[Kind]) -> Kind | None:
    """The effect of one class; None if the scene does not name it."""
    return next(iter(of_kind(effects, kind)), None)
