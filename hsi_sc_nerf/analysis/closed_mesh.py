"""The object's closed surface from its points: smoothing, a closed base, screened Poisson reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.base import find_base, lower_rim, lowest_edge_m
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.meshes.mesh import Mesh

# Points that a quadric is fitted to lie a third of its radius apart: about thirty weigh in.
_THINNING = 3.0
# Cubes of the thinning's size along the cloud's longest side, above which memory would not do.
_MOST_CUBES = 5000
# Fraction of the triangles below which a connected piece is a speck.
_SMALLEST_PIECE = 0.001
NEIGHBOURS = 48
"""The smallest number of points that a quadric is fitted to reliably is a few times its six coefficients."""
_CHUNK_POINTS = 1 << 14
# Added to the normal equations, whose unknowns are scaled to about 1: few or collinear neighbours make a plane.
_RIDGE = 1e-6


@dataclass(frozen=True)
class MeshConfig:
    """How the mesh is made."""

    octree_depth: int = paper.POISSON_DEPTH
    """Depth of the Poisson reconstruction's octree: each step halves the mesh's triangles in size."""
    smoothing_radius_m: float = 0.002
    """Bumps smaller than this, in metres, are taken for noise of the reconstruction and smoothed away."""
    base_height_m: float | None = None
    """Height above the turntable's disc, in metres, of what the object stands on (the container's height): the
    unseen base is closed there. Without it, where the cloud ends at its lowest."""


def closed_mesh(points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], config: MeshConfig) -> Mesh:
    """The closed surface of an object that stands upright, its base flat.

    The points are thinned, half a smoothing radius of the surface's lower rim is left out, the others are smoothed,
    the base that no camera saw is closed (`find_base`), and the whole goes through screened Poisson reconstruction
    (Kazhdan and Hoppe 2013; Open3D), of which specks are left out.

    Args:
        points_m: the seen surface, z up.
        normals: outward on the whole; single ones may be far off.
        config: settings.

    Raises:
        InputError: there are too few points, they lie in one place or too far apart, their normals do not point
            outwards, or they end below the base.
    """
    if len(points_m) < NEIGHBOURS or np.ptp(points_m, axis=0).min() <= 0.0 or not np.isfinite(points_m).all():
        raise InputError(
            f"the cloud has {len(points_m)} points that do not surround a solid; export more points of the object."
        )
    points, facing = np.asarray(points_m, float), np.asarray(normals, float)
    spacing_m, extent_m = config.smoothing_radius_m / _THINNING, float(np.ptp(points, axis=0).max())
    if extent_m > _MOST_CUBES * spacing_m:
        raise InputError(
            f"the cloud is {extent_m:.4g} m large, too large for a smoothing radius of {config.smoothing_radius_m} "
            "m; is it in metres? Scale it to metres, take away what is not the object, or raise the radius."
        )
    base_height_m = lowest_edge_m(points) if config.base_height_m is None else config.base_height_m
    points, facing = thinned(points, facing, spacing_m)
    inner = ~lower_rim(points, config.smoothing_radius_m / 2.0)
    points, facing = points[inner], facing[inner]
    if len(points) < NEIGHBOURS:
        raise InputError(
            f"the cloud is too small for a smoothing radius of {config.smoothing_radius_m} m, which leaves "
            f"{len(points)} points; check that it is in metres, or lower the radius."
        )
    # Over a surface that is open at its foot, and seen from there, outward normals add up to its volume.
    from_foot = points - [*points[:, :2].mean(axis=0), points[:, 2].min()]
    if not np.einsum("pi,pi->", from_foot, facing) > 0.0:
        raise InputError("the cloud's normals do not point out of the object; flip them, or export the cloud again.")
    points, outward = smoothed(points, facing, config.smoothing_radius_m)
    base_points, base_normals = find_base(points, outward, base_height_m).points(spacing_m)
    return solid_pieces(
        _poisson(np.concatenate([points, base_points]), np.concatenate([outward, base_normals]), config.octree_depth)
    )


def _poisson(points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], depth: int) -> Mesh:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    # On several threads Open3D's reconstruction now and then crashes (Open3D issue 6828), and no two runs agree.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    mesh.remove_degenerate_triangles()
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles))


def solid_pieces(mesh: Mesh) -> Mesh:
    """The connected pieces that are solid and not tiny, without vertices that none of their triangles uses.

    A stem that the cloud does not join to its fruit stays; specks, and bubbles inside the object, whose volume is
    negative, go.
    """
    edges = mesh.triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    piece = connected_component_labels(edges, node_count=len(mesh.vertices))[mesh.triangles[:, 0]]
    fraction = np.bincount(piece) / len(piece)
    a, b, c = (mesh.vertices[corner] for corner in mesh.triangles.T)
    volume = np.bincount(piece, np.einsum("ij,ij->i", a, np.cross(b, c)))
    triangles = mesh.triangles[((fraction >= _SMALLEST_PIECE) & (volume > 0.0))[piece]]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return Mesh(mesh.vertices[used], renumbered.reshape(triangles.shape))


def open_edges(mesh: Mesh) -> int:
    """How many edges are not run along as often one way as the other; a mesh with none encloses a volume.

    Unlike `Mesh.is_watertight`, this lets four triangles meet in an edge, as where two parts of a surface touch.
    """
    t = mesh.triangles.astype(np.int64)
    start, end = t.ravel(), np.roll(t, -1, axis=1).ravel()
    edge, which = np.unique(np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end), return_inverse=True)
    return int(np.count_nonzero(np.bincount(which, np.where(start < end, 1.0, -1.0), minlength=len(edge))))


def thinned(
    points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], cell_m: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """One point for each cube of side ``cell_m`` that holds points: the mean of their places and of their normals.

    The normals that come out are no longer than 1; they say which side is outside.
    """
    cells = np.floor((points_m - points_m.min(axis=0)) / cell_m).astype(np.int64)
    shape = cells.max(axis=0) + 1
    _, cell = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)
    count = np.bincount(cell)
    mean = [np.bincount(cell, column) / count for column in np.concatenate([points_m, normals], axis=1).T]
    return np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)


def smoothed(
    points_m: Float[np.ndarray, "n 3"], facing: Float[np.ndarray, "n 3"], radius_m: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Each point moved on to the quadric that fits its neighbours best, and the quadric's normal there.

    Moving least squares (Alexa et al. 2003, "Computing and Rendering Point Set Surfaces"): a plane by principal
    components, over it a quadric by weighted least squares. A quadric, unlike a mean, does not shrink what is curved.

    Args:
        points_m: positions, at least three.
        facing: vectors that point outwards on the whole; how long they are and how they scatter does not matter.
        radius_m: neighbours at this distance weigh exp(-2); smaller features are smoothed away. At least a few of
            the nearest `NEIGHBOURS` points count however sparse the cloud is.

    Returns:
        Positions, and unit normals on the side of ``facing``.
    """
    places, normals = np.empty((len(points_m), 3)), np.empty((len(points_m), 3))
    tree = cKDTree(points_m)
    # What the quadrics' sides are told apart by has to be steadier than the normals of single points.
    count = min(NEIGHBOURS, len(points_m))
    for start in range(0, len(points_m), _CHUNK_POINTS):
        chunk = slice(start, start + _CHUNK_POINTS)
        distance_m, neighbour = tree.query(points_m[chunk], count, workers=-1)
        scale_m = np.maximum(radius_m, distance_m[:, min(count - 1, NEIGHBOURS // 4)])[:, None]
        weight = np.exp(-2.0 * (distance_m / scale_m) ** 2)
        outwards = np.einsum("pk,pkj->pj", weight, facing[neighbour])
        # Points of the other side of something thin are none of this surface.
        weight *= np.einsum("pkj,pj->pk", facing[neighbour], outwards) > 0
        offset = (points_m[neighbour] - points_m[chunk, None]) / scale_m[..., None]
        height, normals[chunk] = _quadric(offset, weight, outwards)
        places[chunk] = points_m[chunk] + scale_m * height
    return places, normals


def _quadric(
    offset: Float[np.ndarray, "p k 3"], weight: Float[np.ndarray, "p k"], outwards: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """From the origin to the fitted quadric along the plane's normal, and the quadric's unit normal there."""
    total = np.maximum(weight.sum(axis=1), 1e-30)
    centred = offset - (np.einsum("pk,pkj->pj", weight, offset) / total[:, None])[:, None]
    _, axes = np.linalg.eigh(np.einsum("pk,pki,pkj->pij", weight, centred, centred))
    normal, *tangents = axes[..., 0], axes[..., 1], axes[..., 2]
    normal = np.where((normal * outwards).sum(axis=1, keepdims=True) < 0, -normal, normal)
    u, v = (np.einsum("pkj,pj->pk", offset, tangent) for tangent in tangents)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    weighted = terms * weight[..., None]
    left = np.einsum("pki,pkj->pij", weighted, terms) + _RIDGE * np.eye(6)
    right = np.einsum("pki,pk->pi", weighted, np.einsum("pkj,pj->pk", offset, normal))
    height, slope_u, slope_v = np.linalg.solve(left, right[..., None])[:, :3, 0].T
    tilted = normal - slope_u[:, None] * tangents[0] - slope_v[:, None] * tangents[1]
    return height[:, None] * normal, tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
