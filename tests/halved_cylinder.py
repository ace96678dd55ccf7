"""A cylinder of two materials, each of which covers one half of it."""

import numpy as np

from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.simulate.mesh import cylinder

NM = np.linspace(400.0, 1000.0, 31)
GREEN, BROWN = np.linspace(0.1, 0.6, 31), np.linspace(0.4, 0.3, 31)


def two_halves(seen=True):
    """A cylinder, 4 cm wide and high: green at y > 0, brown below."""
    mesh = cylinder(0.04, 0.04, segments=128, spacing_m=0.001)
    spectra = np.where(mesh.vertices[:, 1:2] > 0.0, GREEN, BROWN).astype(np.float32)
    return SpectralMesh(mesh, spectra, NM, np.full(len(spectra), seen))
