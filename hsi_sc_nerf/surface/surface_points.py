"""Points spread evenly over the surface of a trained model (scene units).

The depth maps of the training frames are fused into a mesh, whose vertices are moved to the model's silhouettes.
Points are spread evenly over its area. Points that no frame sees are left out. The ray of the frame that sees a point
most from the front gives its spectrum: seen from the front, as the white reference was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.surface.depth_renders import DepthRenders
from hsi_sc_nerf.surface.regions import EVERYWHERE, Region, in_box
from hsi_sc_nerf.surface.silhouette_surface import move_to_silhouettes
from hsi_sc_nerf.surface.surface_depth import MIN_OPACITY, rendered_density
from hsi_sc_nerf.terminal import progress_bar

MAX_SHIFT = 0.02
"""Vertices of the mesh are moved by at most this along their normal (about 2 mm)."""
OPAQUE_WITHIN, _STEP = 0.1, 0.004
"""A vertex lies on a surface if a ray along its normal meets something opaque within this (about a centimetre)."""
_PILOT_POINTS = (1_000, 20_000)
_MARGIN = 1.02
"""Factor on the number of candidates, so that one more batch is rarely needed."""
MAX_BATCH = 2_000_000
"""Candidates at a time, which take 200 bytes each."""
MAX_CANDIDATES = 50
"""Candidates in all, as a multiple of the points to find, or of the largest batch where that is more."""
MIN_VOXEL = 1 / 160
"""Smallest voxel, as a fraction of the box's longest side: half a millimetre on a turntable. Voxels are not smaller
than the part of the surface that a cell of the depth maps covers either."""
TRUNCATION_VOXELS = 4
"""Signed distances are truncated at this many voxels from the surface."""
NORMAL_VERTICES = 8
"""Number of vertices over which normals are averaged: the normal of one vertex is as rough as the voxels."""


@dataclass(eq=False)
class SurfacePoints:
    """Points of the surface, and the training frames that see them most from the front.

    Attributes:
        points: positions.
        mesh_normals: outward unit normals of the fused mesh.
        frames: index of the training frame.
        xy_px: image coordinates (x, y) in that frame, from the upper left corner.
        incidence_deg: angle between the normal and the direction to that frame's camera.
    """

    points: Float[np.ndarray, "n 3"]
    mesh_normals: Float[np.ndarray, "n 3"]
    frames: Int[np.ndarray, "n"]
    xy_px: Float[np.ndarray, "n 2"]
    incidence_deg: Float[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: np.ndarray | slice) -> SurfacePoints:
        """The points that a slice, an index or a boolean array selects."""
        return SurfacePoints(*(column[rows] for column in vars(self).values()))

    @staticmethod
    def concatenate(parts: list[SurfacePoints]) -> SurfacePoints:
        """The points of all parts, in their order."""
        return SurfacePoints(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


def sample_surface_points(
    model: SpectralModel,
    renders: DepthRenders,
    num_points: int,
    rays_per_batch: int,
    box: Float[np.ndarray, "2 3"],
    region: Region = EVERYWHERE,
    touching_opacity: float = 0.5,
) -> SurfacePoints:
    """Points spread evenly over the surface that at least one training frame sees.

    Args:
        model: trained model, in evaluation mode.
        renders: depth maps of its training cameras.
        num_points: points to return; there are fewer if the region holds hardly any surface.
        rays_per_batch: rays searched at a time.
        box: minimum and maximum of the object, which exclude the container.
        region: the points to keep.
        touching_opacity: as in `move_to_silhouettes`.

    Raises:
        InputError: the model holds no object, or the region holds none of it.
    """
    mesh = surface_mesh(model, renders, box, rays_per_batch, touching_opacity)
    if mesh is None:
        raise InputError(
            "the model holds no object: it shows no surface inside the object's box; look in the dataset's report "
            "folder whether the masks show the object and not its container, and if they do, train longer."
        )
    found = 0

    def keep(candidates: Float[np.ndarray, "n 3"]) -> SurfacePoints:
        nonlocal found
        parts = []
        for start in range(0, len(candidates), rays_per_batch):
            seen = _seen(renders, mesh, candidates[start : start + rays_per_batch])
            kept = in_box(seen.points, box) & region.contains(seen.points, seen.mesh_normals)
            parts.append(seen.select(kept))
            found += len(parts[-1])
            update(found)
        return SurfacePoints.concatenate(parts)

    with progress_bar("spreading points", "points", num_points) as update:
        triangles = mesh.triangles_in(region.bounds)
        points = even_points(mesh.vertices, triangles, num_points, keep) if len(triangles) else None
    if points is None or not len(points):
        raise InputError("no point of the object lies in the selected region; make it larger.")
    return points


def even_points(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    count: int,
    keep: Callable[[Float[np.ndarray, "n 3"]], SurfacePoints],
) -> SurfacePoints:
    """``count`` points spread evenly over a mesh's area, after ``keep`` has rejected some candidates.

    The fraction of the candidates that are kept gives the number to try next. Surplus points are left out at random.

    Args:
        vertices: vertices of the mesh.
        triangles: triangles of the mesh.
        count: points to return; there are fewer if hardly any candidate is kept.
        keep: turns candidates on the mesh into as many or fewer points.
    """
    rng = np.random.default_rng(0)
    parts: list[SurfacePoints] = []
    found = tried = 0
    batch = int(np.clip(count, *_PILOT_POINTS))
    while found < count and tried < (MAX_CANDIDATES * max(count, MAX_BATCH) if found else MAX_BATCH):
        parts.append(keep(sample_surface(vertices, triangles, batch, seed=int(rng.integers(2**31)))))
        found, tried = found + len(parts[-1]), tried + batch
        needed = (count - found) * tried / found * _MARGIN + 1 if found else 10 * tried
        batch = min(int(needed), MAX_BATCH)
    return SurfacePoints.concatenate(parts).select(np.sort(rng.permutation(found)[:count]))


@torch.no_grad()
def _seen(renders: DepthRenders, mesh: SurfaceMesh, candidates: Float[np.ndarray, "n 3"]) -> SurfacePoints:
    """Points of the mesh that a frame sees."""
    points = torch.from_numpy(candidates).float().to(renders.depths.device)
    normals = torch.from_numpy(mesh.normals_at(candidates)).to(points)
    frames, xy_px, cosines = renders.most_frontal(points, normals)
    incidence_deg = torch.rad2deg(cosines.clamp_max(1.0).arccos())
    seen = frames >= 0
    columns = (points, normals, frames, xy_px, incidence_deg)
    return SurfacePoints(*(column[seen].cpu().numpy() for column in columns))


@torch.no_grad()
def surface_mesh(
    model: SpectralModel,
    renders: DepthRenders,
    box: Float[np.ndarray, "2 3"],
    points_per_batch: int,
    touching_opacity: float = 0.5,
) -> SurfaceMesh | None:
    """The fused mesh with its vertices moved to the model's silhouettes, without triangles off the model's surface.

    Args:
        model: trained model, in evaluation mode.
        renders: depth maps of its training cameras.
        box: minimum and maximum of the mesh, scene units.
        points_per_batch: vertices moved at a time.
        touching_opacity: as in `move_to_silhouettes`.

    Returns:
        The mesh; None if the frames show no surface in the box.
    """
    mesh = tsdf_fusion(renders, box)
    if mesh is None:
        return None
    vertices, kept = mesh.vertices.copy(), np.zeros(len(mesh.vertices), bool)
    normals = mesh.normals_at(mesh.vertices)
    floor, rise_length = float(box[0][2]), float(model.field.rise_length)

    def density_fn(points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 1"]:
        # Rays that touch the object's base would end in its support.
        return rendered_density(model, points) * (points[..., 2:] >= floor)

    with progress_bar("finding the surface", "points", len(vertices)) as update:
        for start in range(0, len(vertices), points_per_batch):
            rows = slice(start, start + points_per_batch)
            before, outward = (torch.from_numpy(a[rows]).float().to(model.device) for a in (mesh.vertices, normals))
            after = move_to_silhouettes(density_fn, before, outward, touching_opacity, rise_length)
            inwards = after[:, None] - outward[:, None] * torch.arange(0.0, OPAQUE_WITHIN, _STEP).to(after)[:, None]
            opacity = 1.0 - torch.exp(-density_fn(inwards)[..., 0].sum(dim=1) * _STEP)
            vertices[rows] = after.cpu().numpy()
            # Further away is another part of the surface, which has its own vertices.
            kept[rows] = (((after - before).norm(dim=-1) < MAX_SHIFT) & (opacity > MIN_OPACITY)).cpu().numpy()
            update(min(start + points_per_batch, len(vertices)))
    return SurfaceMesh(vertices, mesh.triangles[kept[mesh.triangles].all(axis=1)])


class SurfaceMesh(Mesh):
    """A mesh in any unit, with its normals at points and its triangles in a box."""

    def normals_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Outward unit normals: area-weighted mean over the ``NORMAL_VERTICES`` nearest vertices."""
        tree, vertex_normals = self._search
        _, nearest = tree.query(points, k=min(NORMAL_VERTICES, len(self.vertices)))
        return unit_vectors(vertex_normals[nearest.reshape(len(points), -1)].sum(axis=1))

    def triangles_in(self, box: Float[np.ndarray, "2 3"]) -> Int[np.ndarray, "near 3"]:
        """Triangles with an area whose bounding boxes touch a box."""
        corners = self.vertices[self.triangles]
        near = (corners.max(axis=1) >= box[0]) & (corners.min(axis=1) <= box[1])
        return self.triangles[near.all(axis=1) & (self.triangle_areas_m2() > 0.0)]

    @cached_property
    def _search(self) -> tuple[cKDTree, Float[np.ndarray, "v 3"]]:
        return cKDTree(self.vertices), self.area_weighted_normals()


@torch.no_grad()
def tsdf_fusion(renders: DepthRenders, box: Float[np.ndarray, "2 3"]) -> SurfaceMesh | None:
    """Mesh of the zero level of the mean truncated signed distance (Curless and Levoy 1996, SIGGRAPH).

    The mesh has a surface only where frames see one; nothing is closed. Voxels more than ``TRUNCATION_VOXELS`` behind
    a frame's depth map, or where it has no ray, take no distance from that frame.

    Args:
        renders: depth maps of all frames.
        box: minimum and maximum of the mesh, in the depth maps' unit.

    Returns:
        The mesh; None if the frames show no surface in the box.
    """
    from skimage.measure import marching_cubes

    points = renders.points[in_box(renders.points, box)]
    if len(points) == 0:
        return None
    intrinsics = renders.intrinsics
    distance = np.linalg.norm(renders.camera_to_world[:, :3, 3].cpu().numpy() - points.mean(axis=0), axis=1).mean()
    footprint = distance * renders.cell_px / min(intrinsics.fl_x, intrinsics.fl_y)
    voxel = max(float((box[1] - box[0]).max()) * MIN_VOXEL, footprint)
    truncation = TRUNCATION_VOXELS * voxel
    origin = box[0] - truncation
    shape = np.ceil((box[1] - box[0]) / voxel).astype(int) + 2 * TRUNCATION_VOXELS
    hit = np.zeros(shape, bool)
    hit[tuple(((points - origin) / voxel).astype(int).clip(0, shape - 1).T)] = True
    voxels = np.argwhere(ndimage.binary_dilation(hit, iterations=TRUNCATION_VOXELS))
    centres = torch.from_numpy((voxels + 0.5) * voxel + origin).float().to(renders.depths.device)
    total = torch.zeros(len(centres), device=centres.device)
    count = torch.zeros_like(total)
    for frame in range(len(renders.depths)):
        distances, depths = renders.depth_at(frame, centres)
        signed = depths - distances
        counts = signed > -truncation  # False for NaN
        total += torch.where(counts, signed.clamp(max=truncation), 0.0)
        count += counts
    known = tuple(voxels[(count > 0).cpu().numpy()].T)
    signed_distance = np.full(shape, truncation, np.float32)
    signed_distance[known] = (total / count)[count > 0].cpu().numpy()
    mask = np.zeros(shape, bool)
    mask[known] = True
    if not (signed_distance < 0.0).any():
        return None
    # scikit-image's "descent" is counted left-handed: it turns the triangles outwards.
    vertices, triangles, _, _ = marching_cubes(signed_distance, 0.0, mask=mask, gradient_direction="descent")
    return SurfaceMesh((vertices + 0.5) * voxel + origin, np.asarray(triangles, np.int64))
