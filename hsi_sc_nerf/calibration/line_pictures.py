"""Small pictures of a frame, made line by line while its reflectance is at hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.packed.cube import REFLECTANCE_SCALE

# What the lines' values have on top, so that cutting off their decimals rounds them.
_HALF_UNIT = np.float32(0.5 / REFLECTANCE_SCALE)


@dataclass(frozen=True, eq=False)
class PictureBands:
    """Which of the kept bands (by index) the pictures of a frame are made of.

    Attributes:
        rgb: shown as red, green and blue.
        gray: averaged for finding markers.
        bin_width: neighbouring bands that are averaged into a bin; the last bin may have fewer.
    """

    rgb: Int[np.ndarray, "3"]
    gray: Int[np.ndarray, "gray"]
    bin_width: int


class LinePictures:
    """Collects the pictures of a frame.

    Attributes:
        rgb: reflectance in the three bands.
        gray: mean reflectance in the gray bands.
        binned: mean reflectance in the bins.
    """

    def __init__(self, bands: PictureBands, kept: int, lines: int, samples: int) -> None:
        whole_bins, rest = divmod(kept, bands.bin_width)
        self.rgb = np.empty((3, lines, samples), np.float32)
        self.gray = np.empty((lines, samples), np.float32)
        # Line by line in memory, where one line after the other is written.
        by_line = np.empty((lines, whole_bins + (rest > 0), samples), np.float32)
        self.binned = by_line.swapaxes(0, 1)
        self._rgb_bands = bands.rgb
        self._gray_bands = as_slice(bands.gray)
        self._per_gray = np.float32(1.0 / (len(bands.gray) * REFLECTANCE_SCALE))
        self._bin_shape = (whole_bins, bands.bin_width, samples)
        self._in_whole_bins = kept - rest
        self._sums = np.empty((len(self.binned), samples), np.float32)
        widths = np.full((len(self.binned), 1), bands.bin_width)
        widths[whole_bins:] = rest
        self._per_width = (1.0 / (widths * REFLECTANCE_SCALE)).astype(np.float32)

    def line(self, line: int, values: Float[np.ndarray, "kept samples"]) -> None:
        """Take what the pictures need of a line, whose values are packed numbers and a half."""
        self.rgb[:, line] = _reflectance(values[self._rgb_bands])
        gray = self.gray[line]
        np.add.reduce(values[self._gray_bands], axis=0, out=gray)
        gray *= self._per_gray
        gray -= _HALF_UNIT
        whole_bins = self._bin_shape[0]
        binnable = values[: self._in_whole_bins].reshape(self._bin_shape)
        np.add.reduce(binnable, axis=1, out=self._sums[:whole_bins])
        if len(self._sums) > whole_bins:
            np.add.reduce(values[self._in_whole_bins :], axis=0, out=self._sums[-1])
        self._sums *= self._per_width
        np.subtract(self._sums, _HALF_UNIT, out=self.binned[:, line])


def as_slice(indices: Int[np.ndarray, "count"]) -> slice | Int[np.ndarray, "count"]:
    """Neighbouring indices as a slice, which takes a view in place of a copy."""
    neighbours = len(indices) > 0 and np.array_equal(indices, np.arange(indices[0], indices[0] + len(indices)))
    return slice(int(indices[0]), int(indices[0]) + len(indices)) if neighbours else indices


def _reflectance(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return values * np.float32(1.0 / REFLECTANCE_SCALE) - _HALF_UNIT
