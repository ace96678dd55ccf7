"""Findings of the report: what is good is green, what is not says where to look."""

from types import SimpleNamespace

import numpy as np
import pytest

from hsi_sc_nerf.report.build import judge_cloud
from hsi_sc_nerf.report.dataset_sections import judge_calibration, judge_masks, judge_poses
from hsi_sc_nerf.report.run_sections import judge_comparison, judge_training, judge_traits
from hsi_sc_nerf.report.view_sections import judge_bands, judge_spectra, judge_views

NM = np.linspace(400.0, 1000.0, 7)
EVEN = np.full(8, 1000)
GROWING = 1000 + 30 * np.arange(8)
"""A part of a turn, from the narrow side of an object to the broad one."""


def views(*angles_rad, noise_rad=np.nan, rmse=None):
    return [
        SimpleNamespace(name=f"pear_{i}", metrics={"sam": angle, "rmse": rmse or angle}, noise_angle_rad=noise_rad)
        for i, angle in enumerate(angles_rad)
    ]


def point(factor, measured=True):
    """Spectra of a point; bands that are not ``measured`` are NaN in both."""
    spectrum = np.where(measured, NM / 1000.0, np.nan)
    return SimpleNamespace(measured=spectrum, rendered=factor * spectrum)


def cloud(*incidences_deg):
    return SimpleNamespace(extra={"incidence_deg": np.array(incidences_deg)})


def compared(f_score):
    return {"scores": {"chosen": {"threshold_m": 0.002, "f_score": f_score, "precision": 99.0, "recall": 60.0}}}


def traits(watertight, seen_area_m2):
    return {"watertight": watertight, "seen_area_m2": seen_area_m2, "size": {"area_m2": 0.02}}


def poses(px, used, *warnings):
    return {
        "reprojection_error_px": {"overall": px, "target": 1.0},
        "frames": {"used": used, "total": 9},
        "warnings": warnings,
    }


@pytest.mark.parametrize(
    ("findings", "levels", "tells"),
    [
        (judge_cloud(cloud(10.0, 20.0)), ["green"], "0.0 %"),
        (judge_cloud(cloud(10.0, 80.0)), ["amber"], "50.0 %"),
        (judge_cloud(SimpleNamespace(extra={})), [], ""),
        (judge_views(views(0.03, 0.04)), ["green"], "pear_1, 0.040"),
        (judge_views(views(0.09, 0.04)), ["amber"], "pear_0, 0.090"),
        (judge_views(views(0.2)), ["red"], "0.200"),
        (judge_views(views(0.125, noise_rad=0.12)), ["green"], "0.125 rad, 0.035 beyond the noise"),
        (judge_views(views(0.13, noise_rad=0.05)), ["red"], "0.120 beyond the noise"),
        (judge_views(views(0.03, noise_rad=0.05)), ["green"], "0.000 beyond the noise"),
        (judge_views(views(np.nan, 0.04)), ["green"], "The mean spectral angle is 0.040"),
        (judge_views(views(np.nan, np.nan)), ["red"], "No held-out view"),
        (judge_views(views(np.nan, rmse=0.01)), [], ""),  # of a single band
        (judge_bands(np.array([np.nan, np.nan]), NM[:2]), [], ""),
        (judge_bands(np.array([0.02, 0.04, np.nan]), NM[:3]), ["green"], "500 nm"),
        (judge_bands(np.array([0.08, 0.04]), NM[:2]), ["amber"], "400 nm"),
        (judge_bands(np.array([0.2, 0.04]), NM[:2]), ["red"], "0.200"),
        (judge_bands(np.array([0.08, 0.04]), NM[:2], np.array([0.08, 0.0])), ["green"], "0.040 beyond the noise"),
        (judge_spectra({"A": point(1.02), "B": point(0.97)}), ["green"], "at B, 3.0 %"),
        (judge_spectra({"A": point(1.1), "B": point(1.0)}), ["amber"], "at A, 10.0 %"),
        (judge_spectra({"A": point(1.1, False), "B": point(1.0)}), ["green"], "at B, 0.0 %"),
        (judge_spectra({"A": point(1.02, NM > 500), "B": point(1.0)}), ["green"], "at A, 2.0 %"),
        (judge_spectra({"A": point(1.1, False)}), [], ""),
        (judge_spectra({}), [], ""),
        (judge_comparison(compared(95.0)), ["green"], "95.0 %"),
        (judge_comparison(compared(80.0)), ["amber"], "recall"),
        (judge_comparison(compared(50.0)), ["red"], "recall"),
        (judge_traits(traits(True, 0.018)), ["green"], "10.0 %"),
        (judge_traits(traits(True, 0.015)), ["amber"], "25.0 %"),
        (judge_traits(traits(False, 0.018)), ["red"], "holes"),
        (judge_training(np.repeat([20.0, 30.0, 30.1], [8, 4, 4])), ["green"], "+0.10 dB"),
        (judge_training(np.linspace(20.0, 36.0, 17)), ["amber"], "train longer"),
        (judge_training(np.zeros(3)), [], ""),
        (judge_calibration(0.001, {"measured": True}), ["green"], "0.10 %"),
        (judge_calibration(0.03, {"measured": False, "reason": "no wall"}), ["amber", "amber"], "no wall"),
        (judge_calibration(0.2, {}), ["red"], "20.00 %"),
        (judge_masks(EVEN + 20 * (np.arange(8) % 2), list("abcdefgh"), True), ["green"], "1.0 %"),
        (judge_masks(np.where(np.arange(8) == 3, 500, EVEN), list("abcdefgh"), True), ["amber"], "look at d,"),
        (judge_masks(np.where(np.arange(8) == 7, 500, EVEN), list("abcdefgh"), False), ["amber"], "look at h,"),
        (judge_masks(GROWING, list("abcdefgh"), False), ["green"], "4.3 %"),
        (judge_masks(GROWING, list("abcdefgh"), True), ["amber"], "look at h, "),
        (judge_masks(EVEN[:1], ["a"], False), ["green"], "0.0 %"),
        (judge_poses(poses(0.3, 9)), ["green"], "0.30 px"),
        (judge_poses(poses(2.0, 7, "It wobbles.")), ["amber", "amber", "amber"], "2 of 9 frames"),
        (judge_poses({}), [], ""),
    ],
)
def test_levels_follow_the_values(findings, levels, tells):
    assert [finding.level for finding in findings] == levels
    sentences = " ".join(finding.sentence for finding in findings)
    assert tells in sentences
    assert all(finding.sentence.endswith(".") and "nan" not in finding.sentence for finding in findings)
