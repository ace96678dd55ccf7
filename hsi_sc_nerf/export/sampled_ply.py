"""Add spectra to the points of any PLY file, a cloud or a mesh; everything else in it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData, PlyElement, PlyListProperty

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import read_surface
from hsi_sc_nerf.export.cloud import estimate_normals
from hsi_sc_nerf.export.description import comment_lines
from hsi_sc_nerf.export.ply import band_property_names
from hsi_sc_nerf.export.sample_points import PointSpectra
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.spectra.bands import to_8_bit

_NORMAL = ("nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_NO_SPECTRUM_GREY = 64
"""Colour of points without a spectrum, if the file has no colours of its own."""


@dataclass(frozen=True, eq=False)
class PlyPoints:
    """A PLY file with points.

    Attributes:
        content: all of its elements.
        positions: of the points, in the file's unit.
        triangles: of a mesh; none for a cloud.
    """

    content: PlyData
    positions: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "t 3"]

    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals, to either side: the file's, or else of the faces, or else of neighbouring points.

        They are 0 for a point without one, such as a vertex of no face.
        """
        if len(self.triangles) and not self.has(_NORMAL):
            return Mesh(self.positions, self.triangles).vertex_normals()
        if not self.has(_NORMAL):
            return estimate_normals(self.positions)
        normals = np.stack([np.asarray(self.content["vertex"][name], float) for name in _NORMAL], axis=1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)

    def has(self, names: tuple[str, ...]) -> bool:
        """Whether the points have properties of these names."""
        return set(names) <= set(self.content["vertex"].data.dtype.names)


def read_points(path: Path) -> PlyPoints:
    """Read a PLY file of any kind: ASCII or binary, with or without faces.

    Raises:
        InputError: the file is missing, is no PLY, has no points, or its points hold lists or are not finite.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: is no PLY file; export the cloud or mesh as PLY.")
    positions, triangles = read_surface(path)
    content = PlyData.read(str(path))
    lists = [column.name for column in content["vertex"].properties if isinstance(column, PlyListProperty)]
    if lists:
        raise InputError(f"{path}: its points hold lists ({', '.join(lists)}); save it without them.")
    return PlyPoints(content, positions, triangles)


def write_sampled_ply(
    path: Path,
    points: PlyPoints,
    found: PointSpectra,
    wavelengths_nm: Float[np.ndarray, "bands"],
    rgb_bands: list[int],
    run: str,
) -> None:
    """Write a file with the spectra of its points as binary PLY, and normals and pseudo-RGB if it has none.

    Its comments state ``run``, the name of the run, and what the new columns mean.

    Raises:
        InputError: the file cannot be written.
    """
    content, vertices = points.content, points.content["vertex"].data
    columns = dict(zip(band_property_names(wavelengths_nm), found.spectra.T, strict=True))
    columns |= {"sampled_views": found.views, "sampled_std": found.spectral_std}
    if not points.has(_NORMAL):
        columns |= zip(_NORMAL, found.normals.T.astype(np.float32), strict=True)
    if not points.has(_COLOUR):
        colours = found.spectra[:, rgb_bands]
        known = np.isfinite(colours)
        colours = np.where(known, to_8_bit(np.where(known, colours, 0.0)), np.uint8(_NO_SPECTRUM_GREY))
        columns |= zip(_COLOUR, colours.T, strict=True)
    kept = {name: vertices[name] for name in vertices.dtype.names if name not in columns}
    rows = np.empty(len(vertices), [(name, values.dtype) for name, values in (kept | columns).items()])
    for name, values in (kept | columns).items():
        rows[name] = values
    elements = [
        PlyElement.describe(rows, "vertex") if element.name == "vertex" else element for element in content.elements
    ]
    added = comment_lines([name for name in columns if name not in ("x", "y", "z")], run)
    comments = [*content.comments, *(line for line in added if line not in content.comments)]
    with atomic_write(path) as (temporary,):
        file = PlyData(elements, byte_order="<", comments=comments, obj_info=content.obj_info)
        file.write(str(temporary))
