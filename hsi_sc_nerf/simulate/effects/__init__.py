"""Physical effects beyond a matte object under even light that a perfect sensor sees; each absent unless named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import check_ranges, read_dataclass
from hsi_sc_nerf.simulate.effects.chamber import ChamberShading, InterReflection, TexturedBackground
from hsi_sc_nerf.simulate.effects.detector import (
    BadPixels,
    DarkPattern,
    PhotonNoise,
    ReadNoise,
    Saturation,
    SpectralSmile,
    TarpExposure,
)
from hsi_sc_nerf.simulate.effects.illumination import DriftingLamps, IlluminationFalloff, Lamp
from hsi_sc_nerf.simulate.effects.motion import (
    AngleJitter,
    AxisTilt,
    Clockwise,
    MissingFrames,
    OffCentre,
    PartialTurn,
    RepeatedFrames,
    Wobble,
)
from hsi_sc_nerf.simulate.effects.object import Deformation, Drying, Gloss, Translucency
from hsi_sc_nerf.simulate.effects.optics import ImageRotation, LensDistortion, OpticalBlur
from hsi_sc_nerf.simulate.effects.stages import Effect

_ORDER: tuple[type[Effect], ...] = (
    PartialTurn,
    Clockwise,
    AngleJitter,
    AxisTilt,
    Wobble,
    RepeatedFrames,
    MissingFrames,
    OffCentre,
    Deformation,
    ChamberShading,
    InterReflection,
    Translucency,
    Lamp,
    Gloss,
    TexturedBackground,
    Drying,
    DriftingLamps,
    IlluminationFalloff,
    LensDistortion,
    OpticalBlur,
    ImageRotation,
    SpectralSmile,
    Saturation,
    TarpExposure,
    PhotonNoise,
    DarkPattern,
    ReadNoise,
    BadPixels,
)
EFFECTS: dict[str, type[Effect]] = {effect.name: effect for effect in _ORDER}
"""Every effect by its name, in the order in which effects of one stage act."""

Stage = TypeVar("Stage", bound=Effect)


def of_stage(effects: Sequence[Effect], stage: type[Stage]) -> tuple[Stage, ...]:
    """The effects that act in a stage, in order."""
    return tuple(effect for effect in effects if isinstance(effect, stage))


def read_effects(values: Sequence[Any], source: str) -> tuple[Effect, ...]:
    """Effects of a scene file's list: each a name, or a name with strengths (``read_noise: {electrons: 40}``).

    They come back in the order in which they act.

    Raises:
        InputError: an unknown or repeated effect; an unknown, missing, mistyped or out-of-range strength.
    """
    found: dict[str, Effect] = {}
    strengths: dict[str, Any]
    for value in values:
        if isinstance(value, str):
            name, strengths = value, {}
        elif isinstance(value, dict) and len(value) == 1:
            ((name, strengths),) = value.items()
        else:
            raise InputError(f"{source}: effect {value!r} is neither a name nor `name: {{strength: value}}`.")
        if name not in EFFECTS:
            raise InputError(f"{source}: effect {name!r} is unknown; known are {', '.join(EFFECTS)}.")
        if name in found:
            raise InputError(f"{source}: effect {name} is named twice; name it once.")
        found[name] = read_dataclass(EFFECTS[name], strengths or {}, source, f"effects.{name}.")
        check_ranges(found[name], source, f"effects.{name}.")
    return tuple(found[name] for name in EFFECTS if name in found)
