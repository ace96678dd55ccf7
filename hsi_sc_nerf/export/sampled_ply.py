"""Anybody's PLY file, a cloud or a mesh, with spectra added to its points; all else in it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.ply import band_property_names
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.meshes.mesh import ply_triangles

_NORMAL = ("nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_BLANK = 64
"""Grey of points without a spectrum, where the file has no colours of its own."""


@dataclass(frozen=True, eq=False)
class PlyPoints:
    """A PLY file that has points.

    Attributes:
        path: the file.
        content: all of it.
    """

    path: Path
    content: PlyData

    def __len__(self) -> int:
        return self.content["vertex"].count

    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Of the points, in the file's unit."""
        return self._columns(("x", "y", "z"))

    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals, to either side: the file's, else the faces', else those of neighbouring points.

        0 for a point that has none, such as a vertex of no face.

        Raises:
            InputError: the faces make no sense.
        """
        if self.has(_NORMAL):
            normals = self._columns(_NORMAL)
        elif len(triangles := self._triangles()):
            import trimesh

            normals = np.array(trimesh.Trimesh(self.positions(), triangles, process=False).vertex_normals)
        else:
            from hsi_sc_nerf.surface.outliers import estimate_normals

            normals = estimate_normals(self.positions(), facing=np.zeros((len(self), 3)))
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)

    def has(self, names: tuple[str, ...]) -> bool:
        """Whether the points have properties of these names."""
        return set(names) <= {column.name for column in self.content["vertex"].properties}

    def _columns(self, names: tuple[str, ...]) -> np.ndarray:
        return np.stack([np.asarray(self.content["vertex"][name], float) for name in names], axis=1)

    def _triangles(self) -> np.ndarray:
        try:
            return ply_triangles(self.content)
        except PlyParseError as error:
            raise InputError(f"{self.path}: {error}; export the mesh again, or only its points.") from error


def read_points(path: Path) -> PlyPoints:
    """Read a PLY file of any kind: ASCII or binary, with or without faces.

    Raises:
        InputError: it is missing, is no PLY, or has no points, or such that hold more than numbers.
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
        raise InputError(f"{path}: some points are not at finite places; remove them.")
    return points


class SpectralColumns:
    """The points of a file with room for spectra, which are written to it as they come.

    Args:
        points: the file.
        wavelengths_nm: band centres.
        extra: further columns (float).
    """

    def __init__(self, points: PlyPoints, wavelengths_nm: Float[np.ndarray, "bands"], extra: tuple[str, ...]) -> None:
        bands = band_property_names(wavelengths_nm)
        ours = [*bands, *extra]
        given = points.content["vertex"].data
        self._normals_missing, self._colours_missing = not points.has(_NORMAL), not points.has(_COLOUR)
        added = [(name, "<f4") for name in _NORMAL if self._normals_missing]
        added += [(name, "u1") for name in _COLOUR if self._colours_missing]
        kept = [name for name in given.dtype.names if name not in (*ours, *dict(added))]
        layout = [(name, given.dtype[name]) for name in kept]
        self._points = points
        layout += added
        self._rows = np.zeros(len(points), [*layout, *((name, "<f4") for name in ours)])
        for name in kept:
            self._rows[name] = given[name]
        # The bands stand next to each other: one array without a copy.
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
        """Set spectra and extra columns of some points, and normals and pseudo-RGB where the file has none."""
        self._spectra[rows] = spectra
        if self._normals_missing:
            for name, column in zip(_NORMAL, normals.T, strict=True):
                self._rows[name][rows] = column
        for name, values in extra.items():
            self._rows[name][rows] = values
        if self._colours_missing:
            shown = np.clip(spectra[:, rgb_bands] * 255.0, 0.0, 255.0)
            for name, column in zip(_COLOUR, shown.T, strict=True):
                self._rows[name][rows] = np.where(np.isnan(column), _BLANK, column).round()

    def write(self, path: Path) -> None:
        """Write the file with its new columns as binary PLY, whole or not at all.

        Raises:
            InputError: it cannot be written.
        """
        given = self._points.content
        elements = [
            PlyElement.describe(self._rows, "vertex") if element.name == "vertex" else element
            for element in given.elements
        ]
        with atomic_write(path) as (temporary,):
            PlyData(elements, byte_order="<", comments=given.comments, obj_info=given.obj_info).write(str(temporary))
