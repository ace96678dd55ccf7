"""What of a cloud tells one attitude from another: its thinned points, and a few numbers of their spectra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.closed_mesh import thinned
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.geometry.camera import unit_vectors

SPACINGS_M = (0.005, 0.002)
"""Spacings of the coarse sample, from which the search starts, and of the fine one."""
COMPONENTS = 3
"""Principal components of the spectra's shape that count, beside brightness."""
LEAST_POINTS = 100
"""Of the coarse sample: 25 cm2 of surface."""
_NEIGHBOURS = 13
_DRAWN = 20_000
"""Spectra that the components are found from."""


@dataclass(frozen=True)
class SurfaceSample:
    """Points of a surface.

    Attributes:
        points: metres.
        normals: outward unit normals.
        features: features of the spectra, about 0: a change of the whole surface alike is no feature.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    features: Float[np.ndarray, "n f"]


def surface_samples(
    clouds: Sequence[SpectralCloud], spectra: Sequence[Float[np.ndarray, "n bands"]], names: Sequence[str]
) -> list[list[SurfaceSample]]:
    """A coarse and a fine sample of each cloud, with features that are the same for all.

    Features are the logarithm of brightness, and the principal components of the spectra scaled to unit length.

    Args:
        clouds: clouds of one object, same bands.
        spectra: spectra of the points of each, as measured or of the material.
        names: names of the clouds.

    Raises:
        InputError: an object is too small, or a cloud has too few points.
    """
    units = [unit_vectors(some) for some in spectra]
    every = np.concatenate([one[:: max(1, len(one) // _DRAWN)] for one in units])
    axes = np.linalg.svd(every - every.mean(axis=0), full_matrices=False)[2][: min(COMPONENTS, every.shape[1] - 1)]
    samples = []
    for cloud, some, unit, name in zip(clouds, spectra, units, names, strict=True):
        features = np.column_stack([np.log(np.maximum(some.mean(axis=1), 1e-3)), unit @ axes.T])
        features -= np.median(features, axis=0)
        samples.append([_thinned(cloud, features, spacing_m) for spacing_m in SPACINGS_M])
        if len(samples[-1][0].points) < LEAST_POINTS:
            raise InputError(
                f"{name}: the object is too small for patches of {SPACINGS_M[0] * 1e3:g} mm: change needs "
                "about 25 cm2 of surface, so a fruit of at least 26 mm; if it is larger, give a cloud of all of it, "
                "in metres."
            )
    return samples


def surface_gradients(
    points: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n f"]
) -> Float[np.ndarray, "n f 3"]:
    """Gradient of each value along the surface, by least squares over the nearest points that have all values.

    NaN at points that do not.
    """
    known, gradients = np.isfinite(values).all(axis=1), np.full((*values.shape, 3), np.nan)
    points, values = points[known], values[known]
    near = cKDTree(points).query(points, k=np.arange(1, min(_NEIGHBOURS, len(points)) + 1))[1]
    # Across the surface, neighbours hardly differ: small singular values are left out.
    inverse = np.linalg.pinv(points[near[:, 1:]] - points[:, None], rcond=0.2)
    gradients[known] = np.einsum("njk,nkf->nfj", inverse, values[near[:, 1:]] - values[:, None])
    return gradients


def _thinned(cloud: SpectralCloud, features: Float[np.ndarray, "n f"], spacing_m: float) -> SurfaceSample:
    """One point for each cube: the mean of its points."""
    points, rest = thinned(cloud.points, np.column_stack([cloud.normals, features]), spacing_m)
    return SurfaceSample(points, unit_vectors(rest[:, :3]), rest[:, 3:])
