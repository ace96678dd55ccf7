"""Bases that no camera sees, of cones, spheres and cylinders whose bases are known."""

from dataclasses import replace

import numpy as np
import pytest
from standing_sphere import RADIUS_M, STAND_M, sphere_points

from hsi_sc_nerf.analysis.base import find_base, lower_rim, lowest_edge_m
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh


def test_base_of_a_cone_goes_straight_on_to_where_it_stands():
    rng = np.random.default_rng(0)
    azimuth, z = rng.uniform(0.0, 2.0 * np.pi, 20000), rng.uniform(0.08, 0.12, 20000)
    radius = 0.01 + 0.5 * (z - 0.07)
    points = np.stack([0.002 + radius * np.cos(azimuth), -0.001 + radius * np.sin(azimuth), z], axis=-1)
    normals = np.stack([np.cos(azimuth), np.sin(azimuth), np.full_like(z, -0.5)], axis=-1) / np.sqrt(1.25)
    base = find_base(points, normals, STAND_M)
    np.testing.assert_allclose(base.centre_m, [0.002, -0.001], atol=3e-4)
    np.testing.assert_allclose(base.foot_radius_m, 0.01, atol=1e-3)
    closing, outward = base.points(0.0005)
    assert closing[:, 2].min() == pytest.approx(STAND_M)
    on_floor = closing[:, 2] == closing[:, 2].min()
    np.testing.assert_allclose(outward[on_floor], np.tile([0.0, 0.0, -1.0], (on_floor.sum(), 1)))
    floor_m2 = on_floor.sum() * 0.0005**2
    assert floor_m2 == pytest.approx(np.pi * base.foot_radius_m.mean() ** 2, rel=0.02)
    assert (outward[~on_floor, 2] < 0.0).all()


def test_base_of_a_sphere_goes_on_along_its_arc():
    seen, height_m = -0.6, STAND_M + 0.1 * RADIUS_M
    base = find_base(*sphere_points(40_000, above=seen), height_m)
    np.testing.assert_allclose(base.edge_sine, -seen, atol=0.02)
    np.testing.assert_allclose(base.curvature_per_m, 1.0 / RADIUS_M, rtol=0.1)
    # The straight line of its slope would end at 0.58 of the radius.
    np.testing.assert_allclose(base.foot_radius_m, np.sqrt(1.0 - 0.9**2) * RADIUS_M, atol=0.04 * RADIUS_M)
    wall, outward = base.points(0.001)
    wall, outward = wall[wall[:, 2] > height_m], outward[wall[:, 2] > height_m]
    from_centre = wall - [0.0, 0.0, STAND_M + RADIUS_M]
    np.testing.assert_allclose(np.linalg.norm(from_centre, axis=1), RADIUS_M, atol=0.02 * RADIUS_M)
    assert np.einsum("pi,pi->p", outward, from_centre).min() > 0.99 * RADIUS_M


@pytest.mark.slow
def test_a_sphere_that_is_seen_to_its_lowest_fifth_closes_to_a_sphere():
    cloud = sphere_points(40_000, above=-0.6)
    mesh = closed_mesh(*cloud, MeshConfig(octree_depth=6, base_height_m=STAND_M))
    assert mesh.volume_m3() == pytest.approx(4.0 / 3.0 * np.pi * RADIUS_M**3, rel=0.01)
    assert mesh.area_m2() == pytest.approx(4.0 * np.pi * RADIUS_M**2, rel=0.015)


def test_an_arc_that_would_be_level_above_the_base_ends_on_it():
    base = find_base(*sphere_points(40_000, above=-0.6), STAND_M)
    wide = replace(base, height_m=STAND_M - 0.004, edge_radius_m=base.edge_radius_m + 0.03)
    # A circle from the edge that is level on the base: both its ends' sines and cosines are known.
    inwards_m = wide.drop_m * (wide.edge_sine + 1.0) / np.sqrt(1.0 - wide.edge_sine**2)
    np.testing.assert_allclose(wide.foot_radius_m, wide.edge_radius_m - inwards_m)
    wall, outward = wide.points(0.001)
    assert wall[:, 2].min() == pytest.approx(STAND_M - 0.004)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0)


def test_a_hollow_base_is_a_cone():
    height_m = STAND_M + 0.4 * RADIUS_M + 0.001
    base = replace(find_base(*sphere_points(40_000, above=-0.6), height_m), hollow=0.2)
    floor, outward = base.points(0.0005)
    radius = np.hypot(*(floor[:, :2] - base.centre_m).T)
    foot_m = base.foot_radius_m.mean()
    np.testing.assert_allclose(floor[:, 2] - height_m, 0.2 * (foot_m - radius), atol=3e-4)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0)
    off_axis = radius > 0.001
    np.testing.assert_allclose(outward[off_axis, 2], -1.0 / np.hypot(1.0, 0.2))
    inwards = -np.einsum("pi,pi->p", outward[off_axis, :2], floor[off_axis, :2] - base.centre_m) / radius[off_axis]
    assert (inwards > 0.19).all()


@pytest.mark.slow
def test_base_without_a_height_is_where_the_cloud_ends():
    points, normals = sphere_points(20000, above=-0.6)
    assert lowest_edge_m(points) == pytest.approx(STAND_M + 0.4 * RADIUS_M, abs=5e-4)
    mesh = closed_mesh(points, normals, MeshConfig(octree_depth=6))
    assert mesh.vertices[:, 2].min() == pytest.approx(STAND_M + 0.4 * RADIUS_M, abs=1e-3)


@pytest.mark.slow
def test_a_rim_that_hangs_down_does_not_widen_the_base():
    points, normals = sphere_points(40000, above=-0.8)
    edge_m = STAND_M + 0.2 * RADIUS_M
    azimuth = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    out = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
    hanging = 0.6 * RADIUS_M * out
    hanging[:, 2] = edge_m - np.random.default_rng(1).uniform(0.0, 0.001, len(hanging))
    config = MeshConfig(octree_depth=6, base_height_m=STAND_M)
    clean = closed_mesh(points, normals, config)
    with_rim = closed_mesh(np.concatenate([points, hanging]), np.concatenate([normals, out]), config)
    rim = lower_rim(np.concatenate([points, hanging]), 0.001)
    assert rim[len(points) :].mean() > 0.98
    assert rim[: len(points)].mean() < 0.02
    assert with_rim.area_m2() == pytest.approx(clean.area_m2(), rel=0.005)
    foot_m = find_base(points[~rim[: len(points)]], normals[~rim[: len(points)]], STAND_M).foot_radius_m
    assert foot_m.max() < 0.55 * RADIUS_M


def test_a_base_a_little_above_the_edge_needs_no_wall():
    points, normals = sphere_points(20000, above=-0.5)
    edge_m = STAND_M + 0.5 * RADIUS_M
    closing, outward = find_base(points, normals, edge_m + 0.002).points(0.0005)
    np.testing.assert_allclose(closing[:, 2], edge_m + 0.002)
    np.testing.assert_allclose(outward, np.tile([0.0, 0.0, -1.0], (len(outward), 1)))
