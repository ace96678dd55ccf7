"""A multiresolution hash grid: as fine as what the camera resolves, and trained at a usable speed without a GPU.

Same function and same parameters as nerfstudio's torch ``HashEncoding`` (Müller et al. 2022), so checkpoints and
results are interchangeable. nerfstudio gathers the eight corners of a cell one after the other and keeps all of
them for autograd; here one fused gather-and-sum reads the table, and without a GPU compiled loops do the work.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from hsi_sc_nerf.packed.dataset import PackedDataset

CELLS_PER_PIXEL = 2.0
"""Cells along what one pixel covers at the object. Four resolve more, but gain nothing at equal time
(docs/notes/dead_ends.md)."""
COARSEST_GRID = 16
"""Cells along the scene box in the first level, nerfacto's."""
LEVEL_GROWTH = 1.38
"""Factor from level to level, the smallest that Müller et al. 2022 use."""
LOG2_TABLE_RANGE = (14, 19)
"""Smallest and largest hash table of a level; 19 is nerfacto's."""
FEW_FRAMES = 25
"""Fewer frames support half as many rows: more would learn what no frame shows (docs/notes/dead_ends.md)."""
# Müller et al. 2022, Eq. 4. The second prime exceeds int32: its two's complement gives the same low bits.
_HASH_PRIMES = (1, 2654435761 - 2**32, 805459861)


def interpolate_hash_grid(
    positions: Float[Tensor, "n 3"],
    table: Float[Tensor, "rows features"],
    scalings: Float[Tensor, "levels"],
    table_size: int,
) -> Float[Tensor, "n levels_x_features"]:
    """Trilinear interpolation of a stack of hashed grids, differentiable once in positions and table.

    Args:
        positions: points in [0, 1]^3.
        table: the levels' feature tables, one after the other; ``table_size`` rows each, a power of two.
        scalings: cells along an edge of the unit cube, a level.
        table_size: rows of one level.
    """
    compiled = positions.device.type == "cpu" and positions.dtype == table.dtype == torch.float32
    function = _CompiledInterpolate if compiled else _Interpolate
    return function.apply(positions, table, scalings.to(positions), table_size)


class _CompiledInterpolate(torch.autograd.Function):
    """The interpolation on the processor."""

    @staticmethod
    def forward(ctx, positions, table, scalings, table_size):
        from hsi_sc_nerf.fields import hash_grid_cpu  # compiles; a GPU does without it

        ctx.save_for_backward(positions, table, scalings)
        ctx.table_size = table_size
        features = hash_grid_cpu.interpolate(
            positions.numpy(force=True), table.numpy(force=True), scalings.numpy(), table_size
        )
        return torch.from_numpy(features)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        from hsi_sc_nerf.fields import hash_grid_cpu

        positions, table, scalings = (tensor.numpy(force=True) for tensor in ctx.saved_tensors)
        grid = positions, table, scalings, ctx.table_size, grad.contiguous().numpy()
        grad_positions = grad_table = None
        if ctx.needs_input_grad[0]:
            grad_positions = torch.from_numpy(hash_grid_cpu.position_gradient(*grid))
        if ctx.needs_input_grad[1]:
            grad_table = torch.from_numpy(hash_grid_cpu.table_gradient(*grid))
        return grad_positions, grad_table, None, None


class _Interpolate(torch.autograd.Function):
    """The interpolation as tensor operations with their gradients written out.

    What is saved is what the backward pass reads.
    """

    @staticmethod
    def forward(ctx, positions, table, scalings, table_size):
        scaled = positions[:, None, :] * scalings[:, None]  # (n, levels, 3)
        lower = torch.floor(scaled)
        fraction = (scaled - lower).reshape(-1, 3)
        indices = _corner_rows(lower.to(torch.int32), table_size)
        weights = _corner_weights(fraction)
        ctx.save_for_backward(table, scalings, indices, fraction)
        features = F.embedding_bag(indices, table, per_sample_weights=weights, mode="sum")
        return features.view(positions.shape[0], scalings.shape[0] * table.shape[1])

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        table, scalings, indices, fraction = ctx.saved_tensors
        grad = grad.reshape(-1, table.shape[1])
        grad_positions = grad_table = None
        if ctx.needs_input_grad[0]:
            along = torch.einsum("if,icf->ic", grad, F.embedding(indices, table))
            gradients = _corner_gradients(along, fraction).view(-1, scalings.shape[0], 3)
            grad_positions = torch.einsum("nla,l->na", gradients, scalings)
        if ctx.needs_input_grad[1]:
            grad_table = _scatter_to_table(grad, indices, _corner_weights(fraction), table.shape[0])
        return grad_positions, grad_table, None, None


# The eight corners of a cell are numbered 4 x + 2 y + z, with x, y, z in {0, 1}.


def _corner_rows(lower_cell: Int[Tensor, "n levels 3"], table_size: int) -> Int[Tensor, "n_x_levels 8"]:
    """Row in the table of each corner of the cells (Müller et al. 2022, Eq. 4)."""
    # A tensor of the primes would be a transfer to the device, for which that has to wait.
    near = [axis * prime for axis, prime in zip(lower_cell.unbind(dim=-1), _HASH_PRIMES, strict=True)]
    x, y, z = ((axis, axis + prime) for axis, prime in zip(near, _HASH_PRIMES, strict=True))  # (n, levels) each
    offsets = torch.arange(lower_cell.shape[1], dtype=torch.int32, device=lower_cell.device) * table_size
    xy = [x[i] ^ y[j] for i in (0, 1) for j in (0, 1)]
    corners = torch.stack([pair ^ z[k] for pair in xy for k in (0, 1)], dim=-1)
    return corners.bitwise_and_(table_size - 1).add_(offsets[:, None]).view(-1, 8)


def _corner_weights(fraction: Float[Tensor, "n 3"]) -> Float[Tensor, "n 8"]:
    """Trilinear weight of each corner."""
    (near_x, near_y, near_z), (x, y, z) = (1.0 - fraction).unbind(dim=-1), fraction.unbind(dim=-1)
    edges = [along_x * along_y for along_x in (near_x, x) for along_y in (near_y, y)]
    return torch.stack([edge * along_z for edge in edges for along_z in (near_z, z)], dim=-1)


def _corner_gradients(values: Float[Tensor, "n 8"], fraction: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Gradient of the trilinear interpolation of corner values with respect to the fraction."""
    corners, parts, gradients = values.view(-1, 2, 2, 2), fraction.unbind(dim=-1), []
    for axis in range(3):
        steps = corners.select(axis + 1, 1) - corners.select(axis + 1, 0)  # (n, 2, 2): corners of the other axes
        first, second = parts[:axis] + parts[axis + 1 :]
        ends = torch.lerp(steps[:, 0], steps[:, 1], first[:, None])
        gradients.append(torch.lerp(ends[:, 0], ends[:, 1], second))
    return torch.stack(gradients, dim=-1)


def _scatter_to_table(
    grad: Float[Tensor, "n features"], indices: Int[Tensor, "n 8"], weights: Float[Tensor, "n 8"], rows: int
) -> Float[Tensor, "rows features"]:
    """Gradient of the weighted sums with respect to the table."""
    contributions = (weights[..., None] * grad[:, None, :]).reshape(-1, grad.shape[1])
    return torch.zeros(rows, grad.shape[1], device=grad.device, dtype=grad.dtype).index_add_(
        0, indices.reshape(-1), contributions
    )


class FusedHashEncoding(HashEncoding):
    """nerfstudio's torch ``HashEncoding`` with the fused interpolation."""

    def pytorch_fwd(self, in_tensor: Float[Tensor, "*bs 3"]) -> Float[Tensor, "*bs features"]:
        """Encode points in [0, 1]^3."""
        # nerfstudio leaves them where they were made, and brings them to the device each time.
        self.scalings = self.scalings.to(in_tensor.device)
        flat = interpolate_hash_grid(in_tensor.reshape(-1, 3), self.hash_table, self.scalings, self.hash_table_size)
        return flat.reshape(*in_tensor.shape[:-1], flat.shape[1])


def fuse_hash_encodings(module: nn.Module) -> None:
    """Turn every torch hash encoding inside ``module`` into a fused one; tiny-cuda-nn's are left alone."""
    for child in module.modules():
        if type(child) is HashEncoding and child.tcnn_encoding is None:
            child.__class__ = FusedHashEncoding


@dataclass(frozen=True)
class GridSize:
    """Cells along the scene box in the finest level, number of levels, logarithm of the rows of a level's table."""

    finest: int
    levels: int
    log2_table: int


def grid_for_dataset(dataset: PackedDataset) -> GridSize:
    """The grid that resolves in the scene box what the camera does."""
    box = dataset.scene_box_m
    distance_m = np.linalg.norm(dataset.camera_to_worlds[:, :3, 3] - box.mean(axis=0), axis=1).mean()
    side_m, footprint_m = float((box[1] - box[0]).max()), float(distance_m) / dataset.intrinsics.fl_x
    return grid_for_resolution(side_m, footprint_m, len(dataset.frames))


def grid_for_resolution(box_side_m: float, pixel_footprint_m: float, frames: int) -> GridSize:
    """Grid of a scene box for a camera and a number of frames.

    The finest level has `CELLS_PER_PIXEL` cells a pixel; the number of levels follows from `LEVEL_GROWTH`. A table
    has a row for every cell that a plane through the box cuts, since density lies on surfaces; or for every second
    one, for fewer than `FEW_FRAMES`.

    Raises:
        ValueError: a length is not above 0.

    Example:
        >>> grid_for_resolution(box_side_m=0.2, pixel_footprint_m=0.001, frames=60)
        GridSize(finest=400, levels=11, log2_table=18)
    """
    if not (box_side_m > 0.0 and pixel_footprint_m > 0.0):
        raise ValueError(f"a box of {box_side_m} m and a footprint of {pixel_footprint_m} m are not both above 0")
    finest = max(2 * COARSEST_GRID, math.ceil(CELLS_PER_PIXEL * box_side_m / pixel_footprint_m))
    levels = 1 + math.ceil(math.log(finest / COARSEST_GRID) / math.log(LEVEL_GROWTH))
    rows = finest**2 / (2.0 if frames < FEW_FRAMES else 1.0)
    smallest, largest = LOG2_TABLE_RANGE
    return GridSize(finest, levels, min(max(math.ceil(math.log2(rows)), smallest), largest))
