"""From the few coefficients that a field emits to whole spectra, once a pixel.

Compositing is linear in what the samples emit, and so is the basis: decoding composited coefficients gives the same
as compositing decoded spectra, with far fewer numbers a sample.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class BasisDecoder(nn.Module):
    """Spectra from coefficients in a basis.

    Args:
        basis: one spectrum a column, linearly independent (`SpectralSubspace.scaled_basis`).
        learnable: whether training may change the basis. What it learns is counted in root mean squares of each
            column, so that one learning rate suits strong and weak columns alike.
    """

    basis: Tensor
    correction: nn.Parameter | None

    def __init__(self, basis: Float[Tensor, "bands rank"], learnable: bool = False) -> None:
        super().__init__()
        self.register_buffer("basis", basis.clone())
        self.register_parameter("correction", nn.Parameter(torch.zeros_like(basis)) if learnable else None)

    def matrix(self) -> Float[Tensor, "bands rank"]:
        """The basis as it is now."""
        if self.correction is None:
            return self.basis
        return self.basis + self.basis.square().mean(dim=0).sqrt() * self.correction

    def forward(self, coefficients: Float[Tensor, "*rays rank"]) -> Float[Tensor, "*rays bands"]:
        """Spectra of (composited) coefficients."""
        return coefficients @ self.matrix().T

    def project(self, spectra: Float[Tensor, "*rays bands"]) -> Float[Tensor, "*rays rank"]:
        """Coefficients of the spectra of the basis that are nearest to these (least squares)."""
        return spectra @ torch.linalg.pinv(self.matrix()).T
