"""Did other lamps shine on the frames than on the white? Discharge lamps and screens have narrow lines.

Materials have none: a line that all pixels of the frames show over the white is a lamp that burnt for one of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from hsi_sc_nerf.calibration.detector import light_of_some_lines
from hsi_sc_nerf.calibration.white_source import WhiteSource, checked_source, white_cubes
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.findings import Finding, judged

LINE_AMBER, LINE_RED = 0.03, 0.1
"""Height of a line over the reflectance beside it, as a fraction. Good sessions have less than 0.005."""
WINDOW_NM, LARGEST_STEP_NM, FEWEST_BANDS = 45.0, 6.0, 40
"""Span in which reflectance is compared, more than twice a line's width; and bands that tell of lines."""
LEAST_WHITE = 0.1
"""Light on the white over that of its brightest band. In darker bands a spectrometer's stray light counts, which
differs from material to material."""
FRAMES, BRIGHT, PIXELS = 8, 0.3, 250
"""Frames, fraction of the brightest pixels' light from which pixels are compared, and about so many of a frame."""


def check_lines(
    session: Session,
    frames: Sequence[Float[np.ndarray, "pixels bands"]],
    source: Literal["auto"] | WhiteSource = "auto",
) -> list[Finding]:
    """The finding ``light-lines``, for sessions with narrow bands and a white of their own.

    Args:
        session: its captures.
        frames: counts above dark of brighter pixels of each frame (`bright_pixels`).
        source: where the white is.

    Raises:
        InputError: the session does not have that source of white.
    """
    found = checked_source(session, source)
    wavelengths_nm = session.wavelengths_nm
    steps_nm = np.abs(np.diff(wavelengths_nm))
    if found == "product" or len(wavelengths_nm) < FEWEST_BANDS or np.median(steps_nm) > LARGEST_STEP_NM:
        return []
    cube, dark = white_cubes(session, found)
    white = bright_pixels(light_of_some_lines(cube, dark)).mean(axis=0)
    lit = (white >= LEAST_WHITE * white.max()) & cube.good_bands
    if np.count_nonzero(lit) < FEWEST_BANDS:
        return []
    chosen = np.unique(np.linspace(0, len(session.frames) - 1, FRAMES).astype(int)).tolist()
    spectra = [frames[number][:, lit] / white[lit] for number in chosen]
    window = 2 * round(WINDOW_NM / 2.0 / float(np.median(steps_nm))) + 1
    height = line_heights(np.concatenate(spectra), window)
    worst = int(np.abs(height).argmax())
    text = (
        f"at {wavelengths_nm[lit][worst]:.0f} nm all of the frames differ by {100.0 * abs(height[worst]):.2g} % from "
        "the bands beside it"
    )
    lit_alone = "the frames" if height[worst] > 0.0 else "the white"
    advice = (
        f"a lamp with lines, such as a room's or a screen's, shone on {lit_alone} only; switch it off and take them "
        "again"
    )
    limits = LINE_AMBER, LINE_RED
    return [judged("light-lines", float(np.abs(height[worst])), limits, f"{session.path}: {text}", advice)]


def line_heights(spectra: Float[np.ndarray, "pixels bands"], window: int) -> Float[np.ndarray, "bands"]:
    """Median over pixels of how far each band lies above the median of its neighbours, as a fraction.

    A median over bands leaves slopes and edges as they are.
    """
    beside = median_filter(spectra, (1, window), mode="nearest")
    return np.median(spectra / np.maximum(beside, 1e-6) - 1.0, axis=0)


def bright_pixels(light: Float[np.ndarray, "rows samples bands"]) -> Float[np.ndarray, "pixels bands"]:
    """Spectra of the brighter pixels, evenly chosen."""
    brightness = light.mean(axis=-1)
    bright = light[brightness > BRIGHT * np.percentile(brightness, 99.0)]
    return bright[:: max(1, len(bright) // PIXELS)]
