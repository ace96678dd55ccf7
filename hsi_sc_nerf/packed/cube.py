"""Packed reflectance: 16-bit numbers in BIP order, one of them for "no measurement", and their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt16

from hsi_sc_nerf.capture.envi import write_cube

REFLECTANCE_SCALE = 50_000
"""Packed number of reflectance 1 (the headers' ``reflectance scale factor``)."""
FLAGGED = 65_535
"""Packed number of a value that is no measurement (the headers' ``data ignore value``)."""
LARGEST_REFLECTANCE = (FLAGGED - 1) / REFLECTANCE_SCALE


class PixelFlag(IntFlag):
    """Reasons why bands of a pixel are flagged; a pixel may have several."""

    SATURATED = 1
    DEAD = 2
    NO_DATA = 4


@dataclass(frozen=True, eq=False)
class ReflectanceUncertainty:
    """Variance of a calibrated reflectance R in each band: ``constant + linear * R + quadratic * R^2``.

    The readings of sample and dark give the constant term, the sample's photons the linear one, and the white
    reference the quadratic one. The white's error is common to all pixels of all frames, and the dark's to a detector
    column, so that averaging over pixels does not reduce them. Values near a clipping bound scatter less.
    """

    constant: Float[np.ndarray, "bands"]
    linear: Float[np.ndarray, "bands"]
    quadratic: Float[np.ndarray, "bands"]

    def standard_deviation(self, reflectance: Float[np.ndarray, "*shape bands"]) -> Float[np.ndarray, "*shape bands"]:
        """Standard deviation of a pixel's reflectance; negative reflectance (noise) is taken as 0."""
        lit = np.maximum(reflectance, 0.0)
        return np.sqrt(self.constant + (self.linear + self.quadratic * lit) * lit)


def pack(reflectance: Float[np.ndarray, "*shape"]) -> UInt16[np.ndarray, "*shape"]:
    """Reflectance in [0, ``LARGEST_REFLECTANCE``] as 16-bit numbers, rounded; nan becomes ``FLAGGED``."""
    flagged = np.isnan(reflectance)
    counts = np.rint(np.where(flagged, 0.0, reflectance) * REFLECTANCE_SCALE)
    return np.where(flagged, FLAGGED, np.clip(counts, 0, FLAGGED - 1)).astype(np.uint16)


def unpack(
    counts: UInt16[np.ndarray, "*shape"],
) -> tuple[Float[np.ndarray, "*shape"], Bool[np.ndarray, "*shape"]]:
    """Reflectance (float32, 0 where flagged) of packed numbers, and which of them are measurements.

    Example:
        >>> frame = open_packed(Path("dataset")).frames[0]
        >>> reflectance, valid = unpack(frame.cube()[256])  # one line: (samples, bands)
    """
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
    """Write packed reflectance (`pack`) as a 16-bit BIP ENVI cube, with the bands' widths if they are known.

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
