"""Organs of a simple object, proposed by geometry and spectrum: what its upper or lower end has of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.change_features import unit_spectra
from hsi_sc_nerf.analysis.spectral_mesh import NEIGHBOURS
from hsi_sc_nerf.processing.spectral_subspace import MIN_SPECTRA, find_subspace

BODY, STEM, CALYX, HUSK, KERNELS = "body", "stem", "calyx", "husk", "kernels"
_SAMPLE = 4096
"""Points that the coordinates of spectra are found from, about."""
_LEAST_POINTS = 24
"""Of a part, and of a ring beside its edge."""
_LARGEST = 0.5
"""Fraction of the points that a part may have: the body is the largest one."""
_MOST_PARTS = 2
"""At one end: a stem, and what it stands on."""
_LEAST_HEIGHT = 0.05
"""Least height of a part at the lower end over the object's: the rim's pixels are mixed with what it stands on."""
_RADII = 60
_GAP, _RING = 1.1, 1.6
"""The rings beside an edge lie between these multiples of its radius; between the rings spectra are mixed."""
_LEAST_SEPARATION = 6.0
"""Standard deviations. What is no organ reaches 5 (skin that fades), organs of trained clouds 9 to 21."""
_LEAST_ANGLE_RAD = paper.CLASSIFICATION_ANGLE_RAD / 2.0
_ANGLE_NOISE_RAD = 0.01
"""Added to the deviations, so that spectra without noise are not divided by nothing."""
_REACH = 1.5
"""A part ends at this multiple of the radius that it was found at."""
_SLIM, _WIDENS = 1.0 / 3.0, 2.0
"""A tip is slim if its spread is below this fraction of its length, and stands on something so many times wider."""
_STEM_SHAPE = 0.5
"""Largest ratio of a stem's second extent to its first."""
_LONG = 2.0
"""Height over width of an ear, at least."""
_CALYX = 0.1
"""Largest fraction of the points in a calyx."""


def propose_organs(
    points_m: Float[np.ndarray, "n 3"], spectra: Float[np.ndarray, "n bands"]
) -> dict[str, Bool[np.ndarray, "n"]]:
    """Divide an object into its body and what differs from it at its upper and its lower end.

    Points are ordered by their distance from an end: from its tip, from where the axis meets it, and along the axis.
    An organ's edge is the distance at which the spectra of the rings on both sides differ most, in standard
    deviations of the spectra within the two parts (Fisher's linear discriminant) and whatever their brightness. The
    discriminant then tells which points near the edge belong to the organ. A slim tip on something wide is a stem by
    its shape alone.

    Args:
        points_m: on the surface, object frame: z up along the turntable's axis.
        spectra: of the points, finite.

    Returns:
        Which points each organ has, the body first (of an ear, the kernels), by its name: stem, if it is slim; husk,
        at an end of a long object; calyx, if it is small; else ``part 1``, ... The body alone where nothing differs.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> {name: int(where.sum()) for name, where in propose_organs(cloud.points, cloud.spectra).items()}
        {'body': 49342, 'stem': 658}
    """
    rest, named = np.ones(len(points_m), bool), dict[str, Bool[np.ndarray, "n"]]()
    if len(points_m) < MIN_SPECTRA:
        return {BODY: rest}
    near = cKDTree(points_m).query(points_m, NEIGHBOURS + 1)[1]
    # Spectra without their brightness, in as few coordinates as they support.
    shapes = unit_spectra(spectra[near].mean(axis=1, dtype=float))
    features = shapes @ find_subspace(shapes[:: max(1, len(shapes) // _SAMPLE)]).basis
    for upper in (True, False):
        for _ in range(_MOST_PARTS):
            if (found := _part_at_end(upper, points_m, features, near, rest)) is None:
                break
            name, part = found
            number = sum(other.startswith("part") for other in named) + 1
            named[f"part {number}" if name is None or name in named else name] = part
            rest = rest & ~part
    return {KERNELS if HUSK in named else BODY: rest} | named


def _part_at_end(
    upper: bool,
    points_m: Float[np.ndarray, "n 3"],
    features: Float[np.ndarray, "n k"],
    near: Int[np.ndarray, "n near"],
    rest: Bool[np.ndarray, "n"],
) -> tuple[str | None, Bool[np.ndarray, "n"]] | None:
    """A slim tip, or else what has spectra of its own at an end."""
    distances = list(_distances(upper, points_m, rest))
    slim_m = _slim_length(distances[0], points_m, rest) if upper else 0.0
    if slim_m:
        edge = _sharpest_edge(distances[0], features, rest, (slim_m / _GAP, slim_m * _GAP))
        tip = _beside(edge, features, rest) if edge.separation >= _LEAST_SEPARATION else distances[0] < slim_m
        part = _largest_piece(rest & tip, near)
        if part.sum() >= _LEAST_POINTS and (edge.separation >= _LEAST_SEPARATION or _is_slender(points_m[part])):
            return STEM, part
    edge = max((_sharpest_edge(one, features, rest) for one in distances), key=lambda one: one.separation)
    part = _largest_piece(_beside(edge, features, rest), near)
    if edge.separation < _LEAST_SEPARATION or not _LEAST_POINTS <= part.sum() <= _LARGEST * len(part):
        return None
    if not upper and np.ptp(points_m[part, 2]) < _LEAST_HEIGHT * np.ptp(points_m[:, 2]):
        return None
    size = np.ptp(points_m, axis=0)
    if _is_slender(points_m[part]):
        return STEM, part
    if size[2] >= _LONG * size[:2].max():
        return HUSK, part
    return CALYX if part.mean() <= _CALYX else None, part


def _distances(
    upper: bool, points_m: Float[np.ndarray, "n 3"], rest: Bool[np.ndarray, "n"]
) -> Iterator[Float[np.ndarray, "n"]]:
    """From the tip of an end, from where the axis meets it, and along the axis."""
    height, of_rest = points_m[:, 2] * (1.0 if upper else -1.0), np.flatnonzero(rest)
    some = max(8, len(of_rest) // 500)
    highest = of_rest[np.argsort(-height[of_rest])[:some]]
    low, high = np.quantile(points_m[of_rest, :2], [0.01, 0.99], axis=0)
    aside = np.linalg.norm(points_m[:, :2] - (low + high) / 2.0, axis=1)
    half = of_rest[height[of_rest] > (height[of_rest].min() + height[of_rest].max()) / 2.0]
    for end in (highest, half[np.argsort(aside[half])[:some]] if len(half) else highest):
        yield np.linalg.norm(points_m - points_m[end].mean(axis=0), axis=1)
    yield height[highest].max() - height


@dataclass(frozen=True)
class _Edge:
    """Where an end is divided from the rest: its side has features along ``direction`` above ``level``."""

    distance: Float[np.ndarray, "n"]
    radius: float
    separation: float
    direction: Float[np.ndarray, "k"]
    level: float


def _sharpest_edge(
    distance: Float[np.ndarray, "n"],
    features: Float[np.ndarray, "n k"],
    rest: Bool[np.ndarray, "n"],
    between: tuple[float, float] = (0.0, np.inf),
) -> _Edge:
    """The edge with the largest separation; 0 where no two rings differ by an angle that tells materials apart."""
    best = _Edge(distance, 0.0, 0.0, np.zeros(features.shape[1]), 0.0)
    for radius, cuts, sums in _rings(distance, features, rest):
        inner, outer = (sums.moments(*cut)[0] for cut in (cuts[:2], cuts[2:]))
        within = (sums.moments(0, cuts[1])[1] + sums.moments(cuts[2], rest.sum())[1]) / 2.0
        direction = np.linalg.solve(within + _ANGLE_NOISE_RAD**2 / len(within) * np.eye(len(within)), inner - outer)
        separation = float(np.sqrt((inner - outer) @ direction))
        good = between[0] <= radius <= between[1] and np.linalg.norm(inner - outer) >= _LEAST_ANGLE_RAD
        if good and separation > best.separation:
            best = _Edge(distance, radius, separation, direction, float((inner + outer) @ direction / 2.0))
    return best


def _beside(edge: _Edge, features: Float[np.ndarray, "n k"], rest: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Points on the end's side of an edge by their spectra, not far from it."""
    return rest & (features @ edge.direction > edge.level) & (edge.distance < _REACH * edge.radius)


def _slim_length(
    distance: Float[np.ndarray, "n"], points_m: Float[np.ndarray, "n 3"], rest: Bool[np.ndarray, "n"]
) -> float:
    """Length of a slim tip that stands on something wide; 0 where there is none."""
    widens, length = _WIDENS, 0.0
    for radius, cuts, sums in _rings(distance, points_m - points_m.mean(axis=0), rest):
        inner, outer = (np.sqrt(np.trace(sums.moments(*cut)[1])) for cut in (cuts[:2], cuts[2:]))
        if max(inner, distance[rest].min()) < _SLIM * radius and outer > widens * inner:
            widens, length = outer / inner, radius / _GAP
    return length


def _rings(
    distance: Float[np.ndarray, "n"], values: Float[np.ndarray, "n k"], rest: Bool[np.ndarray, "n"]
) -> Iterator[tuple[float, Int[np.ndarray, "4"], _RunningSums]]:
    """Radii, where the rings on both sides of each begin and end, and sums of the values, in order of distance."""
    rows = np.flatnonzero(rest)
    rows = rows[np.argsort(distance[rows])]
    ordered, sums = distance[rows], _RunningSums(values[rows])
    nearest, farthest = ordered[min(_LEAST_POINTS, len(rows) - 1)], np.quantile(ordered, _LARGEST)
    for radius in np.geomspace(nearest, farthest, _RADII) if 0.0 < nearest < farthest else ():
        cuts = np.searchsorted(ordered, radius * np.array([1.0 / _RING, 1.0 / _GAP, _GAP, _RING]))
        # Beyond a gap in the cloud, the next points are the ring.
        cuts[0], cuts[3] = min(cuts[0], cuts[1] - _LEAST_POINTS), max(cuts[3], cuts[2] + _LEAST_POINTS)
        if cuts[0] >= 0 and cuts[3] <= len(rows):
            yield float(radius), cuts, sums


class _RunningSums:
    """Mean and covariance of any run of rows."""

    def __init__(self, values: Float[np.ndarray, "n k"]) -> None:
        self._sums = [
            np.concatenate([np.zeros((1, *one.shape[1:])), one.cumsum(axis=0)])
            for one in (values, values[:, :, None] * values[:, None, :])
        ]

    def moments(self, start: int, end: int) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"]]:
        mean, square = ((one[end] - one[start]) / (end - start) for one in self._sums)
        return mean, square - np.outer(mean, mean)


def _largest_piece(chosen: Bool[np.ndarray, "n"], near: Int[np.ndarray, "n near"]) -> Bool[np.ndarray, "n"]:
    start, end = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    linked = chosen[start] & chosen[end]
    graph = csr_array((np.ones(linked.sum()), (start[linked], end[linked])), shape=(len(near),) * 2)
    piece = connected_components(graph, directed=False)[1]
    return chosen & (piece == np.bincount(piece[chosen]).argmax()) if chosen.any() else chosen


def _is_slender(points_m: Float[np.ndarray, "n 3"]) -> bool:
    extents = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= _STEM_SHAPE * extents[0])
