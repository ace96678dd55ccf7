import math

import numpy as np
import pytest
import torch

from hsi_sc_nerf.models.losses import DIRECTION_FLOOR, angle_loss, angular_loss, hsi_loss

LOSSES = [hsi_loss, angular_loss, angle_loss]


def pair(shape: tuple[int, ...] = (5, 6, 31)) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


def test_angular_loss_knows_shape_only() -> None:
    predicted, target = pair()
    assert angular_loss(0.3 * target, target).item() == pytest.approx(0, abs=1e-12)
    assert angular_loss(-target, target).item() == pytest.approx(2)
    assert angular_loss(0.01 * predicted, target).item() == pytest.approx(angular_loss(predicted, target).item())


def test_a_dark_spectrum_pulls_no_harder_than_the_floor_allows() -> None:
    target = torch.rand(1, 204)
    for scale in (0.0, 1e-30, 1e-7, 1e-5):
        predicted = torch.full((1, 204), scale, requires_grad=True)
        angular_loss(predicted, target).backward()
        assert predicted.grad.norm().item() <= 1.001 / (DIRECTION_FLOOR * math.sqrt(204))
    assert angular_loss(torch.zeros(1, 204), target).item() == 1


def test_non_finite_predictions_are_not_hidden() -> None:
    predicted, target = pair()
    for bad in (float("nan"), float("inf")):
        predicted[0, 0, 0] = bad
        assert not torch.isfinite(hsi_loss(predicted, target))
        assert not torch.isfinite(angular_loss(predicted, target))


def some_valid() -> torch.Tensor:
    """A third flagged; pixel (0, 0) has one valid band, pixel (0, 1) two, pixel (0, 2) none."""
    valid = torch.rand(5, 6, 31, generator=torch.Generator().manual_seed(1)) > 1 / 3
    valid[0, :3] = False
    valid[0, 0, 7] = valid[0, 1, 3] = valid[0, 1, 30] = True
    return valid


@pytest.mark.parametrize("flagged", [False, True])
def test_losses_are_the_papers_formulas_over_valid_values(flagged, device: str) -> None:
    predicted, target = pair()
    valid = some_valid() if flagged else torch.ones(5, 6, 31, dtype=torch.bool)
    squares, angles = [], []
    spectra = (values.reshape(30, 31).numpy() for values in (valid, predicted.double(), target.double()))
    for bands, p, t in zip(*spectra, strict=True):
        p, t = p[bands], t[bands]
        squares.extend((p - t) ** 2)
        if bands.sum() >= 2:
            angles.append(1 - p @ t / (np.linalg.norm(p) * np.linalg.norm(t)))
    assert len(angles) == 30 - 2 * flagged
    valid = valid.to(device) if flagged else None
    predicted, target = predicted.to(device), target.to(device)
    assert hsi_loss(predicted, target, valid).item() == pytest.approx(np.mean(squares), rel=1e-6)
    assert angular_loss(predicted, target, valid).item() == pytest.approx(np.mean(angles), rel=1e-6)


@pytest.mark.parametrize("anything", [0.0, 1e30, float("nan"), float("inf")])
@pytest.mark.parametrize("loss", LOSSES)
def test_flagged_values_may_be_anything_and_send_no_gradient(loss, anything: float, device: str) -> None:
    predicted, target, valid = (values.to(device) for values in (*pair(), some_valid()))
    expected = loss(predicted, target, valid)
    target[~valid] = predicted[~valid] = anything
    predicted.requires_grad_()
    value = loss(predicted, target, valid)
    value.backward()
    assert value.item() == expected.item()
    assert not predicted.grad[~valid].any()
    assert predicted.grad[valid].abs().sum() > 0
    assert torch.isfinite(predicted.grad).all()


@pytest.mark.parametrize("loss", LOSSES)
def test_a_batch_without_measurements_costs_nothing(loss, device: str) -> None:
    predicted, target = (values.to(device) for values in pair())
    predicted.requires_grad_()
    value = loss(predicted, target * float("nan"), torch.zeros(5, 6, 31, dtype=torch.bool, device=device))
    value.backward()
    assert value.item() == 0
    assert not predicted.grad.any()


def test_the_direction_floor_is_a_root_mean_square_of_the_valid_bands() -> None:
    """What a few valid bands of a dark spectrum cost is what a spectrum of these bands alone would cost."""
    predicted, target = (1e-4 * spectra[0] for spectra in pair())
    valid = torch.zeros(6, 31, dtype=torch.bool)
    valid[:, ::4] = True
    alone = angular_loss(predicted[:, ::4], target[:, ::4])
    assert angular_loss(predicted, target, valid=valid).item() == pytest.approx(alone.item(), rel=1e-6)


@pytest.mark.parametrize("flagged", [False, True])
@pytest.mark.parametrize("loss", LOSSES)
def test_gradients_match_finite_differences(loss, flagged, device: str) -> None:
    predicted, target = (values.double().to(device) for values in pair((2, 3, 5)))
    valid = some_valid()[1:3, :3, :5].to(device) if flagged else None
    assert torch.autograd.gradcheck(lambda values: loss(values, target, valid), (predicted.requires_grad_(),))


@pytest.mark.parametrize("loss", LOSSES)
def test_a_validity_that_does_not_fit_is_refused(loss) -> None:
    predicted, target = pair()
    for valid in (torch.ones(5, 6, dtype=torch.bool), torch.ones(5, 6, 31), torch.ones(5, 6, 30, dtype=torch.bool)):
        with pytest.raises(ValueError, match="the validity of values of shape"):
            loss(predicted, target, valid)


def test_the_angle_loss_is_the_angle() -> None:
    angles = torch.tensor([0.0, 1e-5, 0.3, 2.0], dtype=torch.float64)
    predicted = torch.stack([torch.cos(angles), torch.sin(angles)], dim=-1)
    target = torch.tensor([3.0, 0.0], dtype=torch.float64).expand(4, 2)
    assert angle_loss(predicted, target).item() == pytest.approx(angles.mean().item(), rel=1e-12)
