"""A user's own mesh as the scanned object: reading, scaling, material fractions and checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from PIL import Image
from plyfile import PlyData
from scipy.ndimage import distance_transform_edt, map_coordinates

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.simulate.mesh import snapped, subdivided, welded
from hsi_sc_nerf.simulate.scene import OwnMesh

Y_UP_FORMATS = (".gltf", ".glb")
"""The y axis of glTF is vertical by specification; most tools write PLY and OBJ with a vertical z axis."""
FORMATS = (".ply", ".obj", *Y_UP_FORMATS)
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
HEIGHTS_M = (0.01, 0.5)
WIDEST_M = 1.0
MERGE_DISTANCE = 1e-6
"""Distance below which vertices are merged, as a fraction of the mesh size; exporters repeat vertices at UV seams."""
TEXTURE_SPACING_M = 0.001
"""Largest edge length after the subdivision for sampling a texture at the vertices."""
CHANNELS = 3
"""Colour channels of vertex colours and textures, each the fraction of one material."""
PADDING_PX = 8
"""Distance by which painted islands of a weight texture are dilated."""


@dataclass(frozen=True)
class _MeshFile:
    """Content of a mesh file; vertices may be repeated along seams."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    uv: Float[np.ndarray, "v 2"] | None
    colours: Float[np.ndarray, "v 3"] | None


def load(settings: OwnMesh) -> tuple[Mesh, Float[np.ndarray, "v materials"]]:
    """Read a mesh, place it on z = 0 with its bounding box centred on the axis, and determine its materials.

    Fractions are interpolated linearly between vertices. For a texture, triangles are first subdivided to edges of at
    most `TEXTURE_SPACING_M`. Triangles of the result are counter-clockwise seen from outside.

    Returns:
        The mesh in metres, and the fraction of each material at each vertex.

    Raises:
        InputError: a file is missing or cannot be read; it has no triangles, is not closed, or is not of a size
            that fits on the turntable; the materials' fractions, UVs or colours are missing or do not fit.
    """
    surface = _read_mesh_file(settings)
    vertices = _upright_and_scaled(surface.vertices, settings)
    triangles = surface.triangles
    if len(settings.materials) == 1:
        weights = np.ones((len(vertices), 1))
    elif settings.weight_texture is not None:
        vertices, triangles, weights = _weights_from_texture(settings, vertices, surface)
    elif (given := _vertex_weights(settings)) is not None:
        if len(given) != len(vertices):
            raise InputError(f"{settings.mesh_file}: its vertices and faces are inconsistent; export it again.")
        weights = _normalised_weights(given, f"{settings.mesh_file}: the weights of some vertices")
    elif surface.colours is not None:
        _check_channels(settings, "vertex colours")
        weights = _normalised_weights(
            surface.colours[:, : len(settings.materials)], f"{settings.mesh_file}: the colours of some vertices"
        )
    else:
        raise InputError(
            f"{settings.mesh_file}: does not locate its materials {', '.join(settings.materials)}; give it vertex "
            f"properties weight_{settings.materials[0]} and so on (PLY) or vertex colours, or add a weight_texture "
            "to the scene."
        )
    mesh, weights = welded(vertices, triangles, weights)
    return _facing_outwards(mesh, settings.mesh_file), weights


def _read_mesh_file(settings: OwnMesh) -> _MeshFile:
    path = settings.mesh_file
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the path of the mesh, relative to the scene file.")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: is not a mesh format that can be read; give one of {', '.join(FORMATS)}.")
    try:
        # UVs of PLY faces would split vertices, which then no longer match the file's vertex properties.
        read = trimesh.load_scene(path, process=False, fix_texture=settings.weight_texture is not None).dump()
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
    return _MeshFile(
        vertices,
        triangles,
        _concatenated([_uv(part) for part in parts]),
        _concatenated([_colours(part) for part in parts]),
    )


def _uv(part: trimesh.Trimesh) -> np.ndarray | None:
    uv = getattr(part.visual, "uv", None)
    return None if uv is None or len(uv) != len(part.vertices) else np.asarray(uv, float)[:, :2]


def _colours(part: trimesh.Trimesh) -> np.ndarray | None:
    if isinstance(part.visual, trimesh.visual.ColorVisuals) and part.visual.kind == "vertex":
        return np.asarray(part.visual.vertex_colors, float)[:, :CHANNELS]
    # A glTF with a material has its vertex colours here.
    colours = part.vertex_attributes.get("color")
    return None if colours is None else np.asarray(colours, float)[:, :CHANNELS]


def _concatenated(of_parts: list[np.ndarray | None]) -> np.ndarray | None:
    """Columns of all parts concatenated; None if a part has none."""
    found = [columns for columns in of_parts if columns is not None]
    return np.concatenate(found) if len(found) == len(of_parts) else None


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


def _weights_from_texture(
    settings: OwnMesh, vertices: Float[np.ndarray, "v 3"], surface: _MeshFile
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "t 3"], Float[np.ndarray, "w materials"]]:
    """Subdivided vertices and triangles, and the fractions that the texture gives the vertices."""
    path = settings.weight_texture
    assert path is not None
    _check_channels(settings, "a weight texture")
    if surface.uv is None:
        raise InputError(f"{settings.mesh_file}: has no UVs for {path.name}; unwrap it and export it with UVs.")
    try:
        with Image.open(path) as image:
            channels = image.getbands()
            pixels = np.asarray(image.convert("RGB"), float)[..., : len(settings.materials)]
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
    return fine[:, :3], triangles, _normalised_weights(weights, f"{path}: the texture where some of the surface lies")


def padded_fractions(image: Float[np.ndarray, "h w m"]) -> Float[np.ndarray, "h w m"]:
    """Normalise the channels of an image to fractions that sum to 1; unpainted texels stay 0.

    Texels within `PADDING_PX` of a painted one get its fractions, because UV islands end between texels.
    """
    total = image.sum(axis=-1, keepdims=True)
    fractions = np.divide(image, total, out=np.zeros_like(image), where=total > 0.0)
    distance_px, nearest = distance_transform_edt(total[..., 0] == 0.0, return_indices=True)
    return np.where((distance_px <= PADDING_PX)[..., None], fractions[tuple(nearest)], 0.0)


def sampled(image: Float[np.ndarray, "h w m"], uv: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "v m"]:
    """Bilinear samples at UVs with the origin in the lower left corner; the image repeats outside [0, 1]."""
    height, width = image.shape[:2]
    texels = [(1.0 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
    channels = np.moveaxis(image, -1, 0)
    return np.stack([map_coordinates(channel, texels, order=1, mode="grid-wrap") for channel in channels], axis=-1)


def _vertex_weights(settings: OwnMesh) -> Float[np.ndarray, "v materials"] | None:
    """Vertex properties ``weight_NAME`` of a PLY file; None if it has none of them."""
    if settings.mesh_file.suffix.lower() != ".ply":
        return None
    table = PlyData.read(settings.mesh_file)["vertex"].data
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


def _check_channels(settings: OwnMesh, what: str) -> None:
    if len(settings.materials) > CHANNELS:
        raise InputError(
            f"{settings.mesh_file}: {what} can represent {CHANNELS} materials (red, green, blue), not "
            f"{len(settings.materials)}; name fewer, or use a PLY with vertex properties weight_NAME."
        )


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
