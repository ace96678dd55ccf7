"""Whites and what is none, and a small session whose calibration is spoilt in one way."""

from dataclasses import replace

import numpy as np
import pytest
from capture_factory import BANDS, DARK, LAMP, SIZE_PX, WAVELENGTHS_NM, expose, write_capture, write_session

from hsi_sc_nerf.calibration.calibration_checks import check_calibration, check_clipped, check_white
from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate, NotMeasurable
from hsi_sc_nerf.calibration.noise import NoiseModel
from hsi_sc_nerf.calibration.reference_checks import check_dark
from hsi_sc_nerf.calibration.reflectance import PixelCounts
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.errors import InputError


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    session = open_session(write_session(tmp_path_factory.mktemp("session")))
    return session, calibrate_session(session, CalibrationConfig())


def finding_of(name, calibrated, **changes):
    session, calibration = calibrated
    findings = {finding.name: finding for finding in check_calibration(session, replace(calibration, **changes))}
    assert list(findings) == ["drift", "noise"]
    assert all(finding.sentence.count(". ") == 0 for finding in findings.values())
    return findings[name]


def level_of(name, calibrated, **changes):
    return finding_of(name, calibrated, **changes).level


def drift(change=0.05, error=0.001, scatter=0.003):
    factor = 1.0 - change * np.linspace(0.0, 1.0, 4)[:, None] * np.ones(BANDS)
    static = np.ones((8, SIZE_PX), bool)
    return LampDriftEstimate(factor, factor, np.full(factor.shape, error), static, scatter, 0.0)


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
    assert level_of("drift", calibrated, drift=measured, one_white=False) == "green"


@pytest.mark.parametrize(
    ("clipped", "saturated", "level"),
    [(0, 0, "green"), (2, 0, "amber"), (30, 0, "red"), (0, 2, "amber"), (0, 60, "red")],
)
def test_clipped(calibrated, clipped, saturated, level):
    """Percent of the values, and of one band; lower values and dead elements do no harm."""
    session, calibration = calibrated
    pixels, none = 1000, np.zeros(BANDS, int)
    of_one_band = none.copy()
    of_one_band[2] = 10 * saturated
    counts = PixelCounts(none + 500, none + 10 * clipped, of_one_band, none + 300, none)
    finding = check_clipped(session, calibration, counts, pixels)
    assert (finding.name, finding.level) == ("clipped", level)
    assert (f"{WAVELENGTHS_NM[2]:.0f} nm" in finding.sentence) == (saturated > 0)
    # A shorter exposure of frames and white leaves the reflectance that is clipped as it is.
    if level == "amber":
        assert ("bounds" in finding.sentence, "integration time" in finding.sentence) == (clipped > 0, saturated > 0)


def test_bands_in_which_the_white_saturates_are_named_and_not_lost_in_silence(tmp_path):
    """White and frames of a detector of 12 bits, exposed for a tenth longer."""
    session = open_session(write_session(tmp_path))
    for capture in (session.white, *session.frames):
        assert capture is not None
        counts = np.asarray(capture.cube.memmap()).astype(int)
        write_capture(tmp_path, capture.name, np.clip(1.1 * counts, 0, 4095).astype(np.uint16))
    session = open_session(tmp_path)
    calibration = calibrate_session(session, CalibrationConfig())
    lost_nm = np.delete(WAVELENGTHS_NM, calibration.bands)
    assert len(lost_nm) == 3
    none = np.zeros(len(calibration.bands), int)
    finding = check_clipped(session, calibration, PixelCounts(none, none, none, none, none), 1000)
    assert finding.level == "amber"
    assert f"3 bands ({lost_nm[0]:.0f} to {lost_nm[-1]:.0f} nm) are left out" in finding.sentence
    assert finding.values["lost_nm"] == lost_nm.tolist()


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
    finding = finding_of("noise", calibrated, noise=noise, drift=drift(scatter=scatter))
    assert finding.level == level
    assert (finding.values["signal_to_noise_of_white"] is not None) == measured
    assert level_of("noise", calibrated, noise=None, white=None) == "green"


LINES, SAMPLES, FRAMES = 40, 60, 6
LEAF = np.where(WAVELENGTHS_NM < 700.0, 0.08, 0.8)


def frame(number, wall=0.6, light=0.5):
    """A wall, and before it an object with dark and bright stripes that turn."""
    reflectance = np.full((LINES, SAMPLES, BANDS), wall)
    x = np.arange(20, 42)
    stripes = np.where(np.sin(2.0 * np.arccos((x - 30.5) / 11.0) * 3 + number) > 0.0, light, 0.05)
    reflectance[10:34, 20:42] = stripes[:, None]
    return reflectance


def tarp():
    """A tarp that does not fill the image, in uneven light, with weave, dust and a fold."""
    rng = np.random.default_rng(0)
    white = np.full((LINES, SAMPLES, BANDS), 0.1)
    white[3:-3, 3:-3] = np.linspace(0.75, 1.05, SAMPLES - 6)[:, None]
    white *= 1.0 + 0.04 * rng.standard_normal((LINES, SAMPLES, 1))
    white[rng.random((LINES, SAMPLES)) < 0.02] *= 0.6
    white[20:23] *= 0.8
    return white


@pytest.fixture
def session(tmp_path):
    """Writes a session with the given white and opens it; returns its findings and itself."""

    def write(white, frames=None):
        frames = [frame(number) for number in range(FRAMES)] if frames is None else frames
        for number, reflectance in enumerate(frames):
            write_capture(tmp_path, f"pear_{number}", expose(reflectance))
        write_capture(tmp_path, "white_reference", expose(white))
        opened = open_session(tmp_path)
        return found(opened), opened

    return write


def found(opened, source="auto"):
    return {finding.name: finding for finding in check_white(opened, source)}


def levels(findings):
    return findings["white"].level, findings["white-clipped"].level


@pytest.mark.parametrize("wall", [0.1, 0.6, 0.95])
def test_a_worn_tarp_is_a_white(session, wall):
    findings, opened = session(tarp(), [frame(number, wall) for number in range(FRAMES)])
    assert findings["white"].level == "green"
    # Before a white wall, uneven light takes values above the white's.
    assert findings["white-clipped"].level == ("green" if wall < 0.9 else "red")
    # Nothing is clipped that the exposure explains.
    assert found(replace(opened, frames=opened.frames[:2]))["white"].level == "green"


def test_a_tarp_beside_the_object_is_a_white(session):
    white = frame(FRAMES)
    white[:, 46:] = 1.0
    assert levels(session(white)[0]) == ("green", "green")


@pytest.mark.parametrize(("shade", "is_told"), [(0.95, False), (0.65, True)])
def test_a_white_partly_in_shade(session, shade, is_told):
    white = np.ones((LINES, SAMPLES, BANDS)) * np.linspace(0.95, 1.0, SAMPLES)[:, None]
    white[:, : SAMPLES // 2] *= shade
    findings, _ = session(white, [frame(number, 0.3, 0.3) for number in range(FRAMES)])
    assert findings["white"].level == "green"
    assert ("white-shade" in findings) == is_told


@pytest.mark.parametrize("count", [3, FRAMES])
@pytest.mark.parametrize("wall", [0.1, 0.6])
def test_a_frame_is_no_white(session, wall, count):
    findings, _ = session(frame(FRAMES, wall), [frame(number, wall) for number in range(count)])
    assert findings["white"].level == "red"
    assert findings["white"].values["looks_most_like_a_white"] is None


def test_a_frame_of_another_object_is_no_white(session):
    assert session(frame(20, light=0.35))[0]["white"].level == "red"


def test_the_capture_that_looks_like_a_white_is_named(session):
    frames = [frame(number) for number in range(FRAMES)]
    frames[4] = tarp()
    white = session(frame(FRAMES), frames)[0]["white"]
    assert white.level == "red"
    assert white.values["looks_most_like_a_white"] == "pear_4"
    assert "pear_4" in white.sentence


@pytest.mark.parametrize(
    ("white", "clipped"),
    [
        (0.2 * np.ones((LINES, SAMPLES, BANDS)), "red"),
        (np.broadcast_to(LEAF, (LINES, SAMPLES, BANDS)), "red"),
        (np.zeros((LINES, SAMPLES, BANDS)), "green"),
        (np.random.default_rng(1).uniform(0.3, 1.0, (LINES, SAMPLES, 1)) * np.ones(BANDS), "amber"),
    ],
    ids=["dim", "leaf", "dark", "gravel"],
)
def test_what_is_dark_coloured_or_rough_is_no_white(session, white, clipped):
    findings, _ = session(white)
    assert findings["white"].level == "red"
    assert clipped in ("amber", findings["white-clipped"].level)


@pytest.mark.parametrize("grey", [0.4, 0.2])
@pytest.mark.parametrize("wall", [0.1, 0.6])
def test_a_grey_panel_is_a_white_where_its_reflectance_is_given(session, grey, wall):
    frames = [frame(number, wall) for number in range(FRAMES)]
    findings, opened = session(grey * np.linspace(1.0, 1.05, SAMPLES)[:, None] * np.ones((LINES, 1, BANDS)), frames)
    assert findings["white-clipped"].level == "red"
    described = panel_of(opened, grey)
    assert [finding.level for finding in check_white(described)] == ["green", "green"]
    for capture in described.frames:  # the same of WHITEREF cubes
        header = capture.cube.header_path
        counts = np.rint(grey * np.ones((3, SAMPLES, BANDS)) * LAMP).astype(np.uint16)
        write_cube(header.with_name(f"WHITEREF_{header.name}"), counts, wavelengths_nm=WAVELENGTHS_NM)
    own = open_session(opened.path)
    assert [finding.level for finding in check_white(own, "capture")] == ["green", "green"]


@pytest.mark.parametrize("grey", [0.99, 0.4])
def test_a_frame_is_no_grey_panel(session, grey):
    _, opened = session(frame(FRAMES))
    assert check_white(panel_of(opened, grey))[0].level == "red"


def test_a_panel_whose_reflectance_is_stated_too_high(session):
    _, opened = session(0.2 * np.ones((LINES, SAMPLES, BANDS)))
    assert [finding.level for finding in check_white(panel_of(opened, 0.5))] == ["green", "red"]


def panel_of(opened, reflectance):
    """The session with a certificate of its white."""
    (opened.path / "panel.csv").write_text(f"400,{reflectance}\n1000,{reflectance}\n")
    (opened.path / "session.json").write_text('{"panel_reflectance": "panel.csv"}')
    return open_session(opened.path)


def test_a_longer_exposure_of_the_frames_is_taken_into_account(session):
    _, opened = session(tarp())
    for capture in opened.frames:
        counts = np.rint((capture.cube.read().astype(float) - DARK) * 3.0 + DARK).astype(np.uint16)
        write_cube(capture.cube.header_path, counts, wavelengths_nm=WAVELENGTHS_NM, extra_header={"tint": 30})
    assert found(open_session(opened.path))["white-clipped"].level == "red"
    white = opened.white.cube
    write_cube(white.header_path, white.read(), wavelengths_nm=WAVELENGTHS_NM, extra_header={"tint": 10})
    assert levels(found(open_session(opened.path))) == ("green", "green")


@pytest.mark.parametrize(
    ("spoilt", "expected"),
    [
        (np.ones((3, SAMPLES, BANDS)), ("green", "green")),
        (0.5 * np.ones((3, SAMPLES, BANDS)), ("green", "red")),
        (0.1 * np.ones((3, SAMPLES, BANDS)), ("red", "red")),
        (frame(1), ("red", "amber")),
    ],
    ids=["white", "shaded", "dim", "a frame"],
)
def test_a_white_of_each_capture(session, spoilt, expected):
    _, opened = session(tarp())
    for capture in opened.frames:
        counts = np.rint(spoilt * LAMP).astype(np.uint16)
        header = capture.cube.header_path
        write_cube(header.with_name(f"WHITEREF_{header.name}"), counts, wavelengths_nm=WAVELENGTHS_NM)
    own = open_session(opened.path)
    findings = found(own, "capture")
    assert findings["white"].level == expected[0]
    assert expected[1] in ("amber", findings["white-clipped"].level)
    assert levels(found(own)) == ("green", "green")


def test_a_target_in_the_frames_needs_no_other_white(session):
    """A tarp that is too dim is not judged."""
    _, opened = session(0.1 * tarp())
    alone = replace(opened, white=None)
    for one in (opened, alone):
        assert [finding.level for finding in check_white(one, "target")] == ["green"]
        assert check_dark(one, "target").level == "green"
    calibration = calibrate_session(alone, CalibrationConfig(white_source="target", roi=(0, 0, 20, 10)))
    np.testing.assert_allclose(calibration.frames[0].gain, 1.0 / (0.6 * LAMP[None]), rtol=1e-3)
    with pytest.raises(InputError, match=r"no capture called .*--calibration\.white-source target"):
        check_white(alone)


def test_finished_reflectance_needs_no_white(session):
    _, opened = session(tarp())
    frames = tuple(replace(capture, product=capture.cube) for capture in opened.frames)
    assert [f.level for f in check_white(replace(opened, white=None, frames=frames))] == ["green"]
