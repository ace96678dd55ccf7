"""Matter that is in the way of the chamber; the distortion has its tests in test_training_functions.py."""

import pytest
import torch

from hsi_sc_nerf.models.density_losses import free_space_loss


def test_matter_above_the_support_beside_the_object_costs_its_weight() -> None:
    """Rays: haze before the support, the same through the object, past the support, without haze, partly covered."""
    haze, none = [0.3, 0.2, 0.5], [0.0, 0.0, 1.0]
    weights = torch.tensor([haze, haze, haze, none, haze], requires_grad=True)
    heights = torch.tensor([0.02, 0.01, -0.01]).repeat(5, 1)
    heights[2, 2] = 0.01
    loss = free_space_loss(weights, heights, torch.tensor([1.0, 0.0, 1.0, 1.0, 0.3]))
    assert loss.item() == pytest.approx(1.3 * (0.3 + 0.2))
    (gradient,) = torch.autograd.grad(loss, weights)
    expected = torch.zeros(5, 3)
    expected[[0, 3], :2] = 1.0
    expected[4, :2] = 0.3
    torch.testing.assert_close(gradient, expected)


def test_no_ray_beside_the_object_costs_nothing() -> None:
    weights = torch.zeros(0, 16, requires_grad=True)
    loss = free_space_loss(weights, torch.zeros(0, 16), torch.zeros(0))
    assert loss.item() == 0.0
    assert torch.isfinite(torch.autograd.grad(loss, weights)[0]).all()
