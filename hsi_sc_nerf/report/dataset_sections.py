"""Sections on the data that a run was trained on: calibration, masks, poses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from markupsafe import Markup

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.report.charts import Curve, bar_chart, line_chart
from hsi_sc_nerf.report.page import Block, Figure, Folded, Missing, Section, Table, Warnings, embedded_file

_PROCESS = "hsi-sc-nerf process SESSION --output-dir DATA"
_DIRECTIONS = {"ccw": "counter-clockwise", "cw": "clockwise"}
_FLAGGED = {
    "clipped_low": "clipped at 0",
    "clipped_high": "clipped at 1",
    "saturated": "saturated",
    "dead": "dead element",
    "no_data": "no data",
}


def read_json(path: Path) -> dict[str, Any] | None:
    """What a JSON file holds; None where there is no such file.

    Raises:
        InputError: it is no JSON object.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is no readable JSON ({error}); make it again.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no JSON object; make it again.")
    return content


def _picture(dataset: PackedDataset, name: str, alt: str) -> list[Markup]:
    path = dataset.root / "report" / name
    return [embedded_file(path, alt)] if path.is_file() else []


def calibration_section(dataset: PackedDataset) -> Section:
    """How counts became reflectance, and what that costs in certainty."""
    found = read_json(dataset.root / "calibration.json")
    blocks: list[Block] = []
    if found is None:
        blocks.append(
            Missing("The dataset has no calibration.json, so nothing is known of its calibration.", _PROCESS)
        )
    else:
        blocks.append(_calibration_table(dataset, found))
        blocks += _flagged_values(dataset, found)
    if dataset.typical_uncertainty is not None:
        curve = Curve("", dataset.wavelengths_nm, dataset.typical_uncertainty)
        chart = line_chart(
            [curve],
            x_label="wavelength (nm)",
            y_label="SD of reflectance",
            alt="Uncertainty of a pixel's reflectance by wavelength",
            from_zero=True,
        )
        caption = "Noise of one pixel's reflectance (standard deviation) by band, at the object's mean reflectance."
        blocks.append(Figure([chart], caption))
    for name, summary in (
        ("white_reference.png", "How the white reference was found"),
        ("lamp_drift.png", "Drift of the lamps"),
        ("uncertainty.png", "Uncertainty by reflectance and band"),
    ):
        pictures = _picture(dataset, name, summary)
        if pictures:
            blocks.append(Folded(summary, [Figure(pictures, f"{summary}, as drawn when the session was processed.")]))
    return Section("calibration", "Calibration", blocks)


def _calibration_table(dataset: PackedDataset, found: Mapping[str, Any]) -> Table:
    white, noise, drift = found.get("white"), found.get("noise"), found.get("lamp_drift") or {}
    source = {"tarp": "the tarp's own capture", "capture": "the WHITEREF cube of each capture"}
    rows = [
        (
            "bands",
            f"{len(dataset.wavelengths_nm)}, {dataset.wavelengths_nm.min():.1f} to "
            f"{dataset.wavelengths_nm.max():.1f} nm",
        ),
        ("bands left out", f"{len(dataset.bad_bands_nm)}"),
        ("white reference", source.get(str(found.get("white_source")), str(found.get("white_source")))),
    ]
    if white:
        rows.append(("pixels of the white", f"{white['pixels']}"))
    rows.append(("dead detector elements", f"{found.get('dead_elements', 0)}"))
    fraction = dataset.flagged_values / _values(dataset)
    rows.append(("values that are no measurement", f"{dataset.flagged_values} ({100.0 * fraction:.3f} %)"))
    if noise:
        rows.append(("read noise, median over bands", f"{np.median(noise['read_noise_counts']):.2f} counts"))
        rows.append(("counts per photo-electron", f"{noise['counts_per_electron']:.3f}"))
    rows.append(("drift of the lamps", _drift_in_words(drift)))
    return Table("How counts became reflectance.", ("", "found"), rows)


def _drift_in_words(drift: Mapping[str, Any]) -> str:
    if not drift.get("measured"):
        return f"not measured: {drift.get('reason', 'no reason is given')}"
    factors = np.array(list(drift["factor"].values()))
    words = f"largest {100.0 * np.abs(factors.mean(axis=1) - 1.0).max():.2f} % (mean over bands)"
    return f"{words}, {'corrected' if drift.get('corrected') else 'not corrected'}, p = {drift['p_value']:.2g}"


def _values(dataset: PackedDataset) -> int:
    """Values of one band in all frames times the bands."""
    return len(dataset.frames) * dataset.intrinsics.w * dataset.intrinsics.h * len(dataset.wavelengths_nm)


def _flagged_values(dataset: PackedDataset, found: Mapping[str, Any]) -> list[Figure]:
    """Curves of the values that were clipped or flagged in each band; empty if there are none."""
    of_band = _values(dataset) / len(dataset.wavelengths_nm)
    fractions = {name: np.asarray(found.get(key, ()), float) / of_band for key, name in _FLAGGED.items()}
    curves = [
        Curve(name, dataset.wavelengths_nm, 100.0 * fraction)
        for name, fraction in fractions.items()
        if len(fraction) == len(dataset.wavelengths_nm) and fraction.any()
    ]
    if not curves:
        return []
    chart = line_chart(
        curves,
        x_label="wavelength (nm)",
        y_label="fraction of values (%)",
        alt="Share of values that were clipped or flagged, by wavelength",
        from_zero=True,
    )
    return [Figure([chart], "Values of all frames that were clipped or are no measurement, per cent of each band.")]


def masks_section(dataset: PackedDataset) -> Section:
    """Which pixels are the object."""
    areas_px: Int[np.ndarray, "frames"] = np.array([np.count_nonzero(frame.mask()) for frame in dataset.frames])
    usual, spread = float(np.median(areas_px)), float(areas_px.std())
    rows = [
        ("pixels of the object, median over frames", f"{usual:.0f}"),
        ("fraction of the frame", f"{100.0 * usual / (dataset.intrinsics.w * dataset.intrinsics.h):.1f} %"),
        ("standard deviation over frames", f"{100.0 * spread / max(usual, 1.0):.1f} %"),
        ("smallest", f"{areas_px.min()} ({dataset.frames[int(areas_px.argmin())].capture})"),
        ("largest", f"{areas_px.max()} ({dataset.frames[int(areas_px.argmax())].capture})"),
    ]
    chart = bar_chart(
        np.arange(len(areas_px) + 1.0) - 0.5,
        areas_px.astype(float),
        x_label="frame",
        y_label="pixels",
        alt="Size of the object's mask by frame",
    )
    blocks: list[Block] = [
        Table("The object's masks.", ("", "found"), rows),
        Figure([chart], "Pixels of the object in each frame. A frame that stands out is worth a look below."),
    ]
    pictures = _picture(dataset, "masks.png", "Contact sheet of all frames with the outlines of their masks")
    if pictures:
        caption = "All frames in pseudo-RGB with the outline of the mask in magenta."
        blocks.append(Folded("All masks", [Figure(pictures, caption)]))
    else:
        blocks.append(Missing("There is no picture of the masks.", _PROCESS))
    return Section("masks", "Masks", blocks)


def poses_section(dataset: PackedDataset) -> Section:
    """Where the camera stood, and how sure that is."""
    found = read_json(dataset.root / "poses.json")
    if found is None:
        missing = Missing("The dataset has no poses.json, so nothing is known of how its poses were found.", _PROCESS)
        return Section("poses", "Poses", [missing])
    blocks: list[Block] = [Table("The turntable and the camera.", ("", "found"), _pose_rows(found))]
    if found.get("warnings"):
        blocks.insert(0, Warnings(found["warnings"]))
    errors = np.array([np.nan if (e := f.reprojection_error_px) is None else e for f in dataset.frames])
    if np.isfinite(errors).any():
        chart = bar_chart(
            np.arange(len(errors) + 1.0) - 0.5,
            errors,
            x_label="frame",
            y_label="reprojection error (px)",
            alt="Root mean square reprojection error by frame",
        )
        blocks.append(Figure([chart], "Root mean square reprojection error of the markers or features, pixels."))
    angles = np.array([frame.angle_deg for frame in dataset.frames])
    if len(angles) > 1:
        nominal = (found.get("steps_deg") or {}).get("nominal")
        numbers = np.arange(1.0, len(angles))
        curves = [Curve("found", numbers, np.diff(angles))]
        if nominal is not None:
            size = np.copysign(float(nominal), np.median(np.diff(angles)))
            curves.append(Curve("nominal", numbers, np.full(len(numbers), size), dashed=True))
        chart = line_chart(
            curves,
            x_label="frame",
            y_label="step (degrees)",
            alt="Turn of the table from each frame to the next",
        )
        blocks.append(
            Figure([chart], "Turn of the table since the frame before, degrees, positive counter-clockwise.")
        )
    pictures = _picture(dataset, "poses.png", "Cameras round the object, reprojection errors and steps")
    if pictures:
        blocks.append(
            Folded("Cameras in the object frame", [Figure(pictures, "As drawn when the poses were found.")])
        )
    return Section("poses", "Poses", blocks)


def _pose_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What poses.json tells, as far as it does."""
    error, frames, scale = (found.get(key) or {} for key in ("reprojection_error_px", "frames", "scale"))
    uncertainty, steps, lens = (found.get(key) or {} for key in ("uncertainty", "steps_deg", "intrinsics"))
    candidates: list[tuple[str, str, Any]] = [
        ("found by", "{}", found.get("method")),
        ("frames used", "{} of " + str(frames.get("total")), frames.get("used")),
        ("reprojection error", "{:.3f} px", error.get("overall")),
        ("target of the paper", "{:g} px", error.get("target")),
        ("direction, from above", "{}", _DIRECTIONS.get(str((found.get("direction") or {}).get("found")))),
        ("median step", "{:.3f}°", steps.get("median")),
        ("loop closes to", "{:.3f}°", found.get("loop_closure_deg")),
        ("camera looks down", "{:.2f}°", found.get("camera_looks_down_deg")),
        ("axis leans in the image", "{:.2f}°", found.get("axis_tilt_in_image_deg")),
        ("focal length", "{:.1f} px", lens.get("fl_x")),
        ("uncertainty of the focal length", "{:.2f} %", uncertainty.get("focal_percent")),
        ("uncertainty of the distance", "{:.2f} %", uncertainty.get("distance_percent")),
        ("scale by", "{}", scale.get("source") or ("as given" if found.get("metric") else "none: not in metres")),
        ("uncertainty of the scale", "{:.3f} %", scale.get("uncertainty_percent")),
        ("sightings thrown out", "{}", len(found.get("outliers") or ())),
    ]
    return [(name, pattern.format(value)) for name, pattern, value in candidates if value is not None]
