"""The work on one frame: calibrate, pack, and keep what later steps need, so that a stopped run can go on.

A frame's cube and picture are written first and its notes last: a frame whose notes are there is finished. Earlier
notes go before the first of its files is replaced, or they would vouch for a cube of other settings.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Num, UInt8, UInt16

from hsi_sc_nerf.calibration.reflectance import FrameCalibration, PictureBands, PixelCounts, pack_counts
from hsi_sc_nerf.capture.envi import Cube, CubeLines, open_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write, write_png
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, unpack, write_packed_cube
from hsi_sc_nerf.processing.masks import MaskConfig, bin_width, brightness, foreground_score
from hsi_sc_nerf.spectra.pseudo_rgb import bands_within, nearest_bands, to_8_bit


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
    """What finding poses and masks, and the report, need of a frame; pictures are upright.

    Attributes:
        fingerprint: of the files and settings that the frame was made from.
        gray: in which markers are looked for.
        score: foreground score (``masks.foreground_score``).
        brightness: mean reflectance (``masks.brightness``).
        tally: how many values were clipped and flagged, by kept band.
    """

    fingerprint: str
    gray: UInt8[np.ndarray, "lines samples"]
    score: Float[np.ndarray, "lines samples"]
    brightness: Float[np.ndarray, "lines samples"]
    tally: PixelCounts


def finished_notes(paths: FramePaths, fingerprint: str) -> FrameNotes | None:
    """The notes of a frame that was finished from the same files with the same settings, or None."""
    try:
        with np.load(paths.notes) as stored:
            tally = PixelCounts(**{f.name: stored[f.name] for f in fields(PixelCounts)})
            notes = FrameNotes(
                str(stored["fingerprint"]), stored["gray"], stored["score"], stored["brightness"], tally
            )
        open_cube(paths.cube)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, InputError):
        return None
    complete = paths.image.is_file() and paths.flags.is_file()
    return notes if complete and notes.fingerprint == fingerprint else None


def process_frame(
    cube: Cube,
    calibration: FrameCalibration,
    paths: FramePaths,
    fingerprint: str,
    masks: MaskConfig,
    *,
    pseudo_rgb_nm: tuple[float, float, float],
    marker_range_nm: tuple[float, float],
    buffer: UInt16[np.ndarray, "values"] | None = None,
) -> FrameNotes:
    """Calibrate a frame's raw cube; write its packed cube, flags, pseudo-RGB picture and notes, all upright.

    Frame after frame may be packed in the same ``buffer`` (``pack_counts``).

    Raises:
        InputError: the raw cube cannot be read or the disk is full.
    """
    wavelengths_nm = cube.wavelengths_nm[calibration.bands]
    widths_nm = None if cube.fwhm_nm is None else cube.fwhm_nm[calibration.bands]
    pictures = PictureBands(
        rgb=nearest_bands(wavelengths_nm, pseudo_rgb_nm),
        gray=bands_within(wavelengths_nm, marker_range_nm),
        bin_width=bin_width(len(wavelengths_nm), masks.spectral_bins),
    )
    with CubeLines(cube) as lines:
        frame = pack_counts(lines, calibration, pictures, buffer)

    def upright(image: Num[np.ndarray, "lines samples *channels"]) -> Num[np.ndarray, "h w *channels"]:
        return np.rot90(image, calibration.quarter_turns)

    paths.notes.unlink(missing_ok=True)
    write_packed_cube(paths.cube, upright(frame.packed), wavelengths_nm, widths_nm)
    write_png(paths.flags, upright(frame.flags))
    write_png(paths.image, upright(to_8_bit(np.moveaxis(frame.rgb, 0, -1))))
    notes = FrameNotes(
        fingerprint,
        upright(to_8_bit(frame.gray)),
        upright(foreground_score(frame.binned, masks.smoothing_px)),
        upright(brightness(frame.binned, masks.smoothing_px)),
        frame.pixel_counts,
    )
    with atomic_write(paths.notes) as (temporary,):
        tally = {f.name: getattr(notes.tally, f.name) for f in fields(PixelCounts)}
        np.savez(
            temporary,
            fingerprint=notes.fingerprint,
            gray=notes.gray,
            score=notes.score,
            brightness=notes.brightness,
            **tally,
        )
    return notes


def border_spectrum(
    cube_path: Path, foreground: Bool[np.ndarray, "lines samples"], width_fraction: float = 1 / 32
) -> Float[np.ndarray, "bands"]:
    """Median reflectance spectrum of a packed frame along the image's border, the object left out.

    The border is ``width_fraction`` of the image's shorter side wide, and one pixel at least. Flagged values do not
    count; a band without any value there (an object that fills the border) is nan.
    """
    lines, samples = foreground.shape
    width = max(1, round(width_fraction * min(lines, samples)))
    border = ~foreground
    border[width : lines - width, width : samples - width] = False
    # In ascending order the flagged values, which are the largest numbers, come last.
    ordered = np.sort(open_cube(cube_path).memmap()[border], axis=0)
    measured = (ordered != FLAGGED).sum(axis=0)
    median = np.full(ordered.shape[1], np.nan)
    some = np.flatnonzero(measured)
    middle = [ordered[(measured[some] - odd) // 2, some] for odd in (0, 1)]
    median[some] = np.mean(middle, axis=0) / REFLECTANCE_SCALE
    return median


def object_spectrum(
    cube_path: Path, foreground: Bool[np.ndarray, "lines samples"], pixels: int = 2000
) -> Float[np.ndarray, "bands"]:
    """Mean spectrum of a packed frame's foreground, from so many of its pixels; nan where there is none."""
    at = np.flatnonzero(foreground)
    chosen = np.unravel_index(at[:: max(1, len(at) // pixels)], foreground.shape)
    reflectance, valid = unpack(open_cube(cube_path).memmap()[chosen])
    measured = valid.sum(axis=0)
    return np.where(measured > 0, reflectance.sum(axis=0) / np.maximum(measured, 1), np.nan)
