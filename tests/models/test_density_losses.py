import pytest
import torch

from hsi_sc_nerf.models.density_losses import free_space_loss, separate_distortion


def test_distortion_equals_nerfstudios_where_samples_touch() -> None:
    from nerfstudio.model_components.losses import lossfun_distortion

    torch.manual_seed(0)
    edges = torch.rand(20, 9).sort(dim=-1).values.double()
    weights = torch.rand(20, 8).double()
    expected = lossfun_distortion(edges, weights)
    torch.testing.assert_close(separate_distortion(weights, edges[:, :-1], edges[:, 1:]), expected)


def test_distortion_of_samples_apart_counts_the_gap() -> None:
    weights, starts = torch.tensor([[0.5, 0.5]]), torch.tensor([[0.0, 3.0]])
    # Twice 0.5 x 0.5 over a distance of 3, and 0.25 x 0.1 / 3 within each.
    expected = 2 * 0.25 * 3.0 + 2 * 0.25 * 0.1 / 3
    assert separate_distortion(weights, starts, starts + 0.1).item() == pytest.approx(expected)


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
