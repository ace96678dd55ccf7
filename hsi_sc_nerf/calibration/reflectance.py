"""Raw counts to packed reflectance: steps 6 and 7 of the paper's Algorithm 1, in one pass at the speed of the disk.

A frame is processed line by line, as ``(bands, samples)``, so that a line stays in the processor's cache. Tests and
corrections that a session does not need (saturation, flat field, ...) are skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8, UInt16

from hsi_sc_nerf import paper
from hsi_sc_nerf.capture.envi import CubeLines
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, PixelFlag

_BLOCK_LINES = 8
"""Lines that are stored at a time: rotating single lines would write 400 bytes to each of many places."""
_TRANSPOSED_AS = {1: np.uint8, 2: np.uint16, 4: np.int32, 8: np.float64}
"""Data types that `cv2.transpose` knows, by their size."""
_HALF = np.float32(0.5)
"""Added to the lines' values, so that truncation rounds them."""
_UNIT, _HALF_UNIT = np.float32(1.0 / REFLECTANCE_SCALE), np.float32(0.5 / REFLECTANCE_SCALE)
_LOWEST = np.finfo(np.float32).min
_Test = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """Calibration of one capture: ``reflectance = (counts - dark) * gain / flat``.

    Arrays are in the file's orientation and have all of its bands. A column is a sample of the file; an array with
    one column holds for all samples.

    Attributes:
        dark: counts without light.
        gain: reflectance per count above dark: the panel's reflectance over the white's counts, times the ratio of
            the integration times, over the lamps' drift.
        bands: the bands that are kept.
        bounds: reflectance is clipped to this range.
        flat: illumination of each pixel relative to that of the white spectrum; None for even light.
        saturation_counts: counts from which a reading is saturated; None if nothing saturates.
        dead: dead detector elements; None if there are none.
        ignore_value: counts that stand for "no data"; None if there are none.
        quarter_turns: counter-clockwise turns by 90 degrees (``np.rot90``'s k) that turn the image upright.
    """

    dark: Float[np.ndarray, "columns bands"]
    gain: Float[np.ndarray, "columns bands"]
    bands: Int[np.ndarray, "kept"]
    bounds: tuple[float, float] = paper.REFLECTANCE_BOUNDS
    flat: Float[np.ndarray, "lines samples"] | None = None
    saturation_counts: float | None = None
    dead: Bool[np.ndarray, "samples bands"] | None = None
    ignore_value: float | None = None
    quarter_turns: int = 0


@dataclass(frozen=True, eq=False)
class PictureBands:
    """Indices of the kept bands that the pictures of a frame are made of.

    Attributes:
        rgb: shown as red, green and blue.
        gray: averaged for the detection of markers.
        bin_width: neighbouring bands averaged into a bin; the last bin may have fewer.
    """

    rgb: Int[np.ndarray, "3"]
    gray: Int[np.ndarray, "gray"]
    bin_width: int


@dataclass(frozen=True, eq=False)
class PixelCounts:
    """Numbers of a frame's values that were clipped or flagged, by kept band.

    Each value is counted once, by the first reason that applies: dead, no data, saturated, clipped. A value counts as
    clipped if that changes it by at least half a packed unit.

    Attributes:
        clipped_low: raised to the lower bound.
        clipped_high: lowered to the upper bound.
        saturated: flagged because the reading is saturated.
        dead: flagged because the detector element is dead.
        no_data: flagged because the count is the ignore value or not finite.
    """

    clipped_low: Int[np.ndarray, "kept"]
    clipped_high: Int[np.ndarray, "kept"]
    saturated: Int[np.ndarray, "kept"]
    dead: Int[np.ndarray, "kept"]
    no_data: Int[np.ndarray, "kept"]

    @property
    def flagged(self) -> Int[np.ndarray, "kept"]:
        """Values that are no measurements."""
        return self.saturated + self.dead + self.no_data

    @staticmethod
    def total(of_frames: Iterable[PixelCounts]) -> PixelCounts:
        """The sum over frames (at least one)."""
        columns = zip(*(vars(counts).values() for counts in of_frames), strict=True)
        return PixelCounts(*(np.sum(column, axis=0) for column in columns))


@dataclass(frozen=True, eq=False)
class PackedReflectance:
    """A frame's packed reflectance and pictures of it, in the file's orientation.

    In the pictures, a dead element has the value of the pixel's nearest good band, a saturated one its clipped value,
    and no data, like a pixel without a good band, the lower bound.

    Attributes:
        packed: reflectance times ``REFLECTANCE_SCALE``, or ``FLAGGED``. ``np.rot90(packed, quarter_turns)`` is
            contiguous in memory.
        flags: `PixelFlag`s.
        pixel_counts: numbers of clipped and flagged values.
        rgb: reflectance in three bands.
        gray: mean reflectance over the gray bands.
        binned: mean reflectance in each bin of bands.
    """

    packed: UInt16[np.ndarray, "lines samples kept"]
    flags: UInt8[np.ndarray, "lines samples"]
    pixel_counts: PixelCounts
    rgb: Float[np.ndarray, "3 lines samples"]
    gray: Float[np.ndarray, "lines samples"]
    binned: Float[np.ndarray, "bins lines samples"]


def pack_counts(
    counts: Num[np.ndarray, "lines samples bands"] | CubeLines,
    calibration: FrameCalibration,
    pictures: PictureBands,
    buffer: UInt16[np.ndarray, "values"] | None = None,
) -> PackedReflectance:
    """Calibrate, clip, pack and flag a frame's raw counts, and make pictures of it.

    Args:
        counts: the raw counts; the lines of a BIL file are fastest.
        buffer: memory of at least lines x samples x kept values for the packed numbers, so that several frames can
            share it; allocating takes a considerable part of the time.

    Raises:
        ValueError: the calibration is not finite for a live element, or the illumination is not positive.

    Example:
        >>> with CubeLines(calibration.cubes[0]) as lines:
        ...     frame = pack_counts(lines, calibration.frames[0], pictures)
        >>> reflectance, valid = unpack(frame.packed)
    """
    lines, samples, _ = counts.shape
    kept = len(calibration.bands)
    file_bands = _as_slice(calibration.bands)
    dead, replaced_by = _dead_elements(calibration, samples)
    dead_at = np.flatnonzero(dead)
    scale, offset = _line_constants(calibration, dead)
    flat = calibration.flat
    if flat is not None and not (np.isfinite(flat).all() and (flat > 0.0).all()):
        raise ValueError("the illumination is not positive everywhere")
    per_flat = None if flat is None else np.reciprocal(flat, dtype=np.float32)
    tests = _tests_of_counts(calibration, counts.dtype)
    # Bounds as packed numbers; the values include half a unit, so that truncation rounds them.
    low, high = (round(float(np.clip(b * REFLECTANCE_SCALE, 0, FLAGGED - 1))) for b in calibration.bounds)

    turns = calibration.quarter_turns
    upright_shape = (samples, lines) if turns % 2 else (lines, samples)
    if buffer is None:
        buffer = np.empty(lines * samples * kept, np.uint16)
    packed = np.rot90(buffer[: lines * samples * kept].reshape(*upright_shape, kept), -turns)
    flags = np.tile(np.where(dead.any(axis=0), np.uint8(PixelFlag.DEAD), np.uint8(0)), (lines, 1))
    line_pictures = _LinePictures(pictures, kept, lines, samples)
    counted = {name: np.zeros(kept, np.int64) for name in ("clipped_low", "clipped_high", "saturated", "no_data")}

    def count(name: str, marked: Bool[np.ndarray, "kept samples"]) -> None:
        marked.reshape(-1)[dead_at] = False
        sums = np.asarray(cv2.reduce(marked.view(np.uint8), 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S))
        counted[name] += sums[:, 0].astype(np.int64)

    values = np.empty((kept, samples), np.float32)
    numbers = np.empty((kept, samples), np.uint16)
    # Files that are upright are transposed directly into place.
    block = packed[:1] if turns == 0 else np.empty((_BLOCK_LINES, samples, kept), np.uint16)
    for line in range(lines):
        raw = _band_major(counts[line])
        with np.errstate(over="ignore"):  # doubles beyond float32 are no counts
            np.copyto(values, raw[file_bands], casting="unsafe")
        flagged = None
        for name, flag, test in tests:
            found = test(values)
            if not found.any():
                continue
            if flag == PixelFlag.NO_DATA:
                values[found] = _LOWEST
            if flagged is not None:
                found &= ~flagged
            count(name, found)
            flags[line][found.any(axis=0)] |= np.uint8(flag)
            flagged = found if flagged is None else flagged | found

        cv2.multiply(values, scale, dst=values)
        cv2.add(values, offset, dst=values)
        if per_flat is not None:
            values *= per_flat[line]
            values += _HALF
        smallest, largest, _, _ = cv2.minMaxLoc(values)
        if smallest < low or largest >= high + 1:
            for name, clipped in (("clipped_low", values < low), ("clipped_high", values >= high + 1)):
                count(name, clipped if flagged is None else clipped & ~flagged)
            np.clip(values, low + _HALF, high + _HALF, out=values)
        values.reshape(-1)[dead_at] = values.reshape(-1)[replaced_by]
        line_pictures.add(line, values)

        np.copyto(numbers, values, casting="unsafe")
        if flagged is not None:
            numbers[flagged] = FLAGGED
        numbers.reshape(-1)[dead_at] = FLAGGED
        in_block = line % len(block)
        cv2.transpose(numbers, dst=block[in_block])
        if turns == 0:
            block = packed[line + 1 : line + 2]
        elif in_block == len(block) - 1 or line == lines - 1:
            packed[line - in_block : line + 1] = block[: in_block + 1]

    pixel_counts = PixelCounts(dead=dead.sum(axis=1) * lines, **counted)
    return PackedReflectance(packed, flags, pixel_counts, line_pictures.rgb, line_pictures.gray, line_pictures.binned)


def _dead_elements(
    calibration: FrameCalibration, samples: int
) -> tuple[Bool[np.ndarray, "kept samples"], Int[np.ndarray, "dead"]]:
    """Dead elements of a line, and the flat indices of what replaces them in pictures.

    That is the nearest good band of the same sample, or the element itself if there is none.
    """
    kept = len(calibration.bands)
    dead = np.zeros((kept, samples), bool) if calibration.dead is None else calibration.dead.T[calibration.bands]
    band, sample = np.nonzero(dead)
    index = np.arange(kept)[:, None]
    before = np.maximum.accumulate(np.where(dead, -kept, index), axis=0)[band, sample]
    after = np.minimum.accumulate(np.where(dead, 2 * kept, index)[::-1], axis=0)[::-1][band, sample]
    nearest = np.where(band - before <= after - band, before, after)
    return dead, np.where((nearest < 0) | (nearest >= kept), band, nearest) * samples + sample


def _line_constants(
    calibration: FrameCalibration, dead: Bool[np.ndarray, "kept samples"]
) -> tuple[Float[np.ndarray, "kept samples"], Float[np.ndarray, "kept samples"]]:
    """``scale`` and ``offset`` that turn a line's counts into packed numbers (plus a half without a flat field)."""
    dark, gain = (
        np.broadcast_to(array.T[calibration.bands], dead.shape) for array in (calibration.dark, calibration.gain)
    )
    scale = gain * float(REFLECTANCE_SCALE)
    offset = -dark * scale + (0.5 if calibration.flat is None else 0.0)
    scale[dead] = offset[dead] = 0.0
    if not (np.isfinite(scale).all() and np.isfinite(offset).all()):
        raise ValueError("dark or gain is not finite at an element that is neither dead nor in a band left out")
    return scale.astype(np.float32), offset.astype(np.float32)


def _tests_of_counts(calibration: FrameCalibration, dtype: np.dtype) -> list[tuple[str, PixelFlag, _Test]]:
    """Tests of a frame's counts (as float32); the first that applies counts."""
    tests: list[tuple[str, PixelFlag, _Test]] = []
    if dtype.kind == "f":
        tests.append(("no_data", PixelFlag.NO_DATA, lambda values: ~np.isfinite(values)))
    if calibration.ignore_value is not None:
        with np.errstate(over="ignore"):
            ignored = np.float32(calibration.ignore_value)
        tests.append(("no_data", PixelFlag.NO_DATA, lambda values: values == ignored))
    if calibration.saturation_counts is not None:
        level = np.float32(calibration.saturation_counts)
        tests.append(("saturated", PixelFlag.SATURATED, lambda values: values >= level))
    return tests


def _band_major(line: Num[np.ndarray, "samples bands"]) -> Num[np.ndarray, "bands samples"]:
    """The line with contiguous samples, as in BIL and BSQ files."""
    if line.strides[1] != line.itemsize:
        return line.T
    transposed = cv2.transpose(np.ascontiguousarray(line).view(_TRANSPOSED_AS[line.itemsize]))
    return transposed.view(line.dtype)


class _LinePictures:
    """Collects the pictures of a frame (`PackedReflectance`) line by line."""

    def __init__(self, bands: PictureBands, kept: int, lines: int, samples: int) -> None:
        self._rgb_bands, self._gray_bands = bands.rgb, _as_slice(bands.gray)
        self._whole_bins, rest = divmod(kept, bands.bin_width)
        self._bin_width = bands.bin_width
        self.rgb = np.empty((3, lines, samples), np.float32)
        self.gray = np.empty((lines, samples), np.float32)
        # Contiguous by line, as it is written.
        self.binned = np.empty((lines, self._whole_bins + (rest > 0), samples), np.float32).swapaxes(0, 1)

    def add(self, line: int, values: Float[np.ndarray, "kept samples"]) -> None:
        """Add a line, whose values are packed numbers plus a half."""
        whole, in_whole = self._whole_bins, self._whole_bins * self._bin_width
        gray, rest = values[self._gray_bands], values[in_whole:]
        bins = values[:in_whole].reshape(whole, self._bin_width, -1)
        self.rgb[:, line] = values[self._rgb_bands] * _UNIT - _HALF_UNIT
        self.gray[line] = np.add.reduce(gray, axis=0) * (_UNIT / len(gray)) - _HALF_UNIT
        self.binned[:whole, line] = np.add.reduce(bins, axis=1) * (_UNIT / self._bin_width) - _HALF_UNIT
        if len(rest):
            self.binned[whole, line] = np.add.reduce(rest, axis=0) * (_UNIT / len(rest)) - _HALF_UNIT


def _as_slice(indices: Int[np.ndarray, "count"]) -> slice | Int[np.ndarray, "count"]:
    """Consecutive indices as a slice, which makes a view instead of a copy."""
    consecutive = len(indices) > 0 and np.array_equal(indices, np.arange(indices[0], indices[0] + len(indices)))
    return slice(int(indices[0]), int(indices[0]) + len(indices)) if consecutive else indices
