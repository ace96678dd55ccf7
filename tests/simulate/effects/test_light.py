"""Effects of light against closed forms: form factors, cosines, shadow edges, Fresnel; energy is kept."""

from itertools import combinations

import numpy as np
import pytest

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, turntable_camera_to_world
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.effects.light import ChamberShading, Gloss, InterReflection, Lamp, fresnel, mean_fresnel
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.light import Lighting, colour_spectra, even_light, render
from hsi_sc_nerf.simulate.mesh import cylinder, quads, revolve
from hsi_sc_nerf.simulate.render import Part, Renderer
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.surface import SceneSurface, cosine_directions, split_at_creases

RADIUS_M = 0.03
CAMERA = PinholeIntrinsics(24, 24, 60.0, 60.0, 12.0, 12.0)
DOWN = np.array([0.0, 0.0, -1.0])


def ball(segments=48):
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    profile = RADIUS_M * np.stack([np.cos(latitude), np.sin(latitude)], axis=-1)
    profile[[0, -1], 0] = 0.0
    return revolve(profile, segments)


def part(mesh, material, is_object=False):
    return Part(mesh, (material,), np.ones((len(mesh.vertices), 1)), is_object)


@pytest.fixture(scope="module")
def still_life():
    """A ball of two materials on a white drum on a white table."""
    mesh = ball(32).moved(np.array([0.0, 0.0, 0.05 + RADIUS_M]))
    red = (mesh.vertices[:, :1] > 0).astype(float)
    drum = part(cylinder(0.06, 0.05, 32, spacing_m=0.005), "drum")
    table = part(cylinder(0.2, 0.01, 32, spacing_m=0.005).moved(np.array([0.0, 0.0, -0.0103])), "table")
    return Renderer([Part(mesh, ("red", "green"), np.concatenate([red, 1.0 - red], axis=1), True), drum, table])


def picture(renderer, effects, camera_to_world=None):
    if camera_to_world is None:
        camera_to_world = look_at([0.35, 0.0, 0.25], [0.0, 0.0, 0.05])
    rendering = render(renderer, CAMERA, camera_to_world, 2, lighting=Lighting(renderer, effects))
    return rendering.light_weights, rendering.colours


def if_white(light, colours):
    """Radiance where all materials are white, in two bands."""
    return light @ colour_spectra(colours, np.ones((9, 2)))


def highest(renderer, points):
    """The highest points at some (x, y)."""
    origins = np.column_stack([points, np.full(len(points), 0.5)]).astype(np.float32)
    return renderer.cast(origins, np.broadcast_to(DOWN, origins.shape).astype(np.float32), 1)


def light_below(lighting, points):
    """Light of the highest points at some (x, y), as weights by colour."""
    weights, colours = lighting.light(highest(lighting._renderer, points), np.eye(4))
    return dict(zip(colours, weights.T, strict=True))


def test_what_stands_before_the_chamber_is_seen_through_the_light_as_well():
    effects = ["lamp", "textured_background"]
    frame = Simulation(override(load_scene("sphere"), size_px=32, bands=4, frames=1, effects=effects)).frame(0)
    background = frame.material_weights[0, 0], frame.light.weights[0, 0]
    np.testing.assert_allclose(background[1], background[0], atol=1 / 1024)
    assert background[0][-1] < 0.9


# Reflections


@pytest.mark.parametrize("bounces", [1, 3])
def test_reflections_sum_the_series_of_form_factors(still_life, bounces):
    """Slow reference: dense powers of the form factors, all materials white."""
    effects = ChamberShading(16), InterReflection(16, bounces), Lamp(0.5)
    lighting = Lighting(still_life, effects)
    surface, camera = lighting._light.surface, np.eye(4)
    visibility, form_factors = surface.surroundings(16)
    factors = form_factors.toarray()
    arriving, expected = 0.5 * visibility + Lamp(0.5).on_points(surface, camera), 0.0
    for _ in range(bounces):
        arriving = factors @ arriving
        expected = expected + arriving
    hits = highest(still_life, np.array([[0.07, 0.0], [0.0, -0.08], [0.02, 0.02]]))
    seen = if_white(*lighting.light(hits, camera))[:, 0]
    direct = Lighting(still_life, [ChamberShading(16), Lamp(0.5)])
    seen -= if_white(*direct.light(hits, camera))[:, 0]
    # Where nothing is reflected to, the order of the sums leaves 1e-17 in one of the two.
    expected_there = hits.mix(surface.triangles, len(expected)) @ expected
    np.testing.assert_allclose(seen, expected_there, rtol=0.01, atol=1e-12)


# Energy


def test_white_furnace(still_life):
    """A white ball in a white chamber cannot be seen; as it is convex, no ray is lost to chance."""
    renderer = Renderer([part(ball(), "white", True)])
    seen = if_white(*picture(renderer, [ChamberShading(), InterReflection(), Gloss()]))
    np.testing.assert_allclose(seen, 1.0, atol=2e-6)
    # Neighbours that are evenly lit and as white as the chamber cannot be seen either. A coat mirrors what it keeps
    # from the body, of the chamber or of the other parts.
    for effects in ([InterReflection(16)], [InterReflection(16), Gloss()]):
        np.testing.assert_allclose(if_white(*picture(still_life, effects)), 1.0, atol=2e-3)


ALL = (ChamberShading(16), InterReflection(16), Lamp(), Gloss(roughness=1.0))


@pytest.mark.parametrize(
    "effects",
    [some for n in (1, 2, 3, 4) for some in combinations(ALL, n)],
    ids=lambda some: "+".join(effect.name for effect in some),
)
def test_energy_is_never_created(still_life, effects):
    light, colours = picture(still_life, effects)
    assert light.shape[-1] == len(colours)
    assert light.min() >= 0.0
    # What mirrors is not the same in all directions; its sum over all of them is tested below.
    excess = 0.06 if {Lamp, Gloss} <= {type(effect) for effect in effects} else 1e-5
    assert if_white(light, colours).max() <= 1.0 + excess


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.1, 0.25, 1.0])
def test_a_white_point_under_the_lamp_sends_no_more_than_it_gets(roughness):
    gloss = Gloss(roughness=roughness)
    cosine, azimuth = np.meshgrid((np.arange(800) + 0.5) / 800, 2 * np.pi * np.arange(800) / 800, indexing="ij")
    sine = np.sqrt(1.0 - cosine**2)
    views = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1).reshape(-1, 3)
    cosine = views[:, 2]
    up = np.broadcast_to([0.0, 0.0, 1.0], views.shape)
    through = (1.0 - fresnel(cosine, 1.45)) / (1.0 - mean_fresnel(1.45))
    for angle_deg in (0.0, 30.0, 60.0, 80.0, 88.0):
        angle = np.deg2rad(angle_deg)
        to_lamp = np.array([np.sin(angle), 0.0, np.cos(angle)])
        body = through * (1.0 - fresnel(np.cos(angle), 1.45)) / np.pi
        sent = ((body + gloss.highlight(up, views, to_lamp)) * cosine).mean() * 2.0 * np.pi
        assert sent <= 1.0
        # Light that goes from one rough facet to the next is lost, the more the more grazing it comes.
        assert angle_deg > 30.0 or sent > 0.97


# Sky visibility and one bounce


DISTANCES_M = np.array([0.002, 0.02, 0.05, 0.1, 0.3, 20.0])


def wall_and_floor(height_m=0.1):
    """A wall of 40 m at x = 0 on a longer floor that has points at some distances from the wall's middle.

    Returns its surface, those points, the wall's points, and the wall's form factors.
    """
    x = np.concatenate([[-0.1], DISTANCES_M])
    rows = [np.column_stack([x, np.full(7, y), np.full(7, -1e-5)]) for y in (-60.0, 0.0, 60.0)]
    triangles = [
        corners
        for first in (0, 7)
        for i in range(first, first + 6)
        for corners in ([i, i + 1, i + 8], [i, i + 8, i + 7])
    ]
    floor = Mesh(np.concatenate(rows), np.array(triangles))
    wall = quads(np.array([[[0.0, 20.0, 0.0], [0.0, 20.0, height_m], [0.0, -20.0, height_m], [0.0, -20.0, 0.0]]]))
    surface = SceneSurface(Renderer([part(floor, "floor"), part(wall, "wall")]))
    points = np.argsort(surface.vertex)
    hidden = 0.5 * (1.0 - DISTANCES_M / np.hypot(DISTANCES_M, height_m))
    return surface, points[8:14], points[21:], hidden


@pytest.mark.parametrize("is_shaded", [False, True])
def test_bounce_has_the_form_factor_and_both_colours(is_shaded):
    surface, on_floor, on_wall, hidden = wall_and_floor()
    light = even_light(surface)
    if is_shaded:
        light = ChamberShading(2048).on_surface(light)
    # The floor in turn hides half of the sky from the wall.
    of_wall = 0.5 if is_shaded else 1.0
    np.testing.assert_allclose(light.chamber_lit[on_wall, 1], of_wall, atol=5e-3)
    light = InterReflection(2048).on_surface(light)
    both = light.colours.index((0, 1))
    np.testing.assert_allclose(light.chamber_lit[on_floor, both], hidden * of_wall, atol=5e-3)
    np.testing.assert_allclose(light.chamber_lit[on_floor, 0], 1.0 - hidden, atol=5e-3)
    assert (0, 0) not in light.colours
    spectra = colour_spectra(light.colours, np.array([[0.5, 0.2], [0.9, 0.1], [1.0, 1.0]]))
    np.testing.assert_allclose(spectra[both], [0.45, 0.02])


@pytest.mark.slow
def test_contact_shadow_of_a_drum_on_a_disc_as_by_brute_force():
    radius_m, height_m = 0.045, 0.07
    drum = part(cylinder(2 * radius_m, height_m, 128, spacing_m=0.0025), "drum")
    disc = part(cylinder(0.175, 0.006, 128, spacing_m=0.0025).moved(np.array([0.0, 0.0, -0.0063])), "disc")
    distance_m = np.array([0.0003, 0.001, 0.0022, 0.005, 0.01, 0.02, 0.04])
    lighting = Lighting(Renderer([drum, disc]), [ChamberShading(256)])
    # The mean over azimuths is free of most of the chance in single points.
    azimuth = np.linspace(0.0, 2 * np.pi, 90, endpoint=False)
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    positions = (radius_m + distance_m)[:, None, None] * around
    light = light_below(lighting, positions.reshape(-1, 2))[(1,)].reshape(len(distance_m), -1).mean(axis=1)

    rays = cosine_directions(100_000, np.zeros(1))[0]
    slow = []
    for x in radius_m + distance_m:
        # Where the ray from (x, 0, 0) first meets the infinite cylinder, and at which height.
        a, b, c = rays[:, 0] ** 2 + rays[:, 1] ** 2, x * rays[:, 0], x**2 - radius_m**2
        root = b**2 - a * c
        along = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        slow.append(1.0 - ((root > 0) & (b < 0) & (along * rays[:, 2] < height_m)).mean())
    np.testing.assert_allclose(light[3:], slow[3:], atol=0.005)
    # Between the foot and the next points, a step away, the light is level.
    np.testing.assert_allclose(light, slow, atol=0.025)


def test_points_split_at_the_rims_of_a_drum_only():
    drum = cylinder(0.05, 0.05, 64, spacing_m=0.01)
    triangles, vertex = split_at_creases(drum.vertices, drum.triangles, 40.0)
    np.testing.assert_array_equal(vertex[triangles], drum.triangles)
    repeated = np.flatnonzero(np.bincount(vertex) > 1)
    assert len(vertex) == len(drum.vertices) + 2 * 64
    np.testing.assert_allclose(np.hypot(*drum.vertices[repeated, :2].T), 0.025)
    assert set(np.round(drum.vertices[repeated, 2], 6)) == {0.0, 0.05}


# Lamp


def test_lambert_cosine_on_a_ball():
    lighting = Lighting(
        Renderer([part(ball(336), "white", True)]), [Lamp(fraction=1.0, azimuth_deg=40.0, elevation_deg=0)]
    )
    x = np.linspace(-0.95, 0.95, 41)
    seen = light_below(lighting, RADIUS_M * np.column_stack([x, np.zeros(41)]))[(0,)]
    lamp = np.deg2rad(40.0)
    cosine = x * np.sin(lamp) + np.sqrt(1.0 - x**2) * np.cos(lamp)
    np.testing.assert_allclose(seen, np.maximum(cosine, 0.0), atol=0.015)


@pytest.mark.parametrize("fraction", [0.3, 1.0])
def test_shadow_of_a_post_ends_where_geometry_says(fraction):
    height_m, azimuth_deg = 0.05, 60.0
    post = part(cylinder(0.01, height_m), "post")
    floor = part(quads(np.array([[[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]], float)), "floor")
    lighting = Lighting(Renderer([post, floor]), [Lamp(fraction, azimuth_deg, 0.0)])
    end_m = 0.005 + height_m * np.tan(np.deg2rad(azimuth_deg))
    x = -np.array([0.02, end_m - 5e-4, end_m + 5e-4, 0.2])
    light = light_below(lighting, np.column_stack([x, np.zeros(4)]))[(1,)]
    lit = 1.0 - fraction + fraction * np.cos(np.deg2rad(azimuth_deg))
    np.testing.assert_allclose(light, [1 - fraction, 1 - fraction, lit, lit], atol=1e-5)


def test_shading_stays_with_the_camera_when_the_object_turns():
    renderer = Renderer([part(ball(96), "white", True)])
    first = look_at([0.3, 0.0, 0.1], [0.0, 0.0, 0.0])
    pictures = [
        picture(renderer, [Lamp(0.8)], turntable_camera_to_world(first, angle))[0][..., 0] for angle in (0.0, 90.0)
    ]
    np.testing.assert_allclose(pictures[1], pictures[0], atol=0.01)
    # The lamp stands left of and above the camera.
    assert pictures[0][8, 9] > pictures[0][15, 14] + 0.2


# Gloss


def test_fresnel_at_known_angles():
    assert fresnel(np.array(1.0), 1.45) == pytest.approx((0.45 / 2.45) ** 2)
    assert fresnel(np.array(0.0), 1.45) == 1.0
    cosine = (np.arange(100_000) + 0.5) / 100_000
    assert (fresnel(cosine, 1.45) * 2.0 * cosine).mean() == pytest.approx(mean_fresnel(1.45), abs=1e-6)


def test_gloss_mirrors_the_chamber_and_what_hides_it(still_life):
    black = (still_life.materials.index("chamber"),)
    lighting = Lighting(still_life, [Gloss()])
    origins = np.array([[0.3, 0.0, 0.05 + RADIUS_M], [0.3, 0.0, 0.05 + 0.3 * RADIUS_M], [0.3, 0, 0.02]], np.float32)
    hits = still_life.cast(origins, np.broadcast_to([-1.0, 0.0, 0.0], (3, 3)).astype(np.float32), 1)
    weights, colours = lighting.light(hits, np.eye(4))
    assert colours[-1] == black
    names = still_life.materials
    of_object, of_support = (
        weights[:, [names.index(name) for name in pair]].sum(axis=1) for pair in (("red", "green"), ("drum", "table"))
    )
    chamber, at_normal = weights[:, -1], (0.45 / 2.45) ** 2
    # At the ball's equator; low on it, where it mirrors the drum or the table; and on the drum, which has no gloss.
    assert (of_object[0], chamber[0]) == (pytest.approx(1 - at_normal, abs=1e-4), pytest.approx(at_normal, abs=1e-4))
    assert of_support[0] == chamber[1] == 0.0
    assert of_object[1] < 1 - at_normal
    assert of_support[1] == pytest.approx(1.0 - of_object[1], abs=1e-6)
    assert (of_support[2], chamber[2]) == (1.0, 0.0)


# Two effects together are what their definitions say


def by_colour(renderer, effects):
    light, colours = picture(renderer, effects)
    return dict(zip(colours, np.moveaxis(light, -1, 0), strict=True))


@pytest.mark.parametrize("baked", [ChamberShading(16), InterReflection(16)], ids=lambda e: e.name)
def test_lamp_with_an_effect_of_the_chamber_is_the_sum_of_both_lights(still_life, baked):
    """(1 - fraction) of what the chamber gives with its effect, and the lamp's light, which that does not change."""
    lamp, only_lamp = Lamp(0.4), Lamp(1.0)
    both = by_colour(still_life, [baked, lamp])
    chamber = by_colour(still_life, [baked])
    direct = by_colour(still_life, [baked, only_lamp])
    wall = (still_life.materials.index("chamber"),)
    for colour, light in both.items():
        if colour == wall:
            np.testing.assert_allclose(light, chamber[colour], atol=1e-6)
        else:
            np.testing.assert_allclose(light, 0.6 * chamber[colour] + 0.4 * direct[colour], atol=1e-5)
    for colour, light in by_colour(still_life, [only_lamp]).items():
        np.testing.assert_allclose(direct[colour], light, atol=1e-6)


@pytest.mark.parametrize("baked", [ChamberShading(16), InterReflection(16)], ids=lambda e: e.name)
def test_gloss_dims_what_the_chamber_effects_give_and_mirrors_it(still_life, baked):
    place, coat = look_at([0.35, 0.0, 0.25], [0.0, 0.0, 0.05]), Gloss()
    hits = next(still_life.camera_hits(CAMERA, place, 1))[1]
    matte, both = (Lighting(still_life, [baked, *effects]) for effects in ([], [coat]))
    seen, colours = both.light(hits, place)
    alone, _ = matte.light(hits, place)
    # Slow reference, one ray at a time.
    expected = np.hstack([alone, np.zeros((len(alone), 1))])
    for i in np.flatnonzero(hits.is_object):
        normal, to_camera = hits.facing_normals[i], -hits.directions[hits.ray[i]]
        mirrored = fresnel(normal @ to_camera, coat.refractive_index)
        start = (hits.positions()[i] + 2e-5 * normal).astype(np.float32)
        direction = (2.0 * (normal @ to_camera) * normal - to_camera).astype(np.float32)
        there = matte.light(still_life.cast(start[None], direction[None], 1), place)[0][0]
        body = (1.0 - mirrored) * alone[hits.pixel[i]]
        if there[len(still_life.materials) - 1] == 1.0:
            expected[hits.pixel[i]] = [*body, mirrored]
        else:
            # The coat of a mirrored part would dim it, but a convex ball does not mirror itself.
            expected[hits.pixel[i]] = [*(body + mirrored * there), 0.0]
    assert colours[:-1] == matte.light(hits, place)[1]
    np.testing.assert_allclose(seen, expected, atol=2e-4)
    assert (expected[:, -1] > 0.0).any()
    assert (expected[:, : alone.shape[1]] > alone + 0.01).any()  # of the support


def test_gloss_dims_the_light_of_a_lamp_that_comes_by_way_of_other_surfaces(still_life):
    place, lit = look_at([0.35, 0.0, 0.25], [0.0, 0.0, 0.05]), [InterReflection(16), Lamp(1.0, azimuth_deg=120.0)]
    hits = next(still_life.camera_hits(CAMERA, place, 1))[1]
    alone, coated = (Lighting(still_life, [*lit, *coat]).light(hits, place)[0] for coat in ([], [Gloss()]))
    cosine = -np.einsum("nk,nk->n", hits.facing_normals, hits.directions[hits.ray])
    # In the lamp's shadow, and seen from so near to the front that it mirrors the chamber, which is dark.
    some = hits.is_object & (hits.facing_normals @ lit[1].direction(place) < 0.0) & (cosine > 0.9)
    seen, matte = (light[hits.pixel[some], : alone.shape[1]].sum(axis=1) for light in (coated, alone))
    assert matte.max() > 0.01
    np.testing.assert_allclose(seen, (1.0 - fresnel(cosine[some], 1.45)) * matte, rtol=1e-3)
