"""Bring a cloud into a reference's frame: features (FPFH, RANSAC), then iterative closest points, all by Open3D."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import Similarity
from hsi_sc_nerf.robust_scatter import SIGMA_OF_MAD

if TYPE_CHECKING:
    import open3d

REFERENCE_POINTS, MOVED_POINTS = 50_000, 20_000
"""Largest numbers of points of the reference and of the cloud."""
SEARCH_REFERENCE_POINTS, SEARCH_POINTS = 10_000, 1_000
"""Largest numbers of points while a start is searched for."""
SEARCH_FRACTIONS = (1 / 3, 1 / 10)
"""Largest distances of pairs in the first rounds, as fractions of the reference's radius."""
ROUNDS, CONVERGED = 50, 1e-7
SCALE_ROUNDS, SCALE_CONVERGED = 30, 1e-5
RESTARTS = 3
TURN_DEG = 30.0
SIGNIFICANT = 4.0
"""A fit is worse than the best one if it differs by this many standard errors."""
SAME_TURN_DEG = 10.0
NEIGHBOURS = 30
"""Points that a tangent plane is fitted to."""


@dataclass(frozen=True)
class Rival:
    """An attitude that fits as well as the one that was taken, because the shape is (nearly) symmetric."""

    turn_deg: float
    """Angle between the two attitudes."""
    rms_m: float
    """RMS of distances off the tangent planes, in both directions, each at most a tenth of the object's radius."""
    taken_rms_m: float
    """RMS of these distances in the attitude that was taken."""


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
) -> Registration:
    """Iterative closest points, point to tangent plane, with Tukey's loss, from a roughly correct start.

    The first rounds pair points up to a third of the object's radius apart, the last ones up to three robust standard
    deviations, so that neither outliers nor parts missing in the reference bias the result.

    Args:
        start: default: the identity.

    Example:
        >>> shifted_m = reference_m + [0.002, 0.0, 0.0]
        >>> refine(shifted_m, reference_m).transform(shifted_m)  # close to reference_m
    """
    target = _Target(drawn(reference_m, REFERENCE_POINTS))
    transform = _approached(drawn(cloud_m, SEARCH_POINTS), target, start or Similarity(), with_scale)
    moved_m = drawn(cloud_m, MOVED_POINTS)
    off_m = np.median(target.off_plane_m(transform(moved_m), target.radius_m / 10))
    spacing_m = np.median(target.tree.query(target.points[:: max(1, len(target.points) // 1000)], k=2)[0][:, 1])
    within_m = min(target.radius_m / 10, float(3 * SIGMA_OF_MAD * off_m + 2 * spacing_m))
    return Registration(_closest_points(moved_m, target, transform, within_m, with_scale), within_m)


def align_by_features(
    cloud_m: Float[np.ndarray, "n 3"],
    reference_m: Float[np.ndarray, "m 3"],
    with_scale: bool = False,
    track: Callable[[list[Similarity]], Iterable[Similarity]] = iter,
) -> Registration:
    """Align clouds that lie anywhere: fast point feature histograms (Rusu et al. 2009), RANSAC, `refine`.

    The best of several tries is then rotated about the cloud's principal axes in steps of 30 degrees and refined from
    there. A rotation that fits better replaces it. One that fits as well, within four standard errors of the mean
    squared distance, is reported as a rival: the shape does not determine the attitude.

    Args:
        with_scale: also estimate a scale; it starts at the ratio of the clouds' robust radii.
    """
    import open3d

    open3d.utility.random.seed(0)
    cloud, reference = (_Target(drawn(points, MOVED_POINTS)) for points in (cloud_m, reference_m))
    few, thinned = drawn(cloud_m, SEARCH_POINTS), _Target(drawn(reference_m, SEARCH_REFERENCE_POINTS))
    sized = Similarity(reference.radius_m / cloud.radius_m if with_scale else 1.0)
    cap_m = reference.radius_m / 10

    def fit_from(start: Similarity) -> _Fit:
        transform = _approached(few, thinned, start, with_scale)
        # Both ways, so that a cloud shrunk into a corner does not fit.
        forth_m = reference.off_plane_m(transform(cloud.points), cap_m)
        back_m = cloud.off_plane_m(transform.inverse()(reference.points), cap_m / transform.scale)
        return _Fit(transform, np.concatenate([forth_m, transform.scale * back_m]) ** 2)

    found = _matched_features(sized(cloud.points), reference.points, cap_m, with_scale)
    best = min((fit_from(start.after(sized)) for start in found), key=_Fit.rms)
    turned = [fit_from(best.transform.after(turn)) for turn in track(_rotations(cloud.points))]
    best, *others = sorted([best, *turned], key=_Fit.rms)
    rival = None
    for other in others:
        turn_deg = other.transform.after(best.transform.inverse()).turn_deg()
        if turn_deg > SAME_TURN_DEG and not other.is_worse_than(best):
            rival = Rival(turn_deg, other.rms(), best.rms())
            break
    last = refine(cloud_m, reference_m, best.transform, with_scale)
    return Registration(last.transform, last.within_m, rival)


@dataclass(frozen=True)
class _Fit:
    transform: Similarity
    squares: Float[np.ndarray, "n"]
    """Squared distances off the tangent planes, of the same points for every fit."""

    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.squares)))

    def is_worse_than(self, other: _Fit) -> bool:
        more = self.squares - other.squares
        return bool(more.mean() > SIGNIFICANT * more.std() / np.sqrt(len(more)))


class _Target:
    """Points with their normals, which point away from their centre, and a search tree."""

    def __init__(self, points: Float[np.ndarray, "n 3"]) -> None:
        import open3d

        self.points, self.tree, self.radius_m = points, cKDTree(points), robust_radius(points)
        self.cloud = _open3d_cloud(points)
        self.cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
        self.normals = np.array(self.cloud.normals)
        self.normals[np.einsum("ij,ij->i", self.normals, points - np.median(points, axis=0)) < 0] *= -1
        self.cloud.normals = open3d.utility.Vector3dVector(self.normals)

    def off_plane_m(self, points: Float[np.ndarray, "m 3"], cap_m: float) -> Float[np.ndarray, "m"]:
        """Distance of each point to the tangent plane at its closest point, at most ``cap_m``."""
        distance, nearest = self.tree.query(points, distance_upper_bound=cap_m)
        off = np.full(len(points), cap_m)
        near, there = np.isfinite(distance), nearest[np.isfinite(distance)]
        off[near] = np.abs(np.einsum("ij,ij->i", points[near] - self.points[there], self.normals[there]))
        return off

    def scale_step(self, points: Float[np.ndarray, "m 3"], within_m: float) -> Similarity:
        """The scale about the points' centre that brings them closest to the tangent planes."""
        distance, nearest = self.tree.query(points, distance_upper_bound=within_m)
        near, there = np.isfinite(distance), nearest[np.isfinite(distance)]
        centre = points.mean(axis=0)
        along = np.einsum("ij,ij->i", points[near] - centre, self.normals[there])
        off = np.einsum("ij,ij->i", self.points[there] - points[near], self.normals[there])
        scale = float(np.exp(along @ off / max(along @ along, 1e-30)))
        return Similarity(scale, translation=(1.0 - scale) * centre)


def robust_radius(points: Float[np.ndarray, "n 3"]) -> float:
    """Median distance of the points from their median, which outliers hardly change; for a sphere, its radius."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def drawn(points: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "m 3"]:
    """A random subset of at most ``count`` points, each time the same."""
    points = np.asarray(points, float)
    if len(points) <= count:
        return points
    return points[np.random.default_rng(0).choice(len(points), count, replace=False)]


def _approached(few: np.ndarray, target: _Target, start: Similarity, with_scale: bool) -> Similarity:
    for fraction in SEARCH_FRACTIONS:
        start = _closest_points(few, target, start, fraction * target.radius_m, with_scale)
    return start


def _closest_points(
    points: np.ndarray, target: _Target, transform: Similarity, within_m: float, with_scale: bool
) -> Similarity:
    """Rounds of pairs up to ``within_m`` apart; Open3D's point-to-plane estimate has no scale, which alternates."""
    from open3d.pipelines import registration as open3d_registration

    loss = open3d_registration.TukeyLoss(within_m)
    estimate = open3d_registration.TransformationEstimationPointToPlane(loss)
    criteria = open3d_registration.ICPConvergenceCriteria(CONVERGED, CONVERGED, ROUNDS)
    for _ in range(SCALE_ROUNDS if with_scale else 1):
        moved = transform(points)
        found = open3d_registration.registration_icp(
            _open3d_cloud(moved), target.cloud, within_m, np.eye(4), estimate, criteria
        )
        step = Similarity.from_matrix(found.transformation)
        if with_scale:
            step = target.scale_step(step(moved), within_m).after(step)
        transform = step.after(transform)
        if abs(step.scale - 1.0) < SCALE_CONVERGED:
            break
    return transform


def _rotations(cloud: np.ndarray) -> list[Similarity]:
    """Rotations about the three principal axes through the cloud's centre."""
    centre = np.median(cloud, axis=0)
    turns = []
    for axis in np.linalg.svd(cloud - centre, full_matrices=False)[2]:
        for angle_deg in np.arange(TURN_DEG, 360, TURN_DEG):
            rotation = Rotation.from_rotvec(np.deg2rad(angle_deg) * axis).as_matrix()
            turns.append(Similarity(1.0, rotation, centre - rotation @ centre))
    return turns


def _matched_features(cloud: np.ndarray, reference: np.ndarray, voxel_m: float, with_scale: bool) -> list[Similarity]:
    import open3d

    register = open3d.pipelines.registration
    clouds, features = [], []
    for points in (cloud, reference):
        thinned = _open3d_cloud(points).voxel_down_sample(voxel_m)
        clouds.append(_Target(np.asarray(thinned.points)).cloud)
        radius = open3d.geometry.KDTreeSearchParamRadius(5 * voxel_m)
        features.append(register.compute_fpfh_feature(clouds[-1], radius))
    estimate = register.TransformationEstimationPointToPoint(with_scale)
    checks = [
        register.CorrespondenceCheckerBasedOnEdgeLength(0.8),
        register.CorrespondenceCheckerBasedOnDistance(1.5 * voxel_m),
    ]
    criteria = register.RANSACConvergenceCriteria(20_000, 0.999)
    # Fruit has few mutual matches; Open3D then warns and uses one-way matches.
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        found = [
            register.registration_ransac_based_on_feature_matching(
                *clouds, *features, True, 1.5 * voxel_m, estimate, 3, checks, criteria
            )
            for _ in range(RESTARTS)
        ]
    return [Similarity.from_matrix(one.transformation) for one in found]


def _open3d_cloud(points: np.ndarray) -> open3d.geometry.PointCloud:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
