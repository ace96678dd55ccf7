"""From the few coefficients that a field emits to whole spectra, once a pixel.

Compositing is linear in what the samples emit, and so is the basis: decoding composited coefficients gives the same
as compositing decoded spectra, with far fewer numbers a sample.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn


class BasisDecoder(nn.Module):
    """Spectra from coefficients in a basis.

    Args:
        basis: one spectrum a column, linearly independent (`SpectralSubspace.scaled_basis`).
        learnable: whether training may change the basis.
    """

    basis: Tensor

    def __init__(self, basis: Float[Tensor, "bands rank"], learnable: bool = False) -> None:
        super().__init__()
        if learnable:
            self.basis = nn.Parameter(basis.clone())
        else:
            self.register_buffer("basis", basis.clone())

    def forward(self, coefficients: Float[Tensor, "*rays rank"]) -> Float[Tensor, "*rays bands"]:
        """Spectra of (composited) coefficients."""
        return coefficients @ self.basis.T
