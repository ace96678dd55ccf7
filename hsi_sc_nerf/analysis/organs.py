"""Organs of a simple object, proposed by geometry and spectrum: what an end or a side has of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels

from hsi_sc_nerf.analysis.spectral_edges import GAP, LARGEST, LEAST_POINTS, Edge, beside, rings, sharpest_edge
from hsi_sc_nerf.analysis.spectral_mesh import NEIGHBOURS
from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.processing.spectral_subspace import MIN_SPECTRA, find_subspace

BODY, STEM, CALYX, LEAF, HUSK, KERNELS = "body", "stem", "calyx", "leaf", "husk", "kernels"
_SAMPLE = 4096
"""Points that the coordinates of spectra are found from, about."""
_MOST_PARTS = 2
"""Largest number of parts at one end (a stem, and what it stands on), and at the sides."""
_MOST_SEARCHES = 5
"""Largest number of searches at one end: they find parts, and layers of mixed pixels."""
_LEAST_SEPARATION = 6.0
"""Least separation of an organ in standard deviations: more than skin that fades reaches
(docs/validation/surface.md)."""
_SLIM, _WIDENS = 1.0 / 3.0, 2.0
"""A tip is slim if its spread is below this fraction of its length, and stands on something so many times wider."""
_STEM_SHAPE = 0.5
"""Largest ratio of a stem's second extent to its first."""
_LONG = 2.0
"""Height over width of an ear, at least."""
_SMALL = 0.1
"""Largest fraction of the points in a calyx, and in a part at a side: what is larger there is a blush."""
_CENTRES, _BEST_CENTRES = 1000, 12
"""Centres of parts at the sides that are tried, 4 mm apart on an apple, and how many of them are then moved."""
_LOWEST, _LEAST_EVENNESS = 0.01, 0.9
"""A part begins at the lower edge if it has some of the lowest points, this fraction of them. The contrast of its
middle third to the rest, over that of its lower third: near 1 for an organ, whose upper third training may blur, and
at most 0.82 where contrast falls to 0 evenly."""
_STRIP = 0.06
"""A part there of which no point is further from the rest than this fraction of the object's height is a strip of
such pixels."""
_STANDS_OFF = 0.7
"""Distance of a part's farthest point from the rest, over its length: 1 for a leaf, which is fixed at one end, 0.5
for a spot."""


def propose_organs(
    points_m: Float[np.ndarray, "n 3"], spectra: Float[np.ndarray, "n bands"]
) -> dict[str, Bool[np.ndarray, "n"]]:
    """Divide an object into its body and what differs from it: at its upper end, at its lower end, and at its sides.

    At an end, points are ordered by their distance from its tip, from where the axis meets it, and along the axis; at
    the sides by their distance from points that are spread over the surface. An organ's edge is the distance at which
    the spectra of the rings on both sides differ most, in standard deviations of the spectra within the two parts
    (Fisher's linear discriminant) and whatever their brightness. The discriminant then tells which points near the
    edge belong to the organ. A slim tip on something wide is a stem by its shape alone.

    Args:
        points_m: on the surface, object frame: z up along the turntable's axis.
        spectra: spectra of the points, finite.

    Returns:
        The points of each organ by its name, the body first (of an ear, the kernels). A slim part is a stem, a part
        at an end of a long object a husk, a small part at an end a calyx, a part that stands off a side a leaf. Other
        parts are ``part 1``, ... Only the body where nothing differs.

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
    shapes = unit_vectors(spectra[near].mean(axis=1, dtype=float))
    surface = _Surface(points_m, shapes @ find_subspace(shapes[:: max(1, len(shapes) // _SAMPLE)]).basis, near)
    for search in _SEARCHES:
        organs = 0
        for _ in range(_MOST_SEARCHES):
            if organs == _MOST_PARTS or (found := search(surface, rest)) is None:
                break
            name, part, edge = found
            if edge is not None and _is_mixed_with_support(part, edge, surface, rest):
                rest = rest & (points_m[:, 2] > points_m[part, 2].max())  # around the object
                continue
            rest = rest & ~part
            number, organs = sum(other.startswith("part") for other in named) + 1, organs + 1
            named[f"part {number}" if name is None or name in named else name] = part
    body = ~np.any([*named.values()], axis=0) if named else np.ones(len(points_m), bool)
    return {KERNELS if HUSK in named else BODY: body} | named


@dataclass(frozen=True)
class _Surface:
    """Points, the coordinates of their spectra, and the rows of their neighbours."""

    points_m: Float[np.ndarray, "n 3"]
    features: Float[np.ndarray, "n k"]
    near: Int[np.ndarray, "n near"]


_Part = tuple[str | None, Bool[np.ndarray, "n"], Edge | None]
"""Name, points, and the edge that told its spectra from the rest's; None if its shape did."""


def _part_at_end(upper: bool, surface: _Surface, rest: Bool[np.ndarray, "n"]) -> _Part | None:
    """A slim tip, or else what has spectra of its own at an end."""
    points_m, features, near = surface.points_m, surface.features, surface.near
    if not rest.any():
        return None
    distances = list(_distances(upper, points_m, rest))
    slim_m = _slim_length(distances[0], points_m, rest) if upper else 0.0
    if slim_m:
        edge = sharpest_edge(distances[0], features, rest, (slim_m / GAP, slim_m * GAP))
        tip = beside(edge, features, rest) if edge.separation >= _LEAST_SEPARATION else distances[0] < slim_m
        part = _largest_piece(rest & tip, near)
        if part.sum() >= LEAST_POINTS and (edge.separation >= _LEAST_SEPARATION or _is_slender(points_m[part])):
            return STEM, part, None
    edge = max((sharpest_edge(one, features, rest) for one in distances), key=lambda one: one.separation)
    part = _largest_piece(beside(edge, features, rest), near)
    if edge.separation < _LEAST_SEPARATION or not LEAST_POINTS <= part.sum() <= LARGEST * len(part):
        return None
    size = np.ptp(points_m, axis=0)
    if _is_slender(points_m[part]):
        return STEM, part, edge
    if size[2] >= _LONG * size[:2].max():
        return HUSK, part, edge
    of_part = np.ptp(points_m[part], axis=0)
    if of_part[2] > of_part[:2].max():  # a stub
        return STEM, part, edge
    return CALYX if part.mean() <= _SMALL else None, part, edge


def _part_at_side(surface: _Surface, rest: Bool[np.ndarray, "n"]) -> _Part | None:
    """A small part with spectra of its own around a point anywhere on the surface.

    That point is found on a sample of the points: among some that are spread over it, the best ones are moved to the
    middle of what they found. Then all points are used.
    """
    points_m, features, near = surface.points_m, surface.features, surface.near
    rows = np.flatnonzero(rest)
    if len(rows) < MIN_SPECTRA:
        return None
    rows = rows[:: max(1, len(rows) // _SAMPLE)]
    sample, some, every = points_m[rows], features[rows], np.ones(len(rows), bool)

    def middle(edge: Edge) -> Float[np.ndarray, "3"]:
        return sample[beside(edge, some, every)].mean(axis=0)

    def edges(centres: Iterable[Float[np.ndarray, "3"]]) -> list[Edge]:
        # A larger part would be none of a side, and hide small ones.
        distances = (np.linalg.norm(sample - centre, axis=1) for centre in centres)
        found = (sharpest_edge(distance, some, every, largest=_SMALL) for distance in distances)
        return sorted((edge for edge in found if edge.separation), key=lambda edge: -edge.separation)[:_BEST_CENTRES]

    best = edges(map(middle, edges(map(middle, edges(sample[_spread(sample, _CENTRES)])))))
    if not best:
        return None
    edge = sharpest_edge(np.linalg.norm(points_m - middle(best[0]), axis=1), features, rest, largest=_SMALL)
    part = _largest_piece(beside(edge, features, rest), near)
    if edge.separation < _LEAST_SEPARATION or not LEAST_POINTS <= part.sum() <= _SMALL * len(part):
        return None
    own = points_m[part]
    length_m = 2.0 * np.linalg.norm(own - own.mean(axis=0), axis=1).max()
    if _depth_m(points_m, part) <= _STANDS_OFF * length_m:
        return None, part, edge
    return STEM if _is_slender(points_m[part]) else LEAF, part, edge


def _spread(points_m: Float[np.ndarray, "n 3"], count: int) -> list[int]:
    """Rows of points far from each other: each the farthest from those before."""
    chosen, distance = [0], np.full(len(points_m), np.inf)
    for _ in range(min(count, len(points_m)) - 1):
        distance = np.minimum(distance, np.linalg.norm(points_m - points_m[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return chosen


def _is_mixed_with_support(
    part: Bool[np.ndarray, "n"], edge: Edge, surface: _Surface, rest: Bool[np.ndarray, "n"]
) -> bool:
    """Whether a part at the lower edge is no organ, but pixels that are mixed with what the object stands on.

    Mixed pixels hold less of it the higher they lie; the spectra of an organ do not change towards its edge. A strip
    of a pixel or two is all mixed.
    """
    height = surface.points_m[:, 2]
    if height[part].min() > np.quantile(height[rest], _LOWEST):
        return False
    if _depth_m(surface.points_m, part) < _STRIP * np.ptp(height):
        return True
    # 0 on the ring outside, 1 on that inside.
    contrast = (surface.features[part] @ edge.direction - edge.level) / edge.separation**2 + 0.5
    low, high = np.quantile(height[part], (1.0 / 3.0, 2.0 / 3.0))
    middle = (low < height[part]) & (height[part] < high)
    return bool(np.median(contrast[middle]) < _LEAST_EVENNESS * np.median(contrast[height[part] <= low]))


def _depth_m(points_m: Float[np.ndarray, "n 3"], part: Bool[np.ndarray, "n"]) -> float:
    """Distance from the rest of the point of a part that is the farthest from it."""
    return float(cKDTree(points_m[~part]).query(points_m[part])[0].max())


_SEARCHES: tuple[Callable[[_Surface, Bool[np.ndarray, "n"]], _Part | None], ...] = (
    partial(_part_at_end, True),
    partial(_part_at_end, False),
    _part_at_side,
)


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


def _slim_length(
    distance: Float[np.ndarray, "n"], points_m: Float[np.ndarray, "n 3"], rest: Bool[np.ndarray, "n"]
) -> float:
    """Length of a slim tip that stands on something wide; 0 where there is none."""
    radii, cuts, sums = rings(distance, points_m - points_m.mean(axis=0), rest)
    inner, outer = (
        np.sqrt(np.trace(sums.moments(*cuts[:, ends].T)[1], axis1=1, axis2=2)) for ends in ([0, 1], [2, 3])
    )
    slim = np.maximum(inner, distance[rest].min()) < _SLIM * radii
    widens = np.where(slim, outer / np.maximum(inner, 1e-12), 0.0)
    return float(radii[widens.argmax()] / GAP) if (widens > _WIDENS).any() else 0.0


def _largest_piece(chosen: Bool[np.ndarray, "n"], near: Int[np.ndarray, "n near"]) -> Bool[np.ndarray, "n"]:
    start, end = np.repeat(np.arange(len(near)), near.shape[1]), near.ravel()
    linked = chosen[start] & chosen[end]
    piece = connected_component_labels(np.stack([start[linked], end[linked]], axis=1), node_count=len(near))
    return chosen & (piece == np.bincount(piece[chosen]).argmax()) if chosen.any() else chosen


def _is_slender(points_m: Float[np.ndarray, "n 3"]) -> bool:
    extents = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= _STEM_SHAPE * extents[0])
