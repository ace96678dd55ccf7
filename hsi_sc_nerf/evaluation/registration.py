"""Bring a cloud into a reference's frame: features (FPFH, RANSAC), then iterative closest points.

Features, normals and RANSAC are Open3D's. The closest-point rounds are our own, because Open3D's point-to-plane
estimation has no scale, and its point-to-point estimation of a scale shrinks noisy clouds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import Similarity

if TYPE_CHECKING:
    import open3d

NEARLY_CONVERGED = 1e-3
"""Fraction of the object's radius: the search for a start ends with a round that moves no point further."""
MOST_POINTS = 50_000
"""Points of the reference that are used."""
SEARCHED_POINTS = 10_000
"""Points of the reference that are used while a start is searched for."""
JUDGED_POINTS = 20_000
"""Points by which fits are compared."""
RESTARTS = 3
TURN_DEG = 30.0
SIGNIFICANT = 4.0
"""A fit is worse than the best one if it differs by this many standard errors."""
SAME_TURN_DEG = 10.0
ROUNDS = 50
CONVERGED = 1e-5
"""Fraction of the object's radius: the rounds end when no point moves further."""
NEIGHBOURS = 30
"""Points that a tangent plane is fitted to."""
MOVED_POINTS = 20_000
"""Points of the cloud that are used in the last rounds."""
SEARCH_POINTS = 1_000
"""Points of the cloud that are used in the first rounds."""
FEWEST_PAIRS = 10


@dataclass(frozen=True)
class Rival:
    """An attitude that fits as well as the one that was taken, because the shape is (nearly) symmetric."""

    turn_deg: float
    """Between the two."""
    rms_m: float
    """Of distances off the tangent planes, both ways, each at most a tenth of the object's radius."""
    taken_rms_m: float
    """The same of the attitude that was taken."""


@dataclass(frozen=True)
class Registration:
    """Transform of a cloud into the reference's frame."""

    transform: Similarity
    within_m: float
    """Points further from the reference than this were not used in the last round."""
    rival: Rival | None = None
    """Found by features only."""


def refine(
    cloud_m: Float[np.ndarray, "n 3"],
    reference_m: Float[np.ndarray, "m 3"],
    start: Similarity | None = None,
    with_scale: bool = False,
    seed: int = 0,
) -> Registration:
    """Iterative closest points, point to tangent plane (Chen and Medioni 1992), from a roughly correct start.

    Args:
        cloud_m: moves.
        reference_m: stays.
        start: default: the identity.
        with_scale: also estimate a scale.
        seed: of the random subsets of the points.

    Example:
        >>> shifted_m = reference_m + [0.002, 0.0, 0.0]
        >>> refine(shifted_m, reference_m).transform(shifted_m)  # close to reference_m
    """
    target = Target.of(drawn(reference_m, MOST_POINTS, seed))
    return Registration(*refined(cloud_m, target, start or Similarity(), with_scale, seed))


def align_by_features(
    cloud_m: Float[np.ndarray, "n 3"],
    reference_m: Float[np.ndarray, "m 3"],
    with_scale: bool = False,
    seed: int = 0,
    track: Callable[[list[Similarity]], Iterable[Similarity]] = iter,
) -> Registration:
    """Align clouds that lie anywhere: fast point feature histograms (Rusu et al. 2009), RANSAC, `refine`.

    The best of several tries is then rotated about the cloud's principal axes in steps of 30 degrees and refined from
    there. A rotation that fits better replaces it. One that fits as well, within four standard errors of the mean
    squared distance, is reported as a rival: the shape does not determine the attitude.

    Args:
        cloud_m: moves.
        reference_m: stays.
        with_scale: also estimate a scale; it starts at the ratio of the clouds' robust radii.
        seed: of everything random.
        track: wraps the starts while they are refined, for a progress bar.
    """
    import open3d

    open3d.utility.random.seed(seed)
    cloud, reference = (Target.of(drawn(points, MOST_POINTS, seed)) for points in (cloud_m, reference_m))
    radius = robust_radius(reference.points)
    sized = Similarity(radius / robust_radius(cloud.points) if with_scale else 1.0)
    few = drawn(cloud.points, SEARCH_POINTS, seed)
    thinned = reference.thinned(SEARCHED_POINTS)
    judged_cloud, judged_reference = (drawn(target.points, JUDGED_POINTS, seed) for target in (cloud, reference))

    def approached_from(start: Similarity) -> Similarity:
        return approached(few, thinned, start, with_scale, NEARLY_CONVERGED * radius)

    def fit_of(transform: Similarity) -> _Fit:
        # Both ways, so that a cloud shrunk into a corner does not fit.
        forth = reference.off_plane(transform(judged_cloud), radius / 10)
        back = cloud.off_plane(transform.inverse()(judged_reference), radius / 10 / transform.scale)
        return _Fit(transform, np.concatenate([forth, transform.scale * back]) ** 2)

    matched = _matched_features(sized(cloud.points), reference.points, radius, with_scale)
    start = min((fit_of(approached_from(found.after(sized))) for found in matched), key=_Fit.misfit)
    best = fit_of(refined(cloud_m, reference, start.transform, with_scale, seed)[0])
    turned = [fit_of(approached_from(best.transform.after(turn))) for turn in track(_rotations(cloud.points))]
    best, *others = sorted([best, *turned], key=_Fit.misfit)
    rivals = ((other, other.transform.after(best.transform.inverse()).turn_deg()) for other in others)
    rival = next(
        (
            Rival(turn_deg, other.misfit(), best.misfit())
            for other, turn_deg in rivals
            if turn_deg > SAME_TURN_DEG and not other.is_worse_than(best)
        ),
        None,
    )
    return Registration(*refined(cloud_m, reference, best.transform, with_scale, seed), rival)


@dataclass(frozen=True)
class _Fit:
    transform: Similarity
    squares: Float[np.ndarray, "n"]
    """Squared distances off the tangent planes, of the same points for every fit."""

    def misfit(self) -> float:
        return float(np.sqrt(np.mean(self.squares)))

    def is_worse_than(self, other: _Fit) -> bool:
        more = self.squares - other.squares
        return bool(more.mean() > SIGNIFICANT * more.std() / np.sqrt(len(more)))


def _rotations(cloud: np.ndarray) -> list[Similarity]:
    """Rotations about the three principal axes through the cloud's centre."""
    centre = np.median(cloud, axis=0)
    axes = np.linalg.svd(cloud - centre, full_matrices=False)[2]
    turns = []
    for axis in axes:
        for angle_deg in np.arange(TURN_DEG, 360, TURN_DEG):
            rotation = Rotation.from_rotvec(np.deg2rad(angle_deg) * axis).as_matrix()
            turns.append(Similarity(1.0, rotation, centre - rotation @ centre))
    return turns


def _matched_features(cloud: np.ndarray, reference: np.ndarray, radius: float, with_scale: bool) -> list[Similarity]:
    import open3d

    register = open3d.pipelines.registration
    voxel = radius / 10
    (source, source_features), (target, target_features) = (_features(p, voxel) for p in (cloud, reference))

    def tried() -> Similarity:
        found = register.registration_ransac_based_on_feature_matching(
            source,
            target,
            source_features,
            target_features,
            True,
            1.5 * voxel,
            register.TransformationEstimationPointToPoint(with_scale),
            3,
            [
                register.CorrespondenceCheckerBasedOnEdgeLength(0.8),
                register.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
            ],
            register.RANSACConvergenceCriteria(20_000, 0.999),
        )
        return Similarity.from_matrix(found.transformation)

    # Fruit has few mutual matches; Open3D then warns and uses one-way matches.
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        return [tried() for _ in range(RESTARTS)]


def _features(
    points: np.ndarray, voxel: float
) -> tuple[open3d.geometry.PointCloud, open3d.pipelines.registration.Feature]:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    cloud = with_normals(np.asarray(cloud.points))
    features = open3d.pipelines.registration.compute_fpfh_feature(
        cloud, open3d.geometry.KDTreeSearchParamRadius(5 * voxel)
    )
    return cloud, features


@dataclass(frozen=True)
class Target:
    """Reference points with their normals and search tree."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tree: cKDTree

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"]) -> Target:
        """The points with their normals."""
        return cls(points, np.asarray(with_normals(points).normals), cKDTree(points))

    def thinned(self, count: int) -> Target:
        """About ``count`` of the points, with the normals that all points give."""
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
    """Median distance of the points from their median, which outliers hardly change; for a sphere, its radius."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def refined(
    cloud: Float[np.ndarray, "n 3"], target: Target, start: Similarity, with_scale: bool, seed: int
) -> tuple[Similarity, float]:
    """All closest-point rounds, and the largest distance of the pairs in the last round (metres).

    The first rounds pair points closer than a third of the object's radius, the last ones points closer than three
    robust standard deviations, so that neither outliers nor parts missing in the reference bias the result.
    """
    radius = robust_radius(target.points)
    few, many = (drawn(cloud, count, seed) for count in (SEARCH_POINTS, MOVED_POINTS))
    transform = approached(few, target, start, with_scale, CONVERGED * radius)
    off = target.off_plane(transform(many), radius / 10)
    within = min(radius / 10, 3 * 1.4826 * float(np.median(off)) + 2 * _spacing(target))
    return _closest_point_rounds(many, target, transform, within, with_scale, CONVERGED * radius), within


def approached(
    cloud: Float[np.ndarray, "n 3"], target: Target, start: Similarity, with_scale: bool, converged_m: float
) -> Similarity:
    """The first rounds: pairs up to a third, then up to a tenth of the radius apart."""
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
    """One Gauss-Newton step of point-to-plane registration.

    Linearised in the rotation (and the scale) about the points' centre; motions that the planes do not determine stay
    0. Low 2004, "Linear Least-Squares Optimization for Point-to-Plane ICP Surface Registration".
    """
    centre = points.mean(axis=0)
    arms = points - centre
    columns = [np.cross(arms, normals), normals]
    if with_scale:
        columns.append(np.einsum("ij,ij->i", arms, normals)[:, None])
    size = float(np.sqrt(np.mean(arms**2))) or 1.0
    # Rotation and scale in units of length, so that one bound finds the undetermined motions.
    units = np.array([size] * 3 + [1.0] * 3 + [size] * with_scale)
    design = np.concatenate(columns, axis=1) / units
    off = np.einsum("ij,ij->i", on_plane - points, normals)
    motion = np.linalg.lstsq(design.T @ design, design.T @ off, rcond=1e-6)[0] / units
    rotation = Rotation.from_rotvec(motion[:3]).as_matrix()
    scale = float(np.exp(motion[6])) if with_scale else 1.0
    return Similarity(scale, rotation, centre + motion[3:6] - scale * rotation @ centre)


def with_normals(points: np.ndarray) -> open3d.geometry.PointCloud:
    """An Open3D cloud with normals that point away from its centre."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    outwards = np.einsum("ij,ij->i", normals, points - np.median(points, axis=0))
    cloud.normals = open3d.utility.Vector3dVector(np.where(outwards[:, None] < 0, -normals, normals))
    return cloud


def _spacing(target: Target) -> float:
    """Median distance between neighbouring points."""
    few = target.points[:: max(1, len(target.points) // SEARCH_POINTS)]
    return float(np.median(target.tree.query(few, k=2)[0][:, 1]))


def drawn(points: Float[np.ndarray, "n 3"], count: int, seed: int) -> Float[np.ndarray, "m 3"]:
    """A random subset of at most ``count`` points."""
    points = np.asarray(points, float)
    if len(points) <= count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]
