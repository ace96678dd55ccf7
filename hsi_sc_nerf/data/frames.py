"""The work on one frame: calibrate, pack, and keep what later steps need, so that a stopped run can go on.

A frame's cube and picture are written first and its notes last: a frame whose notes are there is finished.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from hsi_sc_nerf.data.atomic import atomic_write, write_png
from hsi_sc_nerf.data.calibration.config import CalibrationConfig
from hsi_sc_nerf.data.calibration.reflectance import calibrate
from hsi_sc_nerf.data.calibration.white_reference import WhiteReference
from hsi_sc_nerf.data.envi import open_cube
from hsi_sc_nerf.data.masks import MaskConfig, foreground_score
from hsi_sc_nerf.data.packed import REFLECTANCE_SCALE, pack, write_packed_cube
from hsi_sc_nerf.data.pseudo_rgb import gray_image, pseudo_rgb
from hsi_sc_nerf.data.session import Capture
from hsi_sc_nerf.errors import InputError


@dataclass(frozen=True)
class FramePaths:
    """Where a frame's files are in a packed dataset."""

    image: Path
    cube: Path
    flags: Path
    mask: Path
    notes: Path

    @staticmethod
    def of(root: Path, capture: str) -> FramePaths:
        """The paths of ``capture`` under ``root``."""
        return FramePaths(
            image=root / "images" / f"{capture}.png",
            cube=root / "cubes" / f"{capture}.hdr",
            flags=root / "flags" / f"{capture}.png",
            mask=root / "masks" / f"{capture}.png",
            notes=root / ".notes" / f"{capture}.npz",
        )


@dataclass(frozen=True, eq=False)
class FrameNotes:
    """What finding poses and masks needs of a frame.

    Attributes:
        fingerprint: of the files and settings that the frame was made from.
        gray: in which markers are looked for.
        score: foreground score (``masks.foreground_score``).
    """

    fingerprint: str
    gray: UInt8[np.ndarray, "lines samples"]
    score: Float[np.ndarray, "lines samples"]


def finished_notes(paths: FramePaths, fingerprint: str) -> FrameNotes | None:
    """The notes of a frame that was finished from the same files with the same settings, or None."""
    try:
        with np.load(paths.notes) as stored:
            notes = FrameNotes(str(stored["fingerprint"]), stored["gray"], stored["score"])
        open_cube(paths.cube)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, InputError):
        return None
    return notes if notes.fingerprint == fingerprint and paths.image.is_file() else None


def process_frame(
    capture: Capture,
    paths: FramePaths,
    fingerprint: str,
    white: WhiteReference,
    calibration: CalibrationConfig,
    masks: MaskConfig,
    *,
    pseudo_rgb_nm: tuple[float, float, float],
    marker_range_nm: tuple[float, float],
) -> FrameNotes:
    """Calibrate a frame; write its cube, its pseudo-RGB picture and its notes.

    Raises:
        InputError: the raw cube cannot be read or the disk is full.
    """
    wavelengths_nm = capture.cube.wavelengths_nm
    reflectance = calibrate(capture, white.spectrum, calibration)
    write_packed_cube(paths.cube, pack(reflectance), wavelengths_nm)
    write_png(paths.flags, np.zeros(reflectance.shape[:2], np.uint8))
    write_png(paths.image, pseudo_rgb(reflectance, wavelengths_nm, pseudo_rgb_nm))
    notes = FrameNotes(
        fingerprint,
        gray_image(reflectance, wavelengths_nm, marker_range_nm),
        foreground_score(reflectance, spectral_bins=masks.spectral_bins, smoothing_px=masks.smoothing_px),
    )
    with atomic_write(paths.notes) as (temporary,):
        np.savez(temporary, fingerprint=notes.fingerprint, gray=notes.gray, score=notes.score)
    return notes


def border_spectrum(
    cube_path: Path, foreground: Bool[np.ndarray, "lines samples"], width_fraction: float = 1 / 32
) -> Float[np.ndarray, "bands"]:
    """Median reflectance spectrum of a packed frame along the image's border, the object left out.

    The border is ``width_fraction`` of the image's shorter side wide, and one pixel at least. An object that fills
    it all leaves nan.
    """
    lines, samples = foreground.shape
    width = max(1, round(width_fraction * min(lines, samples)))
    border = ~foreground
    border[width : lines - width, width : samples - width] = False
    pixels = open_cube(cube_path).memmap()[border]
    if len(pixels) == 0:
        return np.full(pixels.shape[-1], np.nan)
    return np.median(pixels, axis=0) / REFLECTANCE_SCALE
