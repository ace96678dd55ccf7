"""Steps 6 and 7 of the paper's Algorithm 1, at the speed of the disk: raw counts to packed reflectance in one pass.

A frame is worked on line by line, as ``(bands, samples)``, so that all of a line happens while the processor has it
at hand. What a session does not have (no saturation level, no flat field, ...) is not computed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8, UInt16

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.line_pictures import LinePictures, PictureBands, as_slice
from hsi_sc_nerf.calibration.pixel_counts import Counter, Tally
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, PixelFlag

# Lines that are stored at a time: an upright copy of single lines would write 400 bytes here and 400 there.
_BLOCK_LINES = 8
# What `cv2.transpose` moves in place of numbers of the same size.
_MOVED_AS = {1: np.uint8, 2: np.uint16, 4: np.int32, 8: np.float64}
_HALF = np.float32(0.5)
_LEAST = np.finfo(np.float32).min
_Test = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """What turns the counts of one capture into reflectance, in the file's own orientation and in all its bands.

    ``reflectance = (counts - dark) * gain / flat``. A column is a sample of the file, an element of the detector's
    line; arrays with one column hold for all of them.

    Attributes:
        dark: counts without light.
        gain: reflectance a count above dark: the panel's reflectance over the white's counts, times the ratio of the
            integration times, over the lamps' drift.
        bands: which of the file's bands are kept.
        bounds: reflectance is clipped to these.
        flat: illumination of each pixel over that of the white spectrum; None where it is taken for even.
        saturation_counts: counts from which a reading is saturated; None where nothing is.
        dead: detector elements that do not follow the light; None where all do.
        ignore_value: counts that stand for "no data"; None where all counts are data.
        quarter_turns: counter-clockwise turns by 90 degrees (``np.rot90``'s k) that set the file's image upright.
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
class PackedReflectance:
    """A frame's reflectance and what was seen on the way, in the orientation of the file.

    In the pictures a dead element has the value of the pixel's nearest good band, a saturated one its clipped value
    and what remains (no data, a pixel without any good band) the lower bound: nothing of `FLAGGED` is in them.

    Attributes:
        packed: reflectance times ``REFLECTANCE_SCALE``, ``FLAGGED`` where there is none. Its memory lies upright:
            ``np.rot90(packed, quarter_turns)`` is contiguous.
        flags: `PixelFlag`s.
        tally: of clipped and flagged values.
        rgb: reflectance in three bands.
        gray: mean reflectance in the gray bands.
        binned: mean reflectance in the bins.
    """

    packed: UInt16[np.ndarray, "lines samples kept"]
    flags: UInt8[np.ndarray, "lines samples"]
    tally: Tally
    rgb: Float[np.ndarray, "3 lines samples"]
    gray: Float[np.ndarray, "lines samples"]
    binned: Float[np.ndarray, "bins lines samples"]


class Lines(Protocol):
    """Raw counts, a line ``(samples, bands)`` at a time: an array, or a file that is read as it goes."""

    shape: tuple[int, int, int]
    dtype: np.dtype

    def __getitem__(self, line: int) -> Num[np.ndarray, "samples bands"]: ...


def pack_counts(
    counts: Lines,
    calibration: FrameCalibration,
    pictures: PictureBands,
    buffer: UInt16[np.ndarray, "values"] | None = None,
) -> PackedReflectance:
    """Reflectance of a frame's raw counts, clipped, packed and flagged, and pictures of it.

    Fastest for the lines of a BIL file. The packed numbers lie in ``buffer``, if one is given, of at least as many
    numbers: fresh memory takes a good part of the time.

    Raises:
        ValueError: the calibration is not finite where it is needed, or the illumination not positive.
    """
    lines, samples, _ = counts.shape
    kept = len(calibration.bands)
    file_bands = as_slice(calibration.bands)
    dead = _DeadElements.of(calibration, samples)
    any_dead = len(dead.at) > 0
    scale, offset = _line_constants(calibration, samples)
    per_flat = None if calibration.flat is None else _reciprocal(calibration.flat)
    tests = _tests_of_counts(calibration, counts.dtype)
    # Bounds as packed numbers. Values have half a unit added, so that cutting off their decimals rounds them.
    low, high = (round(float(np.clip(b * REFLECTANCE_SCALE, 0, FLAGGED - 1))) for b in calibration.bounds)

    turns = calibration.quarter_turns
    upright_shape = (samples, lines) if turns % 2 else (lines, samples)
    if buffer is None:
        buffer = np.empty(lines * samples * kept, np.uint16)
    packed = np.rot90(buffer[: lines * samples * kept].reshape(*upright_shape, kept), -turns)
    flags = np.zeros((lines, samples), np.uint8)
    flags |= dead.pixel_flags
    draw = LinePictures(pictures, kept, lines, samples)
    counters = {name: Counter(kept, samples) for name in ("clipped_low", "clipped_high", "saturated", "no_data")}

    values = np.empty((kept, samples), np.float32)
    numbers = np.empty((kept, samples), np.uint16)
    # What lies upright in the file is transposed to its place at once.
    block = packed[:1] if turns == 0 else np.empty((_BLOCK_LINES, samples, kept), np.uint16)
    for line in range(lines):
        raw = _band_major(counts[line])
        with np.errstate(over="ignore"):  # a double that no float32 holds is no count
            np.copyto(values, raw[file_bands], casting="unsafe")
        flagged = None
        for name, flag, test in tests:
            found = test(values)
            if not found.any():
                continue
            if flag == PixelFlag.NO_DATA:
                values[found] = _LEAST
            found.reshape(-1)[dead.at] = False
            if flagged is not None:
                found &= ~flagged
            counters[name].add(found)
            flags[line][found.any(axis=0)] |= np.uint8(flag)
            flagged = found if flagged is None else flagged | found

        cv2.multiply(values, scale, dst=values)
        cv2.add(values, offset, dst=values)
        if per_flat is not None:
            values *= per_flat[line]
            values += _HALF
        least, most, _, _ = cv2.minMaxLoc(values)
        if least < low or most >= high + 1:
            for name, clipped in (("clipped_low", values < low), ("clipped_high", values >= high + 1)):
                counters[name].add(clipped if flagged is None else clipped & ~flagged)
            np.clip(values, low + _HALF, high + _HALF, out=values)
        if any_dead:
            values.reshape(-1)[dead.at] = values.reshape(-1)[dead.replaced_by]
        draw.line(line, values)

        np.copyto(numbers, values, casting="unsafe")
        if flagged is not None:
            numbers[flagged] = FLAGGED
        if any_dead:
            numbers.reshape(-1)[dead.at] = FLAGGED
        in_block = line % len(block)
        cv2.transpose(numbers, dst=block[in_block])
        if turns == 0:
            block = packed[line + 1 : line + 2]
        elif in_block == len(block) - 1 or line == lines - 1:
            packed[line - in_block : line + 1] = block[: in_block + 1]

    tally = Tally(
        dead=dead.per_band * lines, **{name: counter.by_band(dead.at) for name, counter in counters.items()}
    )
    return PackedReflectance(packed, flags, tally, draw.rgb, draw.gray, draw.binned)


@dataclass(frozen=True, eq=False)
class _DeadElements:
    """Dead elements of a line ``(kept, samples)``: where they are (flat), what takes their place, how many a band."""

    at: Int[np.ndarray, "dead"]
    replaced_by: Int[np.ndarray, "dead"]
    per_band: Int[np.ndarray, "kept"]
    pixel_flags: UInt8[np.ndarray, "samples"]

    @staticmethod
    def of(calibration: FrameCalibration, samples: int) -> _DeadElements:
        """The nearest good band of the same sample takes a dead element's place; without any good band, itself."""
        kept = len(calibration.bands)
        dead = np.zeros((kept, samples), bool) if calibration.dead is None else calibration.dead.T[calibration.bands]
        band, sample = np.nonzero(dead)
        index = np.arange(kept)[:, None]
        before = np.maximum.accumulate(np.where(dead, -kept, index), axis=0)[band, sample]
        after = np.minimum.accumulate(np.where(dead, 2 * kept, index)[::-1], axis=0)[::-1][band, sample]
        nearest = np.where(band - before <= after - band, before, after)
        replaced_by = np.where((nearest < 0) | (nearest >= kept), band, nearest) * samples + sample
        flags = np.where(dead.any(axis=0), np.uint8(PixelFlag.DEAD), np.uint8(0))
        return _DeadElements(band * samples + sample, replaced_by, dead.sum(axis=1), flags)


def _line_constants(
    calibration: FrameCalibration, samples: int
) -> tuple[Float[np.ndarray, "kept samples"], Float[np.ndarray, "kept samples"]]:
    """``scale`` and ``offset`` that turn a line's counts into packed numbers (and a half, where there is no flat)."""
    shape = (len(calibration.bands), samples)
    dark, gain = (
        np.broadcast_to(array.T[calibration.bands], shape) for array in (calibration.dark, calibration.gain)
    )
    scale = gain * float(REFLECTANCE_SCALE)
    offset = -dark * scale + (0.5 if calibration.flat is None else 0.0)
    if calibration.dead is not None:
        dead = calibration.dead.T[calibration.bands]
        scale[dead] = 0.0
        offset[dead] = 0.0
    if not (np.isfinite(scale).all() and np.isfinite(offset).all()):
        raise ValueError("dark or gain is not finite at an element that is neither dead nor in a band left out")
    return scale.astype(np.float32), offset.astype(np.float32)


def _reciprocal(flat: Float[np.ndarray, "lines samples"]) -> Float[np.ndarray, "lines samples"]:
    if not (np.isfinite(flat).all() and (flat > 0.0).all()):
        raise ValueError("the illumination is not positive everywhere")
    return np.reciprocal(flat, dtype=np.float32)


def _tests_of_counts(calibration: FrameCalibration, dtype: np.dtype) -> list[tuple[str, PixelFlag, _Test]]:
    """What this frame's counts (as float32) have to be tested for; the first that holds counts."""
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
    """The line with neighbouring samples beside each other, as they are in BIL and BSQ files."""
    if line.strides[1] != line.itemsize:
        return line.T
    moved = cv2.transpose(np.ascontiguousarray(line).view(_MOVED_AS[line.itemsize]))
    return moved.view(line.dtype)
