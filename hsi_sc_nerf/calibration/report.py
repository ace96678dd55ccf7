"""What the calibration found: sentences, ``calibration.json``, and pictures for checking it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from hsi_sc_nerf import paper
from hsi_sc_nerf.calibration.detector import fill_no_data
from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate, NotMeasurable
from hsi_sc_nerf.calibration.reflectance import PixelCounts
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.calibration.white_reference import White, WhiteReference, mean_over_columns, white_mask
from hsi_sc_nerf.capture.envi import Cube
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.morphology import draw_outline
from hsi_sc_nerf.packed.cube import ReflectanceUncertainty
from hsi_sc_nerf.plotting import COLOURS, STYLE, logarithmic_axis, new_figure, save_figure
from hsi_sc_nerf.spectra import nearest_bands, to_8_bit

REPORT_NAME = "calibration.json"
PERCENTILE_STEP = 5.0
"""The white's mask is also shown at a lower and a higher percentile, as in the paper (65, 70, 75)."""
DRIFT_NM = (450.0, 600.0, 750.0, 900.0)
REFLECTANCES = (0.1, 0.5, 0.9)
SMALLEST_P = 1e-6
"""p-values below this are shown as this."""


def describe_calibration(session: Session, calibration: SessionCalibration) -> list[str]:
    """Sentences on what was measured before any frame is calibrated."""
    pixels = 0 if calibration.white is None else calibration.white.pixels
    sentences = {
        "product": ["White: none needed, the instrument's finished reflectance is taken."],
        "capture": ["White: the WHITEREF cube of each capture."],
        "target": [f"White: {pixels} pixels of a target."],
        "tarp": [f"White: {pixels} pixels of the tarp in {session.white.name if session.white else ''}."],
    }[calibration.source]
    if calibration.defects is not None:
        sentences.append(f"Detector: {calibration.defects.summary()}.")
    return sentences


def write_calibration(
    path: Path,
    session: Session,
    calibration: SessionCalibration,
    pixel_counts: PixelCounts,
    typical_uncertainty: Float[np.ndarray, "kept"] | None,
) -> None:
    """Write ``calibration.json``. Lists are by kept band if nothing else is said.

    Raises:
        InputError: the operating system refused to write.
    """
    wavelengths_nm, kept, white = session.wavelengths_nm, calibration.bands, calibration.white
    defects, noise = calibration.defects, calibration.noise
    content: dict[str, Any] = {
        "white_source": calibration.source,
        "white": None if white is None else {"pixels": white.pixels, "counts": white.mean_spectrum()[kept].tolist()},
        "wavelengths_nm": wavelengths_nm[kept].tolist(),
        "bad_bands_nm": np.delete(wavelengths_nm, kept).tolist(),
        "saturation_counts": None if defects is None else defects.saturation_counts,
        "dead_elements": 0 if defects is None else int(defects.dead.sum()),
        "flat_field": calibration.frames[0].flat is not None,
        "noise": None
        if noise is None
        else {
            "read_noise_counts": noise.read_noise[kept].tolist(),
            "read_noise_measured": noise.read_noise_measured,
            "counts_per_electron": noise.counts_per_electron,
            "photon_noise_measured": noise.photon_noise_measured,
        },
        "lamp_drift": _drift(session, calibration),
        **{name: counts.tolist() for name, counts in vars(pixel_counts).items()},
        "typical_uncertainty": None if typical_uncertainty is None else typical_uncertainty.tolist(),
    }
    if isinstance(white, WhiteReference):
        content["white"] |= {"roi": list(white.roi), "percentile": paper.WHITE_PERCENTILE}
    write_json(path, content)


def draw_calibration(
    folder: Path, session: Session, calibration: SessionCalibration, rgb_nm: Sequence[float]
) -> None:
    """Draw the white, the lamps' drift and the uncertainty of reflectance, if they were measured.

    Raises:
        InputError: the operating system refused to write.
    """
    wavelengths_nm, white, drift = session.wavelengths_nm, calibration.white, calibration.drift
    if isinstance(white, WhiteReference):
        capture = session.white if calibration.source == "tarp" else session.frames[0]
        assert capture is not None
        draw_white_reference(folder / "white_reference.png", capture.cube, white, rgb_nm)
    elif white is not None:
        draw_column_white(folder / "white_reference.png", white, wavelengths_nm)
    if isinstance(drift, LampDriftEstimate):
        draw_lamp_drift(folder / "lamp_drift.png", drift, wavelengths_nm, corrected=calibration.drift_corrected)
    if calibration.uncertainty is not None:
        draw_uncertainty(folder / "uncertainty.png", calibration.uncertainty, wavelengths_nm[calibration.bands])


@rc_context(STYLE)
def draw_white_reference(path: Path, cube: Cube, white: WhiteReference, rgb_nm: Sequence[float]) -> None:
    """Draw the steps to the white reference (the paper's appendix).

    These are the coarse region with the part that is kept, the deviation map, the mask at three percentiles, and the
    spectrum before and after smoothing.
    """
    x0, y0, x1, y1 = white.roi
    bands = nearest_bands(cube.wavelengths_nm, rgb_nm)
    counts = fill_no_data(cube.memmap()[..., bands], cube.ignore_value).astype(float)
    image = to_8_bit(counts / np.maximum(np.percentile(counts, 95.0, axis=(0, 1)), 1e-9))
    figure = new_figure(12.0, 10.0)
    top, middle = ["image"] * 3 + ["deviation"] * 3, ["lower"] * 2 + ["used"] * 2 + ["higher"] * 2
    rows: list[Any] = [top, middle, ["spectrum"] * 6]
    axes = figure.subplot_mosaic(rows, height_ratios=[4.0, 4.0, 3.0])
    axes["image"].imshow(draw_outline(image, white.region(image.shape[:2])))
    region = Rectangle((x0 - 0.5, y0 - 0.5), x1 - x0, y1 - y0, fill=False, edgecolor=COLOURS[1], linewidth=2)
    axes["image"].add_patch(region)
    axes["image"].set_title(f"White: coarse region, and the {white.pixels} pixels that are kept")
    extent = (x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5)
    largest = np.percentile(white.deviation, 99.0)
    shown = axes["deviation"].imshow(white.deviation, cmap="viridis", extent=extent, vmin=0.0, vmax=largest)
    figure.colorbar(shown, ax=axes["deviation"], extend="max", shrink=0.8)
    axes["deviation"].set_title(f"Deviation D from the mean, median {np.median(white.deviation):.4f}")
    for name, step in {"lower": -PERCENTILE_STEP, "used": 0.0, "higher": PERCENTILE_STEP}.items():
        percentile = min(paper.WHITE_PERCENTILE + step, 100.0)
        mask = white_mask(white.deviation, percentile=percentile, kernel_px=white.kernel_px)
        inside = image[y0:y1, x0:x1]
        axes[name].imshow(np.where(mask[..., None], inside, inside // 4), extent=extent)
        mean = f"{white.deviation[mask].mean():.4f}" if mask.any() else "-"
        kept_percent = 100.0 * mask.mean()
        axes[name].set_title(f"{percentile:g}th percentile keeps {kept_percent:.1f} %,\nmean D {mean}")
    for name, panel in axes.items():
        panel.grid(name == "spectrum")
    _draw_spectrum(axes["spectrum"], white, cube.wavelengths_nm)
    save_figure(figure, path)


@rc_context(STYLE)
def draw_column_white(path: Path, white: White, wavelengths_nm: Float[np.ndarray, "bands"]) -> None:
    """Draw the white of a capture: its counts by detector column and band, and their mean spectrum."""
    figure = new_figure(11.0, 6.5)
    by_column, spectrum = figure.subplots(2, 1)
    edges = (0.5, len(wavelengths_nm) + 0.5, len(white.spectrum) - 0.5, -0.5)
    shown = by_column.imshow(white.spectrum, aspect="auto", interpolation="nearest", extent=edges)
    figure.colorbar(shown, ax=by_column, label="counts above dark")
    by_column.grid(False)
    by_column.set(xlabel="band", ylabel="sample", title="White by detector column (blank where an element is dead)")
    _draw_spectrum(spectrum, white, wavelengths_nm)
    save_figure(figure, path)


@rc_context(STYLE)
def draw_lamp_drift(
    path: Path, drift: LampDriftEstimate, wavelengths_nm: Float[np.ndarray, "bands"], *, corrected: bool
) -> None:
    """Draw the lamps' light by frame at some wavelengths, and by wavelength in the last frame."""
    change, two_sd = 100.0 * (drift.factor - 1.0), 200.0 * drift.standard_error
    figure = new_figure(12.0, 4.5)
    by_frame, by_band = figure.subplots(1, 2)
    bands = list(dict.fromkeys(nearest_bands(wavelengths_nm, DRIFT_NM)))
    for band, colour in zip(bands, colormaps["plasma"](np.linspace(0.0, 0.8, len(bands))), strict=True):
        bars = {"color": colour, "marker": ".", "capsize": 2, "label": f"{wavelengths_nm[band]:.0f} nm"}
        by_frame.errorbar(np.arange(len(change)), change[:, band], two_sd[:, band], **bars)
    by_frame.legend(title="with 2 standard errors")
    by_frame.xaxis.set_major_locator(MaxNLocator(integer=True))
    by_frame.set(xlabel="frame", ylabel="change since the first frame (%)")
    by_frame.set_title(
        f"Light of the lamps: {'corrected' if corrected else 'not corrected'} "
        f"({'significant' if drift.significant else 'not significant'}, p = {max(drift.p_value, SMALLEST_P):.1g})"
    )
    by_band.plot(wavelengths_nm, 100.0 * (drift.measured[-1] - 1.0), ".", color="0.5", markersize=3, label="measured")
    by_band.plot(wavelengths_nm, change[-1], color=COLOURS[0], label="smooth, with 2 standard errors")
    low, high = change[-1] - two_sd[-1], change[-1] + two_sd[-1]
    by_band.fill_between(wavelengths_nm, low, high, color=COLOURS[0], alpha=0.3, linewidth=0)
    by_band.legend()
    by_band.set(xlabel="wavelength (nm)", ylabel="change in the last frame (%)")
    by_band.set_title(f"Measured on {100.0 * drift.static.mean():.0f} % of the surveyed pixels, which are static")
    for axes in (by_frame, by_band):
        axes.axhline(0.0, color="0.6", linewidth=0.8)
    save_figure(figure, path)


@rc_context(STYLE)
def draw_uncertainty(
    path: Path, uncertainty: ReflectanceUncertainty, wavelengths_nm: Float[np.ndarray, "bands"]
) -> None:
    """Draw the standard deviation of one pixel by wavelength at some reflectances, and the white's part of it."""
    figure = new_figure(8.0, 4.5)
    axes, order = figure.subplots(), np.argsort(wavelengths_nm)
    colours = colormaps["viridis"](np.linspace(0.85, 0.0, len(REFLECTANCES)))
    for reflectance, colour in zip(REFLECTANCES, colours, strict=True):
        deviation = uncertainty.standard_deviation(np.full(len(wavelengths_nm), reflectance))
        axes.plot(wavelengths_nm[order], deviation[order], color=colour, label=f"reflectance {reflectance:g}")
    brightest = max(REFLECTANCES)
    of_white = np.sqrt(uncertainty.quadratic) * brightest
    axes.plot(
        wavelengths_nm[order],
        of_white[order],
        color="0.5",
        linestyle="--",
        label=f"the white's part at {brightest:g}",
    )
    axes.set(xlabel="wavelength (nm)", ylabel="standard deviation of one pixel's reflectance")
    logarithmic_axis(axes, "y")
    axes.set_title("Uncertainty of the reflectance")
    axes.legend()
    save_figure(figure, path)


def _drift(session: Session, calibration: SessionCalibration) -> dict[str, Any]:
    drift = calibration.drift
    if isinstance(drift, NotMeasurable):
        return {"measured": False, "corrected": False, "reason": drift.reason}
    factor, error = (part[:, calibration.bands] for part in (drift.factor, drift.standard_error))
    return {
        "measured": True,
        "corrected": calibration.drift_corrected,
        "significant": drift.significant,
        "p_value": drift.p_value,
        "static_fraction": float(drift.static.mean()),
        "factor": {frame.name: row.tolist() for frame, row in zip(session.frames, factor, strict=True)},
        "standard_error": {frame.name: row.tolist() for frame, row in zip(session.frames, error, strict=True)},
    }


def _draw_spectrum(axes: Axes, white: White, wavelengths_nm: Float[np.ndarray, "bands"]) -> None:
    """The mean white spectrum before and after smoothing, with its bad bands marked."""
    for middle in wavelengths_nm[white.bad_bands]:
        axes.axvline(middle, color=COLOURS[1], alpha=0.25, linewidth=3)
    axes.plot(wavelengths_nm, mean_over_columns(white.measured), color="0.5", label="measured")
    axes.plot(wavelengths_nm, white.mean_spectrum(), color=COLOURS[0], linewidth=1, label="smoothed")
    bad = np.count_nonzero(white.bad_bands)
    axes.set(xlabel="wavelength (nm)", ylabel="counts above dark")
    axes.set_title(f"White spectrum{f', {bad} bad bands marked' if bad else ''}")
    axes.legend()
