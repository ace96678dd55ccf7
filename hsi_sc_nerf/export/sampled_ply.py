"""Add spectra to the points of any PLY file, a cloud or a mesh; everything else in it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import estimate_normals
from hsi_sc_nerf.export.ply import band_property_names
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.meshes.mesh import Mesh, ply_triangles
from hsi_sc_nerf.spectra.pseudo_rgb import to_8_bit

_NORMAL = ("nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_NO_SPECTRUM_GREY = 64
"""Colour of points without a spectrum, if the file has no colours of its own."""


@dataclass(frozen=True, eq=False)
class PlyPoints:
    """A PLY file with points.

    Attributes:
        path: the file.
        content: all of its elements.
    """

    path: Path
    content: PlyData

    def __len__(self) -> int:
        return self.content["vertex"].count

    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the points, in the file's unit."""
        return self._columns(("x", "y", "z"))

    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals, to either side: the file's, or else of the faces, or else of neighbouring points.

        They are 0 for a point without one, such as a vertex of no face.

        Raises:
            InputError: the faces do not refer to vertices of the file.
        """
        if self.has(_NORMAL):
            normals = self._columns(_NORMAL)
        elif len(triangles := self._triangles()):
            normals = Mesh(self.positions(), triangles).area_weighted_normals()
        else:
            normals = estimate_normals(self.positions())
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)

    def has(self, names: tuple[str, ...]) -> bool:
        """Whether the points have properties of these names."""
        return set(names) <= {column.name for column in self.content["vertex"].properties}

    def _columns(self, names: tuple[str, ...]) -> Float[np.ndarray, "n columns"]:
        return np.stack([np.asarray(self.content["vertex"][name], float) for name in names], axis=1)

    def _triangles(self) -> Int[np.ndarray, "t 3"]:
        try:
            return ply_triangles(self.content)
        except PlyParseError as error:
            raise InputError(f"{self.path}: {error}; export the mesh again, or only its points.") from error


def read_points(path: Path) -> PlyPoints:
    """Read a PLY file of any kind: ASCII or binary, with or without faces.

    Raises:
        InputError: the file is missing, is no PLY, has no points, or its points hold lists or are not finite.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give a point cloud or a mesh as PLY.")
    try:
        content = PlyData.read(str(path))
    except (PlyParseError, ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: is no readable PLY file ({error}); export the cloud or mesh again.") from error
    points = PlyPoints(path, content)
    if "vertex" not in content or not len(points) or not points.has(("x", "y", "z")):
        raise InputError(f"{path}: has no points (an element vertex with x, y, z); export the cloud or mesh again.")
    lists = [column.name for column in content["vertex"].properties if isinstance(column, PlyListProperty)]
    if lists:
        raise InputError(f"{path}: its points hold lists ({', '.join(lists)}); save it without them.")
    if not np.isfinite(points.positions()).all():
        raise InputError(f"{path}: some points have no finite position; remove them.")
    return points


class SpectralColumns:
    """The points of a file with columns for spectra, which are filled row by row and then written.

    Args:
        points: the file.
        wavelengths_nm: band centres.
        extra: names of further columns (float).
    """

    def __init__(self, points: PlyPoints, wavelengths_nm: Float[np.ndarray, "bands"], extra: tuple[str, ...]) -> None:
        self._points = points
        bands = band_property_names(wavelengths_nm)
        vertices = points.content["vertex"].data
        self._normals_missing, self._colours_missing = not points.has(_NORMAL), not points.has(_COLOUR)
        added = [(name, "<f4") for name in _NORMAL if self._normals_missing]
        added += [(name, "u1") for name in _COLOUR if self._colours_missing]
        kept = [name for name in vertices.dtype.names if name not in (*bands, *extra, *dict(added))]
        layout = [*((name, vertices.dtype[name]) for name in kept), *added]
        self._rows = np.zeros(len(points), [*layout, *((name, "<f4") for name in (*bands, *extra))])
        for name in kept:
            self._rows[name] = vertices[name]
        # The bands are adjacent in memory, so one view of the bytes holds all of them.
        offset = np.dtype(layout).itemsize
        as_bytes = self._rows.view(np.uint8).reshape(len(points), -1)
        self._spectra = as_bytes[:, offset : offset + 4 * len(bands)].view("<f4")

    def fill(
        self,
        rows: slice,
        normals: Float[np.ndarray, "n 3"],
        spectra: Float[np.ndarray, "n bands"],
        rgb_bands: list[int],
        extra: dict[str, Float[np.ndarray, "n"]],
    ) -> None:
        """Set spectra and extra columns of rows, and normals and pseudo-RGB if the file has none."""
        self._spectra[rows] = spectra
        columns = dict(extra)
        if self._normals_missing:
            columns |= zip(_NORMAL, normals.T, strict=True)
        if self._colours_missing:
            colours = spectra[:, rgb_bands]
            known = np.isfinite(colours)
            colours = np.where(known, to_8_bit(np.where(known, colours, 0.0)), _NO_SPECTRUM_GREY)
            columns |= zip(_COLOUR, colours.T, strict=True)
        for name, values in columns.items():
            self._rows[name][rows] = values

    def write(self, path: Path) -> None:
        """Write the file with its new columns as binary PLY, whole or not at all.

        Raises:
            InputError: the file cannot be written.
        """
        content = self._points.content
        elements = [
            PlyElement.describe(self._rows, "vertex") if element.name == "vertex" else element
            for element in content.elements
        ]
        with atomic_write(path) as (temporary,):
            PlyData(elements, byte_order="<", comments=content.comments, obj_info=content.obj_info).write(
                str(temporary)
            )
