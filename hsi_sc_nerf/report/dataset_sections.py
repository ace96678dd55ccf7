"""Sections on the data that a run was trained on: calibration, masks, poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup

from hsi_sc_nerf.files import content_of
from hsi_sc_nerf.findings import EFFECT_COLUMNS, Finding, effect_rows, judged
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.poses.report import REPROJECTION_TARGET_PX, angle_words
from hsi_sc_nerf.poses.result import is_full_turn
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.page import (
    Block,
    Figure,
    Folded,
    Missing,
    Section,
    Table,
    embedded_file,
    read_known,
)

_PROCESS = "hsi-sc-nerf process SESSION --output-dir DATA"
_DIRECTIONS = {"ccw": "counter-clockwise", "cw": "clockwise"}
_FLAGGED = {
    "clipped_low": "clipped at 0",
    "clipped_high": "clipped at 1",
    "saturated": "saturated",
    "dead": "dead element",
    "no_data": "no data",
}
_FLAGGED_FRACTION = (0.01, 0.05)
# The outline of a convex object changes by a few per cent from frame to frame.
_MASK_JUMP = 0.1


def inspection_section(dataset: PackedDataset) -> list[Section]:
    """What `hsi-sc-nerf inspect` found in the session, as ``report/inspection.json`` of the dataset keeps it.

    Raises:
        InputError: that file holds no findings.
    """
    path = dataset.root / "report" / "inspection.json"
    content = read_known(path)
    if content is None:
        return []
    with content_of(path, "findings", "inspect the session again"):
        above = f"{Path(content.get('session', '')).parent}/"
        findings = [
            # The folders of the machine that processed the session tell a reader nothing.
            Finding(one["name"], one["level"], one["sentence"].replace(above, ""))
            for one in content["findings"]
        ]
    return [Section("inspection", "The session", [], findings)]


def effects_section(dataset: PackedDataset) -> list[Section]:
    """The effects of the session by their evidence; nothing of a dataset without any."""
    if not dataset.effects:
        return []
    sentences = (effect.sentence for effect in dataset.effects)
    rows = [(*row, sentence) for row, sentence in zip(effect_rows(dataset.effects), sentences, strict=True)]
    table = Table("Effects of the session, and their evidence.", (*EFFECT_COLUMNS, ""), rows)
    picture = _folded_picture(dataset, "effects.png", "Evidence over threshold")
    return [Section("effects", "Effects", [table, *picture])]


def calibration_section(dataset: PackedDataset) -> Section:
    """Calibration from counts to reflectance, and the uncertainty of reflectance.

    Raises:
        InputError: ``calibration.json`` does not hold what `process` wrote there.
    """
    path = dataset.root / "calibration.json"
    found = read_known(path)
    with content_of(path, "calibration"):
        if found is None:
            sentence = "The dataset has no calibration.json, so nothing is known of its calibration."
            blocks: list[Block] = [Missing(sentence, _PROCESS)]
        else:
            blocks = [_calibration_table(dataset, found), *_flagged_values(dataset, found)]
        findings = judge_calibration(dataset.flagged_values / _values(dataset), (found or {}).get("lamp_drift") or {})
    if dataset.typical_uncertainty is not None:
        chart = line_chart(
            [Curve("", dataset.wavelengths_nm, dataset.typical_uncertainty)],
            x_label="wavelength (nm)",
            y_label="SD of reflectance",
            alt="Uncertainty of a pixel's reflectance by wavelength",
            from_zero=True,
        )
        caption = "Noise of one pixel's reflectance (standard deviation) by band, at the object's mean reflectance."
        blocks.append(Figure({"": chart}, caption))
    for name, summary in (
        ("white_reference.png", "How the white reference was found"),
        ("lamp_drift.png", "Drift of the lamps"),
        ("uncertainty.png", "Uncertainty by reflectance and band"),
    ):
        blocks += _folded_picture(dataset, name, summary)
    return Section("calibration", "Calibration", blocks, findings)


def judge_calibration(flagged_fraction: float, drift: Mapping[str, Any]) -> list[Finding]:
    """How many values are no measurement, and whether the lamps' drift is known."""
    sentence = (
        f"{100.0 * flagged_fraction:.2f} % of the values are no measurement (good up to "
        f"{100.0 * _FLAGGED_FRACTION[0]:.0f} %)"
    )
    advice = "see which bands, and lower the integration time if they are saturated"
    findings = [judged("flagged", flagged_fraction, _FLAGGED_FRACTION, sentence, advice)]
    if drift and not drift.get("measured"):
        reason = drift.get("reason", "no reason is given")
        findings.append(Finding("drift", "amber", f"The drift of the lamps was not measured: {reason}."))
    return findings


def _calibration_table(dataset: PackedDataset, found: Mapping[str, Any]) -> Table:
    nm, white, noise = dataset.wavelengths_nm, found.get("white"), found.get("noise")
    source = {"tarp": "the tarp's own capture", "capture": "the WHITEREF cube of each capture"}
    fraction = dataset.flagged_values / _values(dataset)
    rows = [
        ("bands", f"{len(nm)}, {nm.min():.1f} to {nm.max():.1f} nm"),
        ("excluded bands", f"{len(dataset.bad_bands_nm)}"),
        ("white reference", source.get(str(found.get("white_source")), str(found.get("white_source")))),
        *([("pixels of the white", f"{white['pixels']}")] if white else []),
        ("dead detector elements", f"{found.get('dead_elements', 0)}"),
        ("values that are no measurement", f"{dataset.flagged_values} ({100.0 * fraction:.3f} %)"),
    ]
    if noise:
        read, photon = f"{np.median(noise['read_noise_counts']):.2f} counts", f"{noise['counts_per_electron']:.3f}"
        rows += [
            ("read noise, median over bands", read if noise.get("read_noise_measured", True) else "not measured"),
            ("counts per photo-electron", photon if noise.get("photon_noise_measured", True) else "not measured"),
        ]
    rows.append(("drift of the lamps", _drift_text(found.get("lamp_drift") or {})))
    return Table("Calibration from counts to reflectance.", ("", "found"), rows)


def _drift_text(drift: Mapping[str, Any]) -> str:
    if not drift.get("measured"):
        return f"not measured: {drift.get('reason', 'no reason is given')}"
    factors = np.array(list(drift["factor"].values()))
    text = f"largest {100.0 * np.abs(factors.mean(axis=1) - 1.0).max():.2f} % (mean over bands)"
    return f"{text}, {'corrected' if drift.get('corrected') else 'not corrected'}, p = {drift['p_value']:.2g}"


def _values(dataset: PackedDataset) -> int:
    """Values of one band in all frames times the bands."""
    return len(dataset.frames) * dataset.intrinsics.w * dataset.intrinsics.h * len(dataset.wavelengths_nm)


def _flagged_values(dataset: PackedDataset, found: Mapping[str, Any]) -> list[Figure]:
    """Curves of the values that were clipped or flagged in each band; empty if there are none."""
    of_band = _values(dataset) / len(dataset.wavelengths_nm)
    percent = {name: 100.0 * np.asarray(found.get(key, ()), float) / of_band for key, name in _FLAGGED.items()}
    nm = dataset.wavelengths_nm
    curves = [Curve(name, nm, values) for name, values in percent.items() if len(values) == len(nm) and values.any()]
    if not curves:
        return []
    chart = line_chart(
        curves,
        x_label="wavelength (nm)",
        y_label="fraction of values (%)",
        alt="Fraction of values that were clipped or flagged, by wavelength",
        from_zero=True,
    )
    return [
        Figure({"": chart}, "Values of all frames that were clipped or are no measurement, per cent of each band.")
    ]


def masks_section(dataset: PackedDataset) -> Section:
    """The object's masks."""
    areas_px: Int[np.ndarray, "frames"] = np.array([np.count_nonzero(frame.mask()) for frame in dataset.frames])
    usual, spread = float(np.median(areas_px)), float(areas_px.std())
    rows = [
        ("pixels of the object, median over frames", f"{usual:.0f}"),
        ("fraction of the frame", f"{100.0 * usual / (dataset.intrinsics.w * dataset.intrinsics.h):.1f} %"),
        ("standard deviation over frames", f"{100.0 * spread / max(usual, 1.0):.1f} %"),
        ("smallest", f"{areas_px.min()} ({dataset.frames[int(areas_px.argmin())].capture})"),
        ("largest", f"{areas_px.max()} ({dataset.frames[int(areas_px.argmax())].capture})"),
    ]
    chart = _by_frame(areas_px, "pixels", "Size of the object's mask by frame")
    blocks: list[Block] = [
        Table("The object's masks.", ("", "found"), rows),
        Figure({"": chart}, "Pixels of the object in each frame. Check the masks of frames that stand out below."),
        *_folded_picture(dataset, "masks.png", "All frames in pseudo-RGB with the outline of the mask in magenta"),
    ]
    closed = is_full_turn(np.array([frame.angle_deg for frame in dataset.frames]))
    findings = judge_masks(areas_px, [frame.capture for frame in dataset.frames], closed)
    return Section("masks", "Masks", blocks, findings)


def judge_masks(areas_px: Int[np.ndarray, "frames"], captures: Sequence[str], closed: bool) -> list[Finding]:
    """Frames whose mask is much larger or smaller than those of the frames before and after.

    Args:
        areas_px: size of each frame's mask.
        captures: names of the frames.
        closed: whether the first frame comes after the last one; if not, frames at the ends have neighbours on one
            side only.
    """
    count, padded = len(areas_px), np.pad(areas_px, 2, mode="wrap" if closed else "reflect")
    neighbours = np.median([padded[first : first + count] for first in (0, 1, 3, 4)], axis=0)
    jumps = np.abs(areas_px / np.maximum(neighbours, 1.0) - 1.0)
    sentence = (
        f"Masks differ from those of the frames beside them by up to {100.0 * jumps.max():.1f} % of their size (good "
        f"up to {100.0 * _MASK_JUMP:.0f} %)"
    )
    odd = ", ".join(captures[index] for index in np.argsort(-jumps)[:5] if jumps[index] > _MASK_JUMP)
    advice = f"look at {odd}, and mend or exclude such frames"
    return [judged("masks", float(jumps.max()), (_MASK_JUMP, np.inf), sentence, advice)]


def poses_section(dataset: PackedDataset) -> Section:
    """Poses of the camera and their uncertainty.

    Raises:
        InputError: ``poses.json`` does not hold what `process` wrote there.
    """
    path = dataset.root / "poses.json"
    found = read_known(path)
    if found is None:
        missing = Missing("The dataset has no poses.json, so nothing is known of how its poses were found.", _PROCESS)
        return Section("poses", "Poses", [missing])
    with content_of(path, "poses"):
        blocks: list[Block] = [Table("The turntable and the camera.", ("", "found"), _pose_rows(found))]
        findings = judge_poses(found)
    errors = np.array([np.nan if (e := f.reprojection_error_px) is None else e for f in dataset.frames])
    charts: dict[str, Markup] = {}
    if np.isfinite(errors).any():
        title = "Reprojection error of the markers or features"
        charts[title] = _by_frame(errors, "root mean square (px)", f"{title} by frame")
    steps_deg = np.diff([frame.angle_deg for frame in dataset.frames])
    if len(steps_deg):
        title = "Turn since the frame before"
        charts[title] = _by_frame(np.append(np.nan, steps_deg), "step (degrees)", f"{title} by frame")
    if charts:
        caption = "Root mean square reprojection error in pixels; turn of the table, positive counter-clockwise."
        blocks.append(Figure(charts, caption, columns=2))
    blocks += _folded_picture(dataset, "poses.png", "Cameras round the object, reprojection errors and steps")
    return Section("poses", "Poses", blocks, findings)


def judge_poses(found: Mapping[str, Any]) -> list[Finding]:
    """The reprojection error, the frames without a pose, and the warnings of ``poses.json``."""
    error, frames = (found.get(key) or {} for key in ("reprojection_error_px", "frames"))
    findings = []
    if error.get("overall") is not None:
        target_px = error.get("target") or REPROJECTION_TARGET_PX
        sentence = f"The reprojection error is {error['overall']:.2f} px (good up to {target_px:g} px)"
        advice = "look at the frames that stand out"
        findings.append(judged("reprojection", error["overall"], (target_px, np.inf), sentence, advice))
    if frames.get("total") and frames.get("used") != frames["total"]:
        sentence = f"{frames['total'] - frames['used']} of {frames['total']} frames have no pose."
        findings.append(Finding("left-out", "amber", sentence))
    return findings + [Finding("poses", "amber", sentence) for sentence in found.get("warnings", ())]


def _by_frame(values: Float[np.ndarray, "frames"], y_label: str, alt: str) -> Markup:
    """A chart of a number of each frame, which are counted from 0; NaN is a gap."""
    curve = Curve("", np.arange(len(values), dtype=float), values.astype(float))
    return line_chart([curve], x_label="frame", y_label=y_label, alt=alt, from_zero=np.nanmin(values) >= 0.0)


def _pose_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The entries of poses.json that are there."""
    error, frames, scale = (found.get(key) or {} for key in ("reprojection_error_px", "frames", "scale"))
    uncertainty, steps, lens = (found.get(key) or {} for key in ("uncertainty", "steps_deg", "intrinsics"))
    angles_deg = (found.get(key) for key in ("camera_looks_down_deg", "axis_tilt_in_image_deg"))
    down, lean = (None if angle_deg is None else angle_words(angle_deg) for angle_deg in angles_deg)
    candidates: list[tuple[str, str, Any]] = [
        ("found by", "{}", found.get("method")),
        ("frames used", "{} of " + str(frames.get("total")), frames.get("used")),
        ("reprojection error", "{:.3f} px", error.get("overall")),
        ("target of the paper", "{:g} px", error.get("target")),
        ("direction, from above", "{}", _DIRECTIONS.get(str((found.get("direction") or {}).get("found")))),
        ("median step", "{:.3f}°", steps.get("median")),
        ("loop closes to", "{:.3f}°", found.get("loop_closure_deg")),
        ("camera looks down", "{}", down),
        ("axis leans in the image", "{}", lean),
        ("focal length", "{:.1f} px", lens.get("fl_x")),
        ("uncertainty of the focal length", "{:.2f} %", uncertainty.get("focal_percent")),
        ("uncertainty of the distance", "{:.2f} %", uncertainty.get("distance_percent")),
        ("scale by", "{}", scale.get("source") or ("as given" if found.get("metric") else "none: not in metres")),
        ("uncertainty of the scale", "{:.3f} %", scale.get("uncertainty_percent")),
        ("rejected observations", "{}", len(found.get("outliers") or ())),
    ]
    return [(name, pattern.format(value)) for name, pattern, value in candidates if value is not None]


def _folded_picture(dataset: PackedDataset, name: str, summary: str) -> list[Block]:
    """A picture of the dataset's ``report/``, which a click opens; nothing where it is missing."""
    path = dataset.root / "report" / name
    return [Folded(summary, [Figure({"": embedded_file(path, summary)}, f"{summary}.")])] if path.is_file() else []
