"""Triangle meshes as plain arrays: area, volume, normals, ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.geometry.camera import unit_vectors

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in metres; triangles run counter-clockwise seen from outside.

    Area, volume and the test for holes are plain sums, because trimesh's take longer.

    Example:
        >>> triangle = Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0, 1, 2]]))
        >>> triangle.area_m2()
        0.5
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]

    def moved(self, offset: Float[np.ndarray, "3"]) -> Mesh:
        """The mesh shifted by ``offset`` (metres)."""
        return Mesh(self.vertices + offset, self.triangles)

    def area_m2(self) -> float:
        """Surface area."""
        return float(self.triangle_areas_m2().sum())

    def triangle_areas_m2(self) -> Float[np.ndarray, "t"]:
        """Area of each triangle."""
        return np.linalg.norm(self._doubled_normals(), axis=1) / 2.0

    def vertex_areas_m2(self) -> Float[np.ndarray, "v"]:
        """Surface area of each vertex: a third of each of its triangles. The areas add up to the mesh's area."""
        thirds = np.repeat(self.triangle_areas_m2() / 3.0, 3)
        return np.bincount(self.triangles.ravel(), thirds, minlength=len(self.vertices))

    def volume_m3(self) -> float:
        """Enclosed volume of a closed mesh (divergence theorem)."""
        first = self.vertices[self.triangles[:, 0]]
        return float(np.einsum("ij,ij->", first, self._doubled_normals()) / 6.0)

    def is_watertight(self) -> bool:
        """Whether each edge belongs to exactly two triangles that run along it in opposite directions."""
        t = self.triangles.astype(np.int64)
        start, end = t.ravel(), np.roll(t, -1, axis=1).ravel()
        n = len(self.vertices)
        forward, backward = np.sort(start * n + end), np.sort(end * n + start)
        return bool((np.diff(forward) > 0).all() and np.array_equal(forward, backward))

    def facet_normals(self) -> Float[np.ndarray, "t 3"]:
        """Outward unit normal of each triangle, 0 for one without an area."""
        return unit_vectors(self._doubled_normals())

    def vertex_normals(self) -> Float[np.ndarray, "v 3"]:
        """Outward unit normal of each vertex: the area-weighted mean of its triangles', 0 for a vertex of none."""
        return unit_vectors(self.area_weighted_normals())

    def area_weighted_normals(self) -> Float[np.ndarray, "v 3"]:
        """Sum of the outward normals of each vertex's triangles, each as long as twice the triangle's area."""
        corners, doubled = self.triangles.ravel(), np.repeat(self._doubled_normals(), 3, axis=0)
        return np.stack([np.bincount(corners, axis, len(self.vertices)) for axis in doubled.T], axis=-1)

    def pieces(self, labels: Int[np.ndarray, "v"] | None = None) -> Int[np.ndarray, "v"]:
        """Number of each vertex's connected piece, from 0.

        Args:
            labels: only edges between vertices of one label connect; all edges without it.
        """
        from trimesh.graph import connected_component_labels  # takes seconds, and the help does without it

        edges = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        if labels is not None:
            edges = edges[labels[edges[:, 0]] == labels[edges[:, 1]]]
        return connected_component_labels(edges, node_count=len(self.vertices))

    def _doubled_normals(self) -> Float[np.ndarray, "t 3"]:
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return np.cross(b - a, c - a)


def ray_scene(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> RaycastingScene:
    """A mesh as Open3D's scene for casting rays and measuring distances, in single precision."""
    from open3d.core import Tensor  # heavy; training and evaluation do without it
    from open3d.t.geometry import RaycastingScene

    scene = RaycastingScene()
    scene.add_triangles(Tensor(np.asarray(vertices, np.float32)), Tensor(np.asarray(triangles, np.uint32)))
    return scene


def rays_for_scene(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 6"]:
    """Rays as Open3D takes them: origin and direction in one row, single precision."""
    return np.concatenate([origins, directions], axis=1, dtype=np.float32)


def unoccluded(
    scene: RaycastingScene,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    nearest: float = 0.0,
) -> Bool[np.ndarray, "n"]:
    """Whether rays hit nothing; hits within ``nearest`` of a ray's origin do not count."""
    return ~scene.test_occlusions(rays_for_scene(origins, directions), tnear=nearest).numpy()
