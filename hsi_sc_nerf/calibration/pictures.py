"""Pictures of the lamps' drift and of the reflectance's uncertainty, by which a user checks them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hsi_sc_nerf.calibration.lamp_drift import LampDrift
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.packed.uncertainty import ReflectanceUncertainty
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands

DRIFT_NM = (450.0, 600.0, 750.0, 900.0)
SMALLEST_P = 1e-6
REFLECTANCES = (0.1, 0.5, 0.9)


def lamp_drift_picture(
    path: Path,
    drift: LampDrift,
    wavelengths_nm: Float[np.ndarray, "bands"],
    *,
    corrected: bool,
    shown_nm: Sequence[float] = DRIFT_NM,
) -> None:
    """Draw the lamps' light by frame at some wavelengths, and over all wavelengths in the last frame.

    Raises:
        InputError: the operating system refused to write.
    """
    change, error, measured = (
        100.0 * part for part in (drift.factor - 1.0, drift.standard_error, drift.measured - 1.0)
    )
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    by_frame, by_band = figure.subplots(1, 2)
    frames = np.arange(len(change))
    bands = list(dict.fromkeys(nearest_bands(wavelengths_nm, shown_nm)))
    colours = colormaps["plasma"](np.linspace(0.0, 0.8, len(bands)))
    p_value = f"p = {drift.p_value:.1g}" if drift.p_value > SMALLEST_P else f"p < {SMALLEST_P:g}"
    for band, colour in zip(bands, colours, strict=True):
        by_frame.errorbar(
            frames,
            change[:, band],
            2.0 * error[:, band],
            color=colour,
            marker=".",
            capsize=2,
            label=f"{wavelengths_nm[band]:.0f} nm",
        )
    by_frame.legend(title="with 2 standard errors")
    by_frame.xaxis.set_major_locator(MaxNLocator(integer=True))
    by_frame.set(xlabel="frame", ylabel="change since the first frame (%)")
    by_frame.set_title(
        f"Light of the lamps: {'corrected' if corrected else 'not corrected'} "
        f"({'significant' if drift.significant else 'not significant'}, {p_value})"
    )
    by_band.plot(wavelengths_nm, measured[-1], ".", color="tab:gray", markersize=3, label="measured")
    by_band.plot(wavelengths_nm, change[-1], color="tab:blue", label="smooth, with 2 standard errors")
    low, high = change[-1] - 2.0 * error[-1], change[-1] + 2.0 * error[-1]
    by_band.fill_between(wavelengths_nm, low, high, color="tab:blue", alpha=0.3, linewidth=0)
    by_band.legend()
    by_band.set(xlabel="wavelength (nm)", ylabel="change in the last frame (%)")
    by_band.set_title(f"Measured on {100.0 * drift.static_share:.0f} % of the surveyed pixels, which stand still")
    for axes in (by_frame, by_band):
        axes.axhline(0.0, color="0.6", linewidth=0.8)
    with atomic_write(path) as (temporary,):
        figure.savefig(temporary, dpi=100)


def uncertainty_picture(
    path: Path,
    uncertainty: ReflectanceUncertainty,
    wavelengths_nm: Float[np.ndarray, "bands"],
    *,
    reflectances: Sequence[float] = REFLECTANCES,
) -> None:
    """Draw the standard deviation of one pixel over the wavelengths at some reflectances, and the white's share.

    Raises:
        InputError: the operating system refused to write.
    """
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    colours = colormaps["viridis"](np.linspace(0.85, 0.0, len(reflectances)))
    for reflectance, colour in zip(reflectances, colours, strict=True):
        deviation = uncertainty.standard_deviation(np.full(len(wavelengths_nm), reflectance))
        axes.plot(wavelengths_nm, deviation, color=colour, label=f"reflectance {reflectance:g}")
    brightest = max(reflectances)
    common = np.sqrt(uncertainty.quadratic) * brightest
    axes.plot(wavelengths_nm, common, color="0.5", linestyle="--", label=f"the white's share at {brightest:g}")
    axes.set(xlabel="wavelength (nm)", ylabel="standard deviation of one pixel's reflectance", yscale="log")
    axes.set_title("Uncertainty of the reflectance")
    axes.grid(color="0.9")
    axes.legend()
    with atomic_write(path) as (temporary,):
        figure.savefig(temporary, dpi=100)
