"""A mesh of the surface that depth maps show, on which points can be spread evenly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.surface.visibility import DepthMaps

FINEST_VOXEL = 1 / 160
"""Of the longest side of the box: half a millimetre on what stands on a turntable. Voxels are no smaller than what a
cell of the depth maps covers on the surface."""
BAND_VOXELS = 4
"""Signed distances are kept this far around the surface."""
NORMAL_VERTICES = 8


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles, corners counter-clockwise seen from outside."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]

    def normals_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Outward unit normals: mean of the triangles at the ``NORMAL_VERTICES`` nearest vertices, weighted by area.

        One vertex's own are as rough as the voxels, above all where the mesh ends.
        """
        _, nearest = self._nearest.query(points, k=min(NORMAL_VERTICES, len(self.vertices)))
        normals = self._vertex_normals[nearest.reshape(len(points), -1)].sum(axis=1)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)

    def triangles_near(self, box: Float[np.ndarray, "2 3"], margin: float) -> Int[np.ndarray, "near 3"]:
        """Those with an area whose own bounding box comes within ``margin`` of a box in each direction."""
        corners = self.vertices[self.triangles]
        near = (corners.max(axis=1) >= box[0] - margin) & (corners.min(axis=1) <= box[1] + margin)
        return self.triangles[near.all(axis=1) & (Mesh(self.vertices, self.triangles).triangle_areas_m2() > 0.0)]

    @cached_property
    def _nearest(self) -> cKDTree:
        return cKDTree(self.vertices)

    @cached_property
    def _vertex_normals(self) -> np.ndarray:
        corners = self.vertices[self.triangles]
        doubled_areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = np.zeros_like(self.vertices)
        for corner in range(3):
            np.add.at(normals, self.triangles[:, corner], doubled_areas)
        return normals


@torch.no_grad()
def fuse_depth_maps(
    maps: DepthMaps, points: Float[np.ndarray, "n 3"], box: Float[np.ndarray, "2 3"]
) -> SurfaceMesh | None:
    """Mesh of the zero level of the mean truncated signed distance (Curless and Levoy 1996, SIGGRAPH).

    There is a surface only where frames see one: nothing is closed. A frame says nothing of where nobody looked or
    what lies more than ``BAND_VOXELS`` behind what it sees.

    Args:
        maps: depth maps of all frames.
        points: places on the surface, so many that few of its voxels are without one.
        box: minimum and maximum of the mesh.

    Returns:
        The mesh, in the unit of the depth maps; None where the frames show no surface.
    """
    from skimage.measure import marching_cubes

    if len(points) == 0:
        return None
    distance = np.linalg.norm(maps.camera_to_world[:, :3, 3].cpu().numpy() - points.mean(axis=0), axis=1).mean()
    footprint = distance * maps.cell_px / min(maps.intrinsics.fl_x, maps.intrinsics.fl_y)
    voxel = max(float((box[1] - box[0]).max()) * FINEST_VOXEL, footprint)
    origin = box[0] - BAND_VOXELS * voxel
    shape = np.ceil((box[1] - box[0]) / voxel).astype(int) + 2 * BAND_VOXELS
    hit = np.zeros(shape, bool)
    hit[tuple(((points - origin) / voxel).astype(int).clip(0, shape - 1).T)] = True
    voxels = np.argwhere(ndimage.binary_dilation(hit, iterations=BAND_VOXELS))
    centres = torch.from_numpy((voxels + 0.5) * voxel + origin).float().to(maps.depths.device)
    band = BAND_VOXELS * voxel
    total = torch.zeros(len(centres), device=centres.device)
    count = torch.zeros_like(total)
    for frame in range(len(maps.depths)):
        distances, depths = maps.depth_behind(frame, centres)
        signed = depths - distances
        counts = signed > -band  # NaN: nobody looked
        total += torch.where(counts, signed.clamp(max=band), 0.0)
        count += counts
    known = (count > 0).cpu().numpy()
    signed_distance = np.full(shape, band, np.float32)
    signed_distance[tuple(voxels[known].T)] = (total / count)[count > 0].cpu().numpy()
    seen = np.zeros(shape, bool)
    seen[tuple(voxels[known].T)] = True
    if not (signed_distance < 0.0).any():
        return None
    # Its directions count by the left hand.
    vertices, triangles, _, _ = marching_cubes(signed_distance, 0.0, mask=seen, gradient_direction="descent")
    return SurfaceMesh((vertices + 0.5) * voxel + origin, np.asarray(triangles, np.int64))
