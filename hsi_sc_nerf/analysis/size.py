"""An object's sizes, and how uncertain they are.

Uncertainty comes from the scatter of single points, and from what all points have in common.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed, closed_mesh, surface_and_base
from hsi_sc_nerf.analysis.surface_errors import hollow_std_m, most_frontal_cosine, surface_std_m
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import content_of, read_json
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.packed.dataset import PackedDataset

VARIED_DEPTH = 6
"""Octree depth of the meshes that are compared, which is enough for differences and saves two thirds of the time."""
UNKNOWN_BASE_PX = 1.0
"""Standard deviation of the base's height in pixels on the object, where it is that of the cloud's edge: masks end
within a pixel of the base."""
HOLLOW_BASE = 0.1
"""Standard deviation of how deep the unseen base is hollow, as a fraction of its radius: many fruits have a basin. A
cone of a tenth holds as much as the basin of an apple, 8 mm deep and 25 mm wide."""
COARSER = 2.0
"""Factor on the smoothing radius. What this changes, finer detail than the smoothing is expected to change again."""
LITRES_PER_M3 = 1000.0
DIMENSIONS = np.array([2.0, 3.0, 1.0, 1.0, 1.0, 1.0])
"""Powers of a length in the sizes, in their order."""


@dataclass(frozen=True)
class Size:
    """Sizes of an object that stands upright.

    Attributes:
        area_m2: surface area, base included.
        volume_l: enclosed volume, litres.
        height_m: from lowest to highest, along the turntable's axis.
        largest_diameter_m: largest width seen from above over all directions (largest Feret diameter).
        smallest_diameter_m: smallest such width (smallest Feret diameter).
        equivalent_diameter_m: diameter of the sphere of the same volume.
    """

    area_m2: float
    volume_l: float
    height_m: float
    largest_diameter_m: float
    smallest_diameter_m: float
    equivalent_diameter_m: float


def size_of(mesh: Mesh) -> Size:
    """Sizes of a closed mesh whose z points up.

    Example:
        >>> size_of(closed_mesh(cloud.points, cloud.normals, MeshConfig())).volume_l
        0.21
    """
    largest, smallest = feret_diameters(mesh.vertices[:, :2])
    volume_m3 = mesh.volume_m3()
    return Size(
        area_m2=mesh.area_m2(),
        volume_l=volume_m3 * LITRES_PER_M3,
        height_m=float(np.ptp(mesh.vertices[:, 2])),
        largest_diameter_m=largest,
        smallest_diameter_m=smallest,
        equivalent_diameter_m=float(np.cbrt(6.0 * volume_m3 / np.pi)),
    )


def feret_diameters(outline: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Largest and smallest distance between parallel lines that enclose the points.

    Exact: the largest is the greatest distance of two corners of the convex hull, the smallest lies across one of
    its edges (Toussaint 1983, "Solving geometric problems with the rotating calipers").
    """
    corners = outline[ConvexHull(outline).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    across = np.stack([-edges[:, 1], edges[:, 0]], axis=-1) / np.linalg.norm(edges, axis=1, keepdims=True)
    widths = np.ptp(corners @ across.T, axis=0)
    distances = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    return float(distances.max()), float(widths.min())


@dataclass(frozen=True)
class SystematicErrors:
    """Standard deviations of what the points of a cloud have in common, for the closed mesh of the cloud.

    Attributes:
        scale: of lengths, as a fraction.
        base_m: of the height of the plane that the object stands on; 0 where it is given.
        surface_m: of the place of each vertex of the mesh along its normal (`surface_std_m`).
        hollow_m: of the depth of each vertex in a hollow (`hollow_std_m`).
    """

    scale: float
    base_m: float
    surface_m: Float[np.ndarray, "v"]
    hollow_m: Float[np.ndarray, "v"]


def size_uncertainty(
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    mesh: Mesh,
    config: MeshConfig,
    splits: int,
    systematic: SystematicErrors | None = None,
    done: Callable[[int], object] = int,
) -> dict[str, Size]:
    """Standard deviation of each size by its cause; the causes are independent.

    points: random halves of the cloud are meshed (half-samples, McCarthy 1969). base: the unseen base is closed
    on a straight line instead of the surface's arc, is hollow, and lies at another height. detail: smoothing by twice
    the radius. scale, surface and hollows: of ``systematic``; without it they are left out.

    Args:
        points_m: the cloud.
        normals: normals of the cloud.
        mesh: its `closed_mesh`.
        config: settings of the mesh.
        splits: pairs of halves.
        systematic: what the points have in common, if it is known.
        done: called with the number of finished sizes, of `sizes_to_find`.

    Raises:
        InputError: the object is too small to be smoothed by twice the radius.

    Example:
        >>> parts = size_uncertainty(cloud.points, cloud.normals, mesh, MeshConfig(), splits=6)
        >>> combined(parts).volume_l
        0.0021
    """
    config = replace(config, octree_depth=min(config.octree_depth, VARIED_DEPTH))
    coarser = replace(config, smoothing_radius_m=COARSER * config.smoothing_radius_m)
    try:
        coarse = surface_and_base(points_m, normals, coarser)
    except InputError as error:
        raise InputError(f"the uncertainty of sizes also needs twice the smoothing radius, and {error}") from error
    finished = itertools.count(1)

    def size(varied: Mesh) -> np.ndarray:
        done(next(finished))
        return np.array(astuple(size_of(varied)))

    parts: dict[str, np.ndarray] = {}
    if splits:
        rng = np.random.default_rng(0)
        halves = (np.array_split(rng.permutation(len(points_m)), 2) for _ in range(splits))
        sizes = np.array([[size(closed_mesh(points_m[h], normals[h], config)) for h in pair] for pair in halves])
        # Half the difference of halves scatters as the whole. A bootstrap would scatter less: thinning merges points.
        parts["points"] = np.sqrt(np.mean(np.square(sizes[:, 0] - sizes[:, 1]), axis=0)) / 2.0
    seen, outward, base = surface_and_base(points_m, normals, config)
    usual = size(closed(seen, outward, base, config))
    others = [replace(base, curvature_per_m=np.zeros_like(base.curvature_per_m)), replace(base, hollow=HOLLOW_BASE)]
    if systematic is not None and systematic.base_m > 0.0:
        others.append(replace(base, height_m=base.height_m - systematic.base_m))
    changes = [size(closed(seen, outward, other, config)) - usual for other in others]
    parts["base"] = np.sqrt(np.square(changes).sum(axis=0))
    parts["detail"] = np.abs(size(closed(*coarse, coarser)) - usual)
    if systematic is not None:
        whole = np.array(astuple(size_of(mesh)))
        parts["scale"] = systematic.scale * whole * DIMENSIONS
        for cause, outwards_m in {"surface": systematic.surface_m, "hollows": -systematic.hollow_m}.items():
            parts[cause] = np.abs(size(offset(mesh, outwards_m)) - whole)
    return {cause: Size(*values.tolist()) for cause, values in parts.items()}


def sizes_to_find(splits: int, systematic: SystematicErrors | None) -> int:
    """How many sizes `size_uncertainty` measures."""
    return 2 * splits + 4 + (0 if systematic is None else 2 + (systematic.base_m > 0.0))


def combined(parts: Mapping[str, Size]) -> Size:
    """Standard deviation of each size by all causes together."""
    return Size(*np.sqrt(np.square([astuple(size) for size in parts.values()]).sum(axis=0)).tolist())


def systematic_errors(mesh: Mesh, dataset: PackedDataset, *, base_known: bool) -> SystematicErrors:
    """What the points of a cloud of this dataset have in common: scale by its poses, the rest by its views.

    Args:
        mesh: the closed mesh of the cloud.
        dataset: its ``poses.json`` gives the uncertainty of the scale; without it the scale is taken for exact.
        base_known: whether the height that the object stands on is known.

    Raises:
        InputError: ``poses.json`` or a mask cannot be read.
    """
    pixel_m, poses = pixel_on_object_m(dataset), dataset.camera_to_worlds
    masks = np.stack([dataset.mask_of(frame) for frame in dataset.frames])
    cosine = most_frontal_cosine(mesh, poses[:, :3, 3])
    return SystematicErrors(
        scale=scale_uncertainty(dataset.root / "poses.json"),
        base_m=0.0 if base_known else UNKNOWN_BASE_PX * pixel_m,
        surface_m=surface_std_m(cosine, pixel_m),
        hollow_m=hollow_std_m(mesh, cosine, masks, poses, dataset.intrinsics, pixel_m),
    )


def pixel_on_object_m(dataset: PackedDataset) -> float:
    """Side of a pixel in the middle of the object, as the mean of all frames."""
    centre_m = dataset.object_box_m.mean(axis=0)
    distances_m = np.linalg.norm(dataset.camera_to_worlds[:, :3, 3] - centre_m, axis=1)
    return float(distances_m.mean()) / dataset.intrinsics.fl_x


def offset(mesh: Mesh, distance_m: Float[np.ndarray, "v"]) -> Mesh:
    """The mesh with its vertices moved outwards, but none below its base."""
    vertices = mesh.vertices + distance_m[:, None] * mesh.vertex_normals()
    vertices[:, 2] = np.maximum(vertices[:, 2], mesh.vertices[:, 2].min())
    return Mesh(vertices, mesh.triangles)


def scale_uncertainty(path: Path) -> float:
    """Of a dataset's scale by its ``poses.json``, as a fraction; 0 where it is not known.

    Raises:
        InputError: the file cannot be read, or holds something else there.
    """
    if not path.is_file():
        return 0.0
    again = "process the session again"
    content = read_json(path, again)
    with content_of(path, "uncertainty of the scale in percent", again):
        percent = float((content.get("scale") or {}).get("uncertainty_percent") or 0.0)
        if not 0.0 <= percent < math.inf:
            raise ValueError("it is not 0 or more")
    return percent / 100.0
