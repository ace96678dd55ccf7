"""How uncertain an object's sizes are: by the scatter of single points, and by what all points have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, Size, closed, closed_mesh, size_of, surface_and_base
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.packed.dataset import PackedDataset

VARIED_DEPTH = 6
"""Octree depth of the meshes that are compared, which is enough for differences and saves two thirds of the time."""
SURFACE_PX = 0.07
"""Standard deviation of where training puts the surface, in pixels on the object (docs/validation/surface.md)."""
UNKNOWN_BASE_PX = 1.0
"""The same of the base, where its height is that of the cloud's edge: masks end within a pixel of the base."""
FOOT = 0.5
"""Standard deviation of how far the surface continues under itself, as a fraction of what its slope says."""
COARSER = 2.0
"""Factor on the smoothing radius. What this changes, finer detail than the smoothing is expected to change again."""
DIMENSIONS = np.array([2.0, 3.0, 1.0, 1.0, 1.0, 1.0])
"""Powers of a length in the sizes, in their order."""


@dataclass(frozen=True)
class SharedErrors:
    """Standard deviations of what the points of a cloud have in common.

    Attributes:
        scale: of lengths, as a fraction.
        surface_m: of the place of the whole surface along its normal.
        base_m: of the height of the plane that the object stands on; 0 where it is given.
    """

    scale: float
    surface_m: float
    base_m: float


def size_uncertainty(
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    mesh: Mesh,
    config: MeshConfig,
    splits: int,
    shared: SharedErrors | None = None,
    done: Callable[[int], None] | None = None,
) -> dict[str, Size]:
    """Standard deviation of each size by its cause; the causes are independent.

    points: random halves of the cloud are meshed (half-samples, McCarthy 1969). base: the unseen base is closed
    straight down instead of along the surface's slope, and at another height. detail: smoothing by twice the radius.
    scale and surface: of ``shared``; without it they are left out.

    Args:
        points_m: the cloud.
        normals: of the cloud.
        mesh: its `closed_mesh`.
        config: settings of the mesh.
        splits: pairs of halves.
        shared: what the points have in common, if it is known.
        done: called with the number of finished sizes, of `sizes_to_find`.

    Example:
        >>> parts = size_uncertainty(cloud.points, cloud.normals, mesh, MeshConfig(), splits=6)
        >>> combined(parts).volume_l
        0.0021
    """
    config = replace(config, octree_depth=min(config.octree_depth, VARIED_DEPTH))
    finished = 0

    def size(varied: Mesh) -> np.ndarray:
        nonlocal finished
        finished += 1
        if done is not None:
            done(finished)
        return np.array(astuple(size_of(varied)))

    parts: dict[str, np.ndarray] = {}
    if splits:
        rng = np.random.default_rng(0)
        halves = (np.array_split(rng.permutation(len(points_m)), 2) for _ in range(splits))
        sizes = np.array([[size(closed_mesh(points_m[h], normals[h], config)) for h in pair] for pair in halves])
        # Half the difference of halves scatters as the whole. A bootstrap would scatter less: thinning merges points.
        parts["points"] = np.sqrt(np.mean(np.square(sizes[:, 0] - sizes[:, 1]), axis=0)) / 2.0
    surface = surface_and_base(points_m, normals, config)
    usual = size(closed(*surface, config))
    straight = replace(surface[2], foot_radius_m=surface[2].edge_radius_m)
    parts["base"] = np.abs(FOOT * (size(closed(*surface[:2], straight, config)) - usual))
    coarser = replace(config, smoothing_radius_m=COARSER * config.smoothing_radius_m)
    parts["detail"] = np.abs(size(closed(*surface_and_base(points_m, normals, coarser), coarser)) - usual)
    if shared is not None:
        if shared.base_m > 0.0:
            lower = replace(surface[2], height_m=surface[2].height_m - shared.base_m)
            parts["base"] = np.hypot(parts["base"], size(closed(*surface[:2], lower, config)) - usual)
        whole = size_of(mesh)
        parts["scale"] = shared.scale * np.array(astuple(whole)) * DIMENSIONS
        parts["surface"] = np.abs(size(offset(mesh, shared.surface_m)) - np.array(astuple(whole)))
    return {cause: Size(*values.tolist()) for cause, values in parts.items()}


def sizes_to_find(splits: int, shared: SharedErrors | None) -> int:
    """How many sizes `size_uncertainty` measures."""
    return 2 * splits + 3 + (0 if shared is None else 1 + (shared.base_m > 0.0))


def combined(parts: Mapping[str, Size]) -> Size:
    """Standard deviation of each size by all causes together."""
    return Size(*np.sqrt(np.square([astuple(size) for size in parts.values()]).sum(axis=0)).tolist())


def shared_errors(dataset: PackedDataset, *, base_known: bool) -> SharedErrors:
    """What the points of a cloud of this dataset have in common: scale by its poses, the rest by its pixels.

    Args:
        dataset: its ``poses.json`` gives the uncertainty of the scale; without it the scale is taken for exact.
        base_known: whether the height that the object stands on is known.

    Raises:
        InputError: ``poses.json`` cannot be read.
    """
    pixel_m = pixel_on_object_m(dataset)
    return SharedErrors(
        scale=_scale_uncertainty(dataset.root / "poses.json"),
        surface_m=SURFACE_PX * pixel_m,
        base_m=0.0 if base_known else UNKNOWN_BASE_PX * pixel_m,
    )


def pixel_on_object_m(dataset: PackedDataset) -> float:
    """Side of a pixel in the middle of the object, as the mean of all frames."""
    centre_m = dataset.object_box_m.mean(axis=0)
    eyes_m = np.stack([frame.camera_to_world[:3, 3] for frame in dataset.frames])
    return float(np.linalg.norm(eyes_m - centre_m, axis=1).mean()) / dataset.intrinsics.fl_x


def offset(mesh: Mesh, distance_m: float) -> Mesh:
    """The mesh with its vertices moved outwards, but none below its base."""
    vertices = mesh.vertices + distance_m * mesh.vertex_normals()
    vertices[:, 2] = np.maximum(vertices[:, 2], mesh.vertices[:, 2].min())
    return Mesh(vertices, mesh.triangles)


def _scale_uncertainty(path: Path) -> float:
    """As a fraction; 0 where it is not known."""
    if not path.is_file():
        return 0.0
    scale = read_json(path, "process the session again").get("scale") or {}
    return float(scale.get("uncertainty_percent") or 0.0) / 100.0
