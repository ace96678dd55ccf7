import math

import pytest
import torch

from hsi_sc_nerf.fields.surface_opacity import opaque_density

FOLDING = 0.003
STEP = 1e-4


def along(rate_of_descent, nearest):
    """Density on a ray into ground that is e times as dense after each FOLDING, from far above to this height."""
    distances = torch.arange(20.0 * FOLDING / rate_of_descent, 0.0, -STEP, dtype=torch.float64)
    return torch.exp(-(nearest + rate_of_descent * distances) / FOLDING)


def optical_depth(densities, rise_length):
    lengths = torch.full_like(densities, STEP)
    return float((opaque_density(densities, lengths, rise_length) * lengths).sum())


@pytest.mark.parametrize("angle_deg", [0.0, 60.0, 85.0])
def test_a_rise_is_as_opaque_from_everywhere(angle_deg):
    cosine = math.cos(math.radians(angle_deg))
    density_alone = optical_depth(along(cosine, 0.0), 0.0)
    assert density_alone == pytest.approx(FOLDING / cosine, rel=0.02)
    assert optical_depth(along(cosine, 0.0), 0.02) - density_alone == pytest.approx(0.02, rel=0.04)


def test_it_is_that_of_loops():
    generator = torch.Generator().manual_seed(0)
    densities, lengths = torch.rand(2, 7, 6, generator=generator, dtype=torch.float64)
    found = opaque_density(densities, lengths, 0.4)
    for ray in range(7):
        before = 0.0
        for sample in range(6):
            density, length = float(densities[ray, sample]), float(lengths[ray, sample])
            depth = density * length + 0.4 * max(density - before, 0.0)
            assert float(found[ray, sample]) * length == pytest.approx(depth, rel=1e-12)
            before = density


@pytest.mark.parametrize("density", [0.0, 1.0, 1e25])
def test_samples_of_no_length_have_no_opacity_and_finite_gradients(density):
    densities = torch.full((1, 4), density, requires_grad=True)
    lengths = torch.zeros(1, 4)
    depth = (opaque_density(densities, lengths, torch.tensor(0.02)) * lengths).sum()
    depth.backward()
    assert depth == 0.0
    assert torch.isfinite(densities.grad).all()
