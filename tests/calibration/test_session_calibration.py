"""Whole sessions of known truth through the calibration: what is not saturated is right, and what is, is flagged."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from calibration_score import CalibrationScore, score_calibration
from capture_factory import BANDS, DARK, LAMP, SIZE_PX, WAVELENGTHS_NM, expose, write_capture, write_session

from hsi_sc_nerf.calibration.calibration_checks import check_calibration
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, SessionCalibration, calibrate_session
from hsi_sc_nerf.capture.envi import Cube, open_cube, write_cube
from hsi_sc_nerf.capture.session import Capture, Session, open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.processing.frames import FramePaths, pack_frames
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import Truth, load_truth

LARGEST_COUNT = 4095
ODDITIES = [
    "{illumination_falloff: {edge_loss: 0.2}}",
    "{lamp_drift: {percent: -6, temperature_change_k: -80}}",
    "{bad_pixels: {dead_fraction: 0.001, hot_fraction: 0.001, dead_bands: 2}}",
    "gloss",
    "{saturation: {exposure_factor: 1.6}}",
    "{tarp_exposure: {exposure_factor: 0.6}}",
    "image_rotation",
]
NOISE = ["photon_noise", "read_noise", "dark_pattern"]
DRIFTING = ["{lamp_drift: {percent: -6}}", "photon_noise", "read_noise"]


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A simulated session, its calibration and the folder of its packed frames."""

    session: Session
    truth: Truth
    calibration: SessionCalibration
    root: Path

    def score(self) -> CalibrationScore:
        return score_calibration(self.session, self.calibration, self.root, self.truth)


def simulated(folder: Path, name: str = "sphere", **changes) -> Session:
    """A simulated session: a small one of three frames and twelve bands, if nothing else is said."""
    scene = override(load_scene(name), **{"size_px": 48, "bands": 12, "frames": 3, "effects": [], **changes})
    return open_session(simulate_session(scene, folder / "session", progress=False))


def calibrated(folder: Path, effects: list[str], config: CalibrationConfig) -> Calibrated:
    session = simulated(folder, "pear", size_px=72, bands=40, frames=6, effects=effects)
    calibration = calibrate_session(session, config)
    pack_frames(session, calibration, folder / "data")
    return Calibrated(session, load_truth(session.path), calibration, folder / "data")


@pytest.fixture(scope="module")
def odd(tmp_path_factory) -> Calibrated:
    return calibrated(tmp_path_factory.mktemp("odd"), ODDITIES, CalibrationConfig(flat_field=True))


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Calibrated:
    return calibrated(tmp_path_factory.mktemp("noisy"), [*ODDITIES, *NOISE], CalibrationConfig(flat_field=True))


@pytest.mark.slow
def test_reflectance_drift_and_uncertainty_are_right(odd, noisy):
    assert odd.score().reflectance_rms < 0.01
    assert 0.9 < noisy.score().error_over_uncertainty < 1.15
    for session in (odd, noisy):
        assert session.calibration.drift_corrected
        assert session.score().drift_rms < 0.003


def validity(root: Path, session: Session, capture: Capture):
    """Which of a packed frame's values are measured, (H, W, bands), turned as the camera recorded them."""
    valid = unpack(open_cube(FramePaths.of(root, capture.name).cube).memmap())[1]
    return np.rot90(valid, -session.quarter_turns)


@pytest.mark.slow
def test_saturated_and_dead_values_are_flagged_and_no_others(odd, noisy):
    for session in (odd, noisy):
        maps = session.truth.detector_maps()
        bands = session.calibration.bands
        dead_bands = (maps["dead"] | maps["hot"]).mean(axis=0) > 0.5
        np.testing.assert_array_equal(np.delete(np.arange(40), bands), np.flatnonzero(dead_bands))
        dead = (maps["dead"] | maps["hot"])[:, bands]
        saturated = 0
        for capture in session.session.frames:
            valid = validity(session.root, session.session, capture)
            at_top = (capture.cube.memmap()[..., bands] >= LARGEST_COUNT) & ~dead
            saturated += at_top.sum()
            np.testing.assert_array_equal(~valid, at_top | dead)
        assert saturated > 100


def leave_gaps(cube: Cube, gap: float, dtype: str) -> None:
    """Write a cube again with no data in two whole pixels and in one reading of two thousand."""
    counts = cube.read().astype(dtype)
    missing = np.random.default_rng(counts.sum().astype(int)).random(counts.shape) < 5e-4
    missing[len(counts) // 2, 36] = missing[0, 3] = True
    counts[missing] = gap
    rewrite(cube, counts, **({} if np.isnan(gap) else {"data ignore value": int(gap)}))


def rewrite(cube: Cube, counts: np.ndarray, **fields) -> None:
    """Write other counts in the place of a cube."""
    write_cube(
        cube.header_path,
        counts,
        wavelengths_nm=cube.wavelengths_nm,
        interleave=cube.interleave,
        data_suffix=cube.data_path.suffix,
        extra_header={"tint": cube.integration_time_ms, **fields},
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap", "dtype", "saturation"),
    [(65_535, "uint16", []), (np.nan, "float32", ["{saturation: {exposure_factor: 1.6}}"])],
)
def test_no_data_is_taken_neither_for_light_nor_for_darkness(tmp_path, gap, dtype, saturation):
    effects = ["{lamp_drift: {percent: -6}}", *saturation, *NOISE]
    session = simulated(tmp_path, "pear", size_px=72, bands=24, frames=6, effects=effects)
    whole = calibrate_session(session, CalibrationConfig())
    for capture in session.captures:
        leave_gaps(capture.cube, gap, dtype)
    gappy = calibrate_session(open_session(session.path), CalibrationConfig())
    limit = LARGEST_COUNT if saturation else None
    assert gappy.defects.saturation_counts == whole.defects.saturation_counts == limit
    np.testing.assert_array_equal(gappy.defects.dead, whole.defects.dead)
    np.testing.assert_array_equal(gappy.bands, whole.bands)
    np.testing.assert_allclose(gappy.white.spectrum, whole.white.spectrum, rtol=2e-3)
    assert gappy.white.roi == whole.white.roi
    assert gappy.noise.counts_per_electron == pytest.approx(whole.noise.counts_per_electron, rel=0.05)
    assert gappy.drift_corrected
    assert gappy.drift.static.mean() == pytest.approx(whole.drift.static.mean(), abs=0.01)
    np.testing.assert_allclose(gappy.drift.factor, whole.drift.factor, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("white_lines", [None, 2])
def test_a_dark_of_one_line_states_the_uncertainty_of_many_or_none(tmp_path, white_lines):
    session = simulated(tmp_path, "pear", size_px=72, bands=24, effects=NOISE)
    whole = calibrate_session(session, CalibrationConfig())
    for dark in {capture.dark for capture in session.captures}:
        rewrite(dark, dark.read()[:1])
    if white_lines is not None:
        x0, y0, x1, _ = whole.white.roi
        rewrite(session.white.cube, session.white.cube.read()[y0 : y0 + white_lines])
        roi = (x0, 0, x1, white_lines)
    single = calibrate_session(
        open_session(session.path), CalibrationConfig(roi=None if white_lines is None else roi)
    )
    if white_lines is not None:
        assert single.uncertainty is None
        return
    np.testing.assert_allclose(single.noise.read_noise, whole.noise.read_noise, rtol=0.1)
    grey = np.full(len(whole.bands), 0.1)
    # One reading of the dark is subtracted instead of the mean of many.
    assert (single.uncertainty.constant > 1.5 * whole.uncertainty.constant).all()
    ratio = single.uncertainty.standard_deviation(grey) / whole.uncertainty.standard_deviation(grey)
    assert ((ratio > 0.95) & (ratio < 1.5)).all()


def test_hot_elements_do_not_move_the_tarp(tmp_path):
    session = write_session(tmp_path)
    tarp = np.full((SIZE_PX, SIZE_PX, BANDS), 0.05)
    tarp[8:40, 8:40] = 1.0
    write_capture(session, "white_reference", expose(tarp))
    for capture in open_session(session).captures:
        counts = capture.cube.read()
        counts[:, 24, : BANDS // 4] = 60_000
        write_capture(session, capture.name, counts)
    assert calibrate_session(open_session(session), CalibrationConfig()).white.roi == (8, 8, 40, 40)


def test_a_small_saturated_highlight_is_found(tmp_path):
    """Eight pixels of one line in each frame: none of the lines that are looked at in any case."""
    session, saturated = simulated(tmp_path, size_px=24, bands=4, frames=2, effects=NOISE), {}
    for capture in session.frames:
        counts = np.array(capture.cube.memmap())
        counts[13, 8:16] = 4095
        write_cube(capture.cube.header_path, counts, wavelengths_nm=capture.cube.wavelengths_nm)
        saturated[capture.name] = counts >= 4095
    session = open_session(session.path)
    calibration = calibrate_session(session, CalibrationConfig())
    pack_frames(session, calibration, tmp_path / "data")
    for capture in session.frames:
        flagged = ~validity(tmp_path / "data", session, capture)
        np.testing.assert_array_equal(flagged, saturated[capture.name][..., calibration.bands])


def own_white(session: Session, capture, lines=3):
    """A WHITEREF cube of a capture, of the session's tarp: a few of its lines."""
    tarp = session.white.cube
    middle = tarp.shape[0] // 2
    header = capture.cube.header_path
    write_cube(
        header.with_name(f"WHITEREF_{header.name}"),
        np.ascontiguousarray(tarp.memmap()[middle : middle + lines]),
        wavelengths_nm=tarp.wavelengths_nm,
        extra_header={"tint": tarp.integration_time_ms},
    )


@pytest.mark.slow
def test_other_sources_of_white(tmp_path):
    session = simulated(tmp_path)
    by_tarp = calibrate_session(session, CalibrationConfig())
    for capture in session.frames:
        own_white(session, capture)
    session = open_session(session.path)
    by_capture = calibrate_session(session, CalibrationConfig(white_source="capture"))
    assert by_capture.source == "capture"
    inside = slice(8, -8)  # where the tarp is
    np.testing.assert_allclose(by_capture.frames[0].gain[inside], by_tarp.frames[0].gain[[0] * 32], rtol=0.01)

    # The chamber's wall as a target inside the frames.
    by_target = calibrate_session(session, CalibrationConfig(white_source="target", roi=(0, 0, 8, 8)))
    wall = load_truth(session.path).light(session.frames[0].name).radiance()[0, 0]
    np.testing.assert_allclose(by_target.frames[0].gain[0] * wall, by_tarp.frames[0].gain[0], rtol=0.01)
    assert not by_target.drift_corrected


@pytest.mark.parametrize("copies", [True, False])
def test_drift_is_taken_off_where_one_white_was_copied_beside_every_frame(tmp_path, copies):
    session = simulated(tmp_path, frames=4, effects=DRIFTING)
    for number, capture in enumerate(session.frames):
        own_white(session, capture, lines=3 if copies else 3 + number)
    session = open_session(session.path)
    calibration = calibrate_session(session, CalibrationConfig(white_source="capture"))
    assert calibration.drift_corrected == copies
    told = {finding.name: finding.sentence for finding in check_calibration(session, calibration)}["drift"]
    assert ("every frame has a white of its own" in told) != copies


def test_the_uncertainty_is_that_of_the_shortest_exposure_whichever_frame_it_is(tmp_path):
    session = simulated(tmp_path, size_px=32, bands=8, effects=NOISE)
    usual = calibrate_session(session, CalibrationConfig()).uncertainty
    cube = session.frames[1].cube
    short = replace(session.frames[1], cube=replace(cube, integration_time_ms=cube.integration_time_ms / 4.0))
    frames = (session.frames[0], short, session.frames[2])
    found = calibrate_session(replace(session, frames=frames), CalibrationConfig()).uncertainty
    np.testing.assert_allclose(found.constant, 16.0 * usual.constant)
    np.testing.assert_allclose(found.linear, 4.0 * usual.linear)


def test_bands_that_are_listed_as_bad_do_not_hide_the_drift_of_the_others(tmp_path):
    session = simulated(tmp_path, frames=4, effects=DRIFTING)
    whole = calibrate_session(session, CalibrationConfig()).drift
    rng, listed = np.random.default_rng(0), np.arange(12) % 4 != 1
    for cube in (cube for capture in session.captures for cube in capture.cubes):
        counts = np.where(listed, cube.read(), rng.integers(100, 4000, cube.shape, np.uint16))
        rewrite(cube, counts, bbl=listed.astype(int).tolist())
    found = calibrate_session(open_session(session.path), CalibrationConfig())
    assert found.bands.tolist() == np.flatnonzero(listed).tolist()
    assert found.drift_corrected
    np.testing.assert_allclose(found.drift.factor[:, listed], whole.factor[:, listed], atol=2e-3)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_band_without_data_leaves_the_uncertainty_of_the_others(tmp_path):
    session = simulated(tmp_path, effects=["photon_noise", "read_noise"])
    whole = calibrate_session(session, CalibrationConfig())
    for capture in session.captures:
        for cube in (capture.cube, capture.dark):
            counts = cube.read()
            counts[..., 3] = 0
            rewrite(cube, counts, **{"data ignore value": 0})
    calibration = calibrate_session(open_session(session.path), CalibrationConfig(flat_field=True))
    assert 3 not in calibration.bands
    assert calibration.uncertainty is not None
    assert calibration.noise.counts_per_electron == pytest.approx(whole.noise.counts_per_electron, rel=0.05)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Session:
    return simulated(tmp_path_factory.mktemp("tiny"), size_px=24, bands=4, frames=2)


@pytest.mark.parametrize(
    ("config", "option"),
    [
        (CalibrationConfig(white_source="capture"), "white-source"),
        (CalibrationConfig(white_source="product"), "white-source"),
        (CalibrationConfig(white_source="target"), "roi"),
        (CalibrationConfig(bounds=(0.0, 2.0)), "bounds"),
        (CalibrationConfig(roi=(0, 600, 10, 700)), "roi"),
        (CalibrationConfig(roi=(0, 9, 9, 9)), "roi"),
        (CalibrationConfig(white_source="target", roi=(0, 0, 8, 8), flat_field=True), "flat-field"),
    ],
)
def test_settings_that_do_not_fit(tiny, config, option):
    with pytest.raises(InputError, match=f"--calibration.{option}"):
        calibrate_session(tiny, config)


def test_a_panel_that_is_no_perfect_white(tiny, tmp_path):
    (tmp_path / "panel.csv").write_text("wavelength_nm,reflectance\n350,0.9\n1050,0.8\n")
    perfect = calibrate_session(tiny, CalibrationConfig())
    info = replace(tiny.info, panel_reflectance=str(tmp_path / "panel.csv"))
    panel = calibrate_session(replace(tiny, info=info), CalibrationConfig())
    expected = np.interp(tiny.wavelengths_nm, [350.0, 1050.0], [0.9, 0.8])
    np.testing.assert_allclose(panel.frames[0].gain / perfect.frames[0].gain, expected[None], rtol=1e-12)


@pytest.mark.parametrize("gap", [np.nan, 0])
def test_an_element_without_dark_counts_is_dead_and_not_without_an_offset(tmp_path, gap):
    dtype, ignored = (np.float32, {}) if np.isnan(gap) else (np.uint16, {"data ignore value": 0})
    dark = np.full((2, SIZE_PX, BANDS), DARK, dtype)
    dark[:, 5, 2] = gap
    dark[0, 7, 3] = gap  # one line has data
    dark[..., 9] = gap
    for header in [*write_session(tmp_path).rglob("DARKREF_*.hdr")]:
        write_cube(header, dark, wavelengths_nm=WAVELENGTHS_NM, extra_header=ignored)
    found = calibrate_session(open_session(tmp_path), CalibrationConfig())
    assert np.argwhere(found.defects.dead).tolist() == [[5, 2]]
    assert found.bands.tolist() == [band for band in range(BANDS) if band != 9]
    np.testing.assert_allclose(found.frames[0].dark[:, found.bands], DARK)
    np.testing.assert_allclose(found.frames[0].gain[0, found.bands], 1.0 / LAMP[found.bands], rtol=1e-3)


@pytest.mark.parametrize(("lines", "offset", "noise"), [(2, 0.0, 0.0), (1, 1.0, 1.0), (8, 2.0, 1.0), (8, -3.0, 1.0)])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_a_dark_of_zeros_has_data_though_its_header_says_none(tmp_path, lines, offset, noise, dtype):
    rng = np.random.default_rng(0)
    for header in [*write_session(tmp_path).rglob("DARKREF_*.hdr")]:
        dark = np.clip(np.rint(rng.normal(offset, noise, (lines, SIZE_PX, BANDS))), 0, None).astype(dtype)
        write_cube(header, dark, wavelengths_nm=WAVELENGTHS_NM, extra_header={"data ignore value": 0})
    found = calibrate_session(open_session(tmp_path), CalibrationConfig())
    assert not found.defects.dead.any()
    assert len(found.bands) == BANDS
    np.testing.assert_allclose(found.frames[-1].dark, dark.mean(axis=0))
