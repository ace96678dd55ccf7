from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding

from hsi_sc_nerf.fields.hash_grid import (
    COARSEST_GRID,
    LEVEL_GROWTH,
    FusedHashEncoding,
    fuse_hash_encodings,
    grid_for_resolution,
    interpolate_hash_grid,
)


def _pair(device):
    torch.manual_seed(0)
    options = {"num_levels": 5, "min_res": 4, "max_res": 61, "log2_hashmap_size": 9, "implementation": "torch"}
    reference, fused = HashEncoding(**options), FusedHashEncoding(**options)
    fused.load_state_dict(reference.state_dict())
    return reference.to(device), fused.to(device)


def test_features_and_gradients_equal_nerfstudios(device):
    reference, fused = _pair(device)
    upstream = torch.randn(200, reference.get_out_dim(), device=device)
    found = []
    for encoding in (reference, fused):
        x = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)).to(device).requires_grad_()
        features = encoding.pytorch_fwd(x)
        (features * upstream).sum().backward()
        found.append((features, encoding.hash_table.grad, x.grad))
    for ours, theirs in zip(*found[::-1], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)


def test_no_points_have_no_features(device):
    _, fused = _pair(device)
    x = torch.zeros(0, 3, device=device, requires_grad=True)
    features = fused.pytorch_fwd(x)
    assert features.shape == (0, 10)
    features.sum().backward()
    assert x.grad.shape == (0, 3)
    assert fused.hash_table.grad.abs().max() == 0


def test_fuse_replaces_torch_encodings_only():
    module = torch.nn.Sequential(_pair("cpu")[0], torch.nn.Linear(10, 2))
    fuse_hash_encodings(module)
    assert type(module[0]) is FusedHashEncoding
    assert type(module[1]) is torch.nn.Linear


@pytest.mark.parametrize("count", [200, 5000])  # by one thread; shared among all
def test_compiled_loops_equal_tensor_operations(count):
    """In float32 the processor runs compiled loops, in float64 the tensor operations that a GPU runs."""
    torch.manual_seed(0)
    size, scalings = 2**9, torch.tensor([4.0, 7.0, 20.0])
    points, table = torch.rand(count, 3), torch.rand(3 * size, 2) - 0.5
    points[:2] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    upstream = torch.randn(count, 6)
    found = []
    for kind in (torch.float32, torch.float64):
        x, rows = (value.detach().to(kind).requires_grad_() for value in (points, table))
        features = interpolate_hash_grid(x, rows, scalings, size)
        (features * upstream).sum().backward()
        found.append([value.double() for value in (features.detach(), rows.grad, x.grad)])
    for compiled, reference in zip(*found, strict=True):
        torch.testing.assert_close(compiled, reference, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_threads_do_not_change_gradients():
    torch.manual_seed(0)
    points, upstream = torch.rand(6000, 3), torch.randn(6000, 4)
    before, gradients = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            x, table = points.clone().requires_grad_(), torch.ones(2 * 64, 2, requires_grad=True)
            (interpolate_hash_grid(x, table, torch.tensor([4.0, 8.0]), 64) * upstream).sum().backward()
            gradients.append((table.grad, x.grad))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(gradients[0][0], gradients[1][0])
    assert torch.equal(gradients[0][1], gradients[1][1])


def test_the_viewer_may_interpolate_while_training_does():
    """Launches from several threads at once, as a viewer's beside the trainer's, do not disturb each other."""
    torch.manual_seed(0)
    points, table, scalings = torch.rand(20_000, 3), torch.rand(2 * 64, 2), torch.tensor([4.0, 8.0])
    alone = interpolate_hash_grid(points, table, scalings, 64)
    with ThreadPoolExecutor(3) as threads:
        found = threads.map(lambda _: interpolate_hash_grid(points, table, scalings, 64), range(60))
        assert all(torch.equal(beside, alone) for beside in found)


def test_half_a_pixel_is_a_cell():
    assert grid_for_resolution(0.2, 0.002, 60).finest == 200
    assert grid_for_resolution(0.2, 0.0005, 60).finest == 800


@pytest.mark.parametrize("footprint_m", [0.003, 0.002, 0.001, 0.0004])
def test_levels_grow_no_faster_than_they_may_and_are_not_more_than_needed(footprint_m):
    size = grid_for_resolution(0.2, footprint_m, 60)
    growth = size.finest / COARSEST_GRID
    assert growth ** (1 / (size.levels - 1)) <= LEVEL_GROWTH + 1e-9
    assert growth ** (1 / (size.levels - 2)) > LEVEL_GROWTH


def test_tables_hold_the_cells_of_a_plane_within_bounds_and_half_of_them_for_few_frames():
    assert 2 ** grid_for_resolution(0.2, 0.002, 60).log2_table >= 200**2
    assert 2 ** (grid_for_resolution(0.2, 0.002, 60).log2_table - 1) < 200**2
    assert [grid_for_resolution(0.2, 0.002, frames).log2_table for frames in (24, 25)] == [15, 16]
    assert grid_for_resolution(0.2, 0.05, 60).log2_table == 14
    assert grid_for_resolution(0.2, 0.0001, 60).log2_table == 19


def test_lengths_of_nothing_are_refused():
    for lengths in ((0.0, 0.001), (0.2, 0.0), (0.2, float("nan"))):
        with pytest.raises(ValueError, match="not both above 0"):
            grid_for_resolution(*lengths, 60)
