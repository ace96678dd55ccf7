"""Read meshes (PLY, OBJ, STL) and point clouds (PLY) of any program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.meshes.mesh import ply_triangles

FORMATS = (".ply", ".obj", ".stl")


def read_surface(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Vertices, in the file's unit, and triangles (none for a point cloud). Polygons are triangulated as fans.

    Raises:
        InputError: the file is missing, has another format, cannot be read, or has no points or points that are not
            finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give a point cloud (PLY) or a mesh (PLY, OBJ, STL).")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: is no file that can be compared; give a point cloud (PLY) or a mesh {FORMATS}.")
    try:
        vertices, triangles = _read_ply(path) if path.suffix.lower() == ".ply" else _read_mesh(path)
    except Exception as error:  # readers raise errors of many types
        raise InputError(f"{path}: cannot be read ({error!r}); export it again.") from error
    if not len(vertices):
        raise InputError(f"{path}: holds no surface and no points; export it again, clouds as PLY.")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some points are not at finite places; remove them or export it again.")
    return vertices, triangles


def _read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    # Memory-mapped: only three of a spectral cloud's hundreds of columns are read.
    content = PlyData.read(path)
    vertices = np.stack([np.asarray(content["vertex"][axis], float) for axis in "xyz"], axis=-1)
    return vertices, ply_triangles(content)


def _read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    read = trimesh.load_mesh(path, process=False)
    return np.asarray(read.vertices, float), np.asarray(read.faces, np.int64)
