"""Size of an object (area, volume, height, diameters) and its standard deviation by resampling the points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh
from hsi_sc_nerf.geometry.mesh import Mesh

SPREAD_DEPTH = 6
"""Octree depth of the meshes of half-samples, which is enough for their spread and saves two thirds of the time."""
LITRES_PER_M3 = 1000.0


@dataclass(frozen=True)
class Size:
    """Sizes of an object that stands upright.

    Attributes:
        area_m2: surface area, base included.
        volume_l: enclosed volume, litres.
        height_m: from lowest to highest, along the turntable's axis.
        largest_diameter_m: largest width seen from above over all directions (largest Feret diameter).
        smallest_diameter_m: smallest such width (smallest Feret diameter).
        equivalent_diameter_m: diameter of the sphere of the same volume.
    """

    area_m2: float
    volume_l: float
    height_m: float
    largest_diameter_m: float
    smallest_diameter_m: float
    equivalent_diameter_m: float


def size_of(mesh: Mesh) -> Size:
    """Sizes of a closed mesh whose z points up.

    Example:
        >>> size_of(closed_mesh(cloud.points, cloud.normals, MeshConfig())).volume_l
        0.21
    """
    largest, smallest = feret_diameters(mesh.vertices[:, :2])
    volume_m3 = mesh.volume_m3()
    return Size(
        area_m2=mesh.area_m2(),
        volume_l=volume_m3 * LITRES_PER_M3,
        height_m=float(np.ptp(mesh.vertices[:, 2])),
        largest_diameter_m=largest,
        smallest_diameter_m=smallest,
        equivalent_diameter_m=float(np.cbrt(6.0 * volume_m3 / np.pi)),
    )


def feret_diameters(outline: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Largest and smallest distance between parallel lines that enclose the points.

    Exact: the largest is the greatest distance of two corners of the convex hull, the smallest lies across one of
    its edges (Toussaint 1983, "Solving geometric problems with the rotating calipers").
    """
    corners = outline[ConvexHull(outline).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    across = np.stack([-edges[:, 1], edges[:, 0]], axis=-1) / np.linalg.norm(edges, axis=1, keepdims=True)
    widths = np.ptp(corners @ across.T, axis=0)
    distances = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    return float(distances.max()), float(widths.min())


def size_spread(
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    config: MeshConfig,
    splits: int,
    done: Callable[[int], None] | None = None,
) -> Size:
    """Standard deviation of each size, from random halves of the points (half-samples, McCarthy 1969).

    The two halves of a split are meshed separately at octree depth `SPREAD_DEPTH` at most. Half of the root mean
    square of their differences is the standard deviation for all points. (A bootstrap would underestimate it, because
    thinning merges repeated points.) Errors that points have in common, such as those of the scale, the poses or the
    surface's depth, are not included.

    ``done`` is called with the number of finished splits, for a progress bar.
    """
    rng = np.random.default_rng(0)
    config = replace(config, octree_depth=min(config.octree_depth, SPREAD_DEPTH))
    differences = []
    for number in range(splits):
        halves = np.array_split(rng.permutation(len(points_m)), 2)
        one, other = (astuple(size_of(closed_mesh(points_m[half], normals[half], config))) for half in halves)
        differences.append(np.subtract(one, other))
        if done is not None:
            done(number + 1)
    return Size(*(np.sqrt(np.mean(np.square(differences), axis=0)) / 2.0).tolist())
