"""What reflectance 1 counts, from a white: steps 1 to 5 of the paper's Algorithm 1 (`white_steps`).

Three sources give the same kind of result: the session's white tarp (`white_reference`, the paper's), a white target
inside every frame (`target_white`), and a white cube that belongs to one capture (`column_white`).

The spatial steps (ROI, deviation, mask) use the counts as they are; dark counts, where there is a dark cube, are
taken off the mean spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.calibration.config import CalibrationConfig
from hsi_sc_nerf.calibration.dark import dark_columns
from hsi_sc_nerf.calibration.defects import Defects, unlit_bands
from hsi_sc_nerf.calibration.no_data import filled, no_data
from hsi_sc_nerf.calibration.white_steps import (
    ColumnSums,
    column_sums,
    deviation_map,
    find_coarse_roi,
    mean_over_columns,
    mean_spectrum,
    smooth_spectrum,
    white_mask,
)
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Capture
from hsi_sc_nerf.errors import InputError


@dataclass(frozen=True, eq=False)
class White:
    """What a white counts above dark, in the file's own orientation. One column holds for all samples of a line.

    Attributes:
        measured: mean counts of the white, dark counts taken off, before smoothing; nan where there is none, which is
            in bad bands and, where the columns are the detector's, in its dead elements.
        spectrum: the same after smoothing.
        dark: mean counts without light.
        pixels: how many pixels were averaged for each column.
        window_bands: how many bands smoothing averaged for each band; 0 in bad bands.
        bad_bands: bands in which the white is not lit, saturated, or has no living detector element.
    """

    measured: Float[np.ndarray, "columns bands"]
    spectrum: Float[np.ndarray, "columns bands"]
    dark: Float[np.ndarray, "dark_columns bands"]
    pixels: int
    window_bands: Int[np.ndarray, "bands"]
    bad_bands: Bool[np.ndarray, "bands"]

    def mean_spectrum(self) -> Float[np.ndarray, "bands"]:
        """Mean of ``spectrum`` over the columns that have one; nan in bad bands."""
        return mean_over_columns(self.spectrum)


@dataclass(frozen=True, eq=False)
class WhiteReference(White):
    """A white that was found in an image, and how.

    Attributes:
        roi: x0, y0, x1, y1 of the coarse region, pixels.
        deviation: D(x, y) inside the coarse region (relative, not negative).
        mask: the refined region inside the coarse one.
        percentile: of D that was kept.
        kernel_px: diameter of the ellipse that closed and opened the mask.
    """

    roi: tuple[int, int, int, int]
    deviation: Float[np.ndarray, "y x"]
    mask: Bool[np.ndarray, "y x"]
    percentile: float
    kernel_px: int


def white_reference(capture: Capture, config: CalibrationConfig, defects: Defects | None = None) -> WhiteReference:
    """Steps 1 to 5 on the capture of the white tarp, whose spectrum is one for the whole image (one column).

    Raises:
        InputError: a ROI outside the image, a tarp with no usable region, or a white that is not lit in half of the
            bands.
    """
    return _white_in(capture, config.roi or tarp_roi(capture, config, defects), config, defects)


def tarp_roi(
    capture: Capture, config: CalibrationConfig, defects: Defects | None = None
) -> tuple[int, int, int, int]:
    """Step 1: where the tarp is in its image (x0, y0, x1, y1), by the brightness of what is neither dead nor no data.

    Raises:
        InputError: the image is dark.
    """
    cube = capture.cube
    live = ~_dead(defects, *cube.shape[1:])
    brightness = []
    for line in cube.memmap():
        missing = no_data(line, cube.ignore_value)
        used = live if missing is None else live & ~missing
        # A sample of which nothing is used is dark.
        brightness.append(np.where(used, line, 0).sum(axis=-1, dtype=np.float64) / np.maximum(used.sum(axis=-1), 1))
    roi = find_coarse_roi(np.stack(brightness), config.roi_brightness)
    if roi is None:
        raise InputError(
            f"{cube.header_path}: the tarp has no usable region, because the image is dark; take it again."
        )
    return roi


def target_white(frame: Capture, config: CalibrationConfig, defects: Defects | None = None) -> WhiteReference:
    """Steps 2 to 5 on the white target inside a frame, at ``config.roi``; only that region is read.

    Raises:
        InputError: no ROI given, or as `white_reference`.
    """
    if config.roi is None:
        raise InputError(
            f"{frame.cube.header_path}: where the white target is in the frames is not known; give its place with "
            "--calibration.roi."
        )
    return _white_in(frame, config.roi, config, defects)


def column_white(
    white: Cube, dark: Cube | None, samples: int, config: CalibrationConfig, defects: Defects | None = None
) -> White:
    """The spectrum of a white cube (WHITEREF: a few lines of nothing but white), for each column of the detector.

    Args:
        white: counts of the white.
        dark: counts without light that belong to it.
        samples: of the frames. A white of another width cannot be matched column by column and gives one spectrum.
        config: settings.
        defects: of the detector, found before.

    Raises:
        InputError: a white that is not lit in half of the bands.
    """
    counts = white.read()
    width, bands = counts.shape[1:]
    columns = column_sums(
        counts,
        np.ones(counts.shape[:2], bool),
        ignore_value=white.ignore_value,
        saturation_counts=None if defects is None else defects.saturation_counts,
    ).without(_dead(defects, width, bands))
    dark_spectra = dark_columns(None if dark is None else dark.read(), width, bands)
    if width == samples:
        with np.errstate(invalid="ignore"):
            measured = columns.sums / columns.numbers - dark_spectra
        pixels = len(counts)
    else:
        measured, pixels = mean_spectrum(columns, dark_spectra)[None], len(counts) * width
        dark_spectra = dark_spectra.mean(axis=0, keepdims=True)
    bad_bands = _bad_bands(white, measured, columns, config, defects)
    measured = np.where(bad_bands | ~(measured > 0.0), np.nan, measured)
    spectrum, window_bands = _smoothed(measured, white, config)
    return White(measured, spectrum, dark_spectra, pixels, window_bands, bad_bands)


def _white_in(
    capture: Capture, roi: tuple[int, int, int, int], config: CalibrationConfig, defects: Defects | None
) -> WhiteReference:
    """Steps 2 to 5 in a coarse region."""
    cube = capture.cube
    lines, samples, bands = cube.shape
    x0, y0, x1, y1 = roi
    if not (0 <= x0 < x1 <= samples and 0 <= y0 < y1 <= lines):
        raise InputError(
            f"{cube.header_path}: the given region x0 y0 x1 y1 = {tuple(roi)} is not inside its {samples} x {lines} "
            "pixels; correct --calibration.roi."
        )
    inside = np.ascontiguousarray(cube.memmap()[y0:y1, x0:x1], dtype=cube.dtype.newbyteorder("="))
    dead = _dead(defects, samples, bands)[x0:x1]
    deviation = deviation_map(filled(inside, cube.ignore_value), dead)
    kernel_px = max(config.morphology_min_px, min(inside.shape[:2]) // config.morphology_fraction)
    mask = white_mask(deviation, percentile=config.percentile, kernel_px=kernel_px)
    if not mask.any() or not deviation[mask].mean() <= config.max_deviation:
        raise InputError(
            f"{cube.header_path}: the tarp has no usable region, because no part of it is evenly bright; take it "
            "again or give its place with --calibration.roi."
        )
    columns = column_sums(
        inside,
        mask,
        ignore_value=cube.ignore_value,
        saturation_counts=None if defects is None else defects.saturation_counts,
    ).without(dead)
    dark = dark_columns(None if capture.dark is None else capture.dark.read(), samples, bands)
    measured = mean_spectrum(columns, dark if len(dark) == 1 else dark[x0:x1])[None]
    bad_bands = _bad_bands(cube, measured, columns, config, defects)
    measured = np.where(bad_bands, np.nan, measured)
    spectrum, window_bands = _smoothed(measured, cube, config)
    return WhiteReference(
        measured,
        spectrum,
        dark,
        int(mask.sum()),
        window_bands,
        bad_bands,
        roi=(x0, y0, x1, y1),
        deviation=deviation,
        mask=mask,
        percentile=config.percentile,
        kernel_px=kernel_px,
    )


def _dead(defects: Defects | None, samples: int, bands: int) -> Bool[np.ndarray, "samples bands"]:
    """The dead elements; none where the defects are not known, or are those of another detector."""
    if defects is None or defects.dead.shape != (samples, bands):
        return np.zeros((samples, bands), bool)
    return defects.dead


def _bad_bands(
    cube: Cube,
    measured: Float[np.ndarray, "columns bands"],
    columns: ColumnSums,
    config: CalibrationConfig,
    defects: Defects | None,
) -> Bool[np.ndarray, "bands"]:
    """Bands in which the white says nothing.

    Raises:
        InputError: half of the bands or more.
    """
    bad = unlit_bands(measured, config.min_light)
    bad |= columns.saturated.sum(axis=0) > config.max_saturated * columns.numbers.sum(axis=0)
    if defects is not None:
        bad |= defects.bad_bands
    if 2 * np.count_nonzero(bad) > len(bad):
        raise InputError(
            f"{cube.header_path}: the white can be used in {np.count_nonzero(~bad)} of its {len(bad)} bands only, "
            "because in the others it is not above the dark counts, saturated or marked as bad; take it again with "
            "another integration time."
        )
    return bad


def _smoothed(
    measured: Float[np.ndarray, "columns bands"], cube: Cube, config: CalibrationConfig
) -> tuple[Float[np.ndarray, "columns bands"], Int[np.ndarray, "bands"]]:
    """Step 5 on each column; of the bands averaged, what is typical of the columns that have any."""
    spectrum, averaged = smooth_spectrum(
        measured, cube.wavelengths_nm, config.smoothing_bands, config.smoothing_max_nm
    )
    return spectrum, averaged.max(axis=0)
