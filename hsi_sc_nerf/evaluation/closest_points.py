"""Iterative closest points: pairs of point and tangent plane, with a scale as well as without.

Open3D estimates a scale from pairs of points only, which shrinks noisy clouds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.similarity import Similarity

if TYPE_CHECKING:
    import open3d

ROUNDS = 50
CONVERGED = 1e-5
"""Share of the object's radius: a round that moves no point further is the last."""
NEIGHBOURS = 30
"""Points to a tangent plane."""
MOVED_POINTS = 20_000
"""Points of the cloud that take part in the last rounds."""
SEARCH_POINTS = 1_000
"""Points of the cloud that find the way in the first rounds."""
FEWEST_PAIRS = 10


@dataclass(frozen=True)
class Target:
    """Points with what closest-point rounds need of them."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tree: cKDTree

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"]) -> Target:
        """The points with their normals."""
        return cls(points, np.asarray(with_normals(points).normals), cKDTree(points))

    def thinned(self, count: int) -> Target:
        """About so many of the points, with the normals of all of them."""
        chosen = slice(None, None, max(1, len(self.points) // count))
        return Target(self.points[chosen], self.normals[chosen], cKDTree(self.points[chosen]))

    def off_plane(self, points: Float[np.ndarray, "m 3"], cap_m: float) -> Float[np.ndarray, "m"]:
        """Distance of each point to the tangent plane at its closest point, at most ``cap_m``."""
        distance, nearest = self.tree.query(points, distance_upper_bound=cap_m)
        off = np.full(len(points), cap_m)
        near, there = np.isfinite(distance), nearest[np.isfinite(distance)]
        off[near] = np.abs(np.einsum("ij,ij->i", points[near] - self.points[there], self.normals[there]))
        return off


def robust_radius(points: Float[np.ndarray, "n 3"]) -> float:
    """Median distance of the points from their median: a sphere's radius, and hardly touched by outliers."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def refined(
    cloud: Float[np.ndarray, "n 3"], target: Target, start: Similarity, with_scale: bool, seed: int
) -> tuple[Similarity, float]:
    """Closest-point rounds from a start that is roughly right, to the end; and within which distance pairs counted.

    Pairs count that are closer than a third of the object's radius in the first rounds, and closer than three robust
    standard deviations in the last, so that outliers and what the reference lacks do not pull.
    """
    radius = robust_radius(target.points)
    few, many = (drawn(cloud, count, seed) for count in (SEARCH_POINTS, MOVED_POINTS))
    transform = approached(few, target, start, with_scale, CONVERGED * radius)
    off = target.off_plane(transform(many), radius / 10)
    # The points' spacing bounds how close a closest point can be expected to be.
    within = min(radius / 10, 3 * 1.4826 * float(np.median(off)) + 2 * _spacing(target))
    return _closest_point_rounds(many, target, transform, within, with_scale, CONVERGED * radius), within


def approached(
    cloud: Float[np.ndarray, "n 3"], target: Target, start: Similarity, with_scale: bool, converged_m: float
) -> Similarity:
    """The first rounds, to pairs at most a tenth of the radius apart, until no point moves further than a bound."""
    radius = robust_radius(target.points)
    transform = start
    for within in (radius / 3, radius / 10):
        transform = _closest_point_rounds(cloud, target, transform, within, with_scale, converged_m)
    return transform


def _closest_point_rounds(
    cloud: np.ndarray, target: Target, transform: Similarity, within: float, with_scale: bool, converged_m: float
) -> Similarity:
    for _ in range(ROUNDS):
        moved = transform(cloud)
        distance, nearest = target.tree.query(moved, distance_upper_bound=within)
        paired = np.isfinite(distance)
        if paired.sum() < FEWEST_PAIRS:
            break
        here, there = moved[paired], nearest[paired]
        step = plane_step(here, target.points[there], target.normals[there], with_scale)
        transform = step.after(transform)
        if np.linalg.norm(step(here) - here, axis=1).max() < converged_m:
            break
    return transform


def plane_step(
    points: Float[np.ndarray, "n 3"],
    on_plane: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    with_scale: bool = False,
) -> Similarity:
    """The small motion that brings points nearest to their planes in the least-squares sense.

    Linearised in the rotation (and the scale) about the points' centre; what the planes do not determine stays as it
    is. Low 2004, "Linear Least-Squares Optimization for Point-to-Plane ICP Surface Registration".
    """
    centre = points.mean(axis=0)
    arms = points - centre
    columns = [np.cross(arms, normals), normals]
    if with_scale:
        columns.append(np.einsum("ij,ij->i", arms, normals)[:, None])
    size = float(np.sqrt(np.mean(arms**2))) or 1.0
    # Turns and stretches in units of length, so that one bound tells which motions are undetermined.
    units = np.array([size] * 3 + [1.0] * 3 + [size] * with_scale)
    design = np.concatenate(columns, axis=1) / units
    off = np.einsum("ij,ij->i", on_plane - points, normals)
    motion = np.linalg.lstsq(design.T @ design, design.T @ off, rcond=1e-6)[0] / units
    rotation = Rotation.from_rotvec(motion[:3]).as_matrix()
    scale = float(np.exp(motion[6])) if with_scale else 1.0
    return Similarity(scale, rotation, centre + motion[3:6] - scale * rotation @ centre)


def with_normals(points: np.ndarray) -> open3d.geometry.PointCloud:
    """A cloud with normals that point away from its centre."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    outwards = np.einsum("ij,ij->i", normals, points - np.median(points, axis=0))
    cloud.normals = open3d.utility.Vector3dVector(np.where(outwards[:, None] < 0, -normals, normals))
    return cloud


def _spacing(target: Target) -> float:
    """Median distance to the next point."""
    few = target.points[:: max(1, len(target.points) // SEARCH_POINTS)]
    return float(np.median(target.tree.query(few, k=2)[0][:, 1]))


def drawn(points: Float[np.ndarray, "n 3"], count: int, seed: int) -> Float[np.ndarray, "m 3"]:
    """At most so many of the points, chosen by chance."""
    points = np.asarray(points, float)
    if len(points) <= count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]
