import math

import pytest
import torch
from torch.nn.functional import normalize

from hsi_sc_nerf.surface.silhouette_surface import move_to_silhouettes

FOLDING = 0.004


def soft(distance_fn, surface_density, folding=FOLDING):
    """A density that grows by e over a depth into a body, of which distance_fn gives the signed distance."""
    return lambda points: surface_density * torch.exp(-distance_fn(points) / folding).clamp_max(1e4)[..., None]


def touching_density(radius, folding=FOLDING):
    """Density at the surface of a round body at which a ray that touches it collects half an opacity.

    Along the ray the distance to the body is t^2 / 2 R, so the optical depth is a Gaussian's integral. No opacity
    from the front tells where the surface is: it would be three times as large on a ball of 0.03 as on one of 0.25.
    """
    return math.log(2.0) / math.sqrt(2.0 * math.pi * radius * folding)


def around(radius, count=200):
    """Points up to 1 mm from a ball, and its normals."""
    generator = torch.Generator().manual_seed(0)
    normals = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return normals * (radius + 0.02 * torch.rand(count, 1, generator=generator) - 0.01), normals


@pytest.mark.parametrize(("radius", "folding"), [(0.03, 0.004), (0.1, 0.004), (0.25, 0.004), (0.35, 0.008)])
def test_a_ball_is_found_whatever_its_radius(radius, folding):
    """The last one is soft over a millimetre, and rays that touch it stay in its density for a centimetre."""
    points, normals = around(radius)
    density_fn = soft(lambda p: p.norm(dim=-1) - radius, touching_density(radius, folding), folding)
    moved = move_to_silhouettes(density_fn, points, normals)
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((len(points),), radius), atol=1e-3, rtol=0)


@pytest.mark.parametrize("opacity", [0.3, 0.6, 0.8])
def test_touching_rays_collect_the_opacity_that_is_given(opacity):
    points, normals = around(0.1)
    density = touching_density(0.1) * math.log1p(-opacity) / math.log(0.5)
    moved = move_to_silhouettes(soft(lambda p: p.norm(dim=-1) - 0.1, density), points, normals, opacity)
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((len(points),), 0.1), atol=1e-3, rtol=0)


@pytest.mark.parametrize("rise_length", [0.005, 0.05])
def test_opaque_rises_are_counted(rise_length):
    """Half of the rays' opacity is the density's, half its rise's, or nearly all of it."""
    radius = 0.1
    along = math.sqrt(2.0 * math.pi * radius * FOLDING)
    density_fn = soft(lambda p: p.norm(dim=-1) - radius, math.log(2.0) / (along + rise_length))
    points, normals = around(radius)
    moved = move_to_silhouettes(density_fn, points, normals, rise_length=rise_length)
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((len(points),), radius), atol=1e-3, rtol=0)


def test_a_stem_is_found_by_the_rays_across_it():
    radius = 0.03
    _, normals = around(1.0)
    normals = normalize(normals * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    stem = soft(lambda p: p[..., :2].norm(dim=-1) - radius, touching_density(radius))
    moved = move_to_silhouettes(stem, normals * (radius + 0.008), normals)
    # None of the four directions is exactly across the stem: they are up to 22.5 degrees off.
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((len(moved),), radius), atol=1.5e-3, rtol=0)


def test_another_part_of_the_object_does_not_count():
    """All rays that touch the ball end in a shell around it."""
    radius, shell_radius = 0.1, 0.14
    density_fn = soft(
        lambda p: torch.minimum(p.norm(dim=-1) - radius, shell_radius - p.norm(dim=-1)), touching_density(radius)
    )
    points, normals = around(radius)
    moved = move_to_silhouettes(density_fn, points, normals)
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((len(moved),), radius), atol=1e-3, rtol=0)


def test_in_a_hollow_the_opacity_from_the_front_is_that_of_the_rest():
    """A bowl that nothing touches, and a ball beside it that gives the opacity."""
    radius, bowl_radius = 0.25, 0.1

    def distance(points):
        ball = (points - torch.tensor([2.0, 0.0, 0.0])).norm(dim=-1) - radius
        from_centre = points.norm(dim=-1)
        bowl = torch.maximum(bowl_radius - from_centre, from_centre - 0.5)
        return torch.minimum(bowl, ball)

    points, normals = around(radius)
    on_ball = points + torch.tensor([2.0, 0.0, 0.0])
    both = torch.cat([-normals * bowl_radius, on_ball]), torch.cat([normals, normals])
    moved = move_to_silhouettes(soft(distance, touching_density(radius)), *both)
    found = moved[: len(points)].norm(dim=-1)
    torch.testing.assert_close(found, torch.full_like(found, bowl_radius), atol=2e-3, rtol=0)


def test_empty_space_moves_nothing_far_and_stays_finite():
    points, normals = around(0.25)
    moved = move_to_silhouettes(lambda p: torch.zeros_like(p[..., :1]), points, normals)
    assert torch.isfinite(moved).all()
