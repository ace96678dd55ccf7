"""The effects that a scene can name: departures from a matte object, even light and a perfect sensor.

Effects act in the order of `EFFECTS`, whatever their order in the scene file: motion of the turntable, light,
background, reflectance, lamps, optics, detector. Effects of one base class change the same thing in turn;
`frames.Simulation` applies the others where they act. A scene without effects runs no code of any effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import check_ranges, read_dataclass
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.effects.detector import (
    BadPixels,
    DarkPattern,
    PhotonNoise,
    ReadNoise,
    Saturation,
    SpectralSmile,
    TarpExposure,
)
from hsi_sc_nerf.simulate.effects.image import (
    DriftingLamps,
    Drying,
    IlluminationFalloff,
    ImageRotation,
    LensDistortion,
    OpticalBlur,
    TexturedBackground,
)
from hsi_sc_nerf.simulate.effects.light import ChamberShading, Gloss, InterReflection, Lamp
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

_ORDER: tuple[type[Effect], ...] = (
    PartialTurn,
    Clockwise,
    AngleJitter,
    AxisTilt,
    Wobble,
    RepeatedFrames,
    MissingFrames,
    OffCentre,
    ChamberShading,
    InterReflection,
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
"""All effects by name, in the order in which they act."""


def read_effects(values: Sequence[Any], source: str) -> tuple[Effect, ...]:
    """Effects of a scene file's list, in the order in which they act.

    Args:
        values: names, or names with settings such as ``{"read_noise": {"electrons": 40}}``.
        source: name of the file or option in error messages.

    Raises:
        InputError: an unknown or repeated effect; an unknown, missing, mistyped or out-of-range setting.

    Example:
        >>> read_effects(["photon_noise", {"lamp": {"fraction": 0.3}}], "scene.yaml")
        (Lamp(fraction=0.3, azimuth_deg=-35.0, elevation_deg=30.0), PhotonNoise())
    """
    found: dict[str, Effect] = {}
    settings: dict[str, Any]
    for value in values:
        if isinstance(value, str):
            name, settings = value, {}
        elif isinstance(value, dict) and len(value) == 1:
            ((name, settings),) = value.items()
        else:
            raise InputError(f"{source}: effect {value!r} is neither a name nor `name: {{setting: value}}`.")
        if name not in EFFECTS:
            raise InputError(f"{source}: effect {name!r} is unknown; known are {', '.join(EFFECTS)}.")
        if name in found:
            raise InputError(f"{source}: effect {name} is named twice; name it once.")
        found[name] = read_dataclass(EFFECTS[name], settings or {}, source, f"effects.{name}.")
        check_ranges(found[name], source, f"effects.{name}.")
    return tuple(found[name] for name in EFFECTS if name in found)
