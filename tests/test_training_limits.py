"""What training computes stays finite for numbers of any size."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hsi_sc_nerf.fields.camera_shading import smoothed_grid
from hsi_sc_nerf.fields.occupancy_grid import OccupancyGrid, grid_over
from hsi_sc_nerf.fields.spectral_field import SpectralField, SpectralProposalField, density_of
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.models.backgrounds import Background
from hsi_sc_nerf.models.optimizers import with_alike_singular_values
from hsi_sc_nerf.numerics import safe_log10, safe_ratio, safe_sqrt

BOX = torch.tensor([[-1.0, -0.5, -1.0], [1.0, 0.5, 0.2]])
any_number = st.floats(allow_nan=False, allow_infinity=False, width=32)


def random(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32], ids=str)
def test_density_of_any_number_is_finite_and_zero_outside(device, dtype):
    raw = torch.tensor([-3e38, -1e4, -20.0, 0.0, 8.0, 60.0, 89.0, 1e4, 3e38, math.inf], device=device)
    raw = raw.to(dtype)[:, None].requires_grad_()
    for inside in (1.0, 0.0):
        density = density_of(raw, torch.full_like(raw, inside, dtype=torch.float32), 0.1)
        assert density.dtype == torch.float32
        expected = [inside * 0.1 * math.exp(min(value, 60.0)) for value in raw.flatten().tolist()]
        assert density.flatten().tolist() == pytest.approx(expected, rel=1e-5, abs=1e-30)
        (gradient,) = torch.autograd.grad(density.sum(), raw)
        assert gradient.isfinite().all()


@pytest.mark.parametrize("kind", [SpectralField, SpectralProposalField])
@pytest.mark.parametrize("learned", [-1e30, 1e4, 1e30])
def test_a_field_gone_wild_has_numbers_for_densities_and_nothing_outside(kind, learned):
    options = {"implementation": "torch", "num_levels": 2, "max_res": 8, "log2_hashmap_size": 6}
    images = {"num_images": 1, "appearance_embedding_dim": 0}
    made = kind(BOX, 3, **images, **options) if kind is SpectralField else kind(BOX, **options)
    with torch.no_grad():
        [layer for layer in made.mlp_base.modules() if isinstance(layer, torch.nn.Linear)][-1].bias.fill_(learned)
    density = made.density_fn(torch.tensor([[0.0, 0.0, 0.0], [0.9, 0.4, 0.1], [1.5, 0.0, 0.0], [1e30, 0.0, 0.0]]))
    assert density.isfinite().all()
    assert (density[2:] == 0.0).all()
    assert (density[:2] > 1e6).all() == (learned > 0.0)


@pytest.mark.parametrize("density", [0.0, 1e-40, 1e10, 3e38, math.inf])
def test_opacities_of_any_density_are_opacities(density):
    shape, _ = grid_over(BOX)
    grid = OccupancyGrid(BOX, torch.ones(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.bool))
    grid.refresh_all(lambda points: torch.full((len(points), 1), density))
    assert ((grid.opacity >= 0.0) & (grid.opacity <= 1.0)).all()
    assert (grid.opacity > 0.9).all() == (density > 1.0)


def test_a_smoothed_grid_of_one_number_is_that_number_up_to_its_sides():
    torch.testing.assert_close(smoothed_grid(torch.full((7, 9, 11), 0.3), 2.5), torch.full((7, 9, 11), 0.3))


DIRECTIONS = [[1.0, 0.0, -1e-30], [1.0, 1.0, -1e-10], [1e30, 0.0, -1.0], [0.0, 0.0, -1e-40], [0.0, 0.0, 0.0]]


@pytest.mark.parametrize("direction", [*DIRECTIONS, [0.0, 0.0, 1.0], [1e-30, 1e-30, -1e-38]])
def test_the_chamber_behind_rays_in_any_direction_is_of_its_picture(device, direction):
    lens = PinholeIntrinsics(6, 4, 8.0, 8.5, 3.1, 1.9)
    image, spectrum_there = random(4, 6, 3).float(), torch.tensor([0.9, 0.8, 0.7])
    made = Background(spectrum_there, image, 1, lens, (-0.25, 0.1, 0.003, -0.002)).to(device)
    seen = made(torch.tensor([direction], device=device), torch.eye(3, device=device).reshape(1, 9))
    assert ((seen >= 0.0) & (seen <= 1.0)).all()


@pytest.mark.parametrize("shape", [(3, 5), (5, 3)])
@pytest.mark.parametrize("scale", [0.0, 1e-42, 1e-30, 1e10, 1e30, 3e38])
def test_a_step_of_muon_is_bounded_for_gradients_of_any_size(shape, scale):
    step = with_alike_singular_values((scale * (random(*shape) - 0.5)).float(), 1e-8)
    assert torch.linalg.matrix_norm(step, 2) < 1.3


@settings(deadline=None, max_examples=40)
@given(a=any_number, b=any_number)
def test_safe_arithmetic_of_any_numbers_is_that_of_python(a, b):
    largest = torch.finfo(torch.float32).max
    x, y = torch.tensor([a]), torch.tensor([b])
    ratio = min(max(a / b, -largest), largest) if b else 0.0
    assert safe_ratio(x, y).item() == pytest.approx(ratio, rel=1e-6, abs=1e-44)
    assert safe_sqrt(x).item() == pytest.approx(math.sqrt(max(a, 0.0)), rel=1e-6)
    assert safe_log10(x).item() == pytest.approx(math.log10(max(a, 1e-30)), rel=1e-6)
