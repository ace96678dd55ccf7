"""A user's own mesh as the object: read, stood on z = 0, its materials laid on, checked to be closed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from PIL import Image
from plyfile import PlyData

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.simulate.mesh import snapped, subdivided, welded
from hsi_sc_nerf.simulate.scene import OwnMesh
from hsi_sc_nerf.simulate.texture import padded_fractions, sampled

Y_UP_FORMATS = (".gltf", ".glb")
"""glTF's specification has y up; PLY and OBJ say nothing, and z is up in most tools that write them."""
FORMATS = (".ply", ".obj", *Y_UP_FORMATS)
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
HEIGHTS_M = (0.01, 0.5)
WIDEST_M = 1.0
SAME_PLACE = 1e-6
"""Vertices closer than this fraction of the mesh's size are one point (exporters repeat vertices along UV seams)."""
TEXTURE_SPACING_M = 0.001
"""Edges are cut to at most this before a texture is sampled at vertices."""
CHANNELS = 3


@dataclass(frozen=True)
class _Surface:
    """What a mesh file holds; vertices may repeat along seams."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    uv: Float[np.ndarray, "v 2"] | None
    colours: Float[np.ndarray, "v 3"] | None


def load(thing: OwnMesh) -> tuple[Mesh, Float[np.ndarray, "v materials"]]:
    """The mesh in metres, standing on z = 0 with its bounding box centred on the axis, and its materials' fractions.

    Fractions are interpolated linearly between vertices; where they come from a texture, triangles are cut first so
    that no edge is longer than `TEXTURE_SPACING_M`. Triangles come out counter-clockwise seen from outside.

    Raises:
        InputError: a file is missing or cannot be read; it has no triangles, is not closed, or is not of a size
            that fits on the turntable; the materials' fractions, UVs or colours are missing or do not fit.
    """
    surface = _read_surface(thing)
    vertices = _stood(surface.vertices, thing)
    triangles = surface.triangles
    if len(thing.materials) == 1:
        weights = np.ones((len(vertices), 1))
    elif thing.weight_texture is not None:
        vertices, triangles, weights = _textured(thing, vertices, surface)
    elif (given := _vertex_weights(thing)) is not None:
        if len(given) != len(vertices):
            raise InputError(f"{thing.mesh_file}: its vertices and its faces do not fit together; export it again.")
        weights = _fractions(given, f"{thing.mesh_file}: the weights of some vertices")
    elif surface.colours is not None:
        _check_channels(thing, "vertex colours")
        weights = _fractions(
            surface.colours[:, : len(thing.materials)], f"{thing.mesh_file}: the colours of some vertices"
        )
    else:
        raise InputError(
            f"{thing.mesh_file}: does not say where {', '.join(thing.materials)} lie; give it vertex properties "
            f"weight_{thing.materials[0]} and so on (PLY) or vertex colours, or add a weight_texture to the scene."
        )
    mesh, weights = welded(vertices, triangles, weights)
    return _facing_outwards(mesh, thing.mesh_file), weights


def _read_surface(thing: OwnMesh) -> _Surface:
    path = thing.mesh_file
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of the mesh, relative to the scene file.")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: is no mesh that can be read; give a file of the kind {', '.join(FORMATS)}.")
    try:
        # UVs of a PLY's faces split its vertices, which would leave those of the file without their weights.
        read = trimesh.load_scene(path, process=False, fix_texture=thing.weight_texture is not None).dump()
    except Exception as error:  # the readers fail in every way there is
        raise InputError(f"{path}: cannot be read as a mesh ({error!r}); export it again.") from error
    parts = [part for part in read if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise InputError(f"{path}: has no triangles; export a surface, not points or curves.")
    vertices = np.concatenate([np.asarray(part.vertices, float) for part in parts])
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some vertices are not at finite places; export it again.")
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = np.concatenate([np.asarray(part.faces) + offset for part, offset in zip(parts, first, strict=False)])
    return _Surface(
        vertices, triangles, _joined([_uv(part) for part in parts]), _joined([_colours(part) for part in parts])
    )


def _uv(part: trimesh.Trimesh) -> np.ndarray | None:
    uv = getattr(part.visual, "uv", None)
    return None if uv is None or len(uv) != len(part.vertices) else np.asarray(uv, float)[:, :2]


def _colours(part: trimesh.Trimesh) -> np.ndarray | None:
    if isinstance(part.visual, trimesh.visual.ColorVisuals) and part.visual.kind == "vertex":
        return np.asarray(part.visual.vertex_colors, float)[:, :CHANNELS]
    # A glTF that has a material as well keeps its colours here.
    colours = part.vertex_attributes.get("color")
    return None if colours is None else np.asarray(colours, float)[:, :CHANNELS]


def _joined(of_parts: list[np.ndarray | None]) -> np.ndarray | None:
    """Columns of all parts one below the other; None if a part has none."""
    found = [columns for columns in of_parts if columns is not None]
    return np.concatenate(found) if len(found) == len(of_parts) else None


def _stood(vertices: Float[np.ndarray, "v 3"], thing: OwnMesh) -> Float[np.ndarray, "v 3"]:
    """Turned upright, scaled, put on z = 0 and on the axis."""
    is_y_up = thing.up_axis == "y" or (
        thing.up_axis == "by_format" and thing.mesh_file.suffix.lower() in Y_UP_FORMATS
    )
    vertices = vertices @ Y_UP_TO_Z_UP.T if is_y_up else vertices
    size = np.ptp(vertices, axis=0)
    if size[2] == 0.0:
        raise InputError(f"{thing.mesh_file}: is flat, so that it has no height; check up_axis.")
    vertices = snapped(vertices, SAME_PLACE * float(size.max()))
    scale = 1.0 if thing.height_m is None else thing.height_m / size[2]
    size = size * scale
    low, high = HEIGHTS_M
    if not low <= size[2] * (1 + 1e-9) or size[2] > high * (1 + 1e-9) or size.max() > WIDEST_M:
        raise InputError(
            f"{thing.mesh_file}: is {size[0]:.3g} x {size[1]:.3g} m wide and {size[2]:.3g} m tall, but must be "
            f"{low:g} to {high:g} m tall and at most {WIDEST_M:g} m wide; give object.height_m, or another up_axis."
        )
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    return (vertices - [centre[0], centre[1], vertices[:, 2].min()]) * scale


def _textured(
    thing: OwnMesh, vertices: Float[np.ndarray, "v 3"], surface: _Surface
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "t 3"], Float[np.ndarray, "w materials"]]:
    """Vertices and triangles fine enough for the texture, and the fractions that it gives them."""
    path = thing.weight_texture
    assert path is not None
    _check_channels(thing, "a weight texture")
    if surface.uv is None:
        raise InputError(
            f"{thing.mesh_file}: has no UVs to lay {path.name} on; unwrap it and export it with its UVs."
        )
    try:
        with Image.open(path) as image:
            channels = image.getbands()
            pixels = np.asarray(image.convert("RGB"), float)[..., : len(thing.materials)]
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read as an image ({error}); give a PNG with fractions as colours."
        ) from error
    if len(channels) < CHANNELS and channels != ("P",):
        raise InputError(
            f"{path}: is grey, but the fractions of materials are its red, green and blue; save it as RGB."
        )
    fine, triangles = subdivided(np.column_stack([vertices, surface.uv]), surface.triangles, TEXTURE_SPACING_M)
    weights = sampled(padded_fractions(pixels), fine[:, 3:])
    return fine[:, :3], triangles, _fractions(weights, f"{path}: the texture where some of the surface lies")


def _vertex_weights(thing: OwnMesh) -> Float[np.ndarray, "v materials"] | None:
    """The PLY's vertex properties ``weight_NAME``; None where it has none of them."""
    if thing.mesh_file.suffix.lower() != ".ply":
        return None
    table = PlyData.read(thing.mesh_file)["vertex"].data
    names = [f"weight_{name}" for name in thing.materials]
    missing = [name for name in names if name not in table.dtype.names]
    if len(missing) == len(names):
        return None
    if missing:
        raise InputError(
            f"{thing.mesh_file}: its vertices have no property {', '.join(missing)}; add it, or take the material "
            "out of object.materials."
        )
    return np.stack([np.asarray(table[name], float) for name in names], axis=-1)


def _check_channels(thing: OwnMesh, what: str) -> None:
    if len(thing.materials) > CHANNELS:
        raise InputError(
            f"{thing.mesh_file}: {what} can tell {CHANNELS} materials apart (red, green, blue), not "
            f"{len(thing.materials)}; name fewer, or use a PLY with vertex properties weight_NAME."
        )


def _fractions(weights: Float[np.ndarray, "v materials"], what: str) -> Float[np.ndarray, "v materials"]:
    """Weights of any scale as fractions that sum to 1."""
    if not (np.isfinite(weights).all() and (weights >= 0.0).all()):
        raise InputError(f"{what} are negative or no numbers; give each material's fraction, 0 or more.")
    total = weights.sum(axis=-1, keepdims=True)
    if not (total > 0.0).all():
        raise InputError(f"{what} are 0 for every material; give each point a material.")
    return weights / total


def _facing_outwards(mesh: Mesh, path: Path) -> Mesh:
    """The mesh with all triangles counter-clockwise seen from outside."""
    if not mesh.is_watertight():
        repaired = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
        trimesh.repair.fix_winding(repaired)
        mesh = Mesh(mesh.vertices, np.asarray(repaired.faces))
    if not mesh.is_watertight():
        raise InputError(
            f"{path}: is not closed (edges without exactly two triangles), so that it has no volume; close its holes "
            "first, for instance with a mesh editor's 'fill holes' and 'remove non-manifold edges'."
        )
    return mesh if mesh.volume_m3() > 0.0 else Mesh(mesh.vertices, mesh.triangles[:, ::-1])
