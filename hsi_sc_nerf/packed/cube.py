"""Packed reflectance: 16-bit numbers in BIP order, one of which says that there is no measurement."""

from __future__ import annotations

from enum import IntFlag
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt16

from hsi_sc_nerf.capture.envi import write_cube

# Reflectance 1 in the packed cubes' uint16, as their headers say ("reflectance scale factor").
REFLECTANCE_SCALE = 50_000
# A value that is no measurement, as their headers say ("data ignore value").
FLAGGED = 65_535
LARGEST_REFLECTANCE = (FLAGGED - 1) / REFLECTANCE_SCALE


class PixelFlag(IntFlag):
    """Why some band of a pixel is flagged; a pixel may have several."""

    SATURATED = 1
    DEAD = 2
    NO_DATA = 4


def pack(reflectance: Float[np.ndarray, "*shape"]) -> UInt16[np.ndarray, "*shape"]:
    """Reflectance in [0, ``LARGEST_REFLECTANCE``] as 16-bit numbers, rounded; nan becomes ``FLAGGED``."""
    flagged = np.isnan(reflectance)
    counts = np.rint(np.where(flagged, 0.0, reflectance) * REFLECTANCE_SCALE)
    return np.where(flagged, FLAGGED, np.clip(counts, 0, FLAGGED - 1)).astype(np.uint16)


def unpack(
    counts: UInt16[np.ndarray, "*shape"],
) -> tuple[Float[np.ndarray, "*shape"], Bool[np.ndarray, "*shape"]]:
    """Reflectance (float32, 0 where flagged) of packed numbers, and which of them are measurements."""
    valid = np.not_equal(counts, FLAGGED)
    reflectance = unpack_unflagged(counts)
    reflectance *= valid
    return reflectance, valid


def unpack_unflagged(counts: UInt16[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Reflectance (float32) of packed numbers that are all measurements."""
    reflectance = np.array(counts, dtype=np.float32)
    reflectance /= REFLECTANCE_SCALE
    return reflectance


def write_packed_cube(
    header_path: Path,
    counts: UInt16[np.ndarray, "lines samples bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    fwhm_nm: Float[np.ndarray, "bands"] | None = None,
) -> None:
    """Write packed reflectance (`pack`) as a 16-bit BIP ENVI cube; the header gets the bands' widths, if known.

    Raises:
        InputError: the operating system refused to write.
    """
    widths = {} if fwhm_nm is None else {"fwhm": [float(width) for width in fwhm_nm]}
    write_cube(
        header_path,
        counts,
        wavelengths_nm=wavelengths_nm,
        interleave="bip",
        data_suffix=".bip",
        extra_header={"reflectance scale factor": REFLECTANCE_SCALE, "data ignore value": FLAGGED, **widths},
    )
