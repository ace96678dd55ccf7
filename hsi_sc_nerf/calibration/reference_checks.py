"""Are the dark references free of light, and did the same lamps shine on the white and on the frames? As findings.

A dark cube is subtracted from the frames band by band, so light in it lowers the reflectance by as much. Such light
has the spectrum of the light on the white.

Discharge lamps and screens emit narrow lines, and materials have none. A line that all pixels of the frames show
relative to the white comes from a lamp that was on for one of the two only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from hsi_sc_nerf.calibration.detector import light_of_some_lines, some_lines, unlit_bands
from hsi_sc_nerf.calibration.white_source import WhiteSource, white_cubes, white_source
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.findings import Finding, judged, leave_out, names_in_short

LIT_AMBER, LIT_RED = 0.002, 0.01
"""Light in a dark cube relative to the light on the white; reflectance is too low by this. It is below 0.0001 with a
covered lens."""
CERTAINTY = 3.0
"""Light is reported from this many standard deviations: with few bands, a dark pattern may resemble a lamp."""
DIFFERENT_TIME = 1.01
"""Integration times differ if their ratio exceeds this."""
LINE_AMBER, LINE_RED = 0.03, 0.1
"""Height of a line over the reflectance beside it, as a fraction. Good sessions have less than 0.005."""
WINDOW_NM, LARGEST_STEP_NM, FEWEST_BANDS = 45.0, 6.0, 40
"""Width of the median filter, more than twice that of a line; largest step between bands and smallest number of bands
with which lines can be detected."""
LEAST_WHITE = 0.1
"""Bands in which the white is darker than this fraction of its brightest band are not used: a spectrometer's stray
light matters there, and it differs between materials."""
FRAMES, BRIGHT, PIXELS = 8, 0.3, 250
"""Number of compared frames; pixels above this fraction of the brightest are used; about this many of a frame."""


def check_dark(
    session: Session,
    source: Literal["auto"] | WhiteSource = "auto",
    spectra: Mapping[str, Float[np.ndarray, "bands"] | None] | None = None,
) -> Finding:
    """The finding ``dark``: whether every capture has a dark reference of its integration time, without light.

    Args:
        session: its captures.
        source: where the white is.
        spectra: mean counts of dark references that were already read, by the name of their capture.

    Raises:
        InputError: the session does not have that source of white.

    Example:
        >>> refuse_red([check_dark(open_session(Path("captures")))])
    """
    found = white_source(session, source)
    if found == "product":
        return Finding("dark", "green", "The instrument's finished reflectance needs no dark reference.")
    exposures = _exposures(session, found)
    without = [name for name, _, _, dark in exposures if dark is None]
    if len(without) == len(exposures):
        return _without_any(session, [counts for _, counts, _, _ in exposures])
    if without:
        sentence = (
            f"{session.path}: {names_in_short(without)} {'has' if len(without) == 1 else 'have'} no dark reference, "
            "unlike the other captures, so the detector's offset would be taken for light; copy it there"
        )
        frames = [frame.name for frame in session.frames if frame.name in without]
        advice = f" or leave out with {leave_out(frames)}" if 0 < len(frames) < len(session.frames) else ""
        return Finding("dark", "red", f"{sentence}{advice}.", {"without": without})
    # With a target, this is the brightest part of the first frame.
    of_white = white_cubes(session, found)[0]
    white = np.percentile(some_lines(of_white), 95.0, axis=(0, 1))
    with_data, lit, other = ~unlit_bands(white[None]) & of_white.good_bands, {}, []
    for name, _, counts_ms, cube in exposures:
        assert cube is not None
        dark = (spectra or {}).get(name)
        if dark is None:
            dark = some_lines(cube).mean(axis=(0, 1))
        lit[name] = light_over_white(dark[with_data], white[with_data])
        dark_ms = cube.integration_time_ms
        if dark_ms and counts_ms and max(dark_ms, counts_ms) > DIFFERENT_TIME * min(dark_ms, counts_ms):
            other.append(name)
    values: dict[str, object] = {"light_over_white": {name: round(value, 5) for name, value in lit.items()}}
    shining = [name for name, value in lit.items() if value > LIT_AMBER]
    if shining:
        most = max(lit[name] for name in shining)
        sentence = (
            f"{session.path}: the dark references of {names_in_short(shining)} show light, {100.0 * most:.2g} % of "
            "that on the white, so that reflectance would be too low by as much; cover the lens and take them again, "
            "or copy that of another capture."
        )
        return Finding("dark", "red" if most > LIT_RED else "amber", sentence, values)
    if other:
        sentence = (
            f"{session.path}: by their headers the dark references of {names_in_short(other)} have another "
            "integration time than the captures; dark counts grow with it, so take both with the same time."
        )
        return Finding("dark", "amber", sentence, values | {"other_integration_time": other})
    return Finding("dark", "green", "Dark references: every capture has one, without light.", values)


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
    found = white_source(session, source)
    wavelengths_nm = session.wavelengths_nm
    steps_nm = np.abs(np.diff(wavelengths_nm))
    # A target is in the frames' own light, and in the frames that would be compared with it.
    if found in ("product", "target") or len(wavelengths_nm) < FEWEST_BANDS or np.median(steps_nm) > LARGEST_STEP_NM:
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
        f"at {wavelengths_nm[lit][worst]:.0f} nm the reflectance of all frames differs by "
        f"{100.0 * abs(height[worst]):.2g} % from that in the neighbouring bands"
    )
    lit_alone = "the frames" if height[worst] > 0.0 else "the white"
    advice = (
        f"a lamp with narrow lines, such as a room's lamp or a screen, shone on {lit_alone} only; switch it off and "
        "take them again"
    )
    value = float(np.abs(height[worst]))
    return [judged("light-lines", value, (LINE_AMBER, LINE_RED), f"{session.path}: {text}", advice)]


def _exposures(session: Session, source: WhiteSource) -> list[tuple[str, Cube, float | None, Cube | None]]:
    """What a dark reference is subtracted from: its name, counts and integration time (ms), and that reference."""
    captures = session.captures if source == "tarp" else session.frames
    found = [(c.name, c.cube, c.integration_time_ms, c.dark) for c in captures]
    if source == "capture":
        found += [
            (f"WHITEREF_{c.name}", c.white, c.white_integration_time_ms, c.white_dark)
            for c in captures
            if c.white is not None
        ]
    return found


def light_over_white(dark: Float[np.ndarray, "bands"], white: Float[np.ndarray, "bands"]) -> float:
    """Light in a dark cube over that on the white; 0 where it is not certain.

    The dark spectrum is fitted by a level and the white's spectrum. Both are raw counts: the white's own dark, which
    may be wrong as well, is part of the level.
    """
    if len(white) < 4:
        return 0.0
    centred = white - white.mean()
    information = float(centred @ centred)
    if not information > 0.0:
        return 0.0
    slope = float(centred @ dark) / information
    rest = dark - dark.mean() - slope * centred
    error = float(np.sqrt(rest @ rest / (len(white) - 2) / information))
    return slope if slope > CERTAINTY * error else 0.0


def _without_any(session: Session, cubes: Sequence[Cube]) -> Finding:
    """No capture has a dark reference. This is right if the counts reach zero, because their offset was removed."""
    some = [some_lines(cube) for cube in cubes]
    lowest = min(float(np.percentile(counts, 0.1)) for counts in some)
    brightest = max(float(counts.max()) for counts in some)
    values = {"lowest": lowest, "brightest": brightest}
    if lowest <= LIT_AMBER * brightest:
        return Finding("dark", "green", "No capture has a dark reference, and the counts reach zero.", values)
    sentence = (
        f"{session.path}: no capture has a dark reference, and hardly any count is below {lowest:.4g}, which may be "
        "the detector's offset; take a dark reference with a covered lens."
    )
    return Finding("dark", "amber", sentence, values)


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
    # A view would keep all of them in memory.
    return bright[:: max(1, len(bright) // PIXELS)].copy()
