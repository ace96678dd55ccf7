"""Triangle meshes as plain arrays: area, volume, and casting rays at them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in metres; triangles run counter-clockwise seen from outside."""

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

    def _doubled_normals(self) -> Float[np.ndarray, "t 3"]:
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return np.cross(b - a, c - a)


def ray_scene(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> RaycastingScene:
    """A mesh as Open3D casts rays at it and measures distances to it, in single precision."""
    from open3d.core import Tensor  # heavy, and training and evaluation do without it
    from open3d.t.geometry import RaycastingScene

    scene = RaycastingScene()
    scene.add_triangles(Tensor(np.asarray(vertices, np.float32)), Tensor(np.asarray(triangles, np.uint32)))
    return scene
