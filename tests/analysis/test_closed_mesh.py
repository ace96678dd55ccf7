"""Closed meshes and their sizes, against spheres and cylinders whose sizes are known."""

import numpy as np
import pytest
from standing_sphere import RADIUS_M, STAND_M, sphere_points

from hsi_sc_nerf.analysis.closed_mesh import (
    MeshConfig,
    closed_mesh,
    open_edges,
    smoothed,
    solid_pieces,
    thinned,
)
from hsi_sc_nerf.analysis.size import feret_diameters, size_of
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.mesh import cylinder

SPECK = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
"""A tetrahedron."""


def test_thinning_leaves_one_mean_a_cell():
    points = np.array([[0.0, 0.0, 0.0], [0.002, 0.0, 0.0], [0.015, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    found, sides = thinned(points, normals, 0.01)
    np.testing.assert_allclose(found, [[0.001, 0.0, 0.0], [0.015, 0.0, 0.0]])
    np.testing.assert_allclose(sides, [[0.0, 0.5, 0.5], [1.0, 0.0, 0.0]])


def test_smoothing_takes_noise_away_and_keeps_a_curved_surface():
    points, normals = sphere_points(8000, noise_m=0.0003)
    noisy = normals + np.random.default_rng(1).standard_normal(normals.shape)
    found, outward = smoothed(points, noisy, 0.004)
    offset = found - [0.0, 0.0, STAND_M + RADIUS_M]
    radius = np.linalg.norm(offset, axis=1)
    assert radius.std() < 0.00012
    assert radius.mean() == pytest.approx(RADIUS_M, abs=3e-5)
    assert ((outward * offset).sum(axis=1) / radius).min() > 0.95


def test_smoothing_keeps_a_quadric_exactly():
    x, y = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-0.01, 0.01, 41)] * 2))
    points = np.stack([x, y, 8.0 * x**2 - 5.0 * x * y + 2.0 * y**2], axis=-1)
    middle = np.flatnonzero(np.hypot(x, y) < 1e-9)
    found, outward = smoothed(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), 0.002)
    np.testing.assert_allclose(found[middle], 0.0, atol=1e-7)
    np.testing.assert_allclose(outward[middle], [[0.0, 0.0, 1.0]], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("noise_m", [0.0, 0.0003])
def test_closed_sphere_has_its_area_and_volume(noise_m):
    points, normals = sphere_points(20000, noise_m=noise_m, above=-0.93)
    mesh = closed_mesh(points, normals, MeshConfig(octree_depth=6, base_height_m=STAND_M))
    size = size_of(mesh)
    assert open_edges(mesh) == 0
    assert size.area_m2 == pytest.approx(4.0 * np.pi * RADIUS_M**2, rel=0.01)
    assert size.volume_l == pytest.approx(4000.0 / 3.0 * np.pi * RADIUS_M**3, rel=0.01)
    assert size.height_m == pytest.approx(2.0 * RADIUS_M, rel=0.01)
    for diameter_m in (size.largest_diameter_m, size.smallest_diameter_m, size.equivalent_diameter_m):
        assert diameter_m == pytest.approx(2.0 * RADIUS_M, rel=0.015)


def joined(*meshes):
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, first, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def test_a_loose_stem_stays_and_specks_and_bubbles_go():
    fruit = cylinder(0.06, 0.06, segments=64, spacing_m=0.002)
    stem = cylinder(0.004, 0.01, segments=16).moved(np.array([0.0, 0.0, 0.07]))
    speck = Mesh(np.array([[0.1, 0, 0], [0.11, 0, 0], [0.1, 0.01, 0], [0.1, 0, 0.01]]), SPECK)
    bubble = cylinder(0.02, 0.02, segments=64).moved(np.array([0.0, 0.0, 0.02]))
    inside_out = Mesh(bubble.vertices, bubble.triangles[:, ::-1])
    kept = solid_pieces(joined(speck, stem, inside_out, fruit))
    assert len(kept.vertices) == len(fruit.vertices) + len(stem.vertices)
    assert kept.volume_m3() == pytest.approx(fruit.volume_m3() + stem.volume_m3())
    assert kept.is_watertight()


def test_open_edges_are_those_of_a_hole():
    mesh = cylinder(0.02, 0.03, segments=16)
    assert open_edges(mesh) == 0
    assert open_edges(Mesh(mesh.vertices, mesh.triangles[1:])) == 3
    # Two wedges that touch along an edge: four triangles meet there.
    other = Mesh(np.array([[1.0, 1.0, 1.0], [1.0, 2.0, 1.0], [2.0, 1.0, 1.0], [1.0, 1.0, 2.0]]), SPECK)
    mirrored = Mesh(2.0 - other.vertices + [0.0, 0.0, 1.0], SPECK[:, ::-1])
    pinched = joined(other, mirrored)
    shared = pinched.triangles.copy()
    shared[shared == 4 + 3], shared[shared == 4] = 0, 3
    assert open_edges(Mesh(pinched.vertices, shared)) == 0
    assert not Mesh(pinched.vertices, shared).is_watertight()


def test_sizes_of_a_cylinder():
    size = size_of(cylinder(0.04, 0.05, segments=256))
    assert size.area_m2 == pytest.approx(np.pi * 0.04 * (0.02 + 0.05), rel=1e-3)
    assert size.volume_l == pytest.approx(1000.0 * np.pi * 0.02**2 * 0.05, rel=1e-3)
    assert size.height_m == pytest.approx(0.05)
    assert size.equivalent_diameter_m == pytest.approx((6.0 * 0.02**2 * 0.05) ** (1.0 / 3.0), rel=1e-3)


def test_feret_diameters_of_a_turned_rectangle():
    corners = np.array([[0.0, 0.0], [0.04, 0.0], [0.04, 0.03], [0.0, 0.03], [0.02, 0.01]])
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    largest, smallest = feret_diameters(corners @ turn.T)
    assert largest == pytest.approx(0.05)
    assert smallest == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("count", "scale", "side", "base_height_m", "says"),
    [
        (10, 1.0, 1.0, None, "export more points"),
        (1000, np.array([1.0, 1.0, 0.0]), 1.0, None, "export more points"),
        (1000, 1e-3, 1.0, None, "it is in metres"),
        (1000, 100.0, 1.0, None, "is it in metres"),
        (1000, 1e8, 1.0, None, "is it in metres"),
        (3000, 1.0, -1.0, STAND_M, "normals do not point out"),
        (3000, 1.0, 0.0, None, "normals do not point out"),
        (3000, 1.0, np.nan, None, r"\d+ of the cloud's points have no normal"),
        (3000, 1.0, 1.0, 1000.0 * STAND_M, "below the base at 70 m"),
        (3000, 1.0, 1.0, STAND_M + 0.02, "below the base at 0.09 m"),
    ],
)
def test_clouds_that_surround_nothing_or_in_other_units_are_refused(count, scale, side, base_height_m, says):
    points, normals = sphere_points(count, above=-0.93)
    with pytest.raises(InputError, match=says):
        closed_mesh(scale * points, side * normals, MeshConfig(base_height_m=base_height_m))
