"""Organs of objects whose parts are known in closed form, and none on what has none."""

import numpy as np
import pytest
from known_fruit import BROWN, GREEN, NM, RADIUS_M, SKIN, ball, fruit, noisy, rod

from hsi_sc_nerf.analysis import organs
from hsi_sc_nerf.analysis.organs import propose_organs
from hsi_sc_nerf.analysis.spectral_edges import Edge

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


ALL_CENTRES = organs._CENTRES


@pytest.fixture(autouse=True)
def few_centres(monkeypatch):
    """Sides are searched from fewer points where nothing is there, or what is easy to find."""
    monkeypatch.setattr(organs, "_CENTRES", 100)


def overlap(found, true):
    return (found & true).sum() / (found | true).sum()


@pytest.mark.slow
@pytest.mark.parametrize("cap_at", [-1.0, 1.0])
def test_a_ball_with_a_cap_and_a_rod_has_body_stem_and_calyx(cap_at):
    """Also where the rod stands on the cap. Each point has one organ."""
    points_m, spectra, true = fruit(cap_at=cap_at)
    found = propose_organs(points_m, spectra)
    assert list(found) == ["body", "stem", "calyx"]
    assert all(overlap(found[name], true[name]) > 0.93 for name in true)
    assert (np.sum(list(found.values()), axis=0) == 1).all()


@pytest.mark.slow
def test_a_stem_in_a_hollow_that_no_camera_sees_is_found_across_the_gap():
    points_m, spectra, true = fruit(cap=SKIN)
    hollow = ~true["stem"] & (points_m[:, 2] > 0.0) & (np.hypot(points_m[:, 0], points_m[:, 1]) < 0.022)
    found = propose_organs(points_m[~hollow], spectra[~hollow])
    assert list(found) == ["body", "stem"]
    assert overlap(found["stem"], true["stem"][~hollow]) > 0.93


@pytest.mark.slow
def test_neither_a_spot_beside_a_stem_nor_a_long_stripe_from_a_calyx_belongs_to_it():
    points_m, spectra, true = fruit()
    spot = (np.linalg.norm(points_m - [0.011, 0.0, 0.0279], axis=1) < 0.004) & ~true["stem"]
    stripe = (np.abs(points_m[:, 0]) < 0.003) & (points_m[:, 1] > 0.0) & ~true["stem"] & ~true["calyx"]
    for where, colour in ((spot, BROWN), (stripe, GREEN)):
        spectra[where] = noisy(np.tile(colour, (where.sum(), 1)), np.random.default_rng(0))
    found = propose_organs(points_m, spectra)
    assert not found["stem"][spot].any()
    assert overlap(found["calyx"], true["calyx"]) > 0.85


@pytest.mark.slow
def test_a_stem_of_the_colour_of_the_body_is_told_by_its_shape():
    points_m, spectra, true = fruit(stem=SKIN, cap=SKIN)
    found = propose_organs(points_m, spectra)
    assert list(found) == ["body", "stem"]
    assert overlap(found["stem"], true["stem"]) > 0.85


@pytest.mark.slow
def test_the_answer_does_not_depend_on_size_turn_or_light_nor_on_which_end_is_up():
    points_m, spectra, true = fruit()
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    found = propose_organs(points_m, spectra)
    again = propose_organs(7.0 * points_m @ turn.T + [0.1, -0.2, 0.3], 0.5 * spectra)
    hanging = propose_organs(points_m * [1.0, -1.0, -1.0], spectra)
    assert list(found) == list(again)
    assert all(overlap(found[name], again[name]) > 0.99 for name in found)
    assert set(hanging) == {"body", "stem", "calyx"}
    assert all(overlap(hanging[name], true[name]) > 0.93 for name in true)


@pytest.mark.slow
def test_an_ear_has_kernels_and_a_husk():
    rng = np.random.default_rng(0)
    points_m = rod(0.16, 0.02, 20_000, rng)
    husk = points_m[:, 2] < 0.025
    kernels = np.where(rng.uniform(size=(20_000, 1)) < 0.5, SKIN, BROWN)
    found = propose_organs(points_m, noisy(np.where(husk[:, None], GREEN, kernels), rng))
    assert list(found) == ["kernels", "husk"]
    assert overlap(found["husk"], husk) > 0.95


@pytest.mark.slow
def test_a_large_part_has_no_name_of_its_own():
    rng = np.random.default_rng(0)
    points_m = ball(10_000, rng)
    upper = points_m[:, 2] > 0.4 * RADIUS_M
    found = propose_organs(points_m, noisy(np.where(upper[:, None], GREEN, SKIN), rng))
    assert list(found) == ["body", "part 1"]
    assert overlap(found["part 1"], upper) > 0.95


def with_part(part, colour):
    """A ball of one material with more points."""
    rng, count = np.random.default_rng(0), 8200
    points_m = np.concatenate([ball(count, rng), part])
    of_part = np.arange(len(points_m)) >= count
    return points_m, noisy(np.where(of_part[:, None], colour, SKIN), rng), of_part


def leaf(count, rng):
    """A round blade whose edge touches the side of the ball."""
    radius, azimuth = 0.012 * np.sqrt(rng.uniform(size=count)), rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack([RADIUS_M + 0.012 + radius * np.cos(azimuth), radius * np.sin(azimuth), 0.0 * radius], axis=-1)


@pytest.mark.slow
def test_a_leaf_and_a_twig_at_the_side_are_told_by_their_spectra_and_named_by_their_shape():
    rng = np.random.default_rng(3)
    twig = rod(0.02, 0.002, 200, rng)[:, [2, 1, 0]] + np.array([RADIUS_M - 0.0005, 0.0, 0.0])
    for part, colour, name in ((leaf(320, rng), GREEN, "leaf"), (twig, BROWN, "stem")):
        points_m, spectra, of_part = with_part(part, colour)
        found = propose_organs(points_m, spectra)
        assert list(found) == ["body", name]
        assert overlap(found[name], of_part) > 0.85


@pytest.mark.slow
def test_a_spot_at_the_side_is_a_part_without_a_name(monkeypatch):
    monkeypatch.setattr(organs, "_CENTRES", ALL_CENTRES)
    points_m, spectra, _ = with_part(np.empty((0, 3)), BROWN)
    spot = np.linalg.norm(points_m - RADIUS_M * np.array([0.8, 0.36, 0.48]), axis=1) < 0.008
    spectra = noisy(np.where(spot[:, None], BROWN, SKIN), np.random.default_rng(3))
    found = propose_organs(points_m, spectra)
    assert list(found) == ["body", "part 1"]
    assert overlap(found["part 1"], spot) > 0.75  # of 146 points, many are beside other ones


@pytest.mark.slow
@pytest.mark.parametrize("falls", [True, False])
def test_a_part_at_the_lower_edge_is_an_organ_if_it_does_not_fade_towards_its_own_edge(falls):
    """Mixed pixels hold less of what the object stands on the higher they lie."""
    rng = np.random.default_rng(0)
    points_m = ball(12_000, rng)
    points_m = points_m[points_m[:, 2] > -0.8 * RADIUS_M]
    height = (points_m[:, 2] - points_m[:, 2].min()) / 0.006
    fraction = np.clip(0.8 * (1.0 - height), 0.0, 1.0) if falls else 0.8 * (height < 1.0)
    found = propose_organs(points_m, noisy(SKIN + fraction[:, None] * (GREEN - SKIN), rng))
    assert (list(found) == ["body"]) == falls
    if not falls:
        assert overlap(next(where for name, where in found.items() if name != "body"), height < 1.0) > 0.9


@pytest.mark.parametrize(("wide", "mixed"), [(0.015, True), (0.12, False)])
def test_a_narrow_strip_at_the_lower_edge_is_mixed_however_even_it_is(wide, mixed):
    points_m = ball(20_000, np.random.default_rng(0))
    points_m = points_m[points_m[:, 2] > -0.5 * RADIUS_M]
    part = (points_m[:, 2] - points_m[:, 2].min() < wide * np.ptp(points_m[:, 2])) & (points_m[:, 0] > 0.0)
    every, features = np.ones(len(part), bool), part.astype(float)[:, None]
    surface = organs._Surface(points_m, features, np.zeros((len(part), 1), int))
    edge = Edge(np.zeros(len(part)), 0.0, 1.0, np.ones(1), 0.5)
    assert organs._is_mixed_with_support(part, edge, surface, every) == mixed


@pytest.mark.slow
def test_a_stub_is_a_stem_and_not_a_calyx():
    points_m, spectra, true = fruit(cap=SKIN)
    gone = true["stem"] & (points_m[:, 2] > RADIUS_M + 0.006)
    found = propose_organs(points_m[~gone], spectra[~gone])
    assert list(found) == ["body", "stem"]


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["ball", "rod"])
@pytest.mark.parametrize("coloured", ["evenly", "without noise", "fading", "one side", "rim", "in shadow"])
def test_no_organ_is_invented(monkeypatch, shape, coloured):
    """Not of noise, of colour that fades, of a blush, of shade, nor of the mixed pixels where it stands."""
    monkeypatch.setattr(organs, "_CENTRES", ALL_CENTRES)
    rng = np.random.default_rng(1)
    points_m = ball(4000, rng) if shape == "ball" else rod(0.16, 0.02, 4000, rng)
    height = (points_m[:, 2] - points_m[:, 2].min()) / np.ptp(points_m[:, 2])
    # Pixels at the lower edge are mixed with what the object stands on, the more the lower they lie.
    rim = np.clip(0.7 - height / 0.06, 0.0, 1.0)
    part = {"fading": height, "one side": points_m[:, 0] > 0.01, "rim": rim}.get(coloured, 0.0 * height)
    spectra = SKIN + part[:, None] * (GREEN - SKIN)
    if coloured == "in shadow":
        spectra = spectra * np.where(height < 0.2, 0.3, 1.0)[:, None]
    found = propose_organs(points_m, spectra if coloured == "without noise" else noisy(spectra, rng))
    assert list(found) == ["body"]


@pytest.mark.parametrize("count", [1, 8, 63, 64, 100])
def test_few_or_equal_points_are_a_body(count):
    points_m = ball(count, np.random.default_rng(0))
    for points in (points_m, 0.0 * points_m):
        for spectra in (np.tile(SKIN, (count, 1)), np.zeros((count, len(NM)))):
            found = propose_organs(points, spectra)
            assert list(found) == ["body"]
            assert found["body"].all()
