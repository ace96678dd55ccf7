"""How well a reconstructed surface fits a known one (paper, section "Spatial Evaluation Metrics")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from hsi_sc_nerf.meshes.mesh import ray_scene
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

    Precision is the share of reconstructed points within ``threshold_m`` (included) of a reference point, recall the
    share of reference points within it of a reconstructed one; the F-score is 2 P R / (P + R), and 0 where both are.
    Distances to points overstate distances to the surface by up to the spacing: sample the reference densely.
    An empty cloud scores 0.
    """
    return _score(*_hits(reconstructed_m, reference_m, threshold_m))


def f_score_with_spread(
    reconstructed_m: Float[np.ndarray, "n 3"],
    reference_m: Float[np.ndarray, "m 3"],
    threshold_m: float = F_SCORE_THRESHOLD_M,
    resamples: int = 100,
    seed: int = 0,
) -> tuple[SpatialScore, float]:
    """`precision_recall_f_score`, and the standard deviation of the F-score (percent) over bootstrap resamples.

    The points of both clouds are drawn again with replacement (Efron 1979): the spread says how much of the score
    is the luck of which points were sampled, not how well the surface is known.
    """
    precise, recalled = _hits(reconstructed_m, reference_m, threshold_m)
    rng = np.random.default_rng(seed)
    scores = [
        _score(rng.choice(precise, len(precise)), rng.choice(recalled, len(recalled))).f_score
        for _ in range(resamples)
        if len(precise) and len(recalled)
    ]
    return _score(precise, recalled), float(np.std(scores)) if scores else 0.0


def _hits(
    reconstructed_m: Float[np.ndarray, "n 3"], reference_m: Float[np.ndarray, "m 3"], threshold_m: float
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "m"]]:
    """Which points of each cloud have a point of the other within the threshold; none, if one is empty."""
    if not len(reconstructed_m) or not len(reference_m):
        return np.zeros(len(reconstructed_m), bool), np.zeros(len(reference_m), bool)
    precise, recalled = (
        cKDTree(there).query(here, workers=-1)[0] <= threshold_m
        for here, there in ((reconstructed_m, reference_m), (reference_m, reconstructed_m))
    )
    return precise, recalled


def _score(precise: Bool[np.ndarray, "n"], recalled: Bool[np.ndarray, "m"]) -> SpatialScore:
    precision, recall = (100.0 * float(np.mean(hits)) if len(hits) else 0.0 for hits in (precise, recalled))
    return SpatialScore(precision, recall, float(f_score(precision, recall)))


def f_score(precision: ArrayLike, recall: ArrayLike) -> Float[np.ndarray, "*n"]:
    """Harmonic mean of precision and recall; 0 where both are."""
    precision, recall = np.asarray(precision, float), np.asarray(recall, float)
    total = precision + recall
    return np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)


def sample_surface(
    vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], count: int, seed: int = 0
) -> Float[np.ndarray, "{count} 3"]:
    """Points spread evenly over a triangle mesh's area.

    Stratified: the mesh's area is cut into ``count`` equal shares in the order of the triangles, and each share gets
    one point, so that every triangle gets its share to within one point. Uniform within a triangle (Osada et al.
    2002, "Shape Distributions", section 3.2).

    Raises:
        ValueError: the mesh has no area.
    """
    corners = np.asarray(vertices_m, float)[triangles]
    edges = corners[:, 1:] - corners[:, :1]
    reach = np.cumsum(0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1))
    if not len(reach) or reach[-1] <= 0:
        raise ValueError("sample_surface: the mesh has no area")
    random = np.random.default_rng(seed)
    shares = (np.arange(count) + random.random(count)) * (reach[-1] / count)
    chosen = np.searchsorted(reach, shares, side="right").clip(max=len(reach) - 1)
    root, along = np.sqrt(random.random(count))[:, None], random.random(count)[:, None]
    return corners[chosen, 0] + root * ((1 - along) * edges[chosen, 0] + along * edges[chosen, 1])


def distance_to_surface(
    points_m: Float[np.ndarray, "n 3"], vertices_m: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, "n"]:
    """Unsigned distance of each point to the nearest point of a triangle mesh, metres (Open3D, float32)."""
    # Single precision tells places of a survey's grid, thousands of kilometres from its origin, only 0.5 m apart.
    centre_m = np.mean(vertices_m, axis=0)
    scene = ray_scene(vertices_m - centre_m, triangles)
    return scene.compute_distance(np.asarray(points_m - centre_m, np.float32)).numpy()
