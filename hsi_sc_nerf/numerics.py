"""Numerically safe ratios, roots, logarithms and spectral angles (torch), which losses and metrics are made of.

Two rules hold for every function here:

- The arithmetic runs in a wider type, float32 for float16 and float64 for float32 and bfloat16, so that squares,
  products and reciprocals of any finite input neither overflow nor vanish and nothing cancels. Results are float32
  (float64 for float64 input). Float64 input has nothing wider: it is good for magnitudes of 1e-150 to 1e150.
- Finite input gives finite values and finite gradients; what would leave the range of its type stops at the largest
  number of that type. NaN and infinity in the input are not hidden, but propagate to the output.

A **zero spectrum** has no direction. Its cosine with anything is taken as 0, as in the paper's formulas with their
small constant in the denominator: the spectral angle is pi / 2, one minus the cosine is 1, and the gradient is 0.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def widen(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Cast to the type that safe arithmetic runs in: float32 for float16, else float64.

    A gradient that flows back stays within the range of the type of ``values``.
    """
    return _Widen.apply(values)


def narrow(values: Float[Tensor, "*shape"], *inputs: Tensor) -> Float[Tensor, "*shape"]:
    """Cast a result to float32, or to float64 if one of the ``inputs`` it came from was float64.

    Finite values beyond the range become the largest number of the type.
    """
    double = any(source.dtype == torch.float64 for source in inputs)
    return _within_range(values, torch.float64 if double else torch.float32)


def _root(values: Tensor) -> Tensor:
    positive = values > 0
    return torch.where(positive, torch.where(positive, values, 1.0).sqrt(), 0.0 * values)


def safe_sqrt(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Square root; 0 with gradient 0 for 0 and for what rounding made negative."""
    return narrow(_root(widen(values)), values)


def safe_ratio(
    numerator: Float[Tensor, "*shape"], denominator: Float[Tensor, "*shape"], minimum: float = 0.0
) -> Float[Tensor, "*shape"]:
    """``numerator / denominator`` where ``|denominator| > minimum``, else 0 with gradient 0. The shapes broadcast."""
    wide = widen(denominator)
    usable = ~(wide.abs() <= minimum)
    ratio = torch.where(usable, widen(numerator), 0.0) / torch.where(usable, wide, 1.0)
    return narrow(ratio, numerator, denominator)


def safe_log10(values: Float[Tensor, "*shape"], minimum: float = 1e-30) -> Float[Tensor, "*shape"]:
    """Base-10 logarithm of ``max(values, minimum)``; the gradient is 0 below ``minimum`` (> 0)."""
    wide = widen(values)
    below = wide <= minimum
    return narrow(torch.where(below, math.log10(minimum), torch.where(below, 1.0, wide).log10()), values)


def _direction(spectra: Tensor, norm_floor: float) -> tuple[Tensor, Tensor]:
    """Spectra divided by max(norm, floor), and by how much their squared length falls short of 1 (last axis kept).

    The shortfall is exactly 0 for spectra at or above the floor, whatever the rounding of the division.
    """
    squared = spectra.square().sum(-1, keepdim=True)
    zero = squared == 0
    norm = torch.where(zero, 1.0, squared).sqrt().clamp_min(norm_floor)
    direction = torch.where(zero, 0.0 * spectra, spectra / norm)
    short = zero | (squared < norm_floor**2)
    return direction, torch.where(short, 1.0 - direction.square().sum(-1, keepdim=True), 0.0)


def spectral_angle(a: Float[Tensor, "*shape bands"], b: Float[Tensor, "*shape bands"]) -> Float[Tensor, "*shape"]:
    """Angle between spectra, radians in [0, pi] (Kruse et al. 1993; paper, Eq. SAM).

    The angle is ``2 atan2(|u - v|, |u + v|)`` of the unit vectors (Kahan, "How Futile are Mindless Assessments of
    Roundoff", 2006), accurate at every angle and independent of the spectra's scale. The arc cosine would lose angles
    below 3e-4 to rounding in float32. The angle to a zero spectrum is pi / 2. The gradient is 0 where the spectra are
    parallel, opposite or zero.

    Example:
        >>> spectral_angle(torch.tensor([1.0, 0.0]), torch.tensor([2.0, 2.0]))
        tensor(0.7854)
    """
    if a.device.type == b.device.type == "cpu" and a.dtype == b.dtype == torch.float32 and a.shape == b.shape:
        flat = (spectra.reshape(-1, spectra.shape[-1]).contiguous() for spectra in (a, b))
        return _CompiledAngle.apply(*flat).reshape(a.shape[:-1])
    u, u_short = _direction(widen(a), 0.0)
    v, v_short = _direction(widen(b), 0.0)
    undirected = ((u_short > 0) | (v_short > 0)).squeeze(-1)
    difference = _root((u - v).square().sum(-1))
    total = torch.where(undirected, 1.0, _root((u + v).square().sum(-1)))
    angle = torch.where(undirected, math.pi / 2, 2.0 * torch.atan2(difference, total))
    return narrow(angle, a, b)


class _CompiledAngle(torch.autograd.Function):
    """The angle between rows of float32 spectra on the processor; it can be differentiated once."""

    @staticmethod
    def forward(ctx, a: Tensor, b: Tensor) -> Tensor:
        from hsi_sc_nerf import spectral_losses_cpu  # compiles; a GPU does without it

        ctx.save_for_backward(a, b)
        return torch.from_numpy(spectral_losses_cpu.angles(a.numpy(force=True), b.numpy(force=True)))

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        from hsi_sc_nerf import spectral_losses_cpu

        a, b = (spectra.numpy(force=True) for spectra in ctx.saved_tensors)
        upstream = gradient.contiguous().numpy(force=True)
        gradients: list[Tensor | None] = [None, None]
        for i, pair in enumerate(((a, b), (b, a))):
            if ctx.needs_input_grad[i]:
                gradients[i] = torch.from_numpy(spectral_losses_cpu.angle_gradient(*pair, upstream))
        return gradients[0], gradients[1]


def mean_square(a: Float[Tensor, "*shape"], b: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Mean of the squared differences; 0 of none.

    Example:
        >>> mean_square(torch.tensor([1.0, 2.0]), torch.tensor([1.0, 4.0]))
        tensor(2.)
    """
    if a.device.type == b.device.type == "cpu" and a.dtype == b.dtype == torch.float32 and a.shape == b.shape:
        return _CompiledMeanSquare.apply(*(values.reshape(-1).contiguous() for values in (a, b)))
    return narrow(masked_mean((widen(a) - widen(b)).square()), a, b)


class _CompiledMeanSquare(torch.autograd.Function):
    """The mean square of float32 arrays on the processor; it can be differentiated once."""

    @staticmethod
    def forward(ctx, a: Tensor, b: Tensor) -> Tensor:
        from hsi_sc_nerf import spectral_losses_cpu

        ctx.save_for_backward(a, b)
        found = spectral_losses_cpu.mean_square(a.numpy(force=True), b.numpy(force=True))
        return narrow(torch.tensor(found, dtype=torch.float64), a)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        from hsi_sc_nerf import spectral_losses_cpu

        a, b = (values.numpy(force=True) for values in ctx.saved_tensors)
        found = torch.from_numpy(spectral_losses_cpu.mean_square_gradient(a, b, gradient.item()))
        needs_a, needs_b = ctx.needs_input_grad
        return found if needs_a else None, -found if needs_b else None


def one_minus_cosine(
    a: Float[Tensor, "*shape bands"], b: Float[Tensor, "*shape bands"], norm_floor: float = 0.0
) -> Float[Tensor, "*shape"]:
    """One minus the cosine of the spectral angle, in [0, 2], without cancellation: ``|u - v|² / 2``.

    Args:
        norm_floor: Lower bound of the norms in the denominator, which bounds the gradient. The cosine of a spectrum
            below it shrinks to 0 with the norm; spectra above it are not affected.
    """
    u, u_short = _direction(widen(a), norm_floor)
    v, v_short = _direction(widen(b), norm_floor)
    return narrow(0.5 * ((u - v).square().sum(-1) + (u_short + v_short).squeeze(-1)), a, b)


def select_pixels(
    values: Float[Tensor, "*pixels bands"], mask: Bool[Tensor, "*pixels"] | None
) -> Float[Tensor, "n bands"]:
    """The spectra of the pixels in the mask (None for all), one a row.

    Other pixels, NaN included, affect neither values nor gradients.

    Raises:
        ValueError: the mask is not boolean, or its shape is not that of the pixels.
    """
    if mask is None:
        return values.reshape(-1, values.shape[-1])
    check_mask(values, mask)
    return values[mask]


def check_mask(values: Float[Tensor, "*pixels bands"], mask: Bool[Tensor, "*pixels"]) -> None:
    """Raise ValueError where the mask is not boolean, or its shape is not that of the pixels."""
    if mask.dtype != torch.bool or mask.shape != values.shape[:-1]:
        raise ValueError(
            f"a mask for spectra of shape {tuple(values.shape)} is boolean with shape {tuple(values.shape[:-1])}, "
            f"not {mask.dtype} with shape {tuple(mask.shape)}"
        )


def masked_mean(values: Float[Tensor, "*shape"], mask: Bool[Tensor, "*shape"] | None = None) -> Float[Tensor, ""]:
    """Mean over the values in the mask (None for all); 0 with gradient 0 if there are none.

    Raises:
        ValueError: the mask is not boolean, or its shape is not that of the values.
    """
    if mask is None:
        wide = widen(values)
        return narrow(wide.sum() / max(wide.numel(), 1), values)
    check_mask(values[..., None], mask)
    # To pick the selected values, a GPU would have to tell how many they are and be waited for.
    selected = widen(torch.where(mask, values, 0.0))
    return narrow(selected.sum() / mask.sum().clamp_min(1), values)


def _within_range(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Cast to ``dtype``; finite values beyond its range become its largest number, non-finite ones stay."""
    largest = torch.finfo(dtype).max
    if torch.finfo(values.dtype).max <= largest:
        return values.to(dtype)
    return torch.where(values.isfinite(), values.clamp(-largest, largest), values).to(dtype)


class _Widen(torch.autograd.Function):
    """Cast to the wider type; the gradient is cast back without overflowing."""

    @staticmethod
    def forward(ctx, values: Tensor) -> Tensor:
        ctx.dtype = values.dtype
        return values.to(torch.float32 if values.dtype == torch.float16 else torch.float64)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        return _within_range(gradient, ctx.dtype)
