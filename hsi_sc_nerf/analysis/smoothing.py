"""A noisy point cloud as points of a smooth surface: thinned to even density, moved on to local quadrics."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

NEIGHBOURS = 48
"""The smallest number of points that a quadric is fitted to reliably is a few times its six coefficients."""
_CHUNK_POINTS = 1 << 14
# Added to the normal equations, whose unknowns are scaled to about 1: few or collinear neighbours make a plane.
_RIDGE = 1e-6


def thinned(
    points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], cell_m: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """One point for each cube of side ``cell_m`` that holds points: the mean of their places and of their normals.

    The normals that come out are no longer than 1; they say which side is outside.
    """
    cells = np.floor((points_m - points_m.min(axis=0)) / cell_m).astype(np.int64)
    shape = cells.max(axis=0) + 1
    _, cell = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)
    count = np.bincount(cell)
    mean = [np.bincount(cell, column) / count for column in np.concatenate([points_m, normals], axis=1).T]
    return np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)


def smoothed(
    points_m: Float[np.ndarray, "n 3"], facing: Float[np.ndarray, "n 3"], radius_m: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Each point moved on to the quadric that fits its neighbours best, and the quadric's normal there.

    Moving least squares (Alexa et al. 2003, "Computing and Rendering Point Set Surfaces"): a plane by principal
    components, over it a quadric by weighted least squares. A quadric, unlike a mean, does not shrink what is curved.

    Args:
        points_m: positions, at least three.
        facing: vectors that point outwards on the whole; how long they are and how they scatter does not matter.
        radius_m: neighbours at this distance weigh exp(-2); smaller features are smoothed away. At least a few of
            the nearest `NEIGHBOURS` points count however sparse the cloud is.

    Returns:
        Positions, and unit normals on the side of ``facing``.
    """
    places, normals = np.empty((len(points_m), 3)), np.empty((len(points_m), 3))
    tree = cKDTree(points_m)
    # What the quadrics' sides are told apart by has to be steadier than the normals of single points.
    count = min(NEIGHBOURS, len(points_m))
    for start in range(0, len(points_m), _CHUNK_POINTS):
        chunk = slice(start, start + _CHUNK_POINTS)
        distance_m, neighbour = tree.query(points_m[chunk], count, workers=-1)
        scale_m = np.maximum(radius_m, distance_m[:, min(count - 1, NEIGHBOURS // 4)])[:, None]
        weight = np.exp(-2.0 * (distance_m / scale_m) ** 2)
        outwards = np.einsum("pk,pkj->pj", weight, facing[neighbour])
        # Points of the other side of something thin are none of this surface.
        weight *= np.einsum("pkj,pj->pk", facing[neighbour], outwards) > 0
        offset = (points_m[neighbour] - points_m[chunk, None]) / scale_m[..., None]
        height, normals[chunk] = _quadric(offset, weight, outwards)
        places[chunk] = points_m[chunk] + scale_m * height
    return places, normals


def _quadric(
    offset: Float[np.ndarray, "p k 3"], weight: Float[np.ndarray, "p k"], outwards: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """From the origin to the fitted quadric along the plane's normal, and the quadric's unit normal there."""
    total = np.maximum(weight.sum(axis=1), 1e-30)
    centred = offset - (np.einsum("pk,pkj->pj", weight, offset) / total[:, None])[:, None]
    _, axes = np.linalg.eigh(np.einsum("pk,pki,pkj->pij", weight, centred, centred))
    normal, *tangents = axes[..., 0], axes[..., 1], axes[..., 2]
    normal = np.where((normal * outwards).sum(axis=1, keepdims=True) < 0, -normal, normal)
    u, v = (np.einsum("pkj,pj->pk", offset, tangent) for tangent in tangents)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    weighted = terms * weight[..., None]
    left = np.einsum("pki,pkj->pij", weighted, terms) + _RIDGE * np.eye(6)
    right = np.einsum("pki,pk->pi", weighted, np.einsum("pkj,pj->pk", offset, normal))
    height, slope_u, slope_v = np.linalg.solve(left, right[..., None])[:, :3, 0].T
    tilted = normal - slope_u[:, None] * tangents[0] - slope_v[:, None] * tangents[1]
    return height[:, None] * normal, tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
