"""Edges on a surface: the distance from a place at which spectra change most."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf import paper

LEAST_POINTS = 24
"""Of a part, and of a ring beside its edge."""
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
) -> Edge:
    """The edge with the largest separation; 0 where no two rings differ by an angle that tells materials apart."""
    best = Edge(distance, 0.0, 0.0, np.zeros(features.shape[1]), 0.0)
    for radius, cuts, sums in rings(distance, features, rest):
        inner, outer = (sums.moments(*cut)[0] for cut in (cuts[:2], cuts[2:]))
        within = (sums.moments(0, cuts[1])[1] + sums.moments(cuts[2], rest.sum())[1]) / 2.0
        direction = np.linalg.solve(within + _ANGLE_NOISE_RAD**2 / len(within) * np.eye(len(within)), inner - outer)
        separation = float(np.sqrt((inner - outer) @ direction))
        good = between[0] <= radius <= between[1] and np.linalg.norm(inner - outer) >= _LEAST_ANGLE_RAD
        if good and separation > best.separation:
            best = Edge(distance, radius, separation, direction, float((inner + outer) @ direction / 2.0))
    return best


def beside(edge: Edge, features: Float[np.ndarray, "n k"], rest: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Points on the end's side of an edge by their spectra, not far from it."""
    return rest & (features @ edge.direction > edge.level) & (edge.distance < _REACH * edge.radius)


def rings(
    distance: Float[np.ndarray, "n"], values: Float[np.ndarray, "n k"], rest: Bool[np.ndarray, "n"]
) -> Iterator[tuple[float, Int[np.ndarray, "4"], RunningSums]]:
    """Radii, where the rings on both sides of each begin and end, and sums of the values, in order of distance."""
    rows = np.flatnonzero(rest)
    rows = rows[np.argsort(distance[rows])]
    ordered, sums = distance[rows], RunningSums(values[rows])
    nearest, farthest = ordered[min(LEAST_POINTS, len(rows) - 1)], np.quantile(ordered, LARGEST)
    for radius in np.geomspace(nearest, farthest, _RADII) if 0.0 < nearest < farthest else ():
        cuts = np.searchsorted(ordered, radius * np.array([1.0 / _RING, 1.0 / GAP, GAP, _RING]))
        # Beyond a gap in the cloud, the next points are the ring.
        cuts[0], cuts[3] = min(cuts[0], cuts[1] - LEAST_POINTS), max(cuts[3], cuts[2] + LEAST_POINTS)
        if cuts[0] >= 0 and cuts[3] <= len(rows):
            yield float(radius), cuts, sums


class RunningSums:
    """Mean and covariance of any run of rows."""

    def __init__(self, values: Float[np.ndarray, "n k"]) -> None:
        self._sums = [
            np.concatenate([np.zeros((1, *one.shape[1:])), one.cumsum(axis=0)])
            for one in (values, values[:, :, None] * values[:, None, :])
        ]

    def moments(self, start: int, end: int) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        """Mean and covariance of the rows from ``start`` to before ``end``."""
        mean, square = ((one[end] - one[start]) / (end - start) for one in self._sums)
        return mean, square - np.outer(mean, mean)
