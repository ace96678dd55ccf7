"""The parts of Open3D that this project uses, by embreex; only benchmarks/gpu.py puts this file on the path."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene


class Tensor:
    """An array."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = np.asarray(array)

    @classmethod
    def from_numpy(cls, array: np.ndarray) -> Tensor:
        """The array as a tensor; nothing is copied."""
        return cls(array)

    def numpy(self) -> np.ndarray:
        """The tensor as an array."""
        return self.array


class RaycastingScene:
    """Triangles at which rays are cast; a ray is (origin, unit direction)."""

    INVALID_ID = 4294967295

    def __init__(self) -> None:
        self._scene = EmbreeScene(robust=True)

    def add_triangles(self, vertices: Tensor, triangles: Tensor) -> None:
        """Put a mesh into the scene."""
        self._kept = np.ascontiguousarray(vertices.array, np.float32), triangles.array.astype(np.int32)
        self._mesh = TriangleMesh(self._scene, *self._kept)

    def cast_rays(self, rays: Tensor | np.ndarray) -> dict[str, Tensor]:
        """Where rays hit first: the triangle (INVALID_ID for none), barycentric coordinates, distance."""
        found = self._scene.run(*_split(rays), output=True)
        triangle = np.where(found["geomID"] < 0, -1, found["primID"]).astype(np.int64) & 0xFFFFFFFF
        return {
            "primitive_ids": Tensor(triangle.astype(np.uint32)),
            "primitive_uvs": Tensor(np.stack([found["u"], found["v"]], axis=-1)),
            "t_hit": Tensor(np.where(found["geomID"] < 0, np.inf, found["tfar"])),
        }

    def test_occlusions(self, rays: Tensor | np.ndarray, tnear: float = 0.0) -> Tensor:
        """Whether rays hit anything further away than ``tnear`` (metres)."""
        origins, directions = _split(rays)
        hit = self._scene.run(origins + np.float32(tnear) * directions, directions, query="OCCLUDED")
        return Tensor(np.asarray(hit) == 0)


def _split(rays: Tensor | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    array = rays.array if isinstance(rays, Tensor) else np.asarray(rays)
    return np.ascontiguousarray(array[:, :3]), np.ascontiguousarray(array[:, 3:])


# ``open3d.core``, ``open3d.t`` and ``open3d.t.geometry`` are modules of their own.
core, t, geometry = (ModuleType(f"open3d.{name}") for name in ("core", "t", "t.geometry"))
core.Tensor, t.geometry, geometry.RaycastingScene = Tensor, geometry, RaycastingScene  # type: ignore[attr-defined]
sys.modules |= {module.__name__: module for module in (core, t, geometry)}
