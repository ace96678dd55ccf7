"""The object's closed surface from its points: smoothing, a base that closes what was not seen, screened Poisson."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.base import Base, find_base, lower_rim, lowest_edge_m
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.settings_file import between

# Smoothing radius over the spacing of thinned points: about thirty points determine a quadric.
_THINNING = 3.0
# Largest number of thinning cells along the cloud's longest side, for the sake of memory.
_MOST_CUBES = 5000
# Largest number of cells that an index holds.
_MOST_CELLS = 2.0**62
# Fraction of the triangles below which a connected piece is a speck.
_SMALLEST_PIECE = 0.001
NEIGHBOURS = 48
"""Points that a quadric is fitted to: several times its six coefficients."""
_CHUNK_POINTS = 1 << 14
# Added to the normal equations, so that few or collinear neighbours give a plane.
_RIDGE = 1e-6


@dataclass(frozen=True)
class MeshConfig:
    """How a cloud is closed to a mesh."""

    # With 4, Open3D makes as many triangles as with 5, but loses volume and floods the terminal.
    octree_depth: int = between(5, 12, default=paper.POISSON_DEPTH)
    """Depth of the Poisson reconstruction's octree: each step halves the mesh's triangles in size."""
    smoothing_radius_m: float = between(1e-6, 1.0, default=0.002)
    """Surface details smaller than this, in metres, are smoothed away as noise of the reconstruction."""
    base_height_m: float | None = between(-10.0, 10.0, default=None)
    """Height of the object's base above the turntable's disc, in metres (the container's height), where the unseen
    base is closed. Default: the lowest point of the cloud's edge."""


def closed_mesh(points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], config: MeshConfig) -> Mesh:
    """The closed surface of an upright object with a flat base.

    The points are thinned, the lower rim (half a smoothing radius) is removed, the rest is smoothed, and the unseen
    base is closed (`find_base`). Screened Poisson reconstruction (Kazhdan and Hoppe 2013; Open3D) gives the mesh;
    small pieces are removed.

    Args:
        points_m: the seen surface, z up.
        normals: mostly outward; single ones may be wrong.
        config: settings.

    Raises:
        InputError: as `surface_and_base`.
    """
    return closed(*surface_and_base(points_m, normals, config), config)


def surface_and_base(
    points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], config: MeshConfig
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], Base]:
    """The thinned and smoothed points of the seen surface, their outward unit normals, and the base that closes it.

    Args:
        points_m: the seen surface, z up.
        normals: mostly outward; single ones may be wrong.
        config: settings.

    Raises:
        InputError: there are too few points, they lie in one place or too far apart, they have no normals or such as
            do not point outwards, or they end below the base.
    """
    if len(points_m) < NEIGHBOURS or np.ptp(points_m, axis=0).min() <= 0.0 or not np.isfinite(points_m).all():
        raise InputError(
            f"the cloud has {len(points_m)} points that do not surround a solid; export more points of the object."
        )
    if unknown := np.count_nonzero(~np.isfinite(normals).all(axis=1)):
        raise InputError(f"{unknown} of the cloud's points have no normal; take them away, or export it again.")
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
    # The divergence theorem: seen from the open foot, outward normals give a positive volume.
    from_foot = points - [*points[:, :2].mean(axis=0), points[:, 2].min()]
    if not np.einsum("pi,pi->", from_foot, facing) > 0.0:
        raise InputError("the cloud's normals do not point out of the object; flip them, or export the cloud again.")
    points, outward = smoothed(points, facing, config.smoothing_radius_m)
    return points, outward, find_base(points, outward, base_height_m)


def closed(
    points_m: Float[np.ndarray, "n 3"], outward: Float[np.ndarray, "n 3"], base: Base, config: MeshConfig
) -> Mesh:
    """The closed surface of the seen points and a base, as `surface_and_base` gives them."""
    base_points, base_normals = base.points(config.smoothing_radius_m / _THINNING)
    points, normals = np.concatenate([points_m, base_points]), np.concatenate([outward, base_normals])
    return solid_pieces(_poisson(points, normals, config.octree_depth))


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
    """The connected pieces of positive volume that are not tiny, without unused vertices.

    A stem apart from its fruit is kept; specks and bubbles inside the object (negative volume) are removed.
    """
    piece = mesh.pieces()[mesh.triangles[:, 0]]
    fraction = np.bincount(piece) / len(piece)
    a, b, c = (mesh.vertices[corner] for corner in mesh.triangles.T)
    volume = np.bincount(piece, np.einsum("ij,ij->i", a, np.cross(b, c)))
    triangles = mesh.triangles[((fraction >= _SMALLEST_PIECE) & (volume > 0.0))[piece]]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return Mesh(mesh.vertices[used], renumbered.reshape(triangles.shape))


def open_edges(mesh: Mesh) -> int:
    """Number of edges whose triangles do not cancel in direction; a mesh without such edges encloses a volume.

    Unlike `Mesh.is_watertight`, this allows four triangles at an edge, where two parts of a surface touch.
    """
    t = mesh.triangles.astype(np.int64)
    start, end = t.ravel(), np.roll(t, -1, axis=1).ravel()
    edge, which = np.unique(np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end), return_inverse=True)
    return int(np.count_nonzero(np.bincount(which, np.where(start < end, 1.0, -1.0), minlength=len(edge))))


def thinned(
    points_m: Float[np.ndarray, "n 3"], columns: Float[np.ndarray, "n k"], cell_m: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m k"]]:
    """Voxel downsampling: mean position and mean columns, such as a normal, of the points in each cell.

    Raises:
        InputError: points are not finite, or so far apart that their cells cannot be numbered.
    """
    if not np.prod(np.ptp(points_m, axis=0) / cell_m + 2.0, dtype=float) < _MOST_CELLS:
        raise InputError(
            "the cloud has points that are not finite or kilometres apart; is it in metres? Scale it to metres, and "
            "take away such points."
        )
    cells = np.floor((points_m - points_m.min(axis=0)) / cell_m).astype(np.int64)
    shape = cells.max(axis=0) + 1
    _, cell = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)
    count = np.bincount(cell)
    mean = [np.bincount(cell, column) / count for column in np.concatenate([points_m, columns], axis=1).T]
    return np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)


def smoothed(
    points_m: Float[np.ndarray, "n 3"], facing: Float[np.ndarray, "n 3"], radius_m: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Move each point onto the quadric that fits its neighbours best.

    Moving least squares (Alexa et al. 2003, "Computing and Rendering Point Set Surfaces"): a plane by principal
    components, over it a quadric by weighted least squares. A quadric, unlike a mean, does not shrink what is curved.

    Args:
        points_m: positions, at least three.
        facing: vectors of any length that mostly point outwards.
        radius_m: neighbours at this distance have the weight exp(-2); smaller features are smoothed away. In sparse
            parts the distance to the twelfth neighbour is used instead.

    Returns:
        Positions, and unit normals on the side of ``facing``.
    """
    positions, normals = np.empty((len(points_m), 3)), np.empty((len(points_m), 3))
    tree = cKDTree(points_m)
    count = min(NEIGHBOURS, len(points_m))
    for start in range(0, len(points_m), _CHUNK_POINTS):
        chunk = slice(start, start + _CHUNK_POINTS)
        distance_m, neighbour = tree.query(points_m[chunk], count, workers=-1)
        scale_m = np.maximum(radius_m, distance_m[:, min(count - 1, NEIGHBOURS // 4)])[:, None]
        weight = np.exp(-2.0 * (distance_m / scale_m) ** 2)
        outwards = np.einsum("pk,pkj->pj", weight, facing[neighbour])
        # Leaves out points on the other side of a thin part.
        weight *= np.einsum("pkj,pj->pk", facing[neighbour], outwards) > 0
        offset = (points_m[neighbour] - points_m[chunk, None]) / scale_m[..., None]
        height, normals[chunk] = _quadric(offset, weight, outwards)
        positions[chunk] = points_m[chunk] + scale_m * height
    return positions, normals


def _quadric(
    offset: Float[np.ndarray, "p k 3"], weight: Float[np.ndarray, "p k"], outwards: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    """Offset from the origin to the fitted quadric, and the quadric's unit normal there."""
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
