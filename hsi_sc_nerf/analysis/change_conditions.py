"""What makes the errors of a patch larger than those of a usual one: how it is seen, what hides it, how rare it is.

The changes of a pair of days tell how much larger the errors are where these numbers are large
(`hsi_sc_nerf.analysis.change_noise.noise_of_patches`).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_features import unit_spectra
from hsi_sc_nerf.analysis.change_significance import Patches
from hsi_sc_nerf.analysis.closed_mesh import thinned

_RISES_WITHIN_M = (0.003, 0.025)
"""From a patch: nearer, the roughness of the mesh counts; further, little is hidden."""
_SPACING_M = 0.002
_LIKE = 0.1
"""The fraction of the surface to which a patch's spectrum is compared: that most like it."""
_MOST_SPECTRA = 1500
"""Patches that each one's spectrum is compared with."""


def patch_conditions(
    before: Day, after: Day, others: tuple[Day, ...], patches: Patches, to_rim_m: Float[np.ndarray, "p"]
) -> Float[np.ndarray, "p c"]:
    """Numbers of each patch of which each is the larger, the larger its errors may be.

    Columns: the conditions of the points on the worst day (`Day`), nearness to the rim of what is seen, how steeply
    the surface rises around the patch, and how rare its spectrum is on both days. A tissue of its own has errors of
    its own, which its patches share: a radiance field emits few numbers, of which one may be that tissue's.

    Args:
        before: the first day.
        after: the day that is compared with it.
        others: further captures that tell errors.
        patches: of what is seen on both days.
        to_rim_m: distance of each patch from what is not seen.
    """
    surface = before.surface
    worst = patches.means(np.max([day.conditions for day in (before, after, *others)], axis=0), surface.areas_m2)
    normals = patches.means(surface.mesh.vertex_normals(), surface.areas_m2)
    rises = steepest_rise(
        patches.centres_m, normals, thinned(surface.mesh.vertices, surface.mesh.vertices, _SPACING_M)[0]
    )
    spectra = (patches.means(unit_spectra(day.surface.spectra), surface.areas_m2) for day in (before, after))
    return np.column_stack([worst, -to_rim_m, rises, np.minimum(*map(rareness, spectra))])


def steepest_rise(
    centres_m: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"], surface_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "p"]:
    """Sine of the largest angle at which a surface rises above the plane of each patch; below 0 on what is convex.

    In a hollow, as around a stem, cameras see a place from few sides, past edges that errors move.
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    nearest_m, furthest_m = _RISES_WITHIN_M
    rises = np.full(len(centres_m), -1.0)
    for number, near in enumerate(cKDTree(surface_m).query_ball_point(centres_m, furthest_m)):
        off = surface_m[near] - centres_m[number]
        distance_m = np.linalg.norm(off, axis=1)
        far = distance_m > nearest_m
        rises[number] = np.max(off[far] @ normals[number] / distance_m[far], initial=-1.0)
    return rises


def rareness(spectra: Float[np.ndarray, "p bands"]) -> Float[np.ndarray, "p"]:
    """Distance of each spectrum's shape from those of a tenth of all: 0 where a tenth has that same shape.

    Example:
        >>> skin, bruise = [0.2, 0.6], [0.3, 0.3]
        >>> rareness(np.array([skin] * 19 + [bruise]))[[0, 19]].round(2)
        array([0.  , 0.46])
    """
    units = unit_spectra(spectra)
    some = units[:: -(-len(units) // _MOST_SPECTRA)]
    return np.quantile(np.sqrt(np.maximum(2.0 - 2.0 * units @ some.T, 0.0)), _LIKE, axis=1)
