"""Spectral point clouds as PLY files (Turk 1994): write and read, in plain NumPy.

One binary little-endian element ``vertex``: ``x y z nx ny nz`` (float, metres), ``red green blue`` (uchar), one float
a band named by its wavelength (``scalar_397.32nm``; CloudCompare shows what begins with ``scalar_`` as a scalar
field), then the extra columns. A million points of 204 bands make 843 MB.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy.lib.recfunctions import structured_to_unstructured

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CHUNK_POINTS, CloudStream, SpectralCloud, stream
from hsi_sc_nerf.files import atomic_write

_GEOMETRY = ("x", "y", "z", "nx", "ny", "nz")
_COLOUR = ("red", "green", "blue")
_BAND_NAME = re.compile(r"scalar_(\d+(?:\.\d+)?)nm")
_TYPES = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}


def band_property_names(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[str]:
    """``scalar_397.32nm`` a band: two decimals, or as many more as it takes to tell all the bands apart.

    Raises:
        ValueError: two wavelengths are equal.
    """
    wavelengths = [float(wavelength) for wavelength in wavelengths_nm]
    for decimals in range(2, 16):
        names = [f"scalar_{wavelength:.{decimals}f}nm" for wavelength in wavelengths]
        if len(set(names)) == len(names):
            return names
    raise ValueError("two bands have the same wavelength")


def _header(count: int, columns: list[str]) -> bytes:
    properties = [
        *(f"property float {name}" for name in _GEOMETRY),
        *(f"property uchar {name}" for name in _COLOUR),
        *(f"property float {name}" for name in columns),
    ]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header", ""]
    return "\n".join(lines).encode("ascii")


def write_spectral_ply(
    path: Path,
    points_m: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    spectra: Float[np.ndarray, "n bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    extra: Mapping[str, Float[np.ndarray, "n"]] | None = None,
) -> None:
    """Write a spectral point cloud, whole or not at all, in chunks: no second copy is held.

    Args:
        path: The PLY file; one that is there is replaced.
        points_m: Positions in metres.
        normals: Unit normals.
        colours: Pseudo-RGB.
        spectra: Reflectance of each point.
        wavelengths_nm: Band centres.
        extra: More columns by property name (one word), written as float after the bands.

    Raises:
        InputError: the file cannot be written, for instance because the disk is full.
        ValueError: the arrays' shapes do not fit together, two wavelengths are equal, or a name is taken.
    """
    cloud = SpectralCloud(points_m, normals, colours, spectra, wavelengths_nm, dict(extra or {}))
    write_ply_stream(Path(path), stream(cloud, CHUNK_POINTS))


def write_ply_stream(path: Path, cloud: CloudStream) -> None:
    """Write a cloud piece by piece, whole or not at all.

    Raises:
        InputError: the file cannot be written, for instance because the disk is full.
        ValueError: the pieces do not fit together, two wavelengths are equal, or an extra column's name is taken.
    """
    band_names = band_property_names(cloud.wavelengths_nm)
    names = [*_GEOMETRY, *_COLOUR, *band_names, *cloud.extra_names]
    if len(set(names)) != len(names) or any(len(name.split()) != 1 for name in cloud.extra_names):
        raise ValueError(f"extra columns need one-word names that are not taken: {list(cloud.extra_names)}")
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
        file.write(_header(cloud.count, [*band_names, *cloud.extra_names]))
        for _, chunk in cloud.placed():
            rows = np.empty(len(chunk), layout)
            rows["points"], rows["normals"], rows["colours"] = chunk.points, chunk.normals, chunk.colours
            rows["spectra"] = chunk.spectra
            for index, values in enumerate(chunk.extra.values()):
                rows["extra"][:, index] = values
            rows.tofile(file)


def _parse_header(path: Path) -> tuple[int, np.dtype, int]:
    """Number of points, layout of a point and offset of the first one."""
    with path.open("rb") as file:
        if file.readline().strip() != b"ply":
            raise InputError(f"{path}: is not a PLY file; give a point cloud that was exported as PLY.")
        count, in_vertex, elements, fields = 0, False, 0, []
        for raw in iter(file.readline, b""):
            words = raw.decode("ascii", "replace").split()
            if words[:1] == ["format"] and words[1:2] != ["binary_little_endian"]:
                raise InputError(f"{path}: is not a binary little-endian PLY; save it as one.")
            if words[:1] == ["element"]:
                in_vertex = words[1:2] == ["vertex"]
                elements += 1
                if in_vertex and (elements > 1 or len(words) != 3 or not words[2].isdigit()):
                    break
                count = int(words[2]) if in_vertex else count
            if words[:1] == ["property"] and in_vertex:
                if len(words) != 3 or words[1] not in _TYPES:
                    break
                fields.append((words[2], _TYPES[words[1]]))
            if words == ["end_header"] and fields:
                return count, np.dtype(fields), file.tell()
    raise InputError(f"{path}: its header is not that of a point cloud; export the cloud again.")


def read_spectral_ply(path: Path) -> SpectralCloud:
    """Read a cloud that ``write_spectral_ply`` wrote, its properties in any order (CloudCompare reorders them).

    Raises:
        InputError: the file is missing, is no binary little-endian PLY, is too short, or lacks positions, normals,
            colours or spectral bands.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the PLY file of an exported point cloud.")
    count, layout, offset = _parse_header(path)
    names = list(layout.names or ())
    bands = {name: float(match[1]) for name in names if (match := _BAND_NAME.fullmatch(name))}
    missing = [name for name in (*_GEOMETRY, *_COLOUR) if name not in names]
    if missing or not bands:
        lacking = ", ".join(missing) or "spectral bands (scalar_...nm)"
        raise InputError(f"{path}: has no {lacking}; give a cloud that ns-export wrote from an hsi-sc-nerf run.")
    if (size := path.stat().st_size) < offset + count * layout.itemsize:
        raise InputError(
            f"{path}: has {size} bytes where its header promises {offset + count * layout.itemsize}; export it again."
        )

    extra_names = [name for name in names if name not in bands and name not in (*_GEOMETRY, *_COLOUR)]
    columns = [
        (_GEOMETRY[:3], np.float32),
        (_GEOMETRY[3:], np.float32),
        (_COLOUR, np.uint8),
        (tuple(bands), np.float32),
    ]
    arrays = [np.empty((count, len(group)), kind) for group, kind in columns]
    extra = {name: np.empty(count, np.float32) for name in extra_names}
    with path.open("rb") as file:
        file.seek(offset)
        for start in range(0, count, CHUNK_POINTS):
            part = np.fromfile(file, layout, min(CHUNK_POINTS, count - start))
            chunk = slice(start, start + len(part))
            for array, (group, _) in zip(arrays, columns, strict=True):
                array[chunk] = structured_to_unstructured(part[list(group)])
            for name, values in extra.items():
                values[chunk] = part[name]
    points, normals, colours, spectra = arrays
    return SpectralCloud(points, normals, colours, spectra, np.array(list(bands.values())), extra)
