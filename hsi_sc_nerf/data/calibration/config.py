"""Settings of the calibration."""

from __future__ import annotations

from dataclasses import dataclass

from hsi_sc_nerf import paper


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the white-reference calibration; the defaults are the paper's."""

    roi: tuple[int, int, int, int] | None = None
    """Where the white tarp is in its image: x0 y0 x1 y1 in pixels, x1 and y1 excluded. Found by itself if not
    given."""
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
