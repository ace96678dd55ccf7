from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsi_sc_nerf.calibration.detector import Defects, dark_columns
from hsi_sc_nerf.calibration.reflectance import FrameCalibration, PictureBands, pack_counts
from hsi_sc_nerf.calibration.report import draw_column_white, draw_white_reference
from hsi_sc_nerf.calibration.white_reference import (
    ElementSums,
    column_white,
    deviation_map,
    mean_over_columns,
    smooth_spectrum,
    white_mask,
    white_reference,
)
from hsi_sc_nerf.capture.envi import Cube, open_cube, write_cube
from hsi_sc_nerf.capture.session import Capture
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.spectra import nearest_bands

MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"
WAVELENGTHS_NM = np.linspace(400.0, 1000.0, 7)
NARROW_NM = np.linspace(400.0, 412.0, 7)
"""Bands so narrow that five of them are smoothed."""
LAMP = np.array([100.0, 400.0, 900.0, 1600.0, 1200.0, 800.0, 300.0])


def capture(
    folder: Path, name: str, counts: np.ndarray, dark: np.ndarray | None = None, bands_nm: np.ndarray = WAVELENGTHS_NM
) -> Capture:
    cubes = []
    for stem, array in ((name, counts), (f"DARKREF_{name}", dark)):
        cubes.append(None if array is None else cube_of(folder, stem, array, bands_nm))
    return Capture(name, cubes[0], cubes[1])


def cube_of(folder: Path, name: str, array: np.ndarray, bands_nm: np.ndarray = WAVELENGTHS_NM, **header) -> Cube:
    write_cube(folder / f"{name}.hdr", array, wavelengths_nm=bands_nm, extra_header=header)
    return open_cube(folder / f"{name}.hdr")


def defects(samples: int = 60, bands: int = 7, dead=(), bad_bands=(), saturation_counts=None) -> Defects:
    of_elements, of_bands = np.zeros((samples, bands), bool), np.zeros(bands, bool)
    for element in dead:
        of_elements[element] = True
    of_bands[list(bad_bands)] = True
    return Defects(saturation_counts, of_elements, of_bands)


def tarp_scene(level: float = 10.0) -> np.ndarray:
    """A tarp in the middle of a dark image, brighter by the lamp's spectrum, with a fold and a bright speck."""
    counts = np.full((40, 60, 7), level)
    counts[8:32, 10:50] += LAMP
    counts[8:32, 10:16] -= 0.3 * LAMP
    counts[20, 30] += 0.5 * LAMP
    return counts


def test_deviation_is_the_mean_of_ratios():
    rng = np.random.default_rng(0)
    white = rng.uniform(0.5, 1.5, (4, 5, 7)) * LAMP
    mean = np.array([np.mean(white[..., band]) for band in range(7)])
    slow = np.zeros((4, 5))
    for y in range(4):
        for x in range(5):
            slow[y, x] = sum(abs(white[y, x, b] - mean[b]) / mean[b] for b in range(7)) / 7
    np.testing.assert_allclose(deviation_map(white), slow, rtol=1e-12)
    ratio_of_means = np.abs(white - mean).mean(-1) / mean.mean()
    assert np.abs(slow - ratio_of_means).max() > 0.01
    # Bands without counts are left out.
    white = np.stack([np.full((3, 3), 2.0), np.zeros((3, 3))], axis=-1)
    white[0, 0, 0] = 11.0
    np.testing.assert_allclose(deviation_map(white)[0, 0], 11.0 / 3.0 - 1.0)
    assert np.isinf(deviation_map(np.zeros((3, 3, 2)))).all()


def test_deviation_leaves_dead_elements_out():
    white = np.random.default_rng(0).uniform(0.5, 1.5, (4, 5, 7)) * LAMP
    dead = np.zeros((5, 7), bool)
    dead[2, 3] = dead[0, :] = True
    dead[0, 5] = False
    spoilt = np.where(dead, 1e5, white)
    found = deviation_map(spoilt, dead)
    assert found.max() < 1.0
    mean = [white[:, ~dead[:, b], b].mean() for b in range(7)]
    expected = np.mean([abs(white[1, 2, b] / mean[b] - 1.0) for b in range(7) if b != 3])
    assert found[1, 2] == pytest.approx(expected, rel=1e-12)
    assert found[1, 0] == pytest.approx(abs(white[1, 0, 5] / mean[5] - 1.0), rel=1e-12)


def test_mask_keeps_the_percentile_and_its_largest_part():
    deviation = np.full((20, 40), 0.5)
    deviation[:, :24] = 0.01
    deviation[:, 32:] = 0.01
    deviation[10, 10] = 0.5
    mask = white_mask(deviation, percentile=70.0, kernel_px=5)
    expected = np.zeros((20, 40), bool)
    expected[:, :24] = True
    np.testing.assert_array_equal(mask, expected)


@given(st.integers(1, 60), st.floats(-5.0, 5.0), st.floats(-100.0, 100.0), st.sampled_from([1, 3, 5, 9]))
def test_smoothing_leaves_lines_alone_in_every_band(bands, slope, offset, window):
    line = offset + slope * np.arange(bands)
    smoothed, averaged = smooth_spectrum(line, 3.0 * np.arange(bands), window, 1e3)
    np.testing.assert_allclose(smoothed, line, atol=1e-10)
    distance = np.minimum(np.arange(bands), np.arange(bands)[::-1])
    np.testing.assert_array_equal(averaged, np.minimum(window, 2 * distance + 1))


NARROW, UNEVEN = 3.0 * np.arange(7), np.array([0.0, 3, 6, 9, 40, 71, 102])


@pytest.mark.parametrize(
    ("bands_nm", "window", "max_nm", "expected"),
    [
        (700.0 - NARROW, 5, 12.0, [0, 0, 1.2, 1.2, 1.2, 0, 0]),
        (NARROW, 1, 12.0, [0, 0, 0, 6, 0, 0, 0]),
        (NARROW, 5, 11.9, [0, 0, 2, 2, 2, 0, 0]),
        (10 * NARROW, 5, 15.0, [0, 0, 0, 6, 0, 0, 0]),
        (UNEVEN, 5, 15.0, [0, 0, 2, 6, 0, 0, 0]),
    ],
    ids=["all five, descending", "none", "three", "broad bands", "bands far apart on one side"],
)
def test_smoothing_averages_inside_and_never_spans_more_than_it_may(bands_nm, window, max_nm, expected):
    spectrum = np.array([0.0, 0, 0, 6, 0, 0, 0])
    np.testing.assert_allclose(smooth_spectrum(spectrum, bands_nm, window, max_nm)[0], expected)


def test_a_missing_band_takes_its_mirror_image_out_of_the_window():
    line = np.arange(9.0) ** 2
    line[5] = np.nan
    smoothed, averaged = smooth_spectrum(np.stack([line, line + 1.0]), 3.0 * np.arange(9), 5, 1e3)
    np.testing.assert_array_equal(averaged[0], [1, 3, 5, 3, 3, 0, 3, 3, 1])
    assert np.isnan(smoothed[:, 5]).all()
    assert smoothed[0, 4] == pytest.approx((line[4] + line[2] + line[6]) / 3.0)
    assert smoothed[0, 3] == pytest.approx((line[3] + line[2] + line[4]) / 3.0)
    np.testing.assert_allclose(smoothed[1] - smoothed[0], np.where(averaged[0] > 0, 1.0, np.nan))
    straight = np.where(np.arange(9) == 5, np.nan, np.arange(9.0))
    np.testing.assert_allclose(smooth_spectrum(straight, 3.0 * np.arange(9), 5, 1e3)[0], straight)


def test_a_camera_with_few_broad_bands_keeps_its_lamps_spectrum(tmp_path):
    """Five bands of seven would smooth the lamp away, and with it the reflectance."""
    white = white_reference(capture(tmp_path, "white", tarp_scene(0.0)))
    np.testing.assert_array_equal(white.spectrum, white.measured)
    smoothed = white_reference(capture(tmp_path, "white", tarp_scene(0.0), bands_nm=NARROW_NM))
    np.testing.assert_allclose(smoothed.spectrum, smooth_spectrum(white.measured, WAVELENGTHS_NM, 5, 1e3)[0])
    np.testing.assert_array_equal(smoothed.window_bands, [1, 3, 5, 5, 5, 3, 1])


def test_white_reference_of_a_folded_tarp(tmp_path):
    dark = np.full((3, 60, 7), 10.0)
    white = white_reference(capture(tmp_path, "white", tarp_scene(), dark))
    assert white.roi == (10, 8, 50, 32)
    assert not white.mask[:, :5].any()
    assert white.mask[:, 7:].all()
    # The speck, which closing takes in, weighs half a pixel among the mask's.
    np.testing.assert_allclose(white.measured, LAMP[None], rtol=2e-3)
    assert white.pixels == white.mask.sum()


def test_given_roi(tmp_path):
    """Nothing outside of it is read."""
    counts = np.random.default_rng(0).uniform(0.0, 5000.0, (40, 60, 7))
    counts[10:30, 20:29] = LAMP
    tarp = capture(tmp_path, "white", counts)
    white = white_reference(tarp, (20, 10, 29, 30), defects())
    assert white.deviation.shape == (20, 9)
    np.testing.assert_allclose(white.measured, LAMP[None])
    with pytest.raises(InputError, match=r"white\.hdr.*not inside its 60 x 40 pixels"):
        white_reference(tarp, (20, 10, 61, 30))


@pytest.mark.parametrize("counts", [np.zeros((20, 20, 7)), np.random.default_rng(1).gamma(0.2, 1.0, (20, 20, 7))])
def test_tarp_with_no_usable_region(tmp_path, counts):
    with pytest.raises(InputError, match=r"white\.hdr: the tarp has no usable region"):
        white_reference(capture(tmp_path, "white", counts))


def test_white_of_one_pixel_is_that_pixel(tmp_path):
    counts = np.random.default_rng(0).uniform(0.0, 5000.0, (40, 60, 7))
    counts[10, 20] = LAMP
    white = white_reference(capture(tmp_path, "white", counts), (20, 10, 21, 11), defects())
    assert white.pixels == 1
    np.testing.assert_allclose(white.measured, LAMP[None])
    assert np.isfinite(white.spectrum).all()


@pytest.mark.parametrize("roi", [None, (3, 4, 30, 15), (3, 4, 4, 5)])
@pytest.mark.parametrize("level", [10.0, 9.0, 0.0])
def test_a_white_at_or_below_dark_is_refused(tmp_path, level, roi):
    tarp = capture(tmp_path, "white", np.full((20, 60, 7), level), np.full((2, 60, 7), 10.0))
    with pytest.raises(InputError, match=r"white\.hdr: the (white|tarp) [^\n]*\.$"):
        white_reference(tarp, roi, defects())


def test_bands_without_light_are_bad_and_not_smoothed_into_others(tmp_path):
    counts = tarp_scene()
    counts[..., 3] = 10.0
    tarp = capture(tmp_path, "white", counts, np.full((2, 60, 7), 10.0), NARROW_NM)
    white = white_reference(tarp, defects=defects())
    np.testing.assert_array_equal(white.bad_bands, np.arange(7) == 3)
    np.testing.assert_array_equal(np.isnan(white.spectrum[0]), white.bad_bands)
    np.testing.assert_array_equal(white.window_bands, [1, 3, 3, 0, 3, 3, 1])


def test_white_that_is_lit_in_few_bands_is_refused(tmp_path):
    dark, counts = np.full((2, 60, 7), 10.0), tarp_scene()
    counts[..., :3] = 10.0
    assert white_reference(capture(tmp_path, "white", counts, dark)).bad_bands.sum() == 3
    counts[..., 3] = 10.0
    with pytest.raises(InputError, match=r"white\.hdr: .* 3 of its 7 bands"):
        white_reference(capture(tmp_path, "white", counts, dark))


def test_dead_elements_and_saturated_bands_stay_out_of_the_white(tmp_path):
    counts = tarp_scene()
    counts[:, 30, 2] = 60_000.0
    counts[:, 31, 4] = 0.0
    counts[..., 3] = np.minimum(counts[..., 3], 1500.0)
    found = defects(dead=[(30, 2), (31, 4)], bad_bands=[6], saturation_counts=1500.0)
    white = white_reference(capture(tmp_path, "white", counts, np.full((2, 60, 7), 10.0)), defects=found)
    np.testing.assert_array_equal(white.bad_bands, [False, False, False, True, False, False, True])
    good = ~white.bad_bands
    np.testing.assert_allclose(white.measured[0, good], LAMP[good], rtol=2e-3)


def test_mean_spectrum_weighs_every_reading_alike():
    rng = np.random.default_rng(0)
    counts, mask = rng.integers(0, 9, (6, 5, 3)), rng.random((6, 5)) < 0.6
    dark, dead = rng.uniform(0.0, 2.0, (5, 3)), rng.random((5, 3)) < 0.3
    readings = ElementSums.of(counts, mask, dead, 4, defects(5, 3, saturation_counts=7))
    slow = [[], [], []]
    saturated = np.zeros(3)
    for y, x, b in np.ndindex(6, 5, 3):
        if mask[y, x] and not dead[x, b] and counts[y, x, b] != 4:
            slow[b].append(counts[y, x, b] - dark[x, b])
            saturated[b] += counts[y, x, b] >= 7
    np.testing.assert_allclose(readings.mean_spectrum(dark), [np.mean(values) for values in slow])
    np.testing.assert_array_equal(readings.saturated.sum(axis=0), saturated)
    assert np.isnan(ElementSums.of(counts, mask, np.ones_like(dead), None, None).mean_spectrum(dark)).all()


def test_white_of_a_capture_by_detector_column(tmp_path):
    rng = np.random.default_rng(0)
    columns, dark = rng.uniform(0.5, 1.5, (60, 1)) * LAMP, rng.uniform(0.0, 50.0, (60, 7))
    slab = np.stack([columns + dark + shift for shift in (-1.0, 0.0, 1.0)])
    slab[:, 20, 2] = 60_000.0
    slab[..., 5] = dark[:, 5]
    white_cube, dark_cube = cube_of(tmp_path, "WHITEREF", slab), cube_of(tmp_path, "DARK", np.stack([dark, dark]))
    white = column_white(white_cube, dark_cube, 60, defects(dead=[(20, 2)]))
    assert (white.spectrum.shape, white.pixels) == ((60, 7), 3)
    np.testing.assert_array_equal(white.bad_bands, np.arange(7) == 5)
    expected = columns.copy()
    expected[20, 2] = expected[:, 5] = np.nan
    np.testing.assert_allclose(white.spectrum, expected)
    np.testing.assert_allclose(white.mean_spectrum(), mean_over_columns(expected))
    # Against the frames' detector, or not at all.
    one = column_white(white_cube, dark_cube, 80, defects(dead=[(20, 2)]))
    assert (one.spectrum.shape, one.pixels) == ((1, 7), 180)
    np.testing.assert_allclose(one.spectrum[0], np.nanmean(expected, axis=0)[None][0])


def test_a_column_that_saturates_on_its_white_has_none(tmp_path):
    """One column of many hardly counts in its band."""
    slab = np.broadcast_to(LAMP, (3, 200, 7)).copy()
    slab[:, 20, 3], slab[0, 30, 3] = 4000.0, 4000.0
    found = defects(200, saturation_counts=4000.0)
    white = column_white(cube_of(tmp_path, "WHITEREF", slab), None, 200, found)
    assert not white.bad_bands.any()
    np.testing.assert_array_equal(np.argwhere(np.isnan(white.spectrum)), [[20, 3], [30, 3]])


@pytest.mark.parametrize(("gap", "header"), [(-1.0, {"data ignore value": -1}), (np.nan, {})])
def test_white_of_one_line_leaves_no_data_out(tmp_path, gap, header):
    slab = np.broadcast_to(LAMP, (2, 5, 7)).copy()
    slab[0, 3, 1] = slab[:, 4, 2] = gap
    cube = cube_of(tmp_path, "WHITEREF", slab, **header)
    white = column_white(cube, None, 5)
    expected = np.broadcast_to(LAMP, (5, 7)).copy()
    expected[4, 2] = np.nan
    np.testing.assert_allclose(white.spectrum, expected)


def test_real_maize_kernel():
    kernel, dark, white = (
        open_cube(MAIZE / f"{name}.hdr")
        for name in ("4-22-22_right_same_B73_top_00", "dark_reference_crop", "white_reference_crop")
    )
    reference = white_reference(Capture("white", white, dark))
    every_band = np.arange(kernel.shape[2])
    calibration = FrameCalibration(dark_columns(dark.read(), *kernel.shape[1:]), 1.0 / reference.spectrum, every_band)
    reflectance, valid = unpack(
        pack_counts(kernel.memmap(), calibration, PictureBands(every_band[:3], every_band, 9)).packed
    )
    assert valid.all()
    centre = reflectance[13:18, 19:24].mean(axis=(0, 1))
    bands = nearest_bands(kernel.wavelengths_nm, [550.0, 700.0, 750.0, 800.0, 900.0])
    np.testing.assert_allclose(centre[bands], [0.54, 0.83, 0.85, 0.85, 0.85], atol=0.025)


@pytest.mark.slow
def test_white_reference_picture(tmp_path):
    tarp = capture(tmp_path, "white", tarp_scene())
    path = tmp_path / "report" / "white_reference.png"
    draw_white_reference(path, tarp.cube, white_reference(tarp), (598.0, 548.0, 449.0))
    picture = cv2.imread(str(path))
    assert picture.shape[0] > 300
    assert picture.std() > 10.0
    slab = column_white(cube_of(tmp_path, "WHITEREF", np.full((2, 60, 7), 900.0)), None, 60)
    draw_column_white(path.with_name("columns.png"), slab, WAVELENGTHS_NM)
    assert cv2.imread(str(path.with_name("columns.png"))).std() > 10.0
    path.with_name("columns.png").unlink()
    assert [p.name for p in path.parent.iterdir()] == ["white_reference.png"]
