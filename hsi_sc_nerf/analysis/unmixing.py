"""How much of each class a place holds, where it holds several: linear unmixing of its spectrum."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import nnls

from hsi_sc_nerf.numerics import spectral_angle


def unmix(
    spectra: Float[np.ndarray, "n bands"], endmembers: Float[np.ndarray, "endmembers bands"]
) -> tuple[Float[np.ndarray, "n endmembers"], Float[np.ndarray, "n"]]:
    """Shares of endmembers in spectra that are mixtures of them by area, and how far each is from being one.

    The mixture is the nearest in least squares that has no negative share (Heinz and Chang, "Fully constrained least
    squares linear spectral mixture analysis", 2001). That shares add up to 1 is brought about by scaling them,
    because shade darkens the whole of a mixture: shares do not depend on brightness.

    Returns:
        Shares, in [0, 1], which add up to 1 (all 0 where nothing of any endmember is in the spectrum), and the
        spectral angle between spectrum and mixture, radians (pi / 2 there).
    """
    wide = np.asarray(endmembers, float)
    # A mixture reaches no further than the space of the endmembers: there the problem is as small as they are few.
    axes, coordinates = np.linalg.qr(wide.T)
    amounts = np.zeros((len(spectra), len(wide)))
    for row, within in zip(amounts, np.asarray(spectra, float) @ axes, strict=True):
        row[:] = nnls(coordinates, within)[0]
    total = amounts.sum(axis=1, keepdims=True)
    shares = np.divide(amounts, total, out=np.zeros_like(amounts), where=total > 0.0)
    measured, mixed = (torch.from_numpy(np.asarray(one, np.float32)) for one in (spectra, amounts @ wide))
    return shares, spectral_angle(measured, mixed).numpy()
