"""Findings of the calibration, on a small session whose calibration is then spoilt in one way."""

from dataclasses import replace

import numpy as np
import pytest
from capture_factory import BANDS, SIZE_PX, write_session

from hsi_sc_nerf.calibration.calibration_checks import check_calibration
from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate, NotMeasurable
from hsi_sc_nerf.calibration.noise import NoiseModel
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.session import open_session


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    session = open_session(write_session(tmp_path_factory.mktemp("session")))
    return session, calibrate_session(session, CalibrationConfig())


def level_of(name, calibrated, **changes):
    session, calibration = calibrated
    findings = {finding.name: finding for finding in check_calibration(session, replace(calibration, **changes))}
    assert list(findings) == ["drift", "clipped", "noise"]
    assert all(finding.sentence.count(". ") == 0 for finding in findings.values())
    return findings[name].level


def drift(change=0.05, error=0.001, scatter=0.003):
    factor = 1.0 - change * np.linspace(0.0, 1.0, 4)[:, None] * np.ones(BANDS)
    static = np.ones((8, SIZE_PX), bool)
    return LampDriftEstimate(factor, factor, np.full(factor.shape, error), static, scatter, 0.0, True)


@pytest.mark.parametrize(
    ("measured", "level"),
    [
        (drift(), "green"),
        (drift(error=0.01), "amber"),
        (drift(change=0.4), "amber"),
        (drift(change=0.7), "red"),
        (NotMeasurable("there is no wall"), "amber"),
    ],
)
def test_drift(calibrated, measured, level):
    assert level_of("drift", calibrated, drift=measured) == level
    assert level_of("drift", calibrated, drift=measured, source="capture") == "green"


@pytest.mark.parametrize(
    ("spoilt", "changes", "level"),
    [
        (0, {}, "green"),
        # The wall has 0.8 of the white's light.
        (4, {"gain": 1.4}, "red"),
        (4, {"gain": 1.4, "bounds": (0.0, 1.3)}, "green"),
        (1, {"saturation_counts": 1000.0}, "amber"),
        (4, {"saturation_counts": 1000.0}, "red"),
        (4, {"saturation_counts": 1000.0, "dead": np.ones((SIZE_PX, BANDS), bool)}, "green"),
    ],
)
def test_clipped(calibrated, spoilt, changes, level):
    frames = list(calibrated[1].frames)
    for number, frame in enumerate(frames[:spoilt]):
        frames[number] = replace(frame, **{**changes, "gain": frame.gain * changes.get("gain", 1.0)})
    assert level_of("clipped", calibrated, frames=tuple(frames)) == level


def test_saturation_is_told_of_a_band_only_where_there_is_some(calibrated):
    def told(**changes):
        frames = tuple(replace(frame, **changes) for frame in calibrated[1].frames)
        findings = check_calibration(calibrated[0], replace(calibrated[1], frames=frames))
        return next(finding.sentence for finding in findings if finding.name == "clipped")

    assert " nm)" not in told()
    assert " nm)" in told(saturation_counts=1000.0)


@pytest.mark.parametrize(
    ("slope", "measured", "scatter", "level"),
    [
        (0.1, True, 0.003, "green"),
        (0.1, False, 0.003, "amber"),
        (0.1, True, 0.06, "amber"),
        (10.0, True, 0.003, "amber"),
        (200.0, True, 0.003, "red"),
    ],
)
def test_noise(calibrated, slope, measured, scatter, level):
    noise = NoiseModel(np.full(BANDS, 2.0), slope, measured, True)
    assert level_of("noise", calibrated, noise=noise, drift=drift(scatter=scatter)) == level
    assert level_of("noise", calibrated, noise=None, white=None) == "green"
