"""Precision, recall and F-score over the distance threshold (paper, section "Spatial Evaluation Metrics")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.evaluation.spatial import SpatialScore, distance_to_surface, f_score


@dataclass(frozen=True)
class Shape:
    """Points, and the surface they were sampled from where there is one; metres."""

    points_m: Float[np.ndarray, "n 3"]
    vertices_m: Float[np.ndarray, "v 3"] | None = None
    triangles: Int[np.ndarray, "t 3"] | None = None

    def distances_m(self, points_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k"]:
        """Distance of each given point to the surface, or to the nearest point where there is none."""
        if self.vertices_m is None or self.triangles is None:
            return cKDTree(self.points_m).query(points_m, workers=-1)[0]
        return distance_to_surface(points_m, self.vertices_m, self.triangles).astype(float)


@dataclass(frozen=True)
class ThresholdCurves:
    """Precision, recall and F-score, each in percent, at each threshold."""

    thresholds_m: Float[np.ndarray, "t"]
    precision: Float[np.ndarray, "t"]
    recall: Float[np.ndarray, "t"]
    f_score: Float[np.ndarray, "t"]


@dataclass(frozen=True)
class DistanceStatistics:
    """Of unsigned distances, in metres."""

    mean_m: float
    median_m: float
    rms_m: float
    percentile_95_m: float
    largest_m: float


def threshold_curves(
    to_reference_m: Float[np.ndarray, "n"], to_cloud_m: Float[np.ndarray, "m"], thresholds_m: Float[np.ndarray, "t"]
) -> ThresholdCurves:
    """Shares of distances within each threshold, the threshold itself included.

    Args:
        to_reference_m: Distance of each point of the cloud to the reference; their shares are the precision.
        to_cloud_m: Distance of each point of the reference to the cloud; their shares are the recall.
        thresholds_m: In any order.

    Raises:
        ValueError: one side has no points.
    """
    if not len(to_reference_m) or not len(to_cloud_m):
        raise ValueError("threshold_curves: the cloud and the reference need one point each at least")
    precision, recall = (
        100.0 * np.searchsorted(np.sort(distances), thresholds_m, side="right") / len(distances)
        for distances in (to_reference_m, to_cloud_m)
    )
    return ThresholdCurves(np.asarray(thresholds_m, float), precision, recall, f_score(precision, recall))


def score_at(
    to_reference_m: Float[np.ndarray, "n"], to_cloud_m: Float[np.ndarray, "m"], threshold_m: float
) -> SpatialScore:
    """The curves' values at one threshold."""
    curves = threshold_curves(to_reference_m, to_cloud_m, np.array([threshold_m]))
    return SpatialScore(float(curves.precision[0]), float(curves.recall[0]), float(curves.f_score[0]))


def best_threshold_m(curves: ThresholdCurves) -> float:
    """The knee of the F-score's curve: where it stops rising steeply, so that a larger threshold buys little.

    An F-score never falls as its threshold grows, so that it has no largest value to look for; and the paper does not
    say how it found its optimum. The knee is the threshold at which the curve lies furthest above the straight line
    from its first to its last point, both axes scaled to [0, 1] (Satopaa et al. 2011, "Finding a 'Kneedle' in a
    Haystack"). It depends on where the curve ends. The first threshold, if the curve does not rise.
    """
    rise = curves.f_score[-1] - curves.f_score[0]
    if rise <= 0:
        return float(curves.thresholds_m[0])
    along = (curves.thresholds_m - curves.thresholds_m[0]) / (curves.thresholds_m[-1] - curves.thresholds_m[0])
    return float(curves.thresholds_m[np.argmax((curves.f_score - curves.f_score[0]) / rise - along)])


def threshold_for_m(
    to_reference_m: Float[np.ndarray, "n"], to_cloud_m: Float[np.ndarray, "m"], percent: float
) -> float:
    """The smallest threshold at which the F-score reaches ``percent``.

    Args:
        to_reference_m: Distance of each point of the cloud to the reference.
        to_cloud_m: Distance of each point of the reference to the cloud.
        percent: In (0, 100].
    """
    candidates = np.sort(np.concatenate([to_reference_m, to_cloud_m]))
    curves = threshold_curves(to_reference_m, to_cloud_m, candidates)
    # Rounding must not keep 100 % from being reached.
    return float(candidates[int(np.argmax(curves.f_score >= percent - 1e-9))])


def distance_statistics(distances_m: Float[np.ndarray, "n"]) -> DistanceStatistics:
    """Mean, median, RMS, 95th percentile and largest of unsigned distances."""
    return DistanceStatistics(
        mean_m=float(np.mean(distances_m)),
        median_m=float(np.median(distances_m)),
        rms_m=float(np.sqrt(np.mean(np.square(distances_m)))),
        percentile_95_m=float(np.percentile(distances_m, 95)),
        largest_m=float(np.max(distances_m)),
    )
