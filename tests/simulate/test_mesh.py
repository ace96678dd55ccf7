"""Meshes of the simulator against closed forms, and the shapes that are made of them."""

import numpy as np
import pytest

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate import plants
from hsi_sc_nerf.simulate.mesh import SEGMENTS, VERTEX_SPACING_M, cylinder, quads, revolve, sphere


@pytest.mark.parametrize(
    ("n", "h", "spacing_m"), [(60, 0.07, None), (60, 0.07, 0.004), (SEGMENTS, 0.01, VERTEX_SPACING_M)]
)
def test_cylinder_has_the_area_and_volume_of_its_polygonal_prism(n, h, spacing_m):
    r = 0.045
    mesh = cylinder(2 * r, h, n, spacing_m)
    base = n / 2 * r**2 * np.sin(2 * np.pi / n)
    assert mesh.is_watertight()
    np.testing.assert_allclose(mesh.volume_m3(), base * h, rtol=1e-10)
    np.testing.assert_allclose(mesh.area_m2(), 2 * base + n * 2 * r * np.sin(np.pi / n) * h, rtol=1e-10)
    radius, height = np.hypot(*mesh.vertices[:, :2].T), mesh.vertices[:, 2]
    np.testing.assert_allclose(radius[(height > 1e-9) & (height < h - 1e-9)], r, rtol=1e-12)
    steps_m = np.diff(np.unique(height.round(9)))
    assert spacing_m is None or steps_m.max() <= spacing_m + 1e-9


@pytest.mark.parametrize("diameter_m", [0.01, 0.07])
def test_sphere_has_its_closed_forms(diameter_m):
    mesh = sphere(diameter_m)
    radius_m = diameter_m / 2
    assert mesh.is_watertight()
    assert mesh.area_m2() == pytest.approx(np.pi * diameter_m**2, rel=2e-4)
    assert mesh.volume_m3() == pytest.approx(np.pi / 6 * diameter_m**3, rel=2e-4)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - [0, 0, radius_m], axis=1), radius_m, rtol=1e-12)


def test_a_hole_and_a_flipped_triangle_are_not_watertight():
    mesh = revolve(np.array([[0.0, 0.0], [0.03, 0.01], [0.02, 0.03], [0.0, 0.04]]), 12)
    assert not Mesh(mesh.vertices, mesh.triangles[1:]).is_watertight()
    flipped = mesh.triangles.copy()
    flipped[5] = flipped[5, ::-1]
    assert not Mesh(mesh.vertices, flipped).is_watertight()


def test_quads_face_their_corners_order():
    square = quads(np.array([[[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0]]], float))
    assert square.area_m2() == pytest.approx(6.0)
    a, b, c = square.vertices[square.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "height_m", "volume_ml", "radius_m"),
    [
        (plants.pear, 0.10, (110, 200), 0.040),
        (plants.apple, 0.075, (130, 230), 0.043),
        (plants.maize, 0.16, (170, 300), 0.03),
        (plants.tomato, 0.055, (130, 230), 0.047),
    ],
)
@pytest.mark.parametrize("seed", [0, 7])
def test_shapes_are_closed_stand_on_zero_and_have_real_sizes(make, height_m, volume_ml, radius_m, seed):
    shape = make(height_m, np.random.default_rng(seed))
    low, high = shape.mesh.vertices.min(axis=0), shape.mesh.vertices.max(axis=0)
    assert shape.mesh.is_watertight()
    assert volume_ml[0] < shape.mesh.volume_m3() * 1e6 < volume_ml[1]
    np.testing.assert_allclose([low[2], high[2]], [0.0, height_m], atol=1e-6)
    assert np.hypot(*shape.mesh.vertices[:, :2].T).max() < radius_m
    # It rests on an area: some of its lowest vertices share one plane.
    assert (shape.mesh.vertices[:, 2] < 1e-9).sum() > 100


def test_maize_kernels_are_relief_and_not_paint():
    shape = plants.maize(0.16, np.random.default_rng(0))
    assert shape.kernel is not None
    assert shape.groove is not None
    x, y, z = shape.mesh.vertices.T
    ring = np.abs(z - 0.048) < 0.0026  # within one kernel pitch
    radius = np.hypot(x, y)[ring]
    assert radius[shape.groove[ring] < 0.01].mean() - radius[shape.groove[ring] > 0.9].mean() > 0.0008
    assert len(np.unique(shape.kernel[shape.stem < 0.5])) > 250


def test_a_tomato_has_deep_ribs_and_a_hollow_top():
    height_m = 0.055
    shape = plants.tomato(height_m, np.random.default_rng(0))
    x, y, z = shape.mesh.vertices.T
    radius, azimuth = np.hypot(x, y), np.arctan2(y, x)
    on_axis = (radius < 0.003) & (z > 0.4 * height_m)
    assert z[on_axis].max() < 0.8 * height_m
    outer = (np.abs(z - 0.75 * height_m) < 0.001) & (radius > 0.02)
    around = np.array([radius[outer & (np.abs(azimuth - a) < 0.02)].mean() for a in np.linspace(-3.1, 3.1, 150)])
    assert around.max() - around.min() > 0.004
    ribs = np.diff(np.sign(np.diff(around))) < 0
    assert 6 <= ribs.sum() <= 9
    assert shape.stem[on_axis].min() > 0.9
    assert shape.stem[radius > 0.008].max() == 0.0
