"""What elements see of the sky and of each other, against closed forms, and what frames measure of them."""

import numpy as np
import pytest
import trimesh

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import (
    EDGE_PX,
    MISPLACED_PX,
    Elements,
    observe_elements,
    shown_points,
    smooth_normals,
    spread_elements,
    support_mesh,
)
from hsi_sc_nerf.light.stationary_light import even_directions
from hsi_sc_nerf.light.views import ElementViews, Transfer, transfer

RADIUS_M = 0.03
DIRECTIONS = even_directions(1024)


def ball_at(height_m: float, subdivisions: int) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS_M)
    return Mesh(np.array(ball.vertices), np.array(ball.faces)).moved(np.array([0.0, 0.0, height_m]))


def ball_over(disc_radius_m: float, height_m: float = 0.0) -> tuple[Elements, Transfer]:
    mesh = ball_at(height_m, subdivisions=4)
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
        positions,
        np.tile([0.0, 0.0, 1.0], (50, 1)),
        np.ones(50, bool),
        np.ones(50, bool),
        comb,
        np.zeros(len(comb.triangles), int),
    )
    points, _, weights = shown_points(elements, 0.006, 1e-5)
    on_side = (points[:, 2] > 1e-4) & (points[:, 2] < 0.0039)
    assert (weights @ on_side.astype(float)).max() < 0.01


SIZE, DISTANCE_M, PIXEL_M = 32, 1.0, 0.01
EDGE = 20
"""The first bright sample."""


def seen_from_above(elements: Elements, height_m: float, reflectance, *, of_object: bool) -> ElementViews:
    """What a camera measures that looks down from `DISTANCE_M` above a height: reflectance by sample."""
    pose = np.eye(4)
    pose[2, 3] = height_m + DISTANCE_M
    focal = DISTANCE_M / PIXEL_M
    return observe_elements(
        elements,
        pose[None],
        PinholeIntrinsics(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2),
        (0.0, 0.0, 0.0, 0.0),
        np.full((1, SIZE, SIZE), of_object),
        lambda frame, line, sample: reflectance(sample)[:, None] * np.ones(3),
        1e-4,
    )


def test_measurements_are_uncertain_where_brightness_changes_from_pixel_to_pixel():
    half = SIZE / 2 * PIXEL_M
    corners = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    across = np.random.default_rng(0).uniform(-0.8 * half, 0.8 * half, (400, 2))
    positions, normals = np.pad(across, ((0, 0), (0, 1))), np.tile([0.0, 0.0, 1.0], (400, 1))
    elements = Elements(positions, normals, np.ones(400, bool), np.ones(400, bool), plane, np.zeros(2, int))
    views = seen_from_above(elements, 0.0, lambda sample: np.where(sample >= EDGE, 0.6, 0.2), of_object=True)
    beyond_edge = positions[views.element, 0] / PIXEL_M + SIZE / 2 - EDGE
    close = np.abs(beyond_edge) < 0.45
    assert close.any()
    expected = 0.4 + 0.4 * beyond_edge[close]
    np.testing.assert_allclose(views.reflectance[close, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(views.own_std[close], MISPLACED_PX * 0.4 / expected, rtol=1e-5)
    np.testing.assert_allclose(views.own_std[np.abs(beyond_edge) > 0.55], 0.0, atol=1e-9)


def test_only_the_object_and_the_surface_that_it_stands_on_show_the_light():
    """Plates and markers shade a container's side and the disc around it; they are not modelled."""
    mesh = ball_at(0.04 + RADIUS_M, subdivisions=3)
    elements = spread_elements(mesh, support_mesh((0.08, 0.04), 0.1), 200, 300, smoothing_m=0.003)
    on_lid = ~elements.on_object & (elements.positions[:, 2] > 0.0399)
    assert on_lid.sum() > 20 < (~elements.on_object & ~on_lid).sum()
    np.testing.assert_array_equal(elements.shows_light, elements.on_object | on_lid)
    alone = spread_elements(mesh, support_mesh(None, 0.0), 200, 0, smoothing_m=0.003)
    assert alone.shows_light.all()


def test_pixels_that_also_cover_what_is_beyond_a_lid_do_not_show_the_light():
    """A lid of 8 pixels' radius, seen from above before the disc."""
    radius_m, height_m = 8 * PIXEL_M, 0.05
    behind_camera = ball_at(5.0, subdivisions=2)
    lid = spread_elements(behind_camera, support_mesh((2 * radius_m, height_m), 0.2), 10, 600, smoothing_m=0.003)
    views = seen_from_above(lid, height_m, lambda sample: np.full(len(sample), 0.5), of_object=False)
    assert not views.on_object.any()
    to_edge = 8.0 - np.hypot(*lid.positions[views.element, :2].T) / PIXEL_M
    assert views.shows_light[to_edge > 1.1 * EDGE_PX].all()
    # Straight right, left, above and below are looked at: a diagonal edge may be nearer by a sixth.
    assert not views.shows_light[to_edge < 0.75 * EDGE_PX].any()
    assert not views.shows_light[lid.positions[views.element, 2] < 0.9 * height_m].any()


def test_a_mesh_that_is_rough_by_its_voxels_is_lit_as_the_smooth_surface():
    """Facets of a noisy ball are 9 degrees off; the normals that light falls on, a third of it."""
    ball = ball_at(0.0, subdivisions=5)
    rng = np.random.default_rng(0)
    radial = ball.vertices / RADIUS_M
    rough = Mesh(radial * (RADIUS_M + 1e-4 * rng.standard_normal((len(radial), 1))), ball.triangles)
    elements = spread_elements(rough, support_mesh(None, 0.0), 500, 0, smoothing_m=0.003)
    points, normals, weights = shown_points(elements, 0.003, 1e-5)
    facets = rough.vertices[rough.triangles].mean(axis=1)

    def off_deg(where: np.ndarray, found: np.ndarray) -> float:
        cosines = (where * found).sum(axis=1) / np.linalg.norm(where, axis=1)
        return float(np.rad2deg(np.sqrt(np.mean(np.arccos(np.clip(cosines, -1.0, 1.0)) ** 2))))

    assert off_deg(facets, rough.facet_normals()) > 7.0
    assert off_deg(points, normals) < 4.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)


def test_the_other_side_of_a_leaf_does_not_turn_its_normals():
    """A leaf of 0.4 mm: both sides lie within the radius."""
    leaf = trimesh.creation.box((0.03, 0.03, 0.0004)).subdivide().subdivide().subdivide().subdivide().subdivide()
    mesh = Mesh(np.array(leaf.vertices), np.array(leaf.faces))
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    places = np.array([[0.001, 0.002, 0.0002], [0.001, 0.002, -0.0002]])
    np.testing.assert_allclose(smooth_normals(mesh, places, 0.001, up), up, atol=1e-6)
