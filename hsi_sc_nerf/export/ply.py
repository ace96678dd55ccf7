"""Write and read spectral point clouds as PLY files (Turk 1994).

The first element, ``vertex``, holds ``x y z nx ny nz`` (float, metres), ``red green blue`` (uchar), one float a band
named by its wavelength (``scalar_397.32nm``; CloudCompare shows properties that begin with ``scalar_`` as scalar
fields), and the extra columns. Comments state the frame, the run, and the unit and meaning of each column. A million
points of 204 bands take 843 MB.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy.lib.recfunctions import structured_to_unstructured

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CloudStream, SpectralCloud, comment_lines, stream
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.geometry.ply_file import read_ply

_GEOMETRY = ("x", "y", "z", "nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_BAND_NAME = re.compile(r"scalar_(\d+(?:\.\d+)?)nm")


def write_spectral_ply(
    path: Path | str, cloud: SpectralCloud | CloudStream, triangles: Int[np.ndarray, "t 3"] | None = None
) -> None:
    """Write a spectral point cloud, or a mesh with spectra at its vertices, whole or not at all.

    A stream is written chunk by chunk; plyfile would need all points at once.

    Args:
        path: the PLY file; an existing one is replaced.
        cloud: the points.
        triangles: indices of three points each, counter-clockwise seen from outside.

    Raises:
        InputError: the file cannot be written, for instance because the disk is full.
        ValueError: the arrays' shapes do not fit together, two wavelengths are equal, or the name of an extra column
            is taken or has several words.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> write_spectral_ply("copy.ply", cloud)
    """
    if isinstance(cloud, SpectralCloud):
        cloud = stream(cloud)
    band_names = band_property_names(cloud.wavelengths_nm)
    names = [*_GEOMETRY, *_COLOUR, *band_names, *cloud.extra_names]
    if len(set(names)) != len(names) or any(len(name.split()) != 1 for name in cloud.extra_names):
        raise ValueError(f"extra columns need one-word names that are not taken: {list(cloud.extra_names)}")
    properties = (f"property {'uchar' if name in _COLOUR else 'float'} {name}" for name in names)
    comments = (f"comment {line}" for line in comment_lines(names, cloud.run))
    header = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {cloud.count}", *properties]
    faces = np.empty(0 if triangles is None else len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    if triangles is not None:
        faces["count"], faces["corners"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    layout = np.dtype(
        [
            ("points", "<f4", 3),
            ("normals", "<f4", 3),
            ("colours", "u1", 3),
            ("spectra", "<f4", len(band_names)),
            ("extra", "<f4", len(cloud.extra_names)),
        ]
    )
    with atomic_write(Path(path)) as (temporary,), temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        for chunk in cloud.chunks:
            rows = np.empty(len(chunk), layout)
            rows["points"], rows["normals"], rows["colours"] = chunk.points, chunk.normals, chunk.colours
            rows["spectra"] = chunk.spectra
            for index, values in enumerate(chunk.extra.values()):
                rows["extra"][:, index] = values
            rows.tofile(file)
        faces.tofile(file)


def band_property_names(wavelengths_nm: Float[np.ndarray, "bands"], kind: str = "scalar") -> list[str]:
    """``scalar_397.32nm`` a band: two decimals, or as many as it takes to distinguish all bands.

    Args:
        wavelengths_nm: band centres.
        kind: ``scalar`` for reflectance as measured, ``material`` for that of the material.

    Raises:
        ValueError: two wavelengths are equal.
    """
    wavelengths = [float(wavelength) for wavelength in wavelengths_nm]
    for decimals in range(2, 16):
        names = [f"{kind}_{wavelength:.{decimals}f}nm" for wavelength in wavelengths]
        if len(set(names)) == len(names):
            return names
    raise ValueError("two bands have the same wavelength")


def material_spectra(cloud: SpectralCloud) -> Float[np.ndarray, "n bands"] | None:
    """Reflectance of the material, from the columns that `hsi-sc-nerf material` adds; None without all of them."""
    names = band_property_names(cloud.wavelengths_nm, "material")
    if not set(names) <= set(cloud.extra):
        return None
    return np.stack([cloud.extra[name] for name in names], axis=1)


def read_spectral_ply(path: Path | str) -> SpectralCloud:
    """Read a cloud that `write_spectral_ply` wrote, its properties in any order (CloudCompare reorders them).

    Raises:
        InputError: the file is missing, is no readable PLY, or lacks positions, normals, colours or spectral bands.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> len(cloud.wavelengths_nm)
        204
    """
    path = Path(path)
    vertices = read_ply(path)["vertex"].data
    names = vertices.dtype.names
    bands = {name: float(match[1]) for name in names if (match := _BAND_NAME.fullmatch(name))}
    missing = [name for name in (*_GEOMETRY, *_COLOUR) if name not in names]
    if missing or not bands:
        lacking = ", ".join(missing) or "spectral bands (scalar_...nm)"
        raise InputError(f"{path}: has no {lacking}; give a cloud that ns-export wrote from an hsi-sc-nerf run.")

    def columns(group: tuple[str, ...], dtype: type) -> np.ndarray:
        # A copy, in one pass: where it can, NumPy gives a view of the file.
        return np.array(structured_to_unstructured(vertices[list(group)], dtype))

    return SpectralCloud(
        points=columns(_GEOMETRY[:3], np.float32),
        normals=columns(_GEOMETRY[3:], np.float32),
        colours=columns(_COLOUR, np.uint8),
        spectra=columns(tuple(bands), np.float32),
        wavelengths_nm=np.array(list(bands.values())),
        extra={
            name: np.array(vertices[name], np.float32)
            for name in names
            if name not in bands and name not in (*_GEOMETRY, *_COLOUR)
        },
    )
