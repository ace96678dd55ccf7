"""What a coat mirrors: of a ball before chamber and support, in closed form, and learned from views of it."""

import math

import pytest
import torch
from torch.nn import functional

from hsi_sc_nerf.fields.coat import COAT_START, Coat

LOWER, SIDES, BASE, CHANNELS = torch.tensor([-1.0, -1.0, -0.6]), torch.tensor([2.0, 2.0, 1.6]), -0.5, 3
CAMERA = torch.tensor([3.0, 0.0, 1.5])


def made(device="cpu") -> Coat:
    coat = Coat(LOWER, SIDES, BASE, CHANNELS)
    with torch.no_grad():
        coat.support.copy_(torch.tensor([0.9, -0.2, 0.1]))
    return coat.to(device)


def point_at(incidence_deg: float, position: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """A point, the camera, and a normal that is so far from the direction to the camera."""
    to_camera = functional.normalize(CAMERA - position, dim=-1)
    aside = functional.normalize(torch.linalg.cross(to_camera, torch.tensor([0.3, 0.5, 0.8])), dim=-1)
    angle = math.radians(incidence_deg)
    normal = math.cos(angle) * to_camera + math.sin(angle) * aside
    return position[None], CAMERA[None], normal[None]


@pytest.mark.parametrize("incidence_deg", [0.0, 45.0, 80.0, 89.0, 120.0])
@pytest.mark.parametrize(("height", "behind"), [(0.9, "chamber"), (-0.45, "support")])
def test_the_mirrored_fraction_is_schlicks(incidence_deg, height, behind):
    """From 3 units away and 1.5 high, a ray through the box's middle at 0.9 leaves it by its side, at -0.45 below."""
    coat, coefficients = made(), torch.tensor([[0.4, 0.3, -0.1]])
    mirrored = (1.0 - max(math.cos(math.radians(incidence_deg)), 0.0)) ** 5 / (1.0 + math.exp(-COAT_START))
    found, of_chamber = coat(coefficients, *point_at(incidence_deg, torch.tensor([0.0, 0.0, height])))
    of_support = 0.0 if behind == "chamber" else mirrored
    torch.testing.assert_close(found, (1.0 - mirrored) * coefficients + of_support * coat.support)
    assert of_chamber.item() == pytest.approx(mirrored - of_support, abs=1e-6)


def test_nothing_is_mirrored_by_the_support_and_where_no_normal_is_known():
    coefficients = torch.tensor([[0.4, 0.3, -0.1]])
    position, origin, normal = point_at(85.0, torch.tensor([0.0, 0.0, BASE - 0.01]))
    for of_point in ((position, origin, normal), (position + 1.0, origin, torch.zeros(1, 3))):
        found, of_chamber = made()(coefficients, *of_point)
        torch.testing.assert_close(found, coefficients)
        assert of_chamber.item() == 0.0


@pytest.mark.parametrize("grazing", [0.0, 0.3, 0.9])
def test_the_coat_is_learned_from_a_ball_before_a_chamber(grazing):
    """Points of a ball whose matte colour and limb are known: the coat's number and the support's colour follow."""
    torch.manual_seed(0)
    normals = functional.normalize(torch.randn(4000, 3), dim=-1)
    positions, origins = 0.45 * normals, CAMERA.expand(4000, 3)
    matte, chamber, truth = torch.tensor([0.5, 0.1, 0.0]), torch.tensor([1.2, 0.0, 0.0]), made()
    with torch.no_grad():
        truth.grazing.copy_(torch.logit(torch.tensor(grazing), eps=1e-4))

    def seen(coat):
        coefficients, of_chamber = coat(matte.expand(4000, 3), positions, origins, normals)
        return coefficients + of_chamber * chamber

    facing = ((origins - positions) * normals).sum(dim=-1) > 0.0
    target, coat = seen(truth).detach()[facing], Coat(LOWER, SIDES, BASE, CHANNELS)
    optimizer = torch.optim.Adam(coat.parameters(), lr=0.1)
    for _ in range(400):
        optimizer.zero_grad()
        (seen(coat)[facing] - target).square().mean().backward()
        optimizer.step()
    assert torch.sigmoid(coat.grazing).item() == pytest.approx(grazing, abs=0.02)
    if grazing > 0.0:
        torch.testing.assert_close(coat.support, truth.support, atol=0.05, rtol=0.0)


@pytest.mark.parametrize("far", [0.0, 1e-30, 1e18, math.nan])
def test_places_at_the_camera_and_far_away_leave_gradients_finite(far):
    coat, coefficients = made(), torch.ones(4, CHANNELS, requires_grad=True)
    positions = torch.full((4, 3), far)
    origins = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 1.5], [1e18, 0.0, 0.0], [0.0, 0.0, 5.0]])
    normals = functional.normalize(
        torch.tensor([[0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    )
    found = coat(coefficients, positions, origins, normals)
    assert all(part.isfinite().all() for part in found)
    for gradient in torch.autograd.grad(sum(part.sum() for part in found), [coefficients, *coat.parameters()]):
        assert gradient.isfinite().all()


def test_a_coat_on_a_gpu_is_that_of_the_processor(device):
    position, origin, normal = point_at(80.0, torch.tensor([0.0, 0.0, -0.45]))
    coefficients = torch.tensor([[0.4, 0.3, -0.1]])
    here = made()(coefficients, position, origin, normal)
    there = made(device)(*(array.to(device) for array in (coefficients, position, origin, normal)))
    for one, other in zip(here, there, strict=True):
        torch.testing.assert_close(other.cpu(), one)
