"""Masks of drawn and rendered objects, and their edges at half-covered and shaded pixels."""

import cv2
import numpy as np
import pytest
from capture_factory import frame_reflectance, sphere_mask, true_pose
from mask_cases import LOWEST, area_too_much
from scipy import ndimage

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.processing.foreground_score import smoothed_bins
from hsi_sc_nerf.processing.mask_edges import at_half_coverage, glossy_edge, shaded_parts
from hsi_sc_nerf.processing.masks import (
    MaskConfig,
    foreground_mask,
    foreground_masks,
    mask_picture,
    pieces_above,
    select_threshold,
)
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth


def largest_piece(score, threshold, region=None, **kwargs) -> np.ndarray:
    region = np.ones(score.shape, bool) if region is None else region
    pieces = pieces_above(score, threshold, region)[:1]
    return foreground_mask(score, threshold, pieces, region=region, **kwargs)


def test_pieces_of_an_object_are_masked_together_and_others_are_told():
    bins = np.full((2, 8, 90, 90), 0.5, np.float32)  # a gray wall
    for image, samples in zip(bins, ((20, 70), (20, 31)), strict=True):  # two balls; in the second frame they touch
        for sample, radius in zip(samples, (10, 6), strict=True):
            inside = np.hypot(*(np.mgrid[:90, :90] - np.array([45, sample])[:, None, None])) < radius
            image[:, inside] = np.linspace(0.1, 0.9, 8)[:, None]
    coloured = bins[:, 0] < 0.3
    one, left_out = foreground_masks(bins, MaskConfig())
    np.testing.assert_array_equal(left_out, [True, False])
    np.testing.assert_array_equal(one[0], coloured[0] & (np.arange(90) < 45))
    both, left_out = foreground_masks(bins, MaskConfig(pieces=2))
    assert not left_out.any()
    np.testing.assert_array_equal(both, coloured)


def test_no_contrast():
    rng = np.random.default_rng(4)
    for scores in (np.abs(rng.normal(0.0, 0.01, (30, 30))), np.zeros((30, 30))):
        with pytest.raises(InputError, match="no object stands out from the background"):
            select_threshold([scores])


def test_mask_is_one_whole_region_with_its_stem():
    score = np.zeros((60, 60))
    score[20:50, 15:45] = 0.3
    score[30:33, 25:28] = 0.0  # a label on the fruit
    score[5:20, 30] = 0.12  # a woody stem, weaker than the threshold
    score[20:50, 45] = 0.12  # the fruit's rim, part background
    score[2:6, 2:6] = 0.3  # something else
    score[30, 46:49] = 0.12  # noise
    mask = largest_piece(score, 0.2)
    expected = np.zeros((60, 60), bool)
    expected[20:50, 15:45] = True
    expected[5:20, 30] = True
    np.testing.assert_array_equal(mask, expected)
    assert not largest_piece(score, 0.2, weak_fraction=1.0)[:20].any()
    region = np.ones((60, 60), bool)
    region[40:] = False
    assert not largest_piece(score, 0.2, region=region)[40:].any()
    assert not largest_piece(np.zeros((60, 60)), 0.2).any()


def test_mask_of_a_sphere():
    bins = smoothed_bins(np.moveaxis(frame_reflectance(77.0), -1, 0))
    truth = sphere_mask(true_pose(77.0))
    (mask,), left_out = foreground_masks([bins], MaskConfig())
    assert not left_out.any()
    assert (mask & truth).sum() / (mask | truth).sum() > 0.97


def test_mask_picture_draws_each_outline(tmp_path):
    images = [np.full((30, 40, 3), 90, np.uint8)] * 7
    masks = [np.zeros((30, 40), bool) for _ in images]
    masks[6][10:20, 10:20] = True
    path = tmp_path / "masks.png"
    mask_picture(path, images, masks, list("abcdefg"))
    sheet = cv2.imread(str(path))[..., ::-1].astype(int)
    assert sheet.shape == (360, 1440, 3)
    magenta = (sheet == [255, 0, 200]).all(-1)
    assert magenta[180:, :240].sum() > 120
    assert not magenta[:180].any()


def in_shade(folder, fruit, *effects):
    """A small session in the chamber's uneven light, and its truth."""
    scene = override(load_scene(fruit), frames=4, size_px=96, bands=12, effects=("chamber_shading", *effects))
    session = simulate_session(scene, folder / "session", progress=False)
    return session, load_truth(session)


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_the_shaded_underside_is_the_objects(tmp_path):
    """Which lies in the fruit's own shade."""
    session, truth = in_shade(tmp_path, "apple", "photon_noise", "read_noise")

    def mean_overlap(config):
        data = process_session(session, tmp_path / "data", ProcessConfig(masks=config), progress=False)
        overlaps = []
        for frame in open_packed(data).frames:
            mask, covered = frame.mask(), truth.object_coverage(frame.capture) > 0.5
            overlaps.append((mask & covered).sum() / (mask | covered).sum())
        return np.mean(overlaps)

    found = mean_overlap(MaskConfig())
    assert found > 0.975
    assert mean_overlap(MaskConfig(shaded_fraction=None)) < found - 0.005


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_the_lid_in_the_light_of_a_fruit_is_not_the_objects(tmp_path):
    """Beside its base, the lid lies in the fruit's shade and gets a large part of its light from it."""
    session, truth = in_shade(tmp_path, "tomato", "inter_reflection", "photon_noise")
    frames = open_packed(process_session(session, tmp_path / "data", progress=False)).frames
    areas = [area_too_much(frame.mask(), truth.object_coverage(frame.capture), LOWEST) for frame in frames]
    too_much, length = np.sum(areas, axis=0)
    assert abs(too_much / length) < 0.2


SUPERSAMPLING = 16


def shaded_ball(background: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bins of a red ball whose lower half gets ever less light, on a gray background; where it is and its light."""
    y, x = np.mgrid[:60, :60]
    ball = np.hypot(x - 30, y - 30) < 20
    light = np.where(y > 30, np.clip(1.0 - (y - 30) / 22.0, 0.0, 1.0), 1.0)
    spectrum = np.linspace(0.1, 0.7, 24)[:, None, None]
    wall = np.full((24, 1, 1), background)
    bins = np.where(ball, spectrum * light, wall * np.where(y > 50, 0.1, 1.0))
    return bins.astype(np.float32), ball, light


def test_shaded_parts_are_told_by_spread_relative_to_brightness():
    bins, ball, light = shaded_ball(background=0.9)
    score, bright = bins.std(axis=0), bins.mean(axis=0)
    body = largest_piece(score, 0.1)
    assert (ball & ~body).sum() > 60  # what the score alone misses
    shaded = shaded_parts(body, score, bright)
    rim = ball & ~ndimage.binary_erosion(ball)
    assert not (ball & (light > 0.15) & ~body & ~shaded & ~rim).any()
    assert (shaded & ~ball).sum() <= 4
    assert not shaded_parts(body, score, bright, fraction=1.5).any()
    upper = np.zeros_like(ball)
    upper[:40] = True
    assert not shaded_parts(body, score, bright, region=upper)[40:].any()


def test_before_a_dark_background_only_what_is_darker_still_is_a_shaded_part():
    bins, ball, light = shaded_ball(background=0.1)
    bins += np.random.default_rng(0).normal(0.0, 0.02, bins.shape).astype(np.float32)
    score, bright = bins.std(axis=0), bins.mean(axis=0)
    body = largest_piece(score, 0.1)
    shaded = shaded_parts(body, score, bright, region=score > 0.04)
    assert not (shaded & ~(ball & (light < 0.3))).any()
    assert not shaded_parts(np.zeros_like(body), score, bright).any()
    assert not shaded_parts(np.ones_like(body), score, bright).any()


def test_shaded_parts_before_a_dark_wall_are_found_beside_a_brighter_lid():
    bins, ball, light = shaded_ball(background=0.1)
    below = np.mgrid[:60, :60][0] > 42
    bins = np.where(below & ~ball, 0.9, bins)
    score, bright = bins.std(axis=0), bins.mean(axis=0)
    body = largest_piece(score, 0.1)
    shaded = shaded_parts(body, score, bright)
    assert (ball & below & (light > 0.15) & ~body & ~shaded).sum() < 0.1 * (ball & below & ~body).sum()
    assert not (shaded & ~ball).any()


def disc(radius: float) -> np.ndarray:
    """Fraction of each pixel that a disc covers."""
    ticks = (np.arange(40 * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    inside = np.hypot(ticks[:, None] - 20.3, ticks - 19.8) < radius
    return inside.reshape(40, SUPERSAMPLING, 40, SUPERSAMPLING).mean(axis=(1, 3))


@pytest.mark.parametrize("dark_half", [1.0, 0.6])
@pytest.mark.parametrize(("wall", "bounced"), [(0.05, 0.0), (0.9, 0.0), (0.9, 0.3)])
@pytest.mark.parametrize("offset_px", [-1.0, 0.0, 0.7])
def test_the_edge_is_where_pixels_are_half_covered(dark_half, wall, bounced, offset_px):
    """Also where the object's light falls on what is behind it, which then has a part of its score."""
    coverage = disc(12.0)
    albedo = np.where(np.arange(40) < 20, 1.0, dark_half) * 0.4
    score = 0.3 * albedo * (coverage + bounced * (1.0 - coverage))
    bright = albedo * coverage + wall * (1.0 - coverage)
    refined = at_half_coverage(disc(12.0 + offset_px) > 0.5, score, bright, score > 0.005)
    assert not (refined & (coverage < 0.4)).any()
    assert not (~refined & (coverage > 0.7)).any()


@pytest.mark.parametrize(("coat", "shade"), [(1.0, 0.0), (0.6, 0.0), (1.0, 0.3), (0.0, 0.6), (0.0, 0.0)])
def test_a_glossy_skin_that_mirrors_the_wall_at_its_edge_is_not_cut_off(coat, shade):
    """Schlick's reflectance of a ball whose picture is 40 pixels across: half of the light at its last half pixel."""
    coverage = disc(19.0)
    ticks = np.arange(40) + 0.5
    from_middle = np.hypot(ticks[:, None] - 20.3, ticks - 19.8) / 19.0
    mirrored = coat * (1.0 - np.sqrt(np.maximum(1.0 - from_middle**2, 0.0))) ** 5
    light = 1.0 - shade * np.minimum(from_middle, 1.0) ** 4  # less at the edge, also without gloss
    score = 0.12 * light * coverage * (1.0 - mirrored)
    bright = light * coverage * (0.4 * (1.0 - mirrored) + 0.8 * mirrored) + 0.8 * (1.0 - coverage)
    mask = coverage > 0.5
    leaves = glossy_edge(mask, score, bright)
    assert leaves > 0.97 if coat == 0.0 else leaves < 1.05 - 0.3 * coat
    refined = at_half_coverage(mask, score, bright, score > 0.005, leaves)
    missed = (mask & ~refined).sum() / (2.0 * np.pi * 19.0)
    assert missed < 0.18
    if shade == 0.0:  # by the rings of the score alone
        by_rings = at_half_coverage(mask, score, np.full((40, 40), 0.6), score > 0.005)
        assert (mask & ~by_rings).sum() / (2.0 * np.pi * 19.0) < 0.26
        assert not (by_rings & (coverage < 0.4)).any()
    assert not (refined & (coverage < 0.4)).any()


def test_no_gloss_is_told_from_less_than_three_rings():
    assert np.isnan(glossy_edge(disc(4.0) > 0.5, disc(4.0), np.ones((40, 40))))
    assert np.isnan(glossy_edge(np.zeros((40, 40), bool), np.zeros((40, 40)), np.ones((40, 40))))


def test_thin_parts_keep_their_edge():
    score = np.zeros((40, 40))
    score[:, 19:21] = 0.1
    score[20:, 20] = 0.03
    mask = score > 0
    np.testing.assert_array_equal(at_half_coverage(mask, score, np.full((40, 40), 0.4), mask), mask)


def test_a_thin_stem_is_not_judged_by_the_bright_body_that_it_stands_on():
    coverage, stem = disc(12.0), np.zeros((40, 40), bool)
    stem[2:9, 19:21] = True
    score = np.where(stem, 0.05, 0.12 * coverage)
    mask = (coverage > 0.5) | stem
    np.testing.assert_array_equal(at_half_coverage(mask, score, np.full((40, 40), 0.4), mask), mask)
