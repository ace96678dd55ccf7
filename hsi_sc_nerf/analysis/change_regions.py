"""Connected areas of a surface that changed, and areas that grew or shrank between two days.

Limit of blank: how large a region may be that two captures of one day show without any change. Two trainings differ
in ways that one pair of days cannot tell from a change: in the hollow of a stem, in the water index of an existing
bruise. As in chemical analysis (Currie 1968; CLSI EP17), such pairs are blanks, and what is no larger than they show
is not called detected. The statistic is the largest region of all quantities of a pair: a false change is a region,
and one in any quantity is one too many (as the largest cluster in Nichols and Holmes 2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels

from hsi_sc_nerf.analysis.change_noise import PATCH_M
from hsi_sc_nerf.analysis.change_significance import Patches
from hsi_sc_nerf.analysis.classes import SMALLEST_REGION_M2
from hsi_sc_nerf.geometry.mesh import Mesh

LIMIT_M2 = 1.4e-4
"""Largest region in 99 of 100 blanks, by an exponential tail through the blanks of `docs/validation/change.md`."""
LIMIT_PART = 0.0087
"""The same as a part of the surface that was seen: what makes such regions, such as a hollow, is larger on larger
objects. On smaller ones, patches of one size make regions of one size."""
OUTSIDE = -1
_PLATEAU_PERCENT = 90.0
_MOST_CONTRAST = 1.25
"""Largest contrast of inside and outside, relative to the plateau of the change."""
_ROUNDS = 10
_GAP = 2.5
"""Distance, in patches, of the centres of two that belong together."""
_REACH = 3.0
"""Distance, in patches, from the significant ones to which a region may reach."""


@dataclass(frozen=True)
class ChangedRegion:
    """A connected area whose change is beyond noise.

    Attributes:
        area_m2: on the surface.
        area_sd_m2: its standard deviation, by the noise at its edge.
        centre_m: mean position, weighted by area.
    """

    area_m2: float
    area_sd_m2: float
    centre_m: tuple[float, float, float]


@dataclass(frozen=True)
class GrownRegion:
    """A connected area on two days: of the surface that has a property on either day.

    Attributes:
        before_m2: its area on the first day, 0 if it is new.
        after_m2: on the second day, 0 if it is gone.
        centre_m: mean position, weighted by area.
    """

    before_m2: float
    after_m2: float
    centre_m: tuple[float, float, float]


def changed_regions(
    mesh: Mesh,
    areas_m2: Float[np.ndarray, "v"],
    patches: Patches,
    before: Float[np.ndarray, "v k"],
    change: Float[np.ndarray, "v k"],
    significant: Bool[np.ndarray, "p"],
    noise: Float[np.ndarray, "k"],
    smallest_m2: float = SMALLEST_REGION_M2,
) -> tuple[Int[np.ndarray, "v"], list[ChangedRegion]]:
    """Outline the areas around significant patches, finer than patches are.

    Significant patches of one sign with gaps of at most one patch are one region, and so are those whose regions
    overlap. A region's change is projected onto the direction of its mean, and its edge is where half of its height
    is reached: there, a blurred edge stays in place. What reaches that level beside the significant patches and is
    connected to them belongs to it. The edges at one standard deviation of the noise more and less give the standard
    deviation of the area.

    The height is the 90th percentile of the change. The difference between the values of both days inside and
    those outside is taken instead where it is larger: a narrow ring around a bruise has blurred edges and no plateau,
    but the bruise has one. Where the surface itself has other colours the latter may be too large, so that it is at
    most a quarter more.

    Args:
        mesh: the surface.
        areas_m2: areas of the vertices.
        patches: patches of the vertices.
        before: values of each vertex on the first day.
        change: change of each vertex since then, less that of the whole surface; NaN where it is not known.
        significant: whether the change of each patch is.
        noise: standard deviations of a usual patch's changes.
        smallest_m2: regions below this area are left out.

    Returns:
        The region of each vertex or `OUTSIDE`, and the regions, the largest first.
    """
    known = np.isfinite(change).all(axis=1) & (patches.of_vertex >= 0)

    def outlined(group: Int[np.ndarray, "group"]) -> tuple[Int[np.ndarray, "inside"], float]:
        """Vertices of the region around a group of patches, and the standard deviation of its area."""
        core = known & np.isin(patches.of_vertex, group)
        mean = areas_m2[core] @ change[core]
        direction = mean / max(float(np.linalg.norm(mean)), 1e-30)
        near = np.flatnonzero(known)
        off_m = cKDTree(mesh.vertices[core]).query(mesh.vertices[near], distance_upper_bound=_REACH * PATCH_M)[0]
        near = near[off_m < np.inf]
        along = np.full(len(core), -np.inf)
        along[near] = change[near] @ direction
        plateau = float(np.percentile(along[core], _PLATEAU_PERCENT))
        first = before[near] @ direction
        contrast = _contrast(
            np.concatenate([first, first + along[near]]), float(np.median(before[core] @ direction)), plateau
        )
        half = np.clip(contrast, plateau, _MOST_CONTRAST * plateau) / 2.0
        blur = float(np.linalg.norm(noise * direction))
        inside, less, more = (connected_to(mesh, along > level, core) for level in (half, half + blur, half - blur))
        return inside, float(areas_m2[more].sum() - areas_m2[less].sum()) / 2.0

    labels = np.full(len(known), OUTSIDE)
    found: list[tuple[Int[np.ndarray, "group"], ChangedRegion]] = []
    groups = _touching(patches, patches.means(change, areas_m2), significant)
    while groups:
        # Groups whose regions overlap are one.
        group = groups.pop(0)
        inside, sd_m2 = outlined(group)
        if len(inside) == 0:
            continue
        others = set(labels[inside].tolist()) - {OUTSIDE}
        if others:
            groups.insert(0, np.concatenate([group, *(found[other][0] for other in others)]))
            for other in others:
                labels[labels == other] = OUTSIDE
            continue
        labels[inside] = len(found)
        area_m2 = float(areas_m2[inside].sum())
        found.append((group, ChangedRegion(area_m2, sd_m2, _centre(mesh, areas_m2, inside))))
    left = np.unique(labels[labels != OUTSIDE]).tolist()
    kept = sorted((n for n in left if found[n][1].area_m2 >= smallest_m2), key=lambda n: -found[n][1].area_m2)
    order = np.full(len(found) + 1, OUTSIDE)
    order[kept] = np.arange(len(kept))
    return order[labels], [found[number][1] for number in kept]


def limit_of_blank_m2(seen_m2: float) -> float:
    """Area up to which a region is no evidence of a change, without a second capture of the first day.

    Args:
        seen_m2: area of the surface that was seen on both days.

    Example:
        >>> f"{limit_of_blank_m2(0.0050):.2e} {limit_of_blank_m2(0.0500):.2e}"
        '1.40e-04 4.35e-04'
    """
    return max(LIMIT_M2, LIMIT_PART * seen_m2)


def _contrast(values: Float[np.ndarray, "n"], low: float, height: float) -> float:
    """By how much the values in the higher one of two classes exceed those in the lower one, median less median.

    The classes are parted half way between the two (Ridler and Calvard 1978), from a first guess on.
    """
    high = low + height
    for _ in range(_ROUNDS):
        above = values > (low + high) / 2.0
        if above.all() or not above.any():
            break
        low, high = float(np.median(values[~above])), float(np.median(values[above]))
    return high - low


def grown_regions(
    mesh: Mesh, areas_m2: Float[np.ndarray, "v"], before: Bool[np.ndarray, "v"], after: Bool[np.ndarray, "v"]
) -> list[GrownRegion]:
    """Areas of the regions that have a property before or after; what overlaps is one region. The largest first.

    Example:
        >>> square = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
        >>> one = np.array([True, False, False, False])
        >>> [(r.before_m2, r.after_m2) for r in grown_regions(square, np.full(4, 0.25), one, np.ones(4, bool))]
        [(0.25, 1.0)]
    """
    regions = [
        GrownRegion(
            float(areas_m2[piece[before[piece]]].sum()),
            float(areas_m2[piece[after[piece]]].sum()),
            _centre(mesh, areas_m2, piece),
        )
        for piece in _pieces(mesh, before | after)
    ]
    return sorted(
        (one for one in regions if max(one.before_m2, one.after_m2) >= SMALLEST_REGION_M2),
        key=lambda one: -max(one.before_m2, one.after_m2),
    )


def connected_to(mesh: Mesh, inside: Bool[np.ndarray, "v"], core: Bool[np.ndarray, "v"]) -> Int[np.ndarray, "inside"]:
    """The pieces of a part of the surface that reach into its core."""
    kept = [piece for piece in _pieces(mesh, inside) if core[piece].any()]
    return np.concatenate(kept) if kept else np.zeros(0, int)


def _touching(
    patches: Patches, change: Float[np.ndarray, "p k"], significant: Bool[np.ndarray, "p"]
) -> list[Int[np.ndarray, "group"]]:
    """Significant patches in groups; where the change is one number, what rose and what fell are two groups."""
    some = np.flatnonzero(significant)
    fell = (change[some, 0] < 0.0) & (change.shape[1] == 1)
    pairs = cKDTree(patches.centres_m[some]).query_pairs(_GAP * PATCH_M, output_type="ndarray") if len(some) else some
    pairs = pairs.reshape(-1, 2)
    linked = pairs[fell[pairs[:, 0]] == fell[pairs[:, 1]]]
    group = connected_component_labels(linked, node_count=len(some))
    return [some[group == number] for number in np.unique(group)]


def _pieces(mesh: Mesh, inside: Bool[np.ndarray, "v"]) -> list[Int[np.ndarray, "piece"]]:
    """Vertices of each connected piece of a part of the surface."""
    piece = mesh.pieces(inside.astype(int))
    some = np.flatnonzero(inside)
    order = some[np.argsort(piece[some], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(piece[order])) + 1) if len(order) else []


def _centre(
    mesh: Mesh, areas_m2: Float[np.ndarray, "v"], piece: Int[np.ndarray, "piece"]
) -> tuple[float, float, float]:
    x, y, z = areas_m2[piece] @ mesh.vertices[piece] / areas_m2[piece].sum()
    return float(x), float(y), float(z)
