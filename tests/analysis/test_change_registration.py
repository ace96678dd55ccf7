"""Attitudes of simulated fruit that was set down again are found; those of a plain ball are refused."""

from dataclasses import replace

import numpy as np
import pytest
from another_day import CloudErrors, SetDown, cloud_of, fruit_of, set_down
from true_object import TrueObject

from hsi_sc_nerf.analysis.change_features import surface_gradients, surface_samples
from hsi_sc_nerf.analysis.change_registration import find_attitude
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.materials import endmembers
from hsi_sc_nerf.simulate.mesh import sphere

NM = np.linspace(400.0, 1000.0, 13)
POINTS = 20_000


def registered(before, after):
    samples = surface_samples([before, after], [before.spectra, after.spectra], ("before", "after"))
    # Of the starts every fourth, none of which is where the fruit was turned to.
    return find_attitude(samples[1], samples[0], lambda starts: starts[::4])


@pytest.fixture(scope="module")
def first_day():
    day = SetDown(bruise_diameter_m=0.018)
    return cloud_of(fruit_of(day, NM), day, CloudErrors(), POINTS, seed=1)


@pytest.fixture(scope="module")
def ball():
    mesh = sphere(0.07)
    skin = endmembers(("apple_skin",), NM)
    return TrueObject(("apple_skin",), mesh, np.ones((len(mesh.vertices), 1)), skin, NM)


@pytest.mark.slow
@pytest.mark.parametrize(("turn_deg", "tip_deg", "growth"), [(30.0, 3.0, 1.0), (180.0, 8.0, 1.04)])
def test_turn_tip_and_growth_are_found_though_stem_and_bruise_changed(first_day, turn_deg, tip_deg, growth):
    day = SetDown(0.026, dried=0.1, turn_deg=turn_deg, tip_deg=tip_deg, growth=growth, keeps_stem=False)
    fruit = fruit_of(day, NM)
    cloud = cloud_of(fruit, day, CloudErrors(), POINTS, seed=2)
    found = registered(first_day, cloud)
    off_deg = (found.turn_deg - turn_deg + 180.0) % 360.0 - 180.0
    assert abs(off_deg) < max(0.5, 5.0 * found.turn_sd_deg)
    assert found.tip_deg == pytest.approx(tip_deg, abs=0.5)
    assert found.growth == pytest.approx(growth, abs=0.004)
    assert found.residual_m < 0.0005
    back = set_down(SetDown(), fruit.mesh.vertices).after(set_down(day, fruit.mesh.vertices).inverse())
    assert np.linalg.norm(found.transform(cloud.points) - back(cloud.points), axis=1).max() < 0.001


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [0.0, 0.015])
def test_a_plain_ball_is_refused_whatever_its_errors_look_like(ball, smooth):
    errors = CloudErrors(smooth=smooth)
    clouds = [cloud_of(ball, SetDown(turn_deg=50.0 * seed), errors, POINTS, seed) for seed in (0, 1)]
    with pytest.raises(InputError, match=r"two attitudes \d+ degrees apart.* p = 0\.\d+"):
        registered(*clouds)


@pytest.mark.slow
def test_another_object_is_refused(first_day):
    day = SetDown(growth=1.5)
    larger = cloud_of(fruit_of(SetDown(0.018), NM), day, CloudErrors(), POINTS, seed=2)
    with pytest.raises(InputError, match=r"1\.50 times as large"):
        registered(first_day, larger)


def test_an_object_that_is_too_small_is_refused_by_name(first_day):
    """A ball of 26 mm, but for where it stands, has the patches that are needed; one of 20 mm does not."""
    normals = np.random.default_rng(0).normal(size=(30_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = normals[normals[:, 2] > -0.7]
    rows = np.arange(len(seen)) % len(first_day)
    small, enough = (replace(first_day.select(rows), points=radius_m * seen) for radius_m in (0.010, 0.0135))
    with pytest.raises(InputError, match=r"friday: .* too small .* 26 mm"):
        surface_samples([enough, small], [enough.spectra, small.spectra], ("monday", "friday"))


def test_gradients_of_a_linear_function_on_a_tilted_plane_are_its_slopes_along_the_plane():
    random = np.random.default_rng(0)
    along = np.linalg.qr(random.normal(size=(3, 3)))[0][:2]
    points = random.random((500, 2)) @ along
    slopes = random.normal(size=(2, 3))
    found = surface_gradients(points, points @ slopes.T)
    np.testing.assert_allclose(found, np.broadcast_to(slopes @ along.T @ along, found.shape), atol=1e-9)


def test_a_point_without_a_value_takes_no_gradient_from_its_neighbours():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(20.0), np.arange(20.0)))
    values = (2.0 * x - 3.0 * y)[:, None]
    values[205] = np.nan
    found = surface_gradients(np.stack([x, y, 0.0 * x], axis=1), values)[:, 0]
    assert np.isnan(found[205]).all()
    np.testing.assert_allclose(np.delete(found, 205, axis=0), np.tile([2.0, -3.0, 0.0], (399, 1)), atol=1e-9)
