"""Steps 1 to 5 of the paper's Algorithm 1, a function each, on arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf.calibration.no_data import no_data
from hsi_sc_nerf.morphology import ellipse_close_open, largest_component


def find_coarse_roi(
    brightness: Num[np.ndarray, "lines samples"], threshold: float = 0.5
) -> tuple[int, int, int, int] | None:
    """Step 1: bounding box (x0, y0, x1, y1) of the largest region above ``threshold`` times the 99th percentile.

    Returns None where nothing is brighter than zero.
    """
    reference = np.percentile(brightness, 99.0)
    if not reference > 0.0:
        return None
    y, x = np.nonzero(largest_component(brightness >= threshold * reference))
    return int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1


def deviation_map(
    white: Num[np.ndarray, "y x bands"], dead: Bool[np.ndarray, "x bands"] | None = None
) -> Float[np.ndarray, "y x"]:
    """Step 2: D(x, y), the mean over bands of |I - mu| / mu, with mu the mean spectrum of the region.

    The mean of ratios, as printed (the released code divides means). Dead elements are left out, and a band without
    any counts, which has no ratio; without any counts at all D is infinite.
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
class ColumnSums:
    """What the readings of each detector element inside a mask add up to.

    Attributes:
        sums: of the counts.
        numbers: of the readings.
        saturated: how many of the readings are saturated.
    """

    sums: Float[np.ndarray, "x bands"]
    numbers: Int[np.ndarray, "x bands"]
    saturated: Int[np.ndarray, "x bands"]

    def without(self, dead: Bool[np.ndarray, "x bands"]) -> ColumnSums:
        """The same without any reading of the dead elements."""
        return ColumnSums(*(np.where(dead, 0, array) for array in (self.sums, self.numbers, self.saturated)))


def column_sums(
    white: Num[np.ndarray, "y x bands"],
    mask: Bool[np.ndarray, "y x"],
    *,
    ignore_value: float | None = None,
    saturation_counts: float | None = None,
) -> ColumnSums:
    """Add up each column's counts inside the mask; what is no data (`no_data`) is left out."""
    sums = np.zeros(white.shape[1:])
    numbers, saturated = np.zeros((2, *white.shape[1:]), np.int64)
    for line, kept in zip(white, mask, strict=True):
        missing = no_data(line, ignore_value)
        valid = kept[:, None] if missing is None else kept[:, None] & ~missing
        np.add(sums, line, out=sums, where=valid)
        numbers += valid
        if saturation_counts is not None:
            saturated += valid & (line >= saturation_counts)
    return ColumnSums(sums, numbers, saturated)


def mean_spectrum(columns: ColumnSums, dark: Float[np.ndarray, "dark_columns bands"]) -> Float[np.ndarray, "bands"]:
    """Step 4: mean of all readings, dark counts taken off; nan in a band without any reading."""
    with np.errstate(invalid="ignore"):
        return (columns.sums - columns.numbers * dark).sum(axis=0) / columns.numbers.sum(axis=0)


def smooth_spectrum(
    spectrum: Float[np.ndarray, "*columns bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    window: int,
    max_nm: float,
) -> tuple[Float[np.ndarray, "*columns bands"], Int[np.ndarray, "*columns bands"]]:
    """Step 5: moving average over ``window`` bands (odd); and how many bands were averaged for each.

    The window shrinks symmetrically towards the ends, and where it would span more than ``max_nm`` between the
    centres of its outermost bands. A band that is nan stays so and takes its mirror image out of the window. A
    symmetrical window leaves constant and linear spectra as they are in every band; the outermost bands are not
    smoothed.
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
    """Mean over the columns that are not nan; nan where all are."""
    known = np.isfinite(spectra)
    with np.errstate(invalid="ignore"):
        return np.where(known, spectra, 0.0).sum(axis=0) / known.sum(axis=0)
