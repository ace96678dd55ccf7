"""What there is on a surface without any reference: principal components, endmembers and their fractions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import qr

from hsi_sc_nerf.analysis.classes import unmix
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.processing.spectral_subspace import MIN_SPECTRA, find_subspace

_SAMPLE = 4096
"""Vertices that the number of components is found from."""
_DARKEST = 0.5
"""Spectra below this fraction of the median brightness are no endmembers: their shape is noise."""
_LARGEST_GAIN = 1.01
"""A swap of an endmember that enlarges the simplex by less is not made."""
_MOST_SWAPS = 1000


@dataclass(frozen=True)
class Components:
    """Principal components and endmembers of the seen surface.

    Attributes:
        supported: directions of the spectra above their noise.
        scores: scores of the principal components, by descending variance; NaN where the surface is unseen.
        variance_fractions: fractions of the variance, of each component.
        endmembers: the spectra of the purest vertices.
        fractions: fractions of each endmember, by non-negative least squares; NaN where the surface is unseen.
    """

    supported: int
    scores: Float[np.ndarray, "v components"]
    variance_fractions: Float[np.ndarray, "components"]
    endmembers: SpectralLibrary
    fractions: Float[np.ndarray, "v endmembers"]

    def columns(self) -> tuple[dict[str, Float[np.ndarray, "v"]], dict[str, Float[np.ndarray, "v"]]]:
        """Scores and fractions by the names of their columns: ``component_1``, ``endmember_1``, ..."""
        scores, fractions = (
            {f"{name}_{number}": column for number, column in enumerate(values.T, 1)}
            for name, values in (("component", self.scores), ("endmember", self.fractions))
        )
        return scores, fractions


def find_components(surface: SpectralMesh, most: int) -> Components:
    """Principal components and endmembers, as many as the noise supports and at most ``most``.

    The noise of the spectra is by how much frames disagree, where the cloud tells that, and else estimated from the
    spectra (`find_subspace`).

    Raises:
        InputError: too little of the surface was seen.

    Example:
        >>> components = find_components(surface, most=4)
        >>> components.endmembers.names
    """
    seen = np.flatnonzero(surface.seen)
    spectra = surface.spectra[seen].astype(float)
    rows = np.sort(np.random.default_rng(0).choice(len(seen), min(_SAMPLE, len(seen)), replace=False))
    noise = None
    if surface.scatter is not None:
        scatter = surface.scatter if surface.lit is None else surface.scatter / surface.lit.irradiance
        known = rows[scatter[seen[rows]] > 0.0]
        if len(known) >= MIN_SPECTRA:
            rows, noise = known, np.repeat(scatter[seen[known], None], spectra.shape[1], axis=1)
    basis = find_subspace(spectra[rows], noise).basis
    count = min(most, basis.shape[1])

    weights = surface.areas_m2[seen] / surface.areas_m2[seen].sum()
    centred = spectra - weights @ spectra
    variances, directions = np.linalg.eigh(centred.T @ (weights[:, None] * centred))
    scores = np.full((len(surface.seen), count), np.nan)
    scores[seen] = centred @ directions[:, ::-1][:, :count]

    purest = spectra[purest_spectra(spectra @ basis, count)]
    fractions = np.full(scores.shape, np.nan)
    fractions[seen] = unmix(spectra, purest)[0]
    names = tuple(f"endmember {number + 1}" for number in range(count))
    library = SpectralLibrary(names, surface.wavelengths_nm, purest)
    return Components(basis.shape[1], scores, variances[::-1][:count] / variances.sum(), library, fractions)


def purest_spectra(coordinates: Float[np.ndarray, "n rank"], count: int) -> Int[np.ndarray, "count"]:
    """Rows of the ``count`` spectra that span the largest simplex, whatever their brightness.

    N-FINDR (Winter 1999) on spectra scaled to the same projection on their mean, as in vertex component analysis
    (Nascimento and Dias 2005). It begins with the successive projections of a pivoted QR decomposition. A spectrum's
    coordinates in the simplex are by how much its volume grows if the spectrum replaces each corner.

    Args:
        coordinates: coordinates of the spectra in their subspace.
        count: at most its rank.
    """
    brightness = coordinates @ (mean := coordinates.mean(axis=0)) / (mean @ mean)
    candidates = np.flatnonzero(brightness >= _DARKEST * np.median(brightness))
    scaled = coordinates[candidates] / brightness[candidates, None]
    # The directions of the largest variance, and that of the mean, along which all are 1.
    _, _, directions = np.linalg.svd(scaled - scaled.mean(axis=0), full_matrices=False)
    corners = np.column_stack([np.ones(len(scaled)), (scaled - scaled.mean(axis=0)) @ directions[: count - 1].T])
    chosen = qr(corners.T, mode="r", pivoting=True)[1][:count]
    for _ in range(_MOST_SWAPS):
        growth = np.abs(np.linalg.lstsq(corners[chosen].T, corners.T, rcond=None)[0])
        corner, row = np.unravel_index(growth.argmax(), growth.shape)
        if growth[corner, row] < _LARGEST_GAIN:
            break
        chosen[corner] = row
    return candidates[chosen]
