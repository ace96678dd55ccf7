"""The files of one frame in a packed dataset, and when it counts as finished."""

import hashlib
import json
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest

from hsi_sc_nerf.calibration.reflectance import FrameCalibration, PixelCounts
from hsi_sc_nerf.calibration.session_calibration import CalibrationConfig, calibrate_session
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE, PixelFlag, unpack
from hsi_sc_nerf.processing.foreground_score import smoothed_bins
from hsi_sc_nerf.processing.frames import FramePaths, pack_frames, process_frame, read_cache, session_fingerprint

WAVELENGTHS_NM = np.array([440.0, 500.0, 550.0, 600.0, 650.0, 900.0])
BANDS = len(WAVELENGTHS_NM)
PSEUDO_RGB_NM = (600.0, 550.0, 440.0)
CALIBRATION = FrameCalibration(
    dark=np.full((1, BANDS), 100.0),
    gain=np.full((1, BANDS), 1 / 2000),
    bands=np.arange(BANDS),
    saturation_counts=4000.0,
)


@pytest.fixture
def cube(tmp_path):
    reflectance = np.random.default_rng(0).uniform(-0.02, 1.05, (20, 16, BANDS))
    counts = np.rint(reflectance * 2000 + 100).astype(np.uint16)
    counts[3, 4, 2] = 4050
    write_cube(
        tmp_path / "raw.hdr",
        counts,
        wavelengths_nm=WAVELENGTHS_NM,
        extra_header={"fwhm": [7.0, 7.1, 7.2, 7.3, 7.4, 8.0]},
    )
    return open_cube(tmp_path / "raw.hdr")


def process(cube, root, calibration=CALIBRATION, stamp="made"):
    paths = FramePaths.of(root, "frame")
    return paths, process_frame(cube, calibration, paths, stamp, pseudo_rgb_nm=PSEUDO_RGB_NM)


def test_everything_is_written_upright(cube, tmp_path):
    bands = np.array([0, 1, 2, 3, 4])
    paths, cache = process(cube, tmp_path / "data", replace(CALIBRATION, bands=bands, quarter_turns=1))
    packed = open_cube(paths.cube)
    assert packed.shape == (16, 20, 5)
    np.testing.assert_array_equal(packed.wavelengths_nm, WAVELENGTHS_NM[bands])
    np.testing.assert_array_equal(packed.fwhm_nm, [7.0, 7.1, 7.2, 7.3, 7.4])
    assert (packed.reflectance_scale, packed.ignore_value) == (REFLECTANCE_SCALE, FLAGGED)

    expected = np.rot90(np.clip((cube.read()[..., bands] - 100.0) / 2000, 0.0, 1.0))
    reflectance, valid = unpack(packed.read())
    assert np.argwhere(~valid).tolist() == [[11, 3, 2]]
    np.testing.assert_allclose(reflectance[valid], expected[valid], atol=1.01 / REFLECTANCE_SCALE)
    flags = cv2.imread(str(paths.flags), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(flags, np.where(valid.all(axis=-1), 0, PixelFlag.SATURATED))
    picture = cv2.imread(str(paths.image))[..., ::-1]
    np.testing.assert_allclose(picture / 255.0, expected[..., [3, 2, 0]], atol=0.5 / 255 + 1e-4)
    np.testing.assert_allclose(cache.gray / 255.0, expected[..., 1:5].mean(axis=-1), atol=0.5 / 255 + 1e-4)
    bins = np.moveaxis(expected, -1, 0).astype(np.float32)
    np.testing.assert_allclose(cache.bins, smoothed_bins(bins), atol=1e-3)
    assert cache.pixel_counts.saturated.tolist() == [0, 0, 1, 0, 0]
    assert cache.pixel_counts.clipped_low.min() > 0
    assert not list((tmp_path / "data").rglob("*partial*"))


def test_finished_reflectance_goes_the_same_way(tmp_path):
    rng = np.random.default_rng(1)
    stored = rng.uniform(0.0, 10_000.0, (8, 6, BANDS)).astype(np.float32)
    stored[:5, :5] = -9999.0
    header = {"reflectance scale factor": 10_000, "data ignore value": -9999}
    path = tmp_path / "product.hdr"
    write_cube(path, stored, wavelengths_nm=WAVELENGTHS_NM, interleave="bsq", extra_header=header)
    cube = open_cube(path)
    calibration = FrameCalibration(
        dark=np.zeros((1, BANDS)),
        gain=np.full((1, BANDS), 1 / cube.reflectance_scale),
        bands=np.arange(BANDS),
        ignore_value=cube.ignore_value,
    )
    paths, cache = process(cube, tmp_path / "data", calibration)
    reflectance, valid = unpack(open_cube(paths.cube).read())
    np.testing.assert_array_equal(valid, stored != -9999.0)
    np.testing.assert_allclose(reflectance[valid], stored[valid] / 10_000, atol=1e-5)
    assert cache.pixel_counts.no_data.tolist() == [25] * BANDS
    assert cache.bins[:, 2, 2].max() < 1e-6


def test_the_cache_of_a_finished_frame_is_read_again(cube, tmp_path):
    paths, cache = process(cube, tmp_path / "data")
    again = read_cache(paths, "made")
    np.testing.assert_array_equal(again.gray, cache.gray)
    np.testing.assert_array_equal(again.bins, cache.bins)
    for field in fields(PixelCounts):
        np.testing.assert_array_equal(
            getattr(again.pixel_counts, field.name), getattr(cache.pixel_counts, field.name)
        )
    assert read_cache(paths, "other files") is None


@pytest.mark.parametrize("kind", ["image", "cube", "flags", "bins", "cache"])
def test_a_frame_that_lacks_a_file_is_not_finished(cube, tmp_path, kind):
    paths, _ = process(cube, tmp_path / "data")
    getattr(paths, kind).unlink()
    assert read_cache(paths, "made") is None


@pytest.mark.parametrize("kind", ["cache", "bins"])
def test_a_damaged_note_is_not_believed(cube, tmp_path, kind):
    paths, _ = process(cube, tmp_path / "data")
    whole = getattr(paths, kind).read_bytes()
    for at in range(0, len(whole), len(whole) // 60) if kind == "cache" else ():
        getattr(paths, kind).write_bytes(whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :])
        assert read_cache(paths, "made") is None
    for damaged in (b"", whole[:-1], whole + b"0"):
        getattr(paths, kind).write_bytes(damaged)
        assert read_cache(paths, "made") is None
    getattr(paths, kind).write_bytes(whole)
    assert read_cache(paths, "made") is not None


@pytest.mark.parametrize("damage", [(b"'descr'", b"(('desc"), (b"fingerprint", b"fingerprinx"), (b"PK", b"KP")])
def test_a_note_that_was_damaged_before_its_digest_was_taken_is_not_believed(cube, tmp_path, damage):
    paths, _ = process(cube, tmp_path / "data")
    note = paths.cache.read_bytes()[hashlib.sha256().digest_size :].replace(*damage, 1)
    paths.cache.write_bytes(hashlib.sha256(note).digest() + note)
    assert read_cache(paths, "made") is None


def test_a_frame_whose_pictures_cannot_be_written_has_no_cache(cube, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "images").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        process(cube, tmp_path / "data")
    assert read_cache(FramePaths.of(tmp_path / "data", "frame"), "made") is None


def test_a_cache_does_not_vouch_for_a_cube_of_other_settings(cube, tmp_path):
    paths, _ = process(cube, tmp_path / "data")
    paths.image.unlink()
    paths.image.mkdir()  # the cube is replaced, then the picture cannot be written
    with pytest.raises(InputError, match="cannot be written"):
        process(cube, tmp_path / "data", replace(CALIBRATION, gain=CALIBRATION.gain / 2.0), stamp="other settings")
    assert not paths.cache.exists()


def test_corrected_band_centres_reach_the_packed_cubes(tmp_path):
    session, output = tmp_path / "session", tmp_path / "data"
    rng = np.random.default_rng(0)
    for name in ("ball_1", "ball_2", "white_reference"):
        counts = rng.uniform(1000.0, 3000.0, (20, 16, BANDS)).astype(np.uint16)
        write_cube(session / f"{name}.hdr", counts, wavelengths_nm=None)
    (session / "session.json").write_text(json.dumps({"band_centres": "bands.csv"}))

    def packed_nm(first_nm: float) -> np.ndarray:
        centres_nm = first_nm + 50.0 * np.arange(BANDS)
        (session / "bands.csv").write_text("nm\n" + "\n".join(map(str, centres_nm)) + "\n")
        opened = open_session(session)
        pack_frames(opened, calibrate_session(opened, CalibrationConfig(lamp_drift="never")), output)
        return open_cube(FramePaths.of(output, "ball_2").cube).wavelengths_nm

    assert packed_nm(450.0)[0] == 450.0
    assert packed_nm(500.0)[0] == 500.0


def test_another_place_in_the_turn_is_another_dataset(tmp_path):
    """A capture that is left out and a copy of another takes none."""

    def write(name: str, level: int) -> None:
        write_cube(tmp_path / name, np.full((4, 4, BANDS), level, np.uint16), wavelengths_nm=WAVELENGTHS_NM)

    for number in range(4):
        write(f"ball_{number}.hdr", number)
    made = []
    for level in (2, 1):
        write("ball_2.hdr", level)
        session = open_session(tmp_path, exclude=["ball_2"])
        made.append((session.places, session_fingerprint(session, CalibrationConfig())))
    assert [places for places, _ in made] == [(0, 1, 3), (0, 1, 2)]
    assert made[0][1] != made[1][1]
