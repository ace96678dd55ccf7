"""What each element sees: open directions, and the other elements. Rays are cast once, in the object's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene

RAYS_AT_ONCE = 1 << 21


@dataclass(frozen=True, eq=False)
class Transfer:
    """How light reaches points: ``open_weights @ radiance + form_factors @ radiosity`` is their irradiance.

    The weights of a point sum to 1 over both, so that in a world of radiance 1 every irradiance is 1.

    Attributes:
        open_weights: part of each direction in a point's irradiance, 0 where it is occluded or behind the surface.
        form_factors: part of each element in the irradiance of each point.
    """

    open_weights: Float[np.ndarray, "n directions"]
    form_factors: scipy.sparse.csr_array

    @property
    def sky(self) -> Float[np.ndarray, "n"]:
        """Irradiance in an even chamber with black occluders, 0 to 1."""
        return self.open_weights.sum(axis=1)

    def mean(self, shares: scipy.sparse.csr_array) -> Transfer:
        """Means over points, by their shares in each row."""
        means = np.asarray(shares @ self.open_weights, np.float32)
        return Transfer(means, scipy.sparse.csr_array(shares @ self.form_factors))


def transfer(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    occluders: Mesh,
    element_of_triangle: Int[np.ndarray, "t"],
    elements: int,
    directions: Float[np.ndarray, "directions 3"],
    lift_m: float,
) -> Transfer:
    """Cast rays from points into evenly spread directions.

    Args:
        points: on the surface, in the unit of the occluders.
        normals: outward unit normals.
        occluders: surfaces that occlude light, the points' own included.
        element_of_triangle: element that each of their triangles belongs to.
        elements: their number.
        directions: unit vectors, evenly spread over the sphere.
        lift_m: rays begin so far outside of the surface, so that its roughness does not occlude them.
    """
    scene = ray_scene(occluders.vertices, occluders.triangles)
    along = directions.astype(np.float32)
    weights = np.zeros((len(points), len(directions)), np.float32)
    factors = []
    some = max(1, RAYS_AT_ONCE // len(directions))
    for first in range(0, len(points), some):
        rows = slice(first, first + some)
        cosines = normals[rows].astype(np.float32) @ along.T
        point, direction = np.nonzero(cosines > 0.0)
        start = (points[rows] + lift_m * normals[rows]).astype(np.float32)
        hits = scene.cast_rays(np.concatenate([start[point], along[direction]], axis=1))
        hit = np.isfinite(hits["t_hit"].numpy())
        share = cosines[point, direction]
        share /= np.bincount(point, share, minlength=len(start))[point].astype(np.float32)
        weights[first + point[~hit], direction[~hit]] = share[~hit]
        met = element_of_triangle[hits["primitive_ids"].numpy()[hit]]
        shape = len(start), elements
        factors.append(scipy.sparse.coo_array((share[hit], (point[hit], met)), shape=shape).tocsr())
    return Transfer(weights, scipy.sparse.csr_array(scipy.sparse.vstack(factors, format="csr")))
