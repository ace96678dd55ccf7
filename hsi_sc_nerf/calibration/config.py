"""Settings of the calibration."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from hsi_sc_nerf import paper

WhiteSource = Literal["auto", "tarp", "capture", "target", "product"]


@dataclass(frozen=True)
class LampDriftConfig:
    """Settings of the lamps' drift over the session, which is measured on what stands still in the image."""

    correct: Literal["auto", "always", "never"] = "auto"
    """Whether the drift is divided out of the frames: where it is larger than its own uncertainty (auto), wherever it
    can be measured (always), or never. It is measured and reported in any case."""
    survey_share: float = 0.06
    """Share of each frame's lines that is read to measure the drift."""
    smallest_static_share: float = 0.05
    """Share of the surveyed pixels that must stand still for the drift to be measured."""
    degree: int = 2
    """Degree of the curve over the wavelength that takes the noise off the drift. A change of the lamps' output and
    of their colour temperature is a straight line in its terms."""
    floor: float = 0.001
    """Relative change of the light, root mean square over frames and wavelengths, that is not taken for drift however
    well it was measured: the chamber's wall also changes by what the turning object reflects on to it. It is a tenth
    of a pixel's own noise."""
    significance: float = 0.001
    """How often a session without drift may be corrected by chance."""


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the white-reference calibration; the defaults are the paper's."""

    white_source: WhiteSource = "auto"
    """Where the white is: in a capture of its own in the session (tarp), in the WHITEREF cube that each capture
    brings along (capture), or inside every frame, in the region given as --calibration.roi (target); or nowhere, and
    the instrument's own finished REFLECTANCE is taken (product). Auto takes the first of tarp, capture and product
    that the session has."""
    roi: tuple[int, int, int, int] | None = None
    """Where the white is, in the image as the file holds it: x0 y0 x1 y1 in pixels, x1 and y1 excluded. A tarp is
    found by itself if this is not given; a white target inside the frames needs it."""
    panel: Path | None = None
    """CSV file of the white's own reflectance by wavelength (wavelength in nm, reflectance as fraction or percent),
    for a white that is not a perfect one. Without it the white counts as reflectance 1."""
    percentile: float = paper.WHITE_PERCENTILE
    """How much of the tarp is kept: the share (in percent) of its pixels that deviate least from its mean."""
    morphology_min_px: int = paper.WHITE_MORPHOLOGY_MIN_PX
    """Smallest diameter of the ellipse that closes and opens the tarp's mask, pixels."""
    morphology_fraction: int = paper.WHITE_MORPHOLOGY_FRACTION
    """The ellipse's diameter is the tarp's shorter side divided by this, where that is larger."""
    smoothing_bands: int = paper.WHITE_SMOOTHING_BANDS
    """Width of the moving average along the white spectrum, bands; 1 leaves the spectrum as measured."""
    smoothing_max_nm: float = 15.0
    """The moving average spans no more than this, nm: five bands of a camera with few, broad bands would smooth the
    lamp's own spectrum away. The paper's five bands span 12 nm."""
    bounds: tuple[float, float] = paper.REFLECTANCE_BOUNDS
    """Reflectance is clipped to these."""
    roi_brightness: float = 0.5
    """The tarp is looked for where the image is brighter than this share of its brightest part."""
    max_deviation: float = 0.5
    """A tarp whose kept pixels deviate from their mean by more than this (relative) is refused."""
    min_light: float = 0.001
    """A band in which the white counts less than this share of what it counts in its brightest band measures
    nothing and is left out."""
    max_saturated: float = 0.01
    """A band in which more than this share of the white is saturated cannot be calibrated and is left out."""
    flat_field: bool = False
    """Divide out that the light falls off over the image, as the tarp shows it (only with the tarp)."""
    flat_field_order: int = 4
    """Order of the polynomial over the image by which the light falls off."""
    lamp_drift: LampDriftConfig = field(default_factory=LampDriftConfig)
    """Drift of the lamps over the session."""
