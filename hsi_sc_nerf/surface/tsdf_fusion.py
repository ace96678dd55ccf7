"""Fuse depth maps into a mesh of the surface, in the depth maps' unit."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.surface.depth_renders import DepthRenders
from hsi_sc_nerf.surface.regions import in_box

MIN_VOXEL = 1 / 160
"""Smallest voxel, as a fraction of the box's longest side: half a millimetre on a turntable. Voxels are not smaller
than the part of the surface that a cell of the depth maps covers either."""
TRUNCATION_VOXELS = 4
"""Signed distances are truncated at this many voxels from the surface."""
NORMAL_VERTICES = 8
"""Normals are means over this many vertices: those of one vertex are as rough as the voxels."""


class SurfaceMesh(Mesh):
    """A mesh in any unit, with its normals at points and its triangles near a box."""

    def normals_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Outward unit normals: area-weighted mean over the ``NORMAL_VERTICES`` nearest vertices."""
        tree, vertex_normals = self._search
        _, nearest = tree.query(points, k=min(NORMAL_VERTICES, len(self.vertices)))
        normals = vertex_normals[nearest.reshape(len(points), -1)].sum(axis=1)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)

    def triangles_near(self, box: Float[np.ndarray, "2 3"], margin: float) -> Int[np.ndarray, "near 3"]:
        """Triangles with an area whose bounding boxes come within ``margin`` of a box in each direction."""
        corners = self.vertices[self.triangles]
        near = (corners.max(axis=1) >= box[0] - margin) & (corners.min(axis=1) <= box[1] + margin)
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
