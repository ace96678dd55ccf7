"""Dark references that hold light, are missing, or belong to another exposure; lamps with lines on one of the two.

Lines of a room's lamp are in the frames or in the white only, and materials have none.
"""

from pathlib import Path

import numpy as np
import pytest
from capture_factory import BANDS, DARK, LAMP, SIZE_PX, WAVELENGTHS_NM, write_session

from hsi_sc_nerf.calibration.detector import light_of_some_lines
from hsi_sc_nerf.calibration.reference_checks import (
    bright_pixels,
    check_dark,
    check_lines,
    light_over_white,
    line_heights,
)
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import open_session

BANDS_NM = np.linspace(400.0, 1000.0, 205)
MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
HALOGEN = 2000.0 * np.exp(-(((BANDS_NM - 700.0) / 250.0) ** 2))
LINES = 1.0 + sum(np.exp(-0.5 * ((BANDS_NM - nm) / 4.0) ** 2) for nm in (546.0, 611.0))
LEAF = 0.06 + 0.5 / (1.0 + np.exp(-(BANDS_NM - 710.0) / 8.0)) - 0.1 * np.exp(-0.5 * ((BANDS_NM - 970.0) / 25.0) ** 2)
BUD = 0.3 + 0.2 / (1.0 + np.exp(-(BANDS_NM - 600.0) / 15.0)) - 0.15 * np.exp(-0.5 * ((BANDS_NM - 676.0) / 12.0) ** 2)


@pytest.fixture
def folder(tmp_path):
    return write_session(tmp_path)


def write_dark(folder, name, light_over_lamp=0.0, role="DARKREF", **fields):
    """A dark reference with read noise, a pattern over the bands, and some light."""
    rng = np.random.default_rng(len(name))
    counts = DARK + 2.0 * np.cos(np.arange(BANDS)) + light_over_lamp * LAMP + rng.normal(0, 3, (8, SIZE_PX, BANDS))
    path = folder / name / "capture" / f"{role}_{name}.hdr"
    write_cube(path, np.rint(counts).astype(np.uint16), wavelengths_nm=WAVELENGTHS_NM, extra_header=fields)


def dark_finding(folder, source="auto"):
    return check_dark(open_session(folder), source)


def remove_darks(folder, pattern):
    for path in folder.glob(f"{pattern}/capture/DARKREF*"):
        path.unlink()


@pytest.mark.parametrize(("light", "level"), [(None, "green"), (0.0, "green"), (0.03, "red")])
def test_all_dark_references_alike_the_whites_own_too(folder, light, level):
    for name in () if light is None else ("ball_1", "ball_2", "ball_3", "ball_4", "white_reference"):
        write_dark(folder, name, light)
    assert dark_finding(folder).level == level


@pytest.mark.parametrize(("light", "level"), [(0.001, "green"), (0.006, "amber"), (0.05, "red"), (0.9, "red")])
@pytest.mark.parametrize("name", ["ball_2", "white_reference"])
def test_a_dark_reference_with_light(folder, name, light, level):
    write_dark(folder, name, light)
    finding = dark_finding(folder)
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
    assert dark_finding(folder).level == "green"


def test_one_capture_without_a_dark(folder):
    remove_darks(folder, "ball_3")
    finding = dark_finding(folder)
    assert finding.level == "red"
    assert finding.values["without"] == ["ball_3"]
    assert "--exclude ball_3" in finding.sentence


def test_only_the_white_or_only_the_frames_without_a_dark(folder):
    remove_darks(folder, "white_reference")
    assert "exclude" not in dark_finding(folder).sentence
    assert dark_finding(folder).level == "red"
    write_dark(folder, "white_reference")
    remove_darks(folder, "ball_*")
    assert dark_finding(folder).level == "red"


@pytest.mark.parametrize(("offset", "level"), [(0, "amber"), (-DARK, "green")])
def test_no_dark_at_all(folder, offset, level):
    """Counts of at least the offset are doubtful; counts that reach zero have none."""
    remove_darks(folder, "*")
    header = folder / "ball_1" / "capture" / "ball_1.hdr"
    counts = open_session(folder).frames[0].cube.read().astype(int)
    counts[:, :20] = DARK
    write_cube(header, (counts + offset).astype(np.uint16), wavelengths_nm=WAVELENGTHS_NM)
    assert dark_finding(folder).level == level


def test_a_dark_of_another_exposure(folder):
    header = folder / "ball_1" / "capture" / "ball_1.hdr"
    header.write_text(header.read_text() + "tint = 100\n")
    write_dark(folder, "ball_1", tint=100)
    assert dark_finding(folder).level == "green"
    write_dark(folder, "ball_1", tint=10)
    assert dark_finding(folder).level == "amber"
    assert "ball_1" in dark_finding(folder).sentence


def test_whites_of_each_capture_need_darks_as_well(folder):
    white = np.rint(np.ones((2, SIZE_PX, BANDS)) * LAMP + DARK).astype(np.uint16)
    for number in range(1, 5):
        path = folder / f"ball_{number}" / "capture" / f"WHITEREF_ball_{number}.hdr"
        write_cube(path, white, wavelengths_nm=WAVELENGTHS_NM, extra_header={"tint": 5})
        write_dark(folder, f"ball_{number}")
    assert dark_finding(folder).level == "green"
    assert dark_finding(folder, "capture").level == "red"
    for number in range(1, 5):
        write_dark(folder, f"ball_{number}", role="WHITEDARKREF", light_over_lamp=0.02 if number == 3 else 0.0)
    assert dark_finding(folder, "capture").level == "red"
    assert "WHITEREF_ball_3" in dark_finding(folder, "capture").sentence
    assert "ball_2" not in dark_finding(folder, "capture").sentence


def test_a_pattern_of_few_bands_is_no_light():
    """Three bands, or bands in which the white is even, tell nothing."""
    white = np.array([1000.0, 2000.0, 1500.0, 1800.0, 1200.0])
    assert light_over_white(100.0 + 0.1 * white, white) == pytest.approx(0.1)
    assert light_over_white(100.0 + 0.1 * white[:3], white[:3]) == 0.0
    assert light_over_white(np.array([101.0, 103.0, 99.0, 104.0, 98.0]), white) == 0.0
    assert light_over_white(np.full(5, 100.0), np.full(5, 3000.0)) == 0.0


def write_leaf(folder, name, reflectance, light, seed=0):
    rng = np.random.default_rng([seed, len(name)])
    counts = 100.0 + reflectance * light * HALOGEN
    counts = counts + rng.normal(0.0, 4.0, counts.shape) + rng.normal(0.0, 0.3, counts.shape) * np.sqrt(counts)
    for prefix, cube in (("", counts), ("DARKREF_", rng.normal(100.0, 4.0, (8, 32, 205)))):
        header = folder / name / "capture" / f"{prefix}{name}.hdr"
        write_cube(header, np.clip(np.rint(cube), 0, 4095).astype(np.uint16), wavelengths_nm=BANDS_NM)


def leaf_session(folder, on_white=1.0, on_frames=1.0):
    """A wall, and a leaf or a bud before it."""
    write_leaf(folder, "white_reference", np.ones((32, 32, 205)), on_white)
    for number in range(3):
        image = np.full((32, 32, 205), 0.7)
        image[8:24, 8:28] = LEAF if number else BUD
        write_leaf(folder, f"leaf_{number}", image, on_frames, number)
    return open_session(folder)


def line_findings(opened, source="auto"):
    frames = [bright_pixels(light_of_some_lines(frame.cube, frame.dark)) for frame in opened.frames]
    return check_lines(opened, frames, source)


def test_materials_and_lamps_that_both_see_have_no_lines(tmp_path):
    assert line_findings(leaf_session(tmp_path / "plain"))[0].level == "green"
    both = 1.0 + 0.5 * (LINES - 1.0)
    assert line_findings(leaf_session(tmp_path / "both", both, both))[0].level == "green"
    # A leaf alone, with its steep edge, before no wall.
    assert np.abs(line_heights(LEAF[None], 15)).max() < 0.025


@pytest.mark.parametrize(("strength", "level"), [(0.06, "amber"), (0.4, "red")])
def test_a_lamp_that_shone_on_the_frames_only(tmp_path, strength, level):
    (finding,) = line_findings(leaf_session(tmp_path, on_frames=1.0 + strength * (LINES - 1.0)))
    assert finding.level == level
    assert "the frames only" in finding.sentence
    assert finding.values["value"] == pytest.approx(strength, rel=0.3)


def test_a_lamp_that_shone_on_the_white_only(tmp_path):
    opened = leaf_session(tmp_path, on_white=1.0 + 0.3 * (LINES - 1.0))
    assert line_findings(opened, "target") == []  # a target is in the frames' light
    (finding,) = line_findings(opened)
    assert finding.level == "red"
    assert "the white only" in finding.sentence


def test_few_broad_bands_tell_nothing(tmp_path):
    opened = leaf_session(tmp_path)
    for capture in opened.captures:
        for cube in capture.cubes:
            write_cube(cube.header_path, cube.read()[..., ::8], wavelengths_nm=BANDS_NM[::8])
    assert line_findings(open_session(tmp_path)) == []


def test_a_real_cube_has_no_lines_where_its_white_is_dark(tmp_path):
    kernel, white, dark = (
        open_cube(MAIZE / f"{name}.hdr")
        for name in ("4-22-22_right_same_B73_top_00", "white_reference_crop", "dark_reference_crop")
    )
    for name, counts in (("a", kernel.read()), ("b", kernel.read()[::-1]), ("white_reference", white.read())):
        write_cube(tmp_path / f"{name}.hdr", counts, wavelengths_nm=kernel.wavelengths_nm)
        write_cube(tmp_path / f"DARKREF_{name}.hdr", dark.read(), wavelengths_nm=kernel.wavelengths_nm)
    assert line_findings(open_session(tmp_path))[0].level == "green"


def test_few_bright_pixels_keep_no_others_in_memory():
    light = np.random.default_rng(0).uniform(0.5, 1.0, (16, 512, 8)).astype(np.float32)
    kept = bright_pixels(light)
    assert 200 < len(kept) < 600
    assert kept.base is None
