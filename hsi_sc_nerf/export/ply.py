"""Write and read spectral point clouds as PLY files (Turk 1994).

The first element, ``vertex``, holds ``x y z nx ny nz`` (float, metres), ``red green blue`` (uchar), one float a band
named by its wavelength (``scalar_397.32nm``; CloudCompare shows properties that begin with ``scalar_`` as scalar
fields), and the extra columns. A million points of 204 bands take 843 MB.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy.lib.recfunctions import structured_to_unstructured
from plyfile import PlyData, PlyElementParseError, PlyParseError

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CloudStream, SpectralCloud, stream
from hsi_sc_nerf.files import atomic_write

_GEOMETRY = ("x", "y", "z", "nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_BAND_NAME = re.compile(r"scalar_(\d+(?:\.\d+)?)nm")


def write_spectral_ply(
    path: Path,
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    spectra: Float[np.ndarray, "n bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    extra: Mapping[str, Float[np.ndarray, "n"]] | None = None,
) -> None:
    """Write a spectral point cloud, whole or not at all.

    Args:
        path: the PLY file; an existing one is replaced.
        points_m: positions in metres.
        normals: unit normals.
        colours: pseudo-RGB.
        spectra: reflectance of each point.
        wavelengths_nm: band centres.
        extra: more columns by property name (one word), written as float after the bands.

    Raises:
        InputError: the file cannot be written, for instance because the disk is full.
        ValueError: the arrays' shapes do not fit together, two wavelengths are equal, or a name is taken.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> arrays = cloud.points, cloud.normals, cloud.colours, cloud.spectra, cloud.wavelengths_nm
        >>> write_spectral_ply("copy.ply", *arrays, extra=cloud.extra)
    """
    cloud = SpectralCloud(points_m, normals, colours, spectra, wavelengths_nm, dict(extra or {}))
    write_ply_stream(Path(path), stream(cloud))


def write_ply_stream(path: Path, cloud: CloudStream) -> None:
    """Write a cloud chunk by chunk, whole or not at all; plyfile would need all points at once.

    Raises:
        InputError: the file cannot be written, for instance because the disk is full.
        ValueError: the chunks do not fit together, two wavelengths are equal, or an extra column's name is taken.
    """
    band_names = band_property_names(cloud.wavelengths_nm)
    names = [*_GEOMETRY, *_COLOUR, *band_names, *cloud.extra_names]
    if len(set(names)) != len(names) or any(len(name.split()) != 1 for name in cloud.extra_names):
        raise ValueError(f"extra columns need one-word names that are not taken: {list(cloud.extra_names)}")
    properties = (f"property {'uchar' if name in _COLOUR else 'float'} {name}" for name in names)
    start = ("ply", "format binary_little_endian 1.0", f"element vertex {cloud.count}")
    header = "\n".join([*start, *properties, "end_header", ""])
    layout = np.dtype(
        [
            ("points", "<f4", 3),
            ("normals", "<f4", 3),
            ("colours", "u1", 3),
            ("spectra", "<f4", len(band_names)),
            ("extra", "<f4", len(cloud.extra_names)),
        ]
    )
    with atomic_write(path) as (temporary,), temporary.open("wb") as file:
        file.write(header.encode("ascii"))
        for _, chunk in cloud.placed():
            rows = np.empty(len(chunk), layout)
            rows["points"], rows["normals"], rows["colours"] = chunk.points, chunk.normals, chunk.colours
            rows["spectra"] = chunk.spectra
            for index, values in enumerate(chunk.extra.values()):
                rows["extra"][:, index] = values
            rows.tofile(file)


def band_property_names(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[str]:
    """``scalar_397.32nm`` a band: two decimals, or as many as it takes to distinguish all bands.

    Raises:
        ValueError: two wavelengths are equal.
    """
    wavelengths = [float(wavelength) for wavelength in wavelengths_nm]
    for decimals in range(2, 16):
        names = [f"scalar_{wavelength:.{decimals}f}nm" for wavelength in wavelengths]
        if len(set(names)) == len(names):
            return names
    raise ValueError("two bands have the same wavelength")


def read_spectral_ply(path: Path | str) -> SpectralCloud:
    """Read a cloud that `write_spectral_ply` wrote, its properties in any order (CloudCompare reorders them).

    Raises:
        InputError: the file is missing, is no readable PLY, or lacks positions, normals, colours or spectral bands.

    Example:
        >>> cloud = read_spectral_ply("point_cloud.ply")
        >>> cloud.spectra.shape
        (1000000, 204)
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the PLY file of an exported point cloud.")
    try:
        vertices = _read(path)["vertex"].data
    except (PlyParseError, KeyError, ValueError) as error:
        raise InputError(f"{path}: is no readable PLY point cloud ({error}); export it again.") from error
    names = vertices.dtype.names
    bands = {name: float(match[1]) for name in names if (match := _BAND_NAME.fullmatch(name))}
    missing = [name for name in (*_GEOMETRY, *_COLOUR) if name not in names]
    if missing or not bands:
        lacking = ", ".join(missing) or "spectral bands (scalar_...nm)"
        raise InputError(f"{path}: has no {lacking}; give a cloud that ns-export wrote from an hsi-sc-nerf run.")
    if vertices.dtype.hasobject:
        raise InputError(f"{path}: its points hold lists; export the cloud again.")

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


def _read(path: Path) -> PlyData:
    try:
        # Triangles of known length are mapped into memory; others take plyfile seconds.
        return PlyData.read(str(path), known_list_len={"face": {"vertex_indices": 3}})
    except PlyElementParseError:
        return PlyData.read(str(path))
