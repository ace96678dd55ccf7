"""A ball that turns with its disc before still lamps: a shadow on it, a lamp that changes, and slips on the disc.

Spectra in the order of their wavelengths, and mirrored by a header that lists them in reverse.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.processing.appearance_checks import (
    SLIPS_DEG,
    check_appearance,
    check_band_order,
    slip_between,
    without_stationary_light,
)
from hsi_sc_nerf.processing.view_changes import PointViews
from hsi_sc_nerf.simulate.materials import MATERIALS, endmembers

NM = np.linspace(397.0, 1003.0, 204)
MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
SKINS = ("pear_skin", "apple_skin", "apple_blush", "kernel_yellow", "tomato_red", "tomato_green", "husk")
FRAMES, POINTS, COLOURS = 24, 2500, 4
NAMES = [f"ball_{number:02d}" for number in range(FRAMES)]
CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # right, up, towards it


def texture(directions, contrast):
    """Reflectance of the ball's skin: patches of a few centimetres, of other colours."""
    rng = np.random.default_rng(3)
    waves = np.sin(directions @ rng.normal(0.0, 5.0, (3, 12)) + rng.uniform(0.0, 6.0, 12))
    return 0.4 * np.exp(contrast * waves @ rng.normal(size=(12, COLOURS)) / np.sqrt(12.0))


def ball(light=lambda facing, frame: 1.0, slips_deg=None, contrast=0.3, noise=0.02, frames=FRAMES, seed=0):
    """Points of a ball in frames 15 degrees apart, under lamps that stand still, and light of one's own."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(POINTS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows, numbers, seen, values = [], [], [], []
    for frame in range(frames):
        turn = Rotation.from_euler("z", 360.0 * frame / FRAMES, degrees=True)
        facing = normals @ turn.as_matrix().T @ CAMERA
        visible = np.flatnonzero(facing[:, 2] > 0.5)
        slip = Rotation.from_euler("z", 0.0 if slips_deg is None else slips_deg[frame], degrees=True)
        skin = texture(slip.inv().apply(normals[visible]), contrast)
        lamps = 1.0 + 0.3 * facing[visible, 0] + 0.2 * facing[visible, 1]
        lit = lamps * light(facing[visible], frame) * np.exp(noise * rng.normal(size=len(visible)))
        rows.append(visible)
        numbers.append(np.full(len(visible), frame))
        seen.append(facing[visible])
        values.append(skin * lit[:, None] * np.exp(0.2 * noise * rng.normal(size=(len(visible), COLOURS))))
    point, frame, facing, reflectance = map(np.concatenate, (rows, numbers, seen, values))
    return PointViews(point, frame, facing, reflectance, 0.04 * normals, normals)


def found(**changes):
    return {finding.name: finding for finding in check_appearance(ball(**changes), NAMES)}


@pytest.mark.parametrize(
    ("noise", "contrast"), [(0.0, 0.0), (0.0, 0.4), (0.02, 0.1), (0.06, 0.0), (0.06, 0.1), (0.06, 0.4)]
)
def test_a_good_session_has_no_findings(noise, contrast):
    assert found(noise=noise, contrast=contrast) == {}


def test_too_few_frames_tell_nothing():
    assert found(frames=5, light=lambda facing, frame: 0.3 if frame == 2 else 1.0) == {}


@pytest.mark.parametrize(("shade", "level"), [(0.99, None), (0.92, "amber"), (0.5, "red"), (2.0, "red")])
def test_a_frame_that_is_darker_or_brighter(shade, level):
    findings = found(light=lambda facing, frame: shade if frame == 7 else 1.0)
    assert list(findings) == ([] if level is None else ["frames-light"])
    if level is not None:
        assert findings["frames-light"].level == level
        assert "--exclude ball_07" in findings["frames-light"].sentence
        assert findings["frames-light"].values == {"ball_07": pytest.approx(abs(np.log(shade)), rel=0.15)}


def test_a_shadow_on_a_part_of_the_object():
    def shadow(facing, frame):
        return np.where(facing[:, 0] > 0.3, 0.4, 1.0) if frame == 11 else 1.0

    findings = found(light=shadow, noise=0.06)
    assert list(findings) == ["frames-light"]
    assert list(findings["frames-light"].values) == ["ball_11"]
    assert findings["frames-light"].level == "red"


def test_a_lamp_that_fails_in_the_middle():
    def one_lamp(facing, frame):
        return 1.0 if frame < FRAMES // 2 else np.exp(0.5 * facing[:, 0] - 0.4)

    findings = found(light=one_lamp)
    assert findings["frames-light"].level == "red"
    assert "again" in findings["frames-light"].sentence


def test_every_other_frame_in_other_light():
    """None is usual, and none is left to look for slips in."""
    findings = found(light=lambda facing, frame: 1.0 if frame % 2 else 0.5)
    assert list(findings["frames-light"].values) == NAMES


@pytest.mark.parametrize(("slip_deg", "noise"), [(12.0, 0.06), (-15.0, 0.01)])
def test_an_object_that_slipped(slip_deg, noise):
    slips = np.where(np.arange(FRAMES) < 10, 0.0, slip_deg)
    finding = found(slips_deg=slips, noise=noise)["frames-slip"]
    assert finding.level == "red"
    assert finding.values["slip_deg"] == {
        "ball_09 to ball_10": pytest.approx(slip_deg, abs=1.6),
        "ball_23 to ball_00": pytest.approx(-slip_deg, abs=1.6),
    }


def test_slips_of_a_plain_object_do_not_show_and_do_no_harm():
    assert found(slips_deg=np.where(np.arange(FRAMES) < 10, 0.0, 15.0), contrast=0.0) == {}


def test_a_frame_in_shade_is_no_slip():
    findings = found(
        slips_deg=np.zeros(FRAMES),
        light=lambda facing, frame: np.where(facing[:, 0] > 0.0, 0.3, 1.0) if frame == 7 else 1.0,
    )
    assert list(findings) == ["frames-light"]


def test_what_stands_still_on_a_smooth_object_is_no_slip():
    """Reflections of the room on a mirror: the object seems to turn back with every step of the table."""
    assert found(slips_deg=-15.0 * np.arange(FRAMES), contrast=0.4) == {}


@pytest.mark.parametrize("slip_deg", [0.0, 12.0, -21.0])
def test_the_slip_between_two_frames_is_measured(slip_deg):
    views = ball(slips_deg=np.where(np.arange(FRAMES) < 10, 0.0, slip_deg), noise=0.01)
    first, second = (np.flatnonzero(views.frame == number) for number in (9, 10))
    found_deg, left = slip_between(views, without_stationary_light(views) / 0.1, first, second)
    assert found_deg == pytest.approx(slip_deg, abs=np.diff(SLIPS_DEG)[0])
    assert left == 1.0 if slip_deg == 0.0 else left < 0.6


@pytest.mark.parametrize("name", MATERIALS)
def test_no_material_looks_reversed(name):
    assert check_band_order(endmembers([name], NM)[0], NM) == []


@pytest.mark.parametrize("name", SKINS)
def test_reversed_wavelengths_of_plants(name):
    (finding,) = check_band_order(endmembers([name], NM)[0], NM[::-1])
    assert (finding.name, finding.level) == ("band-order", "red")
    assert finding.values["blue_over_infrared"] > 2.0


def test_grey_and_dark_things_and_other_ranges_tell_nothing():
    assert check_band_order(np.full(204, 0.5), NM[::-1]) == []
    assert check_band_order(np.linspace(0.09, 0.001, 204), NM) == []
    assert check_band_order(endmembers(["pear_skin"], NM)[0], NM[::-1] + 600.0) == []


def test_a_real_maize_kernel():
    counts, white, dark = (
        open_cube(MAIZE / f"{name}.hdr").read().astype(float)
        for name in ("4-22-22_right_same_B73_top_00", "white_reference_crop", "dark_reference_crop")
    )
    level = dark.mean(axis=(0, 1))
    reflectance = (counts[10:20, 15:30].mean(axis=(0, 1)) - level) / (white.mean(axis=(0, 1)) - level)
    nm = open_cube(MAIZE / "white_reference_crop.hdr").wavelengths_nm
    assert check_band_order(reflectance, nm) == []
    assert check_band_order(reflectance, nm[::-1])[0].level in ("amber", "red")
