"""What is good in a run and what to look at: findings from measured values, with the thresholds that they state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf import paper
from hsi_sc_nerf.export.cloud import INCIDENCE, MAX_INCIDENCE_DEG, SpectralCloud
from hsi_sc_nerf.findings import Finding, Level
from hsi_sc_nerf.report.held_out_views import PointSpectra, ViewScores

# Half of the angle that tells two materials apart, and that angle.
_SAM_RAD = (paper.CLASSIFICATION_ANGLE_RAD / 2.0, paper.CLASSIFICATION_ANGLE_RAD)
# The paper prints 0.03 to 0.044 for real fruit.
_RMSE = (0.05, 0.1)
_SPECTRUM_ERROR = (0.05, 0.15)
_OBLIQUE_FRACTION = 0.1
_F_SCORE_MISSING_PERCENT = (10.0, 30.0)
_UNSEEN_FRACTION = 0.15
_PSNR_RISE_DB = 0.5
_FLAGGED_FRACTION = (0.01, 0.05)
# The outline of a convex object changes by a few per cent from frame to frame.
_MASK_JUMP = 0.1
# The paper's target.
_REPROJECTION_PX = 1.0


def judge_cloud(cloud: SpectralCloud) -> list[Finding]:
    """How much of the surface was seen only obliquely; nothing without that column."""
    if INCIDENCE not in cloud.extra:
        return []
    fraction = float(np.mean(cloud.extra[INCIDENCE] > MAX_INCIDENCE_DEG))
    sentence = (
        f"{fraction:.1%} of the points are seen at more than {MAX_INCIDENCE_DEG:g}° from the front (good up to "
        f"{_OBLIQUE_FRACTION:.0%})"
    )
    advice = f"show the column {INCIDENCE} to see where their spectra are mixed"
    return [_judged("oblique", fraction, (_OBLIQUE_FRACTION, np.inf), sentence, advice)]


def judge_views(views: Sequence[ViewScores]) -> list[Finding]:
    """The spectral angle of the held-out views."""
    angles = np.array([view.metrics["sam"] for view in views])
    sentence = (
        f"The mean spectral angle is {angles.mean():.3f} rad (good up to {_SAM_RAD[0]:g}; {_SAM_RAD[1]:g} is another "
        f"material); it is largest in {views[int(angles.argmax())].name}, {angles.max():.3f} rad"
    )
    advice = "look at the maps, the mask and the pose of that view"
    return [_judged("spectral-angle", float(angles.mean()), _SAM_RAD, sentence, advice)]


def judge_bands(rmse: Float[np.ndarray, "bands"], wavelengths_nm: Float[np.ndarray, "bands"]) -> list[Finding]:
    """The band with the largest error."""
    worst = int(np.nanargmax(rmse))
    sentence = (
        f"The RMSE of reflectance is {np.nanmean(rmse):.3f} and in no band above {rmse[worst]:.3f}, at "
        f"{wavelengths_nm[worst]:.0f} nm (good up to {_RMSE[0]:g})"
    )
    return [_judged("rmse", float(rmse[worst]), _RMSE, sentence, "train longer, or look at the maps of the error")]


def judge_spectra(points: Mapping[str, PointSpectra]) -> list[Finding]:
    """How far rendered mean spectra are from the measured ones, by the points' letters."""
    errors = {
        letter: float(np.nanmean(np.abs(one.rendered - one.measured)) / np.nanmean(one.measured))
        for letter, one in points.items()
    }
    if not errors:
        return []
    worst = max(errors, key=lambda letter: errors[letter])
    sentence = (
        f"Rendered spectra differ from the measured means by {np.mean(list(errors.values())):.1%} of reflectance, "
        f"most at {worst}, {errors[worst]:.1%} (good up to {_SPECTRUM_ERROR[0]:.0%})"
    )
    return [
        _judged("spectra", errors[worst], _SPECTRUM_ERROR, sentence, "compare its curve with the noise around it")
    ]


def judge_comparison(comparison: Mapping[str, Any]) -> list[Finding]:
    """The F-score at the chosen threshold."""
    score = comparison["scores"]["chosen"]
    missing_percent = 100.0 - float(score["f_score"])
    sentence = (
        f"The F-score at {1000.0 * float(score['threshold_m']):.1f} mm is {100.0 - missing_percent:.1f} % (good from "
        f"{100.0 - _F_SCORE_MISSING_PERCENT[0]:g} %)"
    )
    lower = "precision" if score["precision"] < score["recall"] else "recall"
    return [
        _judged("f-score", missing_percent, _F_SCORE_MISSING_PERCENT, sentence, f"{lower} is the lower of the two")
    ]


def judge_traits(traits: Mapping[str, Any]) -> list[Finding]:
    """Whether the mesh encloses a volume, and how much of it was not seen."""
    if not traits["watertight"]:
        return [Finding("watertight", "red", "The mesh has holes, so its volume cannot be trusted; mesh it anew.")]
    fraction = 1.0 - traits["seen_area_m2"] / traits["size"]["area_m2"]
    sentence = f"The mesh is closed; {fraction:.1%} of its area was not seen (good up to {_UNSEEN_FRACTION:.0%})"
    advice = "give the container's height (--data), and see which side was not seen"
    return [_judged("closed-area", fraction, (_UNSEEN_FRACTION, np.inf), sentence, advice)]


def judge_training(psnr_db: Float[np.ndarray, "n"]) -> list[Finding]:
    """Whether the PSNR of training rays in the last stage still rose at its end; nothing of a short log."""
    if len(psnr_db) < 8:
        return []
    before, end = np.array_split(psnr_db[len(psnr_db) // 2 :], 2)
    rise_db = float(np.mean(end) - np.mean(before))
    sentence = (
        f"The PSNR of training rays rose by {rise_db:.2f} dB in the last quarter of the last stage (converged up to "
        f"{_PSNR_RISE_DB:g} dB)"
    )
    return [_judged("convergence", rise_db, (_PSNR_RISE_DB, np.inf), sentence, "train longer")]


def judge_calibration(flagged_fraction: float, drift: Mapping[str, Any]) -> list[Finding]:
    """How many values are no measurement, and whether the lamps' drift is known."""
    sentence = f"{flagged_fraction:.2%} of the values are no measurement (good up to {_FLAGGED_FRACTION[0]:.0%})"
    advice = "see which bands, and lower the integration time if they are saturated"
    findings = [_judged("flagged", flagged_fraction, _FLAGGED_FRACTION, sentence, advice)]
    if drift and not drift.get("measured"):
        reason = drift.get("reason", "no reason is given")
        findings.append(Finding("drift", "amber", f"The drift of the lamps was not measured: {reason}."))
    return findings


def judge_masks(areas_px: Int[np.ndarray, "frames"], captures: Sequence[str]) -> list[Finding]:
    """Frames whose mask is much larger or smaller than those of the frames before and after."""
    neighbours = np.median([np.roll(areas_px, shift) for shift in (-2, -1, 1, 2)], axis=0)
    jumps = np.abs(areas_px / np.maximum(neighbours, 1.0) - 1.0)
    sentence = (
        f"Masks differ from those of the frames beside them by up to {jumps.max():.1%} of their size (good up to "
        f"{_MASK_JUMP:.0%})"
    )
    odd = ", ".join(captures[index] for index in np.argsort(-jumps)[:5] if jumps[index] > _MASK_JUMP)
    advice = f"look at {odd}, and mend or exclude such frames"
    return [_judged("masks", float(jumps.max()), (_MASK_JUMP, np.inf), sentence, advice)]


def judge_poses(found: Mapping[str, Any]) -> list[Finding]:
    """The reprojection error, the frames without a pose, and the warnings of ``poses.json``."""
    error, frames = (found.get(key) or {} for key in ("reprojection_error_px", "frames"))
    findings = []
    if error.get("overall") is not None:
        target_px = error.get("target") or _REPROJECTION_PX
        sentence = f"The reprojection error is {error['overall']:.2f} px (good up to {target_px:g} px)"
        advice = "look at the frames that stand out"
        findings.append(_judged("reprojection", error["overall"], (target_px, np.inf), sentence, advice))
    if frames.get("total") and frames.get("used") != frames["total"]:
        sentence = f"{frames['total'] - frames['used']} of {frames['total']} frames have no pose."
        findings.append(Finding("left-out", "amber", sentence))
    return findings + [Finding("poses", "amber", sentence) for sentence in found.get("warnings", ())]


def _judged(name: str, value: float, limits: tuple[float, float], sentence: str, advice: str) -> Finding:
    """green up to the first limit, amber up to the second, red above; the advice is given unless it is green."""
    good, usable = limits
    level: Level = "green" if value <= good else "amber" if value <= usable else "red"
    return Finding(name, level, f"{sentence}{'' if level == 'green' else f'; {advice}'}.", {"value": float(value)})
