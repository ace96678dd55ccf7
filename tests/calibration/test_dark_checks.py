"""Dark references that hold light, are missing, or belong to another exposure."""

import numpy as np
import pytest
from capture_factory import BANDS, DARK, LAMP, SIZE_PX, WAVELENGTHS_NM, write_session

from hsi_sc_nerf.calibration.reference_checks import check_dark, light_over_white
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import open_session


@pytest.fixture
def folder(tmp_path):
    return write_session(tmp_path)


def write_dark(folder, name, light_over_lamp=0.0, role="DARKREF", **fields):
    """A dark reference with read noise, a pattern over the bands, and some light."""
    rng = np.random.default_rng(len(name))
    counts = DARK + 2.0 * np.cos(np.arange(BANDS)) + light_over_lamp * LAMP + rng.normal(0, 3, (8, SIZE_PX, BANDS))
    path = folder / name / "capture" / f"{role}_{name}.hdr"
    write_cube(path, np.rint(counts).astype(np.uint16), wavelengths_nm=WAVELENGTHS_NM, extra_header=fields)


def found(folder, source="auto"):
    return check_dark(open_session(folder), source)


def remove_darks(folder, pattern):
    for path in folder.glob(f"{pattern}/capture/DARKREF*"):
        path.unlink()


def test_good_dark_references(folder):
    assert found(folder).level == "green"
    for name in ("ball_1", "ball_2", "ball_3", "ball_4", "white_reference"):
        write_dark(folder, name)
    assert found(folder).level == "green"


@pytest.mark.parametrize(("light", "level"), [(0.001, "green"), (0.006, "amber"), (0.05, "red"), (0.9, "red")])
@pytest.mark.parametrize("name", ["ball_2", "white_reference"])
def test_a_dark_reference_with_light(folder, name, light, level):
    write_dark(folder, name, light)
    finding = found(folder)
    assert finding.level == level
    assert (name in finding.sentence) == (level != "green")
    assert finding.values["light_over_white"][name] == pytest.approx(light, rel=0.05, abs=0.001)


def test_spectra_that_were_read_before_are_taken(folder):
    opened = open_session(folder)
    assert check_dark(opened, "auto", {"ball_2": DARK + 0.05 * LAMP, "ball_3": None}).level == "red"


def test_bands_without_data_are_no_light(folder):
    for header in folder.glob("*/capture/*.hdr"):
        cube = open_cube(header)
        counts = cube.read().astype(np.float32)
        counts[..., -2:] = np.nan
        counts[0, 0] = np.nan
        write_cube(header, counts, wavelengths_nm=WAVELENGTHS_NM)
    assert found(folder).level == "green"


def test_all_darks_with_light_the_whites_own_too(folder):
    for name in ("ball_1", "ball_2", "ball_3", "ball_4", "white_reference"):
        write_dark(folder, name, 0.03)
    assert found(folder).level == "red"


def test_one_capture_without_a_dark(folder):
    remove_darks(folder, "ball_3")
    finding = found(folder)
    assert finding.level == "red"
    assert finding.values["without"] == ["ball_3"]
    assert "--exclude ball_3" in finding.sentence


def test_only_the_white_or_only_the_frames_without_a_dark(folder):
    remove_darks(folder, "white_reference")
    assert "exclude" not in found(folder).sentence
    assert found(folder).level == "red"
    write_dark(folder, "white_reference")
    remove_darks(folder, "ball_*")
    assert found(folder).level == "red"


@pytest.mark.parametrize(("offset", "level"), [(0, "amber"), (-DARK, "green")])
def test_no_dark_at_all(folder, offset, level):
    """Counts of at least the offset are doubtful; counts that reach zero have none."""
    remove_darks(folder, "*")
    header = folder / "ball_1" / "capture" / "ball_1.hdr"
    counts = open_session(folder).frames[0].cube.read().astype(int)
    counts[:, :20] = DARK
    write_cube(header, (counts + offset).astype(np.uint16), wavelengths_nm=WAVELENGTHS_NM)
    assert found(folder).level == level


def test_a_dark_of_another_exposure(folder):
    header = folder / "ball_1" / "capture" / "ball_1.hdr"
    header.write_text(header.read_text() + "tint = 100\n")
    write_dark(folder, "ball_1", tint=100)
    assert found(folder).level == "green"
    write_dark(folder, "ball_1", tint=10)
    assert found(folder).level == "amber"
    assert "ball_1" in found(folder).sentence


def test_whites_of_each_capture_need_darks_as_well(folder):
    white = np.rint(np.ones((2, SIZE_PX, BANDS)) * LAMP + DARK).astype(np.uint16)
    for number in range(1, 5):
        path = folder / f"ball_{number}" / "capture" / f"WHITEREF_ball_{number}.hdr"
        write_cube(path, white, wavelengths_nm=WAVELENGTHS_NM, extra_header={"tint": 5})
        write_dark(folder, f"ball_{number}")
    assert found(folder).level == "green"
    assert found(folder, "capture").level == "red"
    for number in range(1, 5):
        write_dark(folder, f"ball_{number}", role="WHITEDARKREF", light_over_lamp=0.02 if number == 3 else 0.0)
    assert found(folder, "capture").level == "red"
    assert "WHITEREF_ball_3" in found(folder, "capture").sentence
    assert "ball_2" not in found(folder, "capture").sentence


def test_a_pattern_of_few_bands_is_no_light():
    """Three bands, or bands in which the white is even, tell nothing."""
    white = np.array([1000.0, 2000.0, 1500.0, 1800.0, 1200.0])
    assert light_over_white(100.0 + 0.1 * white, white) == pytest.approx(0.1)
    assert light_over_white(100.0 + 0.1 * white[:3], white[:3]) == 0.0
    assert light_over_white(np.array([101.0, 103.0, 99.0, 104.0, 98.0]), white) == 0.0
    assert light_over_white(np.full(5, 100.0), np.full(5, 3000.0)) == 0.0
