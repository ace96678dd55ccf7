"""How well a reconstructed surface fits a known one (paper, section "Spatial Evaluation Metrics")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.geometry.mesh import ray_scene
from hsi_sc_nerf.paper import F_SCORE_THRESHOLD_M


@dataclass(frozen=True)
class SpatialScore:
    """Precision, recall and their harmonic mean, each in percent, at one distance threshold."""

    precision: float
    recall: float
    f_score: float


def precision_recall_f_score(
    reconstructed_m: Float[np.ndarray, "n 3"],
    reference_m: Float[np.ndarray, "m 3"],
    threshold_m: float = F_SCORE_THRESHOLD_M,
) -> SpatialScore:
    """Point-to-point precision, recall and F-score of a reconstruction against a reference, in the same frame.

    Precision is the fraction of reconstructed points within ``threshold_m`` (included) of a reference point, recall
    the fraction of reference points within it of a reconstructed point. The F-score is 2 P R / (P + R), or 0 if both
    are 0. An empty cloud scores 0. Sample the reference densely: distances to points exceed distances to the surface
    by up to the points' spacing.

    Example:
        >>> reference_m = np.random.default_rng(0).random((1000, 3))
        >>> precision_recall_f_score(reference_m + [0.001, 0.0, 0.0], reference_m).f_score
        100.0
    """
    if not len(reconstructed_m) or not len(reference_m):
        return SpatialScore(0.0, 0.0, 0.0)
    to_reference_m = Surface(reference_m).distances_m(reconstructed_m)
    return score_at(to_reference_m, Surface(reconstructed_m).distances_m(reference_m), threshold_m)


def sample_surface(
    vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], count: int, seed: int = 0
) -> Float[np.ndarray, "{count} 3"]:
    """Points spread evenly over a triangle mesh's area.

    Stratified: the area is divided into ``count`` equal parts in the order of the triangles, and each part gets one
    point. Uniform within a triangle (Osada et al. 2002, "Shape Distributions", section 3.2).

    Raises:
        ValueError: the mesh has no area.
    """
    corners = np.asarray(vertices_m, float)[triangles]
    edges = corners[:, 1:] - corners[:, :1]
    reach = np.cumsum(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1))
    if not len(reach) or reach[-1] <= 0:
        raise ValueError("sample_surface: the mesh has no area")
    random = np.random.default_rng(seed)
    positions = (np.arange(count) + random.random(count)) * (reach[-1] / count)
    chosen = np.searchsorted(reach, positions, side="right").clip(max=len(reach) - 1)
    root, along = np.sqrt(random.random(count))[:, None], random.random(count)[:, None]
    return corners[chosen, 0] + root * ((1 - along) * edges[chosen, 0] + along * edges[chosen, 1])


@dataclass(frozen=True)
class Surface:
    """Points, and the surface they were sampled from where there is one; metres."""

    points_m: Float[np.ndarray, "n 3"]
    vertices_m: Float[np.ndarray, "v 3"] | None = None
    triangles: Int[np.ndarray, "t 3"] | None = None

    def distances_m(self, points_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k"]:
        """Distance of each given point to the surface (Open3D), or to the nearest point where there is none."""
        if self.vertices_m is None or self.triangles is None:
            return cKDTree(self.points_m).query(points_m, workers=-1)[0]
        # Single precision tells places of a survey's grid, thousands of kilometres from its origin, only 0.5 m apart.
        centre_m = np.mean(self.vertices_m, axis=0)
        scene = ray_scene(self.vertices_m - centre_m, self.triangles)
        return scene.compute_distance(np.asarray(points_m - centre_m, np.float32)).numpy().astype(float)


@dataclass(frozen=True)
class ThresholdCurves:
    """Precision, recall and F-score, each in percent, at each threshold."""

    thresholds_m: Float[np.ndarray, "t"]
    precision: Float[np.ndarray, "t"]
    recall: Float[np.ndarray, "t"]
    f_score: Float[np.ndarray, "t"]


def threshold_curves(
    to_reference_m: Float[np.ndarray, "n"], to_cloud_m: Float[np.ndarray, "m"], thresholds_m: Float[np.ndarray, "t"]
) -> ThresholdCurves:
    """Precision and recall: the fractions of distances within each threshold, the threshold itself included.

    The distances are those of the cloud's points to the reference, for the precision, and back, for the recall; each
    holds one at least. The F-score is their harmonic mean, 0 where both are 0.
    """
    precision, recall = (
        100.0 * np.searchsorted(np.sort(distances), thresholds_m, side="right") / len(distances)
        for distances in (to_reference_m, to_cloud_m)
    )
    total = precision + recall
    f_score = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
    return ThresholdCurves(np.asarray(thresholds_m, float), precision, recall, f_score)


def score_at(
    to_reference_m: Float[np.ndarray, "n"], to_cloud_m: Float[np.ndarray, "m"], threshold_m: float
) -> SpatialScore:
    """The curves' values at one threshold."""
    curves = threshold_curves(to_reference_m, to_cloud_m, np.array([threshold_m]))
    return SpatialScore(float(curves.precision[0]), float(curves.recall[0]), float(curves.f_score[0]))


def best_threshold_m(curves: ThresholdCurves) -> float:
    """The knee of the F-score's curve, beyond which a larger threshold gains little.

    The knee is the threshold at which the curve lies furthest above the straight line between its ends, both axes
    scaled to [0, 1] (Satopaa et al. 2011, "Finding a 'Kneedle' in a Haystack"). It depends on the largest threshold.
    A curve that does not rise has its knee at the first threshold. The paper does not say how it found its optimum.
    """
    rise = curves.f_score[-1] - curves.f_score[0]
    if rise <= 0:
        return float(curves.thresholds_m[0])
    fraction = (curves.thresholds_m - curves.thresholds_m[0]) / (curves.thresholds_m[-1] - curves.thresholds_m[0])
    return float(curves.thresholds_m[np.argmax((curves.f_score - curves.f_score[0]) / rise - fraction)])


def threshold_for_m(
    to_reference_m: Float[np.ndarray, "n"], to_cloud_m: Float[np.ndarray, "m"], percent: float
) -> float:
    """The smallest threshold at which the F-score reaches ``percent``, in (0, 100]."""
    candidates = np.sort(np.concatenate([to_reference_m, to_cloud_m]))
    curves = threshold_curves(to_reference_m, to_cloud_m, candidates)
    # Rounding must not keep 100 % from being reached.
    return float(candidates[int(np.argmax(curves.f_score >= percent - 1e-9))])


def distance_statistics(distances_m: Float[np.ndarray, "n"]) -> dict[str, float]:
    """Mean, median, RMS, 95th percentile and largest of unsigned distances, metres, by name."""
    return {
        "mean_m": float(np.mean(distances_m)),
        "median_m": float(np.median(distances_m)),
        "rms_m": float(np.sqrt(np.mean(np.square(distances_m)))),
        "percentile_95_m": float(np.percentile(distances_m, 95)),
        "largest_m": float(np.max(distances_m)),
    }
