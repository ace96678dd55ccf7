"""Diffusion over the surface of a triangle mesh: softens what lies on it and keeps its total."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

COLUMNS_AT_ONCE = 8


def diffused(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    values: Float[np.ndarray, "v c"],
    width_m: float,
) -> Float[np.ndarray, "v c"]:
    """Values at the vertices, each spread over the surface around it.

    Solves (1 - w² / 2 Laplacian) u = values with linear finite elements, so that a point becomes a spot whose
    standard deviation along each direction of a flat surface is ``width_m``: the steady state of light that wanders
    and is lost on its way (the diffusion approximation, in two dimensions). Each column's total over the surface is
    kept, and none exceeds its largest value or falls below its smallest.
    """
    laplacian, areas_m2 = cotangent_laplacian(vertices, triangles)
    # A vertex of no triangle keeps its value.
    areas_m2 = np.where(areas_m2 > 0.0, areas_m2, areas_m2.mean())
    matrix = scipy.sparse.diags_array(areas_m2) + 0.5 * width_m**2 * laplacian
    factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    spread = np.zeros_like(values)
    used = np.flatnonzero(values.any(axis=0))
    for first in range(0, len(used), COLUMNS_AT_ONCE):
        columns = used[first : first + COLUMNS_AT_ONCE]
        spread[:, columns] = factors.solve(areas_m2[:, None] * values[:, columns].astype(float))
    return spread


def cotangent_laplacian(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[scipy.sparse.csr_array, Float[np.ndarray, "v"]]:
    """Stiffness matrix of linear finite elements (positive semidefinite), and each vertex's share of the area.

    Negative cotangents, of triangles with an obtuse angle, count as 0: values then stay within their range.
    """
    size = len(vertices)
    matrix = scipy.sparse.csr_array((size, size))
    areas_m2 = np.zeros(size)
    for k in range(3):
        apex, start, end = (triangles[:, (k + i) % 3] for i in range(3))
        u, v = vertices[start] - vertices[apex], vertices[end] - vertices[apex]
        doubled = np.linalg.norm(np.cross(u, v), axis=1)
        half_cotangent = 0.5 * np.maximum(np.einsum("nk,nk->n", u, v), 0.0) / np.maximum(doubled, 1e-30)
        matrix += scipy.sparse.csr_array((half_cotangent, (start, end)), shape=(size, size))
        areas_m2 += np.bincount(apex, doubled / 6.0, minlength=size)
    matrix = matrix + matrix.T
    return scipy.sparse.csr_array(scipy.sparse.diags_array(matrix.sum(axis=1)) - matrix), areas_m2
