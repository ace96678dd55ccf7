"""A room's lamp whose lines stand in the frames or in the white only, and materials that have none."""

from pathlib import Path

import numpy as np
import pytest

from hsi_sc_nerf.calibration.detector import light_of_some_lines
from hsi_sc_nerf.calibration.reference_checks import bright_pixels, check_lines, line_heights
from hsi_sc_nerf.capture.envi import open_cube, write_cube
from hsi_sc_nerf.capture.session import open_session

BANDS_NM = np.linspace(400.0, 1000.0, 205)
MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
LAMP = 2000.0 * np.exp(-(((BANDS_NM - 700.0) / 250.0) ** 2))
LINES = 1.0 + sum(np.exp(-0.5 * ((BANDS_NM - nm) / 4.0) ** 2) for nm in (546.0, 611.0))
LEAF = 0.06 + 0.5 / (1.0 + np.exp(-(BANDS_NM - 710.0) / 8.0)) - 0.1 * np.exp(-0.5 * ((BANDS_NM - 970.0) / 25.0) ** 2)
BUD = 0.3 + 0.2 / (1.0 + np.exp(-(BANDS_NM - 600.0) / 15.0)) - 0.15 * np.exp(-0.5 * ((BANDS_NM - 676.0) / 12.0) ** 2)


def write(folder, name, reflectance, light, seed=0):
    rng = np.random.default_rng([seed, len(name)])
    counts = 100.0 + reflectance * light * LAMP
    counts = counts + rng.normal(0.0, 4.0, counts.shape) + rng.normal(0.0, 0.3, counts.shape) * np.sqrt(counts)
    for prefix, cube in (("", counts), ("DARKREF_", rng.normal(100.0, 4.0, (8, 32, 205)))):
        header = folder / name / "capture" / f"{prefix}{name}.hdr"
        write_cube(header, np.clip(np.rint(cube), 0, 4095).astype(np.uint16), wavelengths_nm=BANDS_NM)


def session(folder, on_white=1.0, on_frames=1.0):
    """A wall, and a leaf or a bud before it."""
    write(folder, "white_reference", np.ones((32, 32, 205)), on_white)
    for number in range(3):
        image = np.full((32, 32, 205), 0.7)
        image[8:24, 8:28] = LEAF if number else BUD
        write(folder, f"leaf_{number}", image, on_frames, number)
    return open_session(folder)


def found(opened):
    frames = [bright_pixels(light_of_some_lines(frame.cube, frame.dark)) for frame in opened.frames]
    return check_lines(opened, frames)


def test_materials_and_lamps_that_both_see_have_no_lines(tmp_path):
    assert found(session(tmp_path / "plain"))[0].level == "green"
    both = 1.0 + 0.5 * (LINES - 1.0)
    assert found(session(tmp_path / "both", both, both))[0].level == "green"
    # A leaf alone, with its steep edge, before no wall.
    assert np.abs(line_heights(LEAF[None], 15)).max() < 0.025


@pytest.mark.parametrize(("strength", "level"), [(0.06, "amber"), (0.4, "red")])
def test_a_lamp_that_shone_on_the_frames_only(tmp_path, strength, level):
    (finding,) = found(session(tmp_path, on_frames=1.0 + strength * (LINES - 1.0)))
    assert finding.level == level
    assert "the frames only" in finding.sentence
    assert finding.values["value"] == pytest.approx(strength, rel=0.3)


def test_a_lamp_that_shone_on_the_white_only(tmp_path):
    (finding,) = found(session(tmp_path, on_white=1.0 + 0.3 * (LINES - 1.0)))
    assert finding.level == "red"
    assert "the white only" in finding.sentence


def test_few_broad_bands_tell_nothing(tmp_path):
    opened = session(tmp_path)
    for capture in opened.captures:
        for cube in capture.cubes:
            write_cube(cube.header_path, cube.read()[..., ::8], wavelengths_nm=BANDS_NM[::8])
    assert found(open_session(tmp_path)) == []


def test_a_real_cube_has_no_lines_where_its_white_is_dark(tmp_path):
    kernel, white, dark = (
        open_cube(MAIZE / f"{name}.hdr")
        for name in ("4-22-22_right_same_B73_top_00", "white_reference_crop", "dark_reference_crop")
    )
    for name, counts in (("a", kernel.read()), ("b", kernel.read()[::-1]), ("white_reference", white.read())):
        write_cube(tmp_path / f"{name}.hdr", counts, wavelengths_nm=kernel.wavelengths_nm)
        write_cube(tmp_path / f"DARKREF_{name}.hdr", dark.read(), wavelengths_nm=kernel.wavelengths_nm)
    assert found(open_session(tmp_path))[0].level == "green"
