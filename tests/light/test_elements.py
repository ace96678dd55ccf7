"""What elements see of the sky and of each other, against closed forms, and what frames measure of them."""

import numpy as np
import pytest
import trimesh

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import (
    MISPLACED_PX,
    Elements,
    observe_elements,
    shown_points,
    spread_elements,
    support_mesh,
)
from hsi_sc_nerf.light.stationary_light import even_directions
from hsi_sc_nerf.light.views import Transfer, transfer

RADIUS_M = 0.03
DIRECTIONS = even_directions(1024)


def ball_over(disc_radius_m: float, height_m: float = 0.0) -> tuple[Elements, Transfer]:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_M)
    mesh = Mesh(np.array(ball.vertices), np.array(ball.faces)).moved(np.array([0.0, 0.0, height_m]))
    support = support_mesh(None, disc_radius_m)
    elements = spread_elements(mesh, support, 300, 200 if disc_radius_m else 0, smoothing_m=0.003)
    rays = elements.occluders, elements.of_triangle, len(elements.positions), DIRECTIONS
    return elements, transfer(elements.positions, elements.normals, *rays, lift_m=1e-4)


def test_a_convex_body_alone_sees_the_sky_and_nothing_else():
    _, seen = ball_over(0.0)
    np.testing.assert_allclose(seen.sky, 1.0, atol=0.01)


def test_a_ball_over_a_wide_plane_sees_it_by_its_slope():
    """Form factor of an infinite plane: (1 - cos) / 2 of the angle between the normals."""
    elements, seen = ball_over(2.0, height_m=RADIUS_M + 0.002)
    ball = elements.on_object
    plane = seen.form_factors[:, np.flatnonzero(~ball)].sum(axis=1)[ball]
    expected = (1.0 - elements.normals[ball, 2]) / 2.0
    np.testing.assert_allclose(plane, expected, atol=0.02)
    np.testing.assert_allclose(seen.sky[ball], 1.0 - expected, atol=0.02)


def test_a_plane_under_a_ball_sees_it_as_a_disc():
    """Form factor of a ball for an element that it stands above: (r / d)^2 cos."""
    elements, seen = ball_over(0.15, height_m=0.08)
    ball = elements.on_object
    of_ball = seen.form_factors[:, np.flatnonzero(ball)].sum(axis=1)[~ball]
    position = elements.positions[~ball]
    distance = np.linalg.norm(position - [0.0, 0.0, 0.08], axis=1)
    np.testing.assert_allclose(of_ball, (RADIUS_M / distance) ** 2 * 0.08 / distance, atol=0.01)


@pytest.mark.parametrize("disc_radius_m", [0.0, 0.1])
def test_white_furnace(disc_radius_m):
    elements, seen = ball_over(disc_radius_m, height_m=RADIUS_M)
    np.testing.assert_allclose(seen.sky + seen.form_factors @ np.ones(len(elements.positions)), 1.0, atol=1e-5)


def test_the_support_points_outwards_and_has_the_area_of_a_drum_on_a_disc():
    mesh = support_mesh((0.08, 0.06), 0.1)
    normals, middles = mesh.facet_normals(), mesh.vertices[mesh.triangles].mean(axis=1)
    assert normals[:, 2].min() > -1e-9
    assert (normals[:, :2] * middles[:, :2]).sum(axis=1).min() > -1e-9
    assert mesh.area_m2() == pytest.approx(np.pi * 0.1**2 + np.pi * 0.08 * 0.06, rel=0.01)
    assert not len(support_mesh(None, 0.0).triangles)


def test_pixels_show_points_around_each_element_and_the_support_as_it_is():
    elements, _ = ball_over(0.1, height_m=RADIUS_M)
    points, normals, weights = shown_points(elements, 0.006, 1e-4)
    ball, shown = elements.on_object, np.diff(weights.indptr)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert np.median(shown[ball]) > 3
    assert np.linalg.norm(weights @ points - elements.positions, axis=1).max() < 0.006
    assert np.einsum("nk,nk->n", weights @ normals, elements.normals).min() > 0.9
    np.testing.assert_array_equal(shown[~ball], 1)
    np.testing.assert_allclose((weights @ points)[~ball], elements.positions[~ball])


def test_pixels_do_not_show_what_lies_in_a_groove():
    """A comb of upright plates, 1 mm wide and apart, 4 mm high."""
    profile = [(x, z) for at in np.arange(0.0, 0.02, 0.002) for x, z in ((at, 0), (at, 0.004), (at + 0.001, 0.004))]
    profile = [pair for x, z in profile for pair in ([(x, z), (x + 1e-9, 0)] if z and x % 0.002 > 5e-4 else [(x, z)])]
    vertices = np.array([[x, y, z] for x, z in profile for y in (0.0, 0.02)])
    first = np.arange(0, len(vertices) - 2, 2)
    triangles = np.stack([[first, first + 2, first + 1], [first + 1, first + 2, first + 3]]).transpose(0, 2, 1)
    comb = Mesh(vertices, triangles.reshape(-1, 3))
    assert comb.facet_normals()[:, 2].min() > -1e-6
    x = np.linspace(0.006, 0.014, 50)
    positions = np.stack([x, np.full(50, 0.01), np.full(50, 0.004)], axis=1)
    elements = Elements(
        positions, np.tile([0.0, 0.0, 1.0], (50, 1)), np.ones(50, bool), comb, np.zeros(len(comb.triangles), int)
    )
    points, _, weights = shown_points(elements, 0.006, 1e-5)
    on_side = (points[:, 2] > 1e-4) & (points[:, 2] < 0.0039)
    assert (weights @ on_side.astype(float)).max() < 0.01


SIZE, DISTANCE_M, PIXEL_M = 32, 1.0, 0.01
EDGE = 20
"""The first bright sample."""


def test_measurements_are_uncertain_where_brightness_changes_from_pixel_to_pixel():
    half = SIZE / 2 * PIXEL_M
    corners = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    across = np.random.default_rng(0).uniform(-0.8 * half, 0.8 * half, (400, 2))
    positions, normals = np.pad(across, ((0, 0), (0, 1))), np.tile([0.0, 0.0, 1.0], (400, 1))
    elements = Elements(positions, normals, np.ones(400, bool), plane, np.zeros(2, int))
    pose = np.eye(4)
    pose[2, 3] = DISTANCE_M
    focal = DISTANCE_M / PIXEL_M
    views = observe_elements(
        elements,
        pose[None],
        PinholeIntrinsics(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2),
        (0.0, 0.0, 0.0, 0.0),
        np.ones((1, SIZE, SIZE), bool),
        lambda frame, line, sample: np.where(sample >= EDGE, 0.6, 0.2)[:, None] * np.ones(3),
        1e-4,
    )
    beyond_edge = positions[views.element, 0] / PIXEL_M + SIZE / 2 - EDGE
    close = np.abs(beyond_edge) < 0.45
    assert close.any()
    expected = 0.4 + 0.4 * beyond_edge[close]
    np.testing.assert_allclose(views.reflectance[close, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(views.own_std[close], MISPLACED_PX * 0.4 / expected, rtol=1e-5)
    np.testing.assert_allclose(views.own_std[np.abs(beyond_edge) > 0.55], 0.0, atol=1e-9)
