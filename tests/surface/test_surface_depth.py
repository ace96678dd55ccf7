import math
from types import SimpleNamespace

import pytest
import torch

from hsi_sc_nerf.fields.occupancy_grid import OccupancyGrid
from hsi_sc_nerf.surface.surface_depth import SURFACE_OPACITY, densities_along, opacity_crossing_depth, surface_depth


@pytest.mark.parametrize("level", [0.1, 0.25, 0.5, 0.9])
@pytest.mark.parametrize("density", [0.7, 30.0, 5000.0])
def test_constant_density_crosses_where_beer_and_lambert_say(level, density):
    edges = torch.linspace(1.0, 9.0, 33, dtype=torch.float64)[None]
    depth = opacity_crossing_depth(edges, torch.full((1, 32), density, dtype=torch.float64), level)
    assert depth.item() == pytest.approx(min(9.0, 1.0 - math.log(1 - level) / density), abs=1e-9)


def test_a_hard_surface_is_found_at_its_front():
    edges = torch.linspace(0.0, 1.0, 11)[None]
    densities = torch.zeros(1, 10)
    densities[0, 6:] = 1e6
    assert opacity_crossing_depth(edges, densities, 0.25).item() == pytest.approx(0.6, abs=1e-4)


def test_an_empty_ray_ends_at_its_last_edge():
    edges = torch.linspace(0.0, 1.0, 11)[None].expand(3, -1)
    assert opacity_crossing_depth(edges, torch.zeros(3, 10), 0.25).tolist() == [1.0] * 3


@pytest.mark.parametrize("rise_length", [0.0, 0.03])
@pytest.mark.parametrize("normal_is_known", [True, False])
@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 60.0, 75.0])
def test_an_oblique_ray_finds_the_surface_where_a_frontal_one_does(angle_deg, normal_is_known, rise_length):
    rise = 4000.0  # of the density with the depth below z = 0: a quarter of a unit is opaque
    soft_ground = SimpleNamespace(
        occupancy=None,
        field=SimpleNamespace(
            density_fn=lambda p: -rise * p[..., 2:].clamp_max(0.0),
            density_gradient=lambda p: torch.tensor([0.0, 0.0, -rise]) * (p[..., 2:] < 0.0),
            rise_length=rise_length,
        ),
    )
    angle = math.radians(angle_deg)
    directions = torch.tensor([[math.sin(angle), 0.0, -math.cos(angle)]])
    origins, cosines = -2.0 * directions, -directions[:, 2:]
    depth, opacity = surface_depth(
        soft_ground, origins, directions, torch.full((1, 1), 2.02), cosines if normal_is_known else None
    )
    below = -(origins + depth * directions)[0, 2].item()
    # The optical depth of a frontal ray is rise * (z^2 / 2 + rise_length * z); the search steps by 5e-3 of a ray.
    optical_depth = -math.log1p(-SURFACE_OPACITY)
    expected = math.sqrt(rise_length**2 + 2.0 * optical_depth / rise) - rise_length
    assert below == pytest.approx(expected, abs=1e-3)
    assert opacity.item() > 0.99


def test_densities_are_asked_for_where_there_is_matter_and_light_is_left():
    """A ray down through a grid whose uppermost half knows no matter, into ground of density 50."""
    matter = torch.ones(128, 128, 128, dtype=torch.bool)
    matter[..., 64:] = False
    grid = OccupancyGrid(torch.tensor([[-1.0] * 3, [1.0] * 3]), matter, matter)
    asked = []

    def density_fn(points):
        asked.append(points.reshape(-1, 3))
        return torch.full_like(points[..., :1], 50.0)

    model = SimpleNamespace(occupancy=grid, field=SimpleNamespace(density_fn=density_fn))
    origins, directions = torch.tensor([[0.1, 0.1, 0.95]]), torch.tensor([[0.0, 0.0, -1.0]])
    edges = torch.linspace(0.0, 1.9, 96)[None]
    densities = densities_along(model, origins, directions, edges)
    middles = 0.95 - (edges[0, 1:] + edges[0, :-1]) / 2.0
    assert (densities[0, middles > 0.0] == 0.0).all()
    assert (densities[0, (middles < 0.0) & (middles > -0.1)] == 50.0).all()
    assert torch.cat(asked)[:, 2].max() < 0.0
    assert len(torch.cat(asked)) <= 15
