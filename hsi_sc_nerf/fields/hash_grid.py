"""A multiresolution hash grid that trains at a usable speed without a GPU.

Same function and same parameters as nerfstudio's torch ``HashEncoding`` (Müller et al. 2022), so checkpoints and
results are interchangeable. nerfstudio gathers the eight corners of a cell one after the other and keeps all of
them for autograd; here one fused gather-and-sum reads the table, and one histogram writes its gradient.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

# Müller et al. 2022, Eq. 4. The second prime exceeds int32: its two's complement gives the same low bits.
_HASH_PRIMES = (1, 2654435761 - 2**32, 805459861)


class _WeightedGather(torch.autograd.Function):
    """``out[i] = sum_j weights[i, j] * table[indices[i, j]]``, with a gradient for table and weights."""

    @staticmethod
    def forward(ctx, table, indices, weights):  # noqa: D102
        ctx.save_for_backward(table, indices, weights)
        return F.embedding_bag(indices, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):  # noqa: D102
        table, indices, weights = ctx.saved_tensors
        grad_table = grad_weights = None
        if ctx.needs_input_grad[0]:
            grad_table = _scatter_to_table(grad, indices, weights, table.shape[0])
        if ctx.needs_input_grad[2]:
            corners = F.embedding(indices, table)
            grad_weights = torch.einsum("if,ijf->ij", grad, corners)
        return grad_table, None, grad_weights


def _scatter_to_table(
    grad: Float[Tensor, "n features"],
    indices: Int[Tensor, "n corners"],
    weights: Float[Tensor, "n corners"],
    rows: int,
) -> Float[Tensor, "rows features"]:
    """The gradient of the weighted gather with respect to its table."""
    flat = indices.reshape(-1)
    if grad.device.type == "cpu":
        # bincount is several times faster than index_add_ there, and sums in float64.
        columns = [
            torch.bincount(flat, weights=(weights * grad[:, f : f + 1]).reshape(-1), minlength=rows)
            for f in range(grad.shape[1])
        ]
        return torch.stack(columns, dim=1).to(grad.dtype)
    contributions = (weights[..., None] * grad[:, None, :]).reshape(-1, grad.shape[1])
    return torch.zeros(rows, grad.shape[1], device=grad.device, dtype=grad.dtype).index_add_(0, flat, contributions)


def interpolate_hash_grid(
    positions: Float[Tensor, "n 3"],
    table: Float[Tensor, "rows features"],
    scalings: Float[Tensor, "levels"],
    table_size: int,
) -> Float[Tensor, "n levels_x_features"]:
    """Trilinear interpolation of a stack of hashed grids.

    Args:
        positions: points in [0, 1]^3.
        table: the levels' feature tables, one after the other; ``table_size`` rows each, a power of two.
        scalings: cells along an edge of the unit cube, a level.
        table_size: rows of one level.
    """
    levels = scalings.shape[0]
    scaled = positions[:, None, :] * scalings.to(positions)[:, None]  # (n, levels, 3)
    lower = torch.floor(scaled)
    fraction = scaled - lower
    lower_cell = lower.detach().to(torch.int32)

    primes = torch.tensor(_HASH_PRIMES, dtype=torch.int32, device=positions.device)
    hashed = torch.stack([lower_cell * primes, (lower_cell + 1) * primes], dim=-1)  # (n, levels, 3, 2)
    x, y, z = hashed.unbind(dim=2)
    corners = x[..., :, None, None] ^ y[..., None, :, None] ^ z[..., None, None, :]  # (n, levels, 2, 2, 2)
    offsets = torch.arange(levels, dtype=torch.int32, device=positions.device) * table_size
    indices = (corners & (table_size - 1)) + offsets[:, None, None, None]

    ends = torch.stack([1.0 - fraction, fraction], dim=-1)  # (n, levels, 3, 2)
    wx, wy, wz = ends.unbind(dim=2)
    weights = wx[..., :, None, None] * wy[..., None, :, None] * wz[..., None, None, :]

    features = _WeightedGather.apply(table, indices.reshape(-1, 8), weights.reshape(-1, 8))
    return features.reshape(positions.shape[0], levels * table.shape[1])


class FusedHashEncoding(HashEncoding):
    """nerfstudio's torch ``HashEncoding`` with the fused interpolation."""

    def pytorch_fwd(self, in_tensor: Float[Tensor, "*bs 3"]) -> Float[Tensor, "*bs features"]:
        """Encode points in [0, 1]^3."""
        flat = interpolate_hash_grid(in_tensor.reshape(-1, 3), self.hash_table, self.scalings, self.hash_table_size)
        return flat.reshape(*in_tensor.shape[:-1], -1)


def fuse_hash_encodings(module: nn.Module) -> None:
    """Turn every torch hash encoding inside ``module`` into a fused one; tiny-cuda-nn's are left alone."""
    for child in module.modules():
        if type(child) is HashEncoding and child.tcnn_encoding is None:
            child.__class__ = FusedHashEncoding
