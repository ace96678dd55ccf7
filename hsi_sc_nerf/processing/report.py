"""Pictures by which a user checks the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hsi_sc_nerf.calibration.no_data import filled
from hsi_sc_nerf.calibration.white_reference import White, WhiteReference
from hsi_sc_nerf.calibration.white_steps import mean_over_columns, white_mask
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.morphology import draw_outline
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands, to_8_bit

PERCENTILE_STEP = 5.0
"""The percentile of the white's mask is shown beside others so far below and above, as in the paper (65, 70, 75)."""


def white_reference_picture(path: Path, cube: Cube, white: WhiteReference, rgb_nm: Sequence[float]) -> None:
    """Draw how the white was found (the paper's appendix): coarse region, deviation map, kept region over the image,
    the same with a lower and a higher percentile, and the white spectrum before and after smoothing.

    Raises:
        InputError: the operating system refused to write.
    """
    x0, y0, x1, y1 = white.roi
    shown_counts = cube.memmap()[..., nearest_bands(cube.wavelengths_nm, rgb_nm)]
    raw = filled(shown_counts, cube.ignore_value).astype(float)
    image = to_8_bit(raw / np.maximum(np.percentile(raw, 95.0, axis=(0, 1)), 1e-9))
    figure = _figure(14.0, 14.0)
    axes = figure.subplot_mosaic(
        [["image", "deviation", "kept"], ["lower", "chosen", "higher"], ["spectrum"] * 3, ["smoothing"] * 3],
        height_ratios=[4.0, 4.0, 3.0, 1.5],
    )
    axes["image"].imshow(image)
    region = Rectangle((x0 - 0.5, y0 - 0.5), x1 - x0, y1 - y0, fill=False, edgecolor="tab:red", linewidth=2)
    axes["image"].add_patch(region)
    axes["image"].set_title("White and its coarse region")
    top = np.percentile(white.deviation, 99.0)
    extent = (x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5)
    shown = axes["deviation"].imshow(white.deviation, cmap="viridis", extent=extent, vmin=0.0, vmax=top)
    figure.colorbar(shown, ax=axes["deviation"], extend="max", shrink=0.8)
    axes["deviation"].set_title(f"Deviation D from the mean spectrum\n{_deviations(white.deviation)}", fontsize=10)
    kept = np.zeros(image.shape[:2], dtype=bool)
    kept[y0:y1, x0:x1] = white.mask
    axes["kept"].imshow(draw_outline(image, kept))
    in_mask = white.deviation[white.mask]
    axes["kept"].set_title(f"Region kept: {white.pixels} pixels\n{_deviations(in_mask)}", fontsize=10)
    for name, step in {"lower": -PERCENTILE_STEP, "chosen": 0.0, "higher": PERCENTILE_STEP}.items():
        percentile = min(white.percentile + step, 100.0)
        mask = white_mask(white.deviation, percentile=percentile, kernel_px=white.kernel_px)
        inside = image[y0:y1, x0:x1]
        axes[name].imshow(np.where(mask[..., None], inside, inside // 4), extent=extent)
        mean = f"{white.deviation[mask].mean():.4f}" if mask.any() else "-"
        axes[name].set_title(
            f"{percentile:g}th percentile{' (taken)' if step == 0.0 else ''}\n"
            f"keeps {100.0 * mask.mean():.1f} % of the region, mean D {mean}",
            fontsize=10,
        )
    _draw_spectrum(axes["spectrum"], white, cube.wavelengths_nm)
    measured, smoothed = white.measured[0], white.spectrum[0]
    axes["smoothing"].plot(cube.wavelengths_nm, 100.0 * (smoothed / measured - 1.0), color="tab:blue", linewidth=1)
    axes["smoothing"].set(xlabel="wavelength (nm)", ylabel="change by\nsmoothing (%)")
    axes["smoothing"].sharex(axes["spectrum"])
    _save(figure, path)


def column_white_picture(path: Path, white: White, wavelengths_nm: Float[np.ndarray, "bands"]) -> None:
    """Draw a white of a capture's own: its counts by detector column and band, and their mean spectrum.

    Raises:
        InputError: the operating system refused to write.
    """
    figure = _figure(14.0, 8.0)
    by_column, spectrum = figure.subplots(2, 1)
    edges = (0.5, len(wavelengths_nm) + 0.5, len(white.spectrum) - 0.5, -0.5)
    shown = by_column.imshow(white.spectrum, aspect="auto", interpolation="nearest", extent=edges)
    figure.colorbar(shown, ax=by_column, label="counts above dark")
    by_column.set(xlabel="band", ylabel="sample", title="White by detector column (blank where an element is dead)")
    _draw_spectrum(spectrum, white, wavelengths_nm)
    spectrum.set_xlabel("wavelength (nm)")
    _save(figure, path)


def _draw_spectrum(axes: Axes, white: White, wavelengths_nm: Float[np.ndarray, "bands"]) -> None:
    """The mean white spectrum before and after smoothing; bands without one are marked."""
    for number in np.flatnonzero(white.bad_bands).tolist():
        left, right = max(number - 1, 0), min(number + 1, len(wavelengths_nm) - 1)
        middle = wavelengths_nm[number]
        span = (middle + wavelengths_nm[left]) / 2.0, (middle + wavelengths_nm[right]) / 2.0
        axes.axvspan(*span, color="tab:red", alpha=0.25, linewidth=0)
    axes.plot(wavelengths_nm, mean_over_columns(white.measured), color="tab:gray", label="measured")
    axes.plot(wavelengths_nm, white.mean_spectrum(), color="tab:blue", linewidth=1, label="smoothed")
    bad = np.count_nonzero(white.bad_bands)
    axes.set(ylabel="counts above dark", title=f"White spectrum{f', {bad} bad bands marked' if bad else ''}")
    axes.legend()


def _deviations(deviation: Float[np.ndarray, "n"]) -> str:
    middle, high = np.percentile(deviation, [50.0, 95.0])
    return f"median {middle:.4f}, 95th percentile {high:.4f}\nlargest {deviation.max():.4f}"


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    with atomic_write(path) as (temporary,):
        figure.savefig(temporary, dpi=100)
