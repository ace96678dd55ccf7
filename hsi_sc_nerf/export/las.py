"""Spectral point clouds as LAS 1.4 files: a band is a dimension of extra bytes (ASPRS LAS 1.4 R15, "Extra Bytes")."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CloudStream
from hsi_sc_nerf.export.optional import require
from hsi_sc_nerf.export.ply import band_property_names
from hsi_sc_nerf.files import atomic_write

COORDINATE_STEP_M = 1e-6
"""LAS stores positions as whole steps."""
MAX_DIMENSIONS = 341
"""A record of extra bytes is described by 192 bytes, and all descriptions share one record of at most 65535."""
_WITH_COLOURS = 7
_NORMALS = ("NormalX", "NormalY", "NormalZ")  # CloudCompare takes these for normals
_COLOURS = ("red", "green", "blue")
_EIGHT_TO_SIXTEEN_BITS = 257


def require_room(path: Path, num_bands: int, num_extra: int) -> None:
    """Refuse a cloud of more bands, beside its extra columns, than a LAS file holds.

    Raises:
        InputError: there are too many bands.
    """
    room = MAX_DIMENSIONS - len(_NORMALS) - num_extra
    if num_bands > room:
        raise InputError(
            f"{path}: LAS has room for {room} bands and the cloud has {num_bands}; choose some with --bands, or "
            "export as PLY."
        )


def write_las_stream(path: Path, cloud: CloudStream) -> None:
    """Write a cloud as LAS, piece by piece, whole or not at all.

    Positions are metres in steps of a micrometre, colours 16 bits; normals, bands (``397.32nm``) and extra
    columns are float dimensions.

    Raises:
        InputError: the package laspy is missing, there are too many bands, or the file cannot be written.
        ValueError: the pieces do not fit together.
    """
    laspy = require("laspy", "a LAS file")
    require_room(path, len(cloud.wavelengths_nm), len(cloud.extra_names))
    bands = [name.removeprefix("scalar_") for name in band_property_names(cloud.wavelengths_nm)]
    names = [*_NORMALS, *bands, *cloud.extra_names]
    header = laspy.LasHeader(point_format=_WITH_COLOURS, version="1.4")
    header.scales = np.full(3, COORDINATE_STEP_M)
    header.add_extra_dims([laspy.ExtraBytesParams(name, "f4") for name in names])
    with atomic_write(path) as (temporary,), laspy.open(str(temporary), mode="w", header=header) as writer:
        for _, chunk in cloud.placed():
            record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
            record.x, record.y, record.z = np.asarray(chunk.points, np.float64).T
            for name, channel in zip(_COLOURS, chunk.colours.T, strict=True):
                record[name] = channel.astype(np.uint16) * _EIGHT_TO_SIXTEEN_BITS
            columns = [*chunk.normals.T, *chunk.spectra.T, *chunk.extra.values()]
            for name, values in zip(names, columns, strict=True):
                record[name] = values
            writer.write_points(record)
