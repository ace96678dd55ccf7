"""A user's own mesh as the scanned object: reading, scaling, material fractions and checks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.geometry.ply_file import read_ply
from hsi_sc_nerf.simulate.mesh import snapped, welded
from hsi_sc_nerf.simulate.scene import OwnMesh

Y_UP_FORMATS = (".gltf", ".glb")
"""The y axis of glTF is vertical by specification; most tools write PLY and OBJ with a vertical z axis."""
FORMATS = (".ply", ".obj", *Y_UP_FORMATS)
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
HEIGHTS_M = (0.01, 0.5)
WIDEST_M = 1.0
MERGE_DISTANCE = 1e-6
"""Distance below which vertices are merged, as a fraction of the mesh size; exporters repeat vertices at UV seams."""
CHANNELS = 3
"""Colour channels of vertex colours, each the fraction of one material."""


def load(settings: OwnMesh) -> tuple[Mesh, Float[np.ndarray, "v materials"]]:
    """Read a mesh, place it on z = 0 with its bounding box centred on the axis, and determine its materials.

    Fractions are interpolated linearly between vertices. Triangles of the result are counter-clockwise seen from
    outside.

    Returns:
        The mesh in metres, and the fraction of each material at each vertex.

    Raises:
        InputError: a file is missing or cannot be read; it has no triangles, is not closed, or is not of a size
            that fits on the turntable; the materials' fractions or colours are missing or do not fit.
    """
    vertices, triangles, colours = _read_mesh_file(settings.mesh_file)
    vertices = _upright_and_scaled(vertices, settings)
    if len(settings.materials) == 1:
        weights = np.ones((len(vertices), 1))
    elif (given := _vertex_weights(settings)) is not None:
        if len(given) != len(vertices):
            raise InputError(f"{settings.mesh_file}: its vertices and faces are inconsistent; export it again.")
        weights = _normalised_weights(given, f"{settings.mesh_file}: the weights of some vertices")
    elif colours is not None:
        if len(settings.materials) > CHANNELS:
            raise InputError(
                f"{settings.mesh_file}: vertex colours can represent {CHANNELS} materials (red, green, blue), not "
                f"{len(settings.materials)}; name fewer, or use a PLY with vertex properties weight_NAME."
            )
        used = colours[:, : len(settings.materials)]
        weights = _normalised_weights(used, f"{settings.mesh_file}: the colours of some vertices")
    else:
        raise InputError(
            f"{settings.mesh_file}: does not locate its materials {', '.join(settings.materials)}; give it vertex "
            f"properties weight_{settings.materials[0]} and so on (PLY) or vertex colours."
        )
    mesh, weights = welded(vertices, triangles, weights)
    return _facing_outwards(mesh, settings.mesh_file), weights


def _read_mesh_file(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices (v, 3), which may be repeated along seams, triangles (t, 3), and colours (v, 3) where all have one."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of the mesh, relative to the scene file.")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: is not a mesh format that can be read; give one of {', '.join(FORMATS)}.")
    if path.suffix.lower() == ".ply":
        read_ply(path)  # trimesh does not check the counts in a header
    try:
        # UVs of PLY faces would split vertices, which then no longer match the file's vertex properties.
        read = trimesh.load_scene(path, process=False, fix_texture=False).dump()
    except Exception as error:  # the readers raise many kinds of exceptions
        raise InputError(f"{path}: cannot be read as a mesh ({error!r}); export it again.") from error
    parts = [part for part in read if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise InputError(f"{path}: has no triangles; export a surface, not points or curves.")
    vertices = np.concatenate([np.asarray(part.vertices, float) for part in parts])
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some vertices are not finite; export it again.")
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = np.concatenate([np.asarray(part.faces) + offset for part, offset in zip(parts, first, strict=False)])
    if not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise InputError(f"{path}: its triangles refer to vertices that do not exist; export it again.")
    colours = [of_part for part in parts if (of_part := _colours(part)) is not None]
    return vertices, triangles, np.concatenate(colours) if len(colours) == len(parts) else None


def _colours(part: trimesh.Trimesh) -> np.ndarray | None:
    if isinstance(part.visual, trimesh.visual.ColorVisuals) and part.visual.kind == "vertex":
        return np.asarray(part.visual.vertex_colors, float)[:, :CHANNELS]
    # A glTF with a material has its vertex colours here.
    colours = part.vertex_attributes.get("color")
    return None if colours is None else np.asarray(colours, float)[:, :CHANNELS]


def _upright_and_scaled(vertices: Float[np.ndarray, "v 3"], settings: OwnMesh) -> Float[np.ndarray, "v 3"]:
    """Rotate the vertical axis to z, scale, and place on z = 0 and on the axis."""
    is_y_up = settings.up_axis == "y" or (
        settings.up_axis == "by_format" and settings.mesh_file.suffix.lower() in Y_UP_FORMATS
    )
    vertices = vertices @ Y_UP_TO_Z_UP.T if is_y_up else vertices
    size = np.ptp(vertices, axis=0)
    if size[2] == 0.0:
        raise InputError(f"{settings.mesh_file}: is flat and has no height; check up_axis.")
    vertices = snapped(vertices, MERGE_DISTANCE * float(size.max()))
    scale = 1.0 if settings.height_m is None else settings.height_m / size[2]
    size = size * scale
    low, high = HEIGHTS_M
    if not low <= size[2] * (1 + 1e-9) or size[2] > high * (1 + 1e-9) or size.max() > WIDEST_M:
        raise InputError(
            f"{settings.mesh_file}: is {size[0]:.3g} x {size[1]:.3g} m wide and {size[2]:.3g} m tall, but must be "
            f"{low:g} to {high:g} m tall and at most {WIDEST_M:g} m wide; give object.height_m, or another up_axis."
        )
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    return (vertices - [centre[0], centre[1], vertices[:, 2].min()]) * scale


def _vertex_weights(settings: OwnMesh) -> Float[np.ndarray, "v materials"] | None:
    """Vertex properties ``weight_NAME`` of a PLY file; None if it has none of them."""
    if settings.mesh_file.suffix.lower() != ".ply":
        return None
    table = read_ply(settings.mesh_file)["vertex"].data
    names = [f"weight_{name}" for name in settings.materials]
    missing = [name for name in names if name not in table.dtype.names]
    if len(missing) == len(names):
        return None
    if missing:
        raise InputError(
            f"{settings.mesh_file}: its vertices have no property {', '.join(missing)}; add it, or take the material "
            "out of object.materials."
        )
    return np.stack([np.asarray(table[name], float) for name in names], axis=-1)


def _normalised_weights(weights: Float[np.ndarray, "v materials"], what: str) -> Float[np.ndarray, "v materials"]:
    """Scale weights to fractions that sum to 1."""
    if not (np.isfinite(weights).all() and (weights >= 0.0).all()):
        raise InputError(f"{what} are negative or not numbers; give fractions of 0 or more.")
    total = weights.sum(axis=-1, keepdims=True)
    if not (total > 0.0).all():
        raise InputError(f"{what} are 0 for every material; give each point a material.")
    return weights / total


def _facing_outwards(mesh: Mesh, path: Path) -> Mesh:
    """Orient all triangles counter-clockwise seen from outside."""
    if not mesh.is_watertight():
        repaired = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
        trimesh.repair.fix_winding(repaired)
        mesh = Mesh(mesh.vertices, np.asarray(repaired.faces))
    if not mesh.is_watertight():
        raise InputError(
            f"{path}: is not closed (edges without exactly two triangles) and has no volume; close its holes "
            "first, for instance with a mesh editor's 'fill holes' and 'remove non-manifold edges'."
        )
    return mesh if mesh.volume_m3() > 0.0 else Mesh(mesh.vertices, mesh.triangles[:, ::-1])
