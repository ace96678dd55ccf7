"""What makes the errors of a patch larger: hollows and rare tissues count as hard, whatever their orientation."""

import numpy as np

from hsi_sc_nerf.analysis.change_conditions import patch_conditions, rareness, steepest_rise
from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_significance import surface_patches
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.simulate.mesh import sphere


def plane_with_a_pin(height_m):
    """Points 1 mm apart on a plane, and a pin that stands up in its middle."""
    at_m = np.stack(np.meshgrid(*[np.arange(-0.03, 0.0301, 0.001)] * 2), axis=-1).reshape(-1, 2)
    pin_m = np.column_stack([np.zeros((20, 2)), np.linspace(0.0, height_m, 20)])
    return np.concatenate([np.column_stack([at_m, np.zeros(len(at_m))]), pin_m])


def test_a_surface_rises_by_the_angle_to_the_tip_of_what_stands_on_it():
    centres_m = np.array([[0.01, 0.0, 0.0], [0.0, 0.02, 0.0], [0.029, 0.0, 0.0]])
    rises = steepest_rise(centres_m, np.tile([0.0, 0.0, 2.0], (3, 1)), plane_with_a_pin(0.01))
    expected = np.sin(np.arctan2(0.01, [0.01, 0.02]))
    np.testing.assert_allclose(rises[:2], expected, atol=1e-9)
    assert rises[2] < 1e-9  # the pin is too far away


def test_a_ball_falls_off_on_all_sides_and_inside_of_it_its_wall_rises():
    ball_m = sphere(0.06).vertices - [0.0, 0.0, 0.03]
    some_m = ball_m[::97]
    outside, inside = (steepest_rise(some_m, side * some_m, ball_m[::7]) for side in (1.0, -1.0))
    assert (outside < 0.0).all()
    np.testing.assert_allclose(inside, 0.025 / 0.06, atol=0.02)  # a chord rises by its length over the diameter


def test_rare_spectra_are_those_of_little_of_the_surface_and_brightness_does_not_count():
    random = np.random.default_rng(0)
    skin, blush, bruise = random.random((3, 12))
    shares = np.repeat([0, 1, 2], [600, 380, 20])
    spectra = np.stack([skin, blush, bruise])[shares] * random.uniform(0.3, 1.0, (1000, 1))
    found = rareness(spectra)
    np.testing.assert_allclose(found[shares < 2], 0.0, atol=1e-6)
    units = [one / np.linalg.norm(one) for one in (skin, blush, bruise)]
    nearest = min(np.linalg.norm(units[2] - one) for one in units[:2])
    np.testing.assert_allclose(found[shares == 2], nearest, rtol=1e-6)


def test_of_many_patches_some_stand_for_all():
    spectra = np.random.default_rng(1).random((4000, 6))
    some = np.random.default_rng(2).permutation(4000)[:1000]
    np.testing.assert_allclose(rareness(spectra)[some], rareness(spectra[some]), rtol=0.15)


def test_a_spot_is_rare_if_it_was_there_on_both_days_and_the_worst_day_counts():
    mesh = sphere(0.06)
    vertices, skin, bruise = mesh.vertices, np.array([0.2, 0.4, 0.7]), np.array([0.3, 0.3, 0.3])
    old, new = (np.linalg.norm(vertices - vertices[(vertices @ at).argmax()], axis=1) < 0.008 for at in np.eye(3)[:2])

    def day(spots, steep):
        spectra = np.where(spots[:, None], bruise, skin)
        surface = SpectralMesh(mesh, spectra, np.array([500.0, 600.0, 700.0]), np.ones(len(vertices), bool))
        return Day("day", surface, np.zeros(len(vertices)), np.full((len(vertices), 3), steep), None)

    days = day(old, 1.0), day(old | new, 3.0)
    patches = surface_patches(vertices, days[0].surface.areas_m2, np.ones(len(vertices), bool))
    to_rim_m = np.arange(len(patches.areas_m2)) / 1e3
    found = patch_conditions(*days, (day(old, 2.0),), patches, to_rim_m)
    np.testing.assert_allclose(found[:, :3], 3.0)
    np.testing.assert_allclose(found[:, 3], -to_rim_m)
    assert (found[:, 4] < 0.0).all()  # a ball rises nowhere
    inside = [patches.means(spot[:, None].astype(float), days[0].surface.areas_m2)[:, 0] > 0.9 for spot in (old, new)]
    assert all(one.any() for one in inside)
    assert found[inside[0], 5].min() > 0.2
    np.testing.assert_allclose(found[inside[1], 5], 0.0, atol=1e-6)
