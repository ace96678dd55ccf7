"""The white reference: steps 1 to 5 of the paper's Algorithm 1, from the counts of a white to its spectrum.

`white_reference` finds the white in an image: the session's white tarp, or a white target inside every frame.
`column_white` takes a white cube that belongs to one capture. The spatial steps use raw counts; dark counts are
subtracted from the mean spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.detector import (
    SOME_LINES,
    Defects,
    dark_columns,
    dark_counts,
    fill_no_data,
    no_data,
    spread_rows,
    unlit_bands,
)
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.morphology import ellipse_close_open, largest_component

Roi = tuple[int, int, int, int]
"""A region of an image as its file holds it: x0, y0, x1, y1 in pixels, x1 and y1 excluded."""
TARP_BRIGHTNESS = 0.5
"""The tarp is the largest region brighter than this fraction of the image's 99th percentile."""
MAX_DEVIATION = 0.5
"""Largest mean deviation of a white's pixels from their mean spectrum (relative)."""
MAX_SATURATED = 0.01
"""A band is bad if a larger fraction of the white's readings is saturated."""
SMOOTHING_MAX_NM = 15.0
"""Largest span of the moving average. The paper's five bands span 12 nm; five broad bands would smooth the lamp's own
spectrum away."""


@dataclass(frozen=True, eq=False)
class White:
    """Counts of a white above dark, in the file's orientation. One column holds for all samples of a line.

    Attributes:
        measured: mean counts above dark before smoothing; nan in bad bands and, with one column for each sample, in
            dead and saturated elements.
        spectrum: mean counts above dark after smoothing.
        pixels: pixels averaged for each column.
        window_bands: bands averaged by smoothing for each band; 0 in bad bands.
        bad_bands: bands in which the white is unlit, saturated, or without a live detector element.
    """

    measured: Float[np.ndarray, "columns bands"]
    spectrum: Float[np.ndarray, "columns bands"]
    pixels: int
    window_bands: Int[np.ndarray, "bands"]
    bad_bands: Bool[np.ndarray, "bands"]

    def mean_spectrum(self) -> Float[np.ndarray, "bands"]:
        """Mean of ``spectrum`` over the columns that have one; nan in bad bands."""
        return mean_over_columns(self.spectrum)


@dataclass(frozen=True, eq=False)
class WhiteReference(White):
    """A white that was found in an image.

    Attributes:
        roi: the coarse region.
        deviation: D(x, y) inside the coarse region (relative, not negative).
        mask: the refined region inside the coarse one.
        kernel_px: diameter of the ellipse that closed and opened the mask.
    """

    roi: Roi
    deviation: Float[np.ndarray, "y x"]
    mask: Bool[np.ndarray, "y x"]
    kernel_px: int

    def region(self, shape: tuple[int, ...]) -> Bool[np.ndarray, "lines samples"]:
        """The refined region in an image of that shape."""
        x0, y0, x1, y1 = self.roi
        image = np.zeros(shape, bool)
        image[y0:y1, x0:x1] = self.mask
        return image


def white_reference(capture: Capture, roi: Roi | None = None, defects: Defects | None = None) -> WhiteReference:
    """Steps 1 to 5 on an image that shows the white; the spectrum has one column.

    Args:
        roi: region of the white; None finds it by its brightness (step 1). Nothing outside of it is read.

    Raises:
        InputError: the region is not inside the image, no part of it is evenly bright, or the white is not lit in
            half of the bands.

    Example:
        >>> session = open_session(Path("captures"))
        >>> white = white_reference(session.white)
        >>> white.roi, white.pixels, white.spectrum.shape  # (1, bands)
    """
    cube = capture.cube
    _, samples, bands = cube.shape
    x0, y0, x1, y1 = roi = roi or tarp_roi(capture, defects)
    require_inside(roi, cube)
    counts = np.ascontiguousarray(cube.memmap()[y0:y1, x0:x1], dtype=cube.dtype.newbyteorder("="))
    dead = dead_elements(defects, samples, bands)[x0:x1]
    deviation = deviation_map(fill_no_data(counts, cube.ignore_value), dead)
    kernel_px = max(paper.WHITE_MORPHOLOGY_MIN_PX, min(counts.shape[:2]) // paper.WHITE_MORPHOLOGY_FRACTION)
    with np.errstate(invalid="ignore"):  # a white without counts deviates infinitely
        mask = white_mask(deviation, percentile=paper.WHITE_PERCENTILE, kernel_px=kernel_px)
    if not mask.any() or not deviation[mask].mean() <= MAX_DEVIATION:
        raise InputError(
            f"{cube.header_path}: the tarp has no usable region, because no part of it is evenly bright; take it "
            "again or give its place with --calibration.roi."
        )
    readings = ElementSums.of(counts, mask, dead, cube.ignore_value, defects)
    dark = dark_columns(dark_counts(capture.dark), samples, bands)
    measured = readings.mean_spectrum(dark if len(dark) == 1 else dark[x0:x1])[None]
    bad_bands = _bad_bands(cube, measured, readings, defects)
    measured = np.where(bad_bands, np.nan, measured)
    spectrum, window_bands = smooth_spectrum(measured, cube.wavelengths_nm)
    return WhiteReference(
        measured,
        spectrum,
        pixels=int(mask.sum()),
        window_bands=window_bands.max(axis=0),
        bad_bands=bad_bands,
        roi=(x0, y0, x1, y1),
        deviation=deviation,
        mask=mask,
        kernel_px=kernel_px,
    )


def require_inside(roi: Roi, cube: Cube) -> None:
    """Raise InputError where a region is empty or reaches beyond an image."""
    (x0, y0, x1, y1), (lines, samples) = roi, cube.shape[:2]
    if not (0 <= x0 < x1 <= samples and 0 <= y0 < y1 <= lines):
        raise InputError(
            f"{cube.header_path}: the given region x0 y0 x1 y1 = {tuple(roi)} is not inside its {samples} x {lines} "
            "pixels; correct --calibration.roi."
        )


def column_white(white: Cube, dark: Cube | None, samples: int, defects: Defects | None = None) -> White:
    """Steps 4 and 5 on a white cube (WHITEREF: lines of nothing but white), for each sample of the detector.

    Args:
        samples: samples of the frames. A white of another width cannot be matched by sample and gives one column.

    Raises:
        InputError: the white is not lit in half of the bands.
    """
    counts = white.read()
    width, bands = counts.shape[1:]
    everywhere = np.ones(counts.shape[:2], bool)
    readings = ElementSums.of(counts, everywhere, dead_elements(defects, width, bands), white.ignore_value, defects)
    dark_spectra = dark_columns(dark_counts(dark), width, bands)
    if width == samples:
        with np.errstate(invalid="ignore"):
            measured = readings.sums / readings.numbers - dark_spectra
        pixels = len(counts)
    else:
        measured, pixels = readings.mean_spectrum(dark_spectra)[None], everywhere.size
    bad_bands = _bad_bands(white, measured, readings, defects)
    if width == samples:  # a column may be saturated in a band of which it is a small part
        measured[readings.saturated > MAX_SATURATED * readings.numbers] = np.nan
    measured = np.where(bad_bands | ~(measured > 0.0), np.nan, measured)
    spectrum, window_bands = smooth_spectrum(measured, white.wavelengths_nm)
    return White(measured, spectrum, pixels, window_bands.max(axis=0), bad_bands)


def tarp_roi(capture: Capture, defects: Defects | None = None) -> Roi:
    """Step 1: region of the tarp, by the mean counts of live elements with data.

    Raises:
        InputError: the image is dark.
    """
    cube = capture.cube
    live = ~dead_elements(defects, *cube.shape[1:]) & cube.good_bands
    brightness = []
    for line in cube.memmap():
        missing = no_data(line, cube.ignore_value)
        used = live if missing is None else live & ~missing
        # A sample without any usable reading is dark.
        brightness.append(np.where(used, line, 0).sum(axis=-1, dtype=np.float64) / np.maximum(used.sum(axis=-1), 1))
    y, x = np.nonzero(bright_region(np.stack(brightness)))
    if not len(y):
        raise InputError(
            f"{cube.header_path}: the tarp has no usable region, because the image is dark; take it again."
        )
    return int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1


def tarp_region(
    cube: Cube, brightness: Float[np.ndarray, "rows samples"], roi: Roi | None
) -> Bool[np.ndarray, "rows samples"]:
    """Where some lines of a tarp's image (`some_lines`) show it: in a given region, or in the largest bright one."""
    if roi is not None:
        rows, columns = spread_rows(cube.shape[0], SOME_LINES), np.arange(cube.shape[1])
        inside = np.outer((rows >= roi[1]) & (rows < roi[3]), (columns >= roi[0]) & (columns < roi[2]))
        if inside.any():
            return inside
    return bright_region(brightness)


def bright_region(brightness: Num[np.ndarray, "lines samples"]) -> Bool[np.ndarray, "lines samples"]:
    """The largest bright region of an image, which a tarp is in its own; empty if nothing is brighter than zero."""
    reference = np.percentile(brightness, 99.0)
    return largest_component((brightness >= TARP_BRIGHTNESS * reference) & (reference > 0.0))


def deviation_map(
    white: Num[np.ndarray, "y x bands"], dead: Bool[np.ndarray, "x bands"] | None = None
) -> Float[np.ndarray, "y x"]:
    """Step 2: D(x, y), the mean over bands of |I - mu| / mu, with mu the mean spectrum of the region.

    This is the mean of ratios, as printed (the released code divides means). Dead elements and bands without counts
    are left out; without any counts D is infinite.
    """
    live = np.ones(white.shape[1:], bool) if dead is None else ~dead
    with np.errstate(invalid="ignore"):
        mean = white.sum(axis=0, dtype=np.float64).sum(axis=0, where=live) / (len(white) * live.sum(axis=0))
    lit = mean > 0.0
    number = live[:, lit].sum(axis=1)
    if not number.all():
        return np.full(white.shape[:2], np.inf)
    # Line by line: the ratios of a whole tarp would take gigabytes.
    return np.stack(
        [np.abs(line[:, lit] / mean[lit] - 1.0).sum(axis=1, where=live[:, lit]) / number for line in white]
    )


def white_mask(deviation: Float[np.ndarray, "y x"], *, percentile: float, kernel_px: int) -> Bool[np.ndarray, "y x"]:
    """Step 3: pixels up to the percentile of D; closing, opening, the largest connected component."""
    kept = deviation <= np.percentile(deviation, percentile)
    return largest_component(ellipse_close_open(kept, close_px=kernel_px, open_px=kernel_px))


@dataclass(frozen=True, eq=False)
class ElementSums:
    """Sums over the readings of each detector element: of the counts, of the readings and of the saturated ones."""

    sums: Float[np.ndarray, "x bands"]
    numbers: Int[np.ndarray, "x bands"]
    saturated: Int[np.ndarray, "x bands"]

    @staticmethod
    def of(
        white: Num[np.ndarray, "y x bands"],
        mask: Bool[np.ndarray, "y x"],
        dead: Bool[np.ndarray, "x bands"],
        ignore_value: float | None,
        defects: Defects | None,
    ) -> ElementSums:
        """Sum inside the mask, without dead elements and readings that are no data."""
        sums = np.zeros(white.shape[1:])
        numbers, saturated = np.zeros((2, *white.shape[1:]), np.int64)
        level = np.inf if defects is None or defects.saturation_counts is None else defects.saturation_counts
        for line, kept in zip(white, mask, strict=True):
            missing = no_data(line, ignore_value)
            valid = kept[:, None] & ~dead if missing is None else kept[:, None] & ~dead & ~missing
            np.add(sums, line, out=sums, where=valid)
            numbers += valid
            saturated += valid & (line >= level)
        return ElementSums(sums, numbers, saturated)

    def mean_spectrum(self, dark: Float[np.ndarray, "dark_columns bands"]) -> Float[np.ndarray, "bands"]:
        """Step 4: mean of all readings above dark; nan in a band without any reading."""
        with np.errstate(invalid="ignore"):
            return (self.sums - self.numbers * dark).sum(axis=0) / self.numbers.sum(axis=0)


def smooth_spectrum(
    spectrum: Float[np.ndarray, "*columns bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    window: int = paper.WHITE_SMOOTHING_BANDS,
    max_nm: float = SMOOTHING_MAX_NM,
) -> tuple[Float[np.ndarray, "*columns bands"], Int[np.ndarray, "*columns bands"]]:
    """Step 5: moving average over ``window`` bands (odd), and how many bands were averaged for each.

    The window shrinks symmetrically towards the ends, and until its outermost bands are at most ``max_nm`` apart, so
    that constant and linear spectra are unchanged in every band. A nan band stays nan and excludes its mirror image
    from the window.
    """
    total = np.array(spectrum, dtype=np.float64)
    averaged = np.isfinite(total).astype(np.int64)
    for reach in range(1, (min(window, total.shape[-1]) - 1) // 2 + 1):
        middle = slice(reach, total.shape[-1] - reach)
        pair = spectrum[..., : -2 * reach] + spectrum[..., 2 * reach :]
        span_nm = np.abs(wavelengths_nm[2 * reach :] - wavelengths_nm[: -2 * reach])
        usable = np.isfinite(pair) & np.isfinite(total[..., middle]) & (span_nm <= max_nm)
        total[..., middle] += np.where(usable, pair, 0.0)
        averaged[..., middle] += 2 * usable
    return total / np.maximum(averaged, 1), averaged


def mean_over_columns(spectra: Float[np.ndarray, "columns bands"]) -> Float[np.ndarray, "bands"]:
    """Mean over the columns that are not nan; nan if all are."""
    known = np.isfinite(spectra)
    with np.errstate(invalid="ignore"):
        return np.where(known, spectra, 0.0).sum(axis=0) / known.sum(axis=0)


def dead_elements(defects: Defects | None, samples: int, bands: int) -> Bool[np.ndarray, "samples bands"]:
    """The dead elements and those of bad bands; none if the defects are unknown or of another detector."""
    if defects is None or defects.dead.shape != (samples, bands):
        return np.zeros((samples, bands), bool)
    return defects.dead | defects.bad_bands


def _bad_bands(
    cube: Cube, measured: Float[np.ndarray, "columns bands"], readings: ElementSums, defects: Defects | None
) -> Bool[np.ndarray, "bands"]:
    """Bands in which the white measures nothing.

    Raises:
        InputError: more than half of the bands are bad.
    """
    bad = unlit_bands(measured)
    bad |= readings.saturated.sum(axis=0) > MAX_SATURATED * readings.numbers.sum(axis=0)
    if defects is not None:
        bad |= defects.bad_bands
    if 2 * np.count_nonzero(bad) > len(bad):
        raise InputError(
            f"{cube.header_path}: the white can be used in {np.count_nonzero(~bad)} of its {len(bad)} bands only, "
            "because in the others it is not above the dark counts, saturated or marked as bad; take it again with "
            "another integration time."
        )
    return bad
