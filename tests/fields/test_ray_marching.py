"""Samples along rays: only in matter, most of them where the ray sees something, alike compiled and as tensors."""

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components.scene_colliders import AABBBoxCollider

from hsi_sc_nerf.fields.ray_marching import EXPLORED, cell_of, march_steps, sample_occupied, sample_with_tensors

CELL = 0.05
LOWER = torch.tensor([-1.0, -1.0, -0.8])
SHAPE = (40, 40, 32)


def cell_centres():
    axes = [torch.arange(side) + 0.5 for side in SHAPE]
    return LOWER + CELL * torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def shell():
    """An opaque shell in a ball that may hold matter, and a thin cloud beside it."""
    radius = cell_centres().norm(dim=-1)
    opacity = torch.where(radius < 0.6, torch.where((radius > 0.4) & (radius < 0.5), 0.9, 0.0), -1.0)
    opacity[(cell_centres() - torch.tensor([0.8, 0.0, 0.0])).norm(dim=-1) < 0.12] = 0.05
    return opacity


def rays(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1) * 3.0
    directions = torch.rand(count, 3, generator=generator) * 1.6 - 0.8 - origins
    nears = 1.2 + torch.rand(count, generator=generator) * 0.1
    return origins, torch.nn.functional.normalize(directions, dim=-1), nears, torch.full((count,), 4.8)


def sampled(function, opacity, samples=16, count=500, device="cpu"):
    on_device = (tensor.to(device) for tensor in (*rays(count), opacity, LOWER))
    return [found.cpu() for found in function(*on_device, CELL, samples)]


@pytest.mark.parametrize("samples", [1, 5, 16])
def test_compiled_loop_equals_tensor_operations(samples, device):
    compiled = sampled(sample_occupied, shell(), samples)
    tensors = sampled(sample_with_tensors, shell(), samples, device=device)
    for a, b in zip(compiled, tensors, strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("function", [sample_occupied, sample_with_tensors])
def test_samples_are_in_order_and_in_matter(function):
    origins, directions, nears, *_ = rays(500)
    starts, ends = sampled(function, shell())
    met = ends[:, -1] > nears
    assert 0.2 < met.float().mean() < 0.9
    assert (ends >= starts).all()
    assert (starts[:, 1:] >= ends[:, :-1] - 1e-5).all()
    middles = origins[:, None] + directions[:, None] * (starts + ends)[..., None] / 2.0
    cells, inside = cell_of(middles[met], SHAPE, LOWER, CELL)
    assert inside.all()
    # A step is in the cell of its middle, so that its ends may lie in the next one.
    assert (shell().flatten()[cells] >= 0.0).float().mean() > 0.97


@pytest.mark.parametrize("function", [sample_occupied, sample_with_tensors])
def test_most_samples_are_where_an_opaque_wall_is_seen(function):
    opacity = torch.zeros(SHAPE)
    opacity[20:] = 0.95  # from x = 0 on
    origin, direction = torch.tensor([[-3.0, 0.01, 0.01]]), torch.tensor([[1.0, 0.0, 0.0]])
    starts, ends = function(origin, direction, torch.tensor([2.0]), torch.tensor([4.0]), opacity, LOWER, CELL, 20)
    middles = (starts + ends) / 2.0 - 3.0
    at_wall = ((middles > -CELL) & (middles < 2 * CELL)).sum().item()
    # Widened by a cell on each side, the wall weighs a little over 1.9, all that is explored `EXPLORED`.
    assert at_wall >= 20 * 1.9 / (1.9 + EXPLORED) - 1


@pytest.mark.parametrize("function", [sample_occupied, sample_with_tensors])
def test_an_unknown_scene_is_sampled_evenly(function):
    starts, ends = function(
        torch.tensor([[-3.0, 0.01, 0.01]]),
        torch.tensor([[1.0, 0.0, 0.0]]),
        torch.tensor([2.0]),
        torch.tensor([4.0]),
        torch.zeros(SHAPE),
        LOWER,
        CELL,
        4,
    )
    torch.testing.assert_close(ends - starts, torch.full((1, 4), 2.0 / 5.0), rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("function", [sample_occupied, sample_with_tensors])
def test_rays_that_meet_nothing_have_samples_of_no_length(function):
    starts, ends = sampled(function, torch.full(SHAPE, -1.0), count=20)
    torch.testing.assert_close(starts, ends)
    assert starts.isfinite().all()


IN_BOX = [-1.0, -1.0, -0.8, 1.0, 1.0, 0.8]
HARD_RAYS = {
    "misses": ([-3.0, 2.0, 0.0], [1.0, 0.0, 0.0]),
    "looks away": ([-3.0, 0.0, 0.0], [-1.0, 0.0, 0.0]),
    "starts inside": ([0.0, 0.0, 0.0], [1.0, 2.0, -1.0]),
    "starts on a face": ([-1.0, 0.3, 0.1], [1.0, 0.0, 0.0]),
    "along a face": ([-3.0, 1.0, 0.0], [1.0, 0.0, 0.0]),
    "along an edge": ([-1.0, -1.0, -0.8], [0.0, 0.0, 1.0]),
    "through a corner": ([-2.0, 0.0, -0.8], [1.0, 1.0, 0.0]),
    "grazes a face": ([-3.0, 1.000001, 0.0], [1.0, -1e-7, 0.0]),
    "almost along an axis": ([-3.0, 0.0, 0.0], [1.0, -1e-6, 1e-38]),
}


@pytest.mark.parametrize("function", [sample_occupied, sample_with_tensors])
@pytest.mark.parametrize("ray", HARD_RAYS)
def test_hard_rays_have_finite_samples_in_order(function, ray, device):
    origin, direction = (torch.tensor([values], device=device) for values in HARD_RAYS[ray])
    direction = torch.nn.functional.normalize(direction, dim=-1)
    bundle = RayBundle(origin, direction, torch.ones_like(origin[:, :1]))
    box = SceneBox(torch.tensor(IN_BOX, device=device).reshape(2, 3))
    bundle = AABBBoxCollider(box, near_plane=0.0)(bundle)
    nears, fars = bundle.nears[:, 0], bundle.fars[:, 0]
    grid = torch.zeros(SHAPE, device=device), LOWER.to(device)
    starts, ends = function(origin, direction, nears, fars, *grid, CELL, 8)
    assert starts.isfinite().all()
    assert ends.isfinite().all()
    assert (ends >= starts).all()
    assert (starts[:, 1:] >= ends[:, :-1] - 1e-5).all()
    lengths = (ends - starts).sum()
    if ray in ("misses", "looks away"):
        assert lengths == 0.0
    if ray in ("starts inside", "starts on a face", "almost along an axis"):
        assert lengths > 0.5


def test_steps_cross_the_diagonal():
    assert march_steps((3, 4, 12)) >= 13
