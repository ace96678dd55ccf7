"""Edges on a surface: the distance from a point at which spectra change most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf import paper

LEAST_POINTS = 24
"""Fewest points of a part, and of a ring beside its edge."""
LARGEST = 0.5
"""Fraction of the points that a part may have: the body is the largest one."""
_RADII = 60
GAP, _RING = 1.1, 1.6
"""The rings beside an edge lie between these multiples of its radius; between the rings spectra are mixed."""
_LEAST_ANGLE_RAD = paper.CLASSIFICATION_ANGLE_RAD / 2.0
_ANGLE_NOISE_RAD = 0.01
"""Added to the deviations, so that spectra without noise are not divided by nothing."""
_REACH = 1.5
"""A part ends at this multiple of the radius that it was found at."""


@dataclass(frozen=True)
class Edge:
    """Where an end is divided from the rest: its side has features along ``direction`` above ``level``."""

    distance: Float[np.ndarray, "n"]
    radius: float
    separation: float
    direction: Float[np.ndarray, "k"]
    level: float


def sharpest_edge(
    distance: Float[np.ndarray, "n"],
    features: Float[np.ndarray, "n k"],
    rest: Bool[np.ndarray, "n"],
    between: tuple[float, float] = (0.0, np.inf),
    largest: float = LARGEST,
) -> Edge:
    """The edge with the largest separation; 0 where no two rings differ by an angle that tells materials apart.

    Args:
        distance: distance of the points from one point.
        features: features of their spectra.
        rest: points that count.
        between: least and largest radius.
        largest: fraction of the points that may lie inside.
    """
    none = Edge(distance, 0.0, 0.0, np.zeros(features.shape[1]), 0.0)
    radii, cuts, sums = rings(distance, features, rest, largest)
    allowed = (between[0] <= radii) & (radii <= between[1])
    radii, cuts = radii[allowed], cuts[allowed]
    inner, outer = (sums.moments(*cuts[:, ends].T)[0] for ends in ([0, 1], [2, 3]))
    inside, outside = sums.moments(np.zeros_like(cuts[:, 1]), cuts[:, 1]), sums.moments(cuts[:, 2])
    within = (inside[1] + outside[1]) / 2.0
    within += _ANGLE_NOISE_RAD**2 / within.shape[1] * np.eye(within.shape[1])
    directions = np.linalg.solve(within, (inner - outer)[..., None])[..., 0]
    separations = np.sqrt(np.einsum("rk,rk->r", inner - outer, directions))
    separations[np.linalg.norm(inner - outer, axis=1) < _LEAST_ANGLE_RAD] = 0.0
    if not separations.any():
        return none
    best = int(separations.argmax())
    level = float((inner[best] + outer[best]) @ directions[best] / 2.0)
    return Edge(distance, float(radii[best]), float(separations[best]), directions[best], level)


def beside(edge: Edge, features: Float[np.ndarray, "n k"], rest: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Points on the end's side of an edge by their spectra, not far from it."""
    return rest & (features @ edge.direction > edge.level) & (edge.distance < _REACH * edge.radius)


def rings(
    distance: Float[np.ndarray, "n"],
    values: Float[np.ndarray, "n k"],
    rest: Bool[np.ndarray, "n"],
    largest: float = LARGEST,
) -> tuple[Float[np.ndarray, "radii"], Int[np.ndarray, "radii 4"], RunningSums]:
    """Radii, where the rings on both sides of each begin and end, and sums of the values, in order of distance."""
    rows = np.flatnonzero(rest)
    rows = rows[np.argsort(distance[rows])]
    ordered = distance[rows]
    nearest, farthest = ordered[min(LEAST_POINTS, len(rows) - 1)], np.quantile(ordered, largest)
    if not 0.0 < nearest < farthest:
        return np.empty(0), np.empty((0, 4), int), RunningSums(values[rows], 0)
    radii = np.geomspace(nearest, farthest, _RADII)
    cuts = np.searchsorted(ordered, radii[:, None] * np.array([1.0 / _RING, 1.0 / GAP, GAP, _RING]))
    # Beyond a gap in the cloud, the next points are the ring.
    cuts[:, 0] = np.minimum(cuts[:, 0], cuts[:, 1] - LEAST_POINTS)
    cuts[:, 3] = np.maximum(cuts[:, 3], cuts[:, 2] + LEAST_POINTS)
    there = (cuts[:, 0] >= 0) & (cuts[:, 3] <= len(rows))
    radii, cuts = radii[there], cuts[there]
    return radii, cuts, RunningSums(values[rows], int(cuts.max(initial=0)))


class RunningSums:
    """Means and covariances of runs of rows.

    Args:
        values: the rows.
        reach: rows that runs may begin or end at.
    """

    def __init__(self, values: Float[np.ndarray, "n k"], reach: int) -> None:
        self._count, some = len(values), values[:reach]
        self._totals = values.sum(axis=0), values.T @ values
        self._sums = [
            np.concatenate([np.zeros((1, *one.shape[1:])), one.cumsum(axis=0)])
            for one in (some, some[:, :, None] * some[:, None, :])
        ]

    def moments(
        self, starts: Int[np.ndarray, "runs"], ends: Int[np.ndarray, "runs"] | None = None
    ) -> tuple[Float[np.ndarray, "runs k"], Float[np.ndarray, "runs k k"]]:
        """Mean and covariance of the rows from each start to before its end, or to the last one."""
        counts = ((self._count if ends is None else ends) - starts)[:, None]
        upto = self._totals if ends is None else [one[ends] for one in self._sums]
        mean, square = upto[0] - self._sums[0][starts], upto[1] - self._sums[1][starts]
        mean, square = mean / counts, square / counts[..., None]
        return mean, square - mean[:, :, None] * mean[:, None, :]
