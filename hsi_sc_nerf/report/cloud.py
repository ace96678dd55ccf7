"""A spectral cloud compressed for the page: fewer points, and spectra as 16-bit coefficients of a basis."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int16, UInt16
from matplotlib import colormaps
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.calibrations import Calibration
from hsi_sc_nerf.analysis.class_maps import most_probable, rest_words
from hsi_sc_nerf.analysis.classes import UNCLASSIFIED, class_areas_m2
from hsi_sc_nerf.export.cloud import SpectralCloud, band_property_names, material_spectra
from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.indices.formula import index_values
from hsi_sc_nerf.plotting import INDEX_COLOURS, usual_range
from hsi_sc_nerf.spectra import available_composites

_INT16 = 32767
_MISSING = 65535
# Below the resolution of screens and of the instrument.
TOLERANCE = 5e-4
MAX_RANK = 32
_NEIGHBOURS = 8
"""Neighbours of a point whose distance tells how many points there are on an area."""


@dataclass(frozen=True, eq=False)
class CompressedSpectra:
    """Spectra as ``mean + (coefficients * scale) @ basis``.

    Attributes:
        mean: mean spectrum.
        basis: orthonormal rows, those of the largest variance first.
        scale: reflectance of one count of each coefficient.
        coefficients: counts.
        rmse: root mean square of what was lost, reflectance.
        largest_error: of any value, reflectance.
    """

    mean: Float[np.ndarray, "bands"]
    basis: Float[np.ndarray, "rank bands"]
    scale: Float[np.ndarray, "rank"]
    coefficients: Int16[np.ndarray, "n rank"]
    rmse: float
    largest_error: float


def compress_spectra(spectra: Float[np.ndarray, "n bands"], max_rank: int = MAX_RANK) -> CompressedSpectra:
    """Principal components of finite reflectance.

    As many, up to ``max_rank``, as every band's root mean square error needs to fall below `TOLERANCE`.
    """
    mean = spectra.mean(axis=0, dtype=float)
    centred = spectra - mean
    variances, vectors = np.linalg.eigh(centred.T @ centred / len(spectra))
    variances, basis = np.maximum(variances[::-1], 0.0), vectors[:, ::-1].T
    # Variance of each band that the components from each on hold together.
    held = np.cumsum((variances[:, None] * basis**2)[::-1], axis=0)[::-1]
    good = np.flatnonzero(np.append(held, np.zeros((1, held.shape[1])), axis=0).max(axis=1) <= TOLERANCE**2)
    rank = int(np.clip(good[0], 1, max_rank))
    basis = basis[:rank]
    coefficients = centred @ basis.T
    scale = np.maximum(np.abs(coefficients).max(axis=0), np.finfo(np.float32).tiny) / _INT16
    counts = np.rint(coefficients / scale).astype(np.int16)
    lost = (counts * scale) @ basis - centred
    return CompressedSpectra(mean, basis, scale, counts, float(np.sqrt(np.mean(lost**2))), float(np.abs(lost).max()))


def quantise(values: Float[np.ndarray, "n"]) -> tuple[UInt16[np.ndarray, "n"], float, float]:
    """Values as 16-bit counts, and their smallest and largest value; NaN and infinity become 65535."""
    finite = np.isfinite(values)
    low, high = (float(f(values[finite])) for f in (np.min, np.max)) if finite.any() else (0.0, 1.0)
    fractions = (np.where(finite, values, low) - low) / ((high - low) or 1.0)
    return np.where(finite, np.rint(fractions * (_MISSING - 1)), _MISSING).astype(np.uint16), low, high


def point_areas_m2(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """The surface that each point stands for: that within its eighth neighbour, over eight."""
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    if neighbours < 1:
        return np.zeros(len(points))
    reach, _ = cKDTree(points).query(points, [neighbours + 1])
    return np.pi / neighbours * np.square(reach[:, 0])


def _base64(array: np.ndarray) -> str:
    """Bytes of an array, little-endian, in base64."""
    return base64.b64encode(np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes()).decode()


def _scalar(name: str, tells: str, values: Float[np.ndarray, "n"], drawn: Sequence[float] | None) -> dict[str, Any]:
    """A number of each point; ``drawn`` is what the ends of the colour map stand for, all of them without it."""
    counts, low, high = quantise(values)
    ends = [low, high]
    return {"name": name, "tells": tells, "data": _base64(counts), "range": ends, "drawn": drawn or ends}


def _measures(
    spectra: Float[np.ndarray, "n bands"],
    nm: Float[np.ndarray, "bands"],
    of_what: str,
    indices: Sequence[str],
    calibrated: Sequence[_Calibrated],
) -> Iterator[dict[str, Any]]:
    """What indices and calibrations tell of each point, from the material's spectra where they are known."""
    for index in find_indices(indices, nm):
        values = index_values(index, spectra, nm)
        drawn = index.drawn_range if index.has_range else usual_range(values)
        tells = f"{index.expression}: {index.tells}{of_what}"
        yield _scalar(index.name, tells, values, drawn) | {"index": True, "unit": ""}
    for one, found in calibrated:
        for label, values in zip(one.classes or ("",), found.T, strict=True):
            drawn = (0.0, 1.0) if label else usual_range(values)
            tells = f"probability by {one.name}" if label else one.unit or "calibration"
            scalar = _scalar(f"{one.name} {label}".strip(), f"{tells}{of_what}", values, drawn)
            yield scalar | {"index": True, "unit": "" if label else one.unit}


_Calibrated = tuple[Calibration, Float[np.ndarray, "n outputs"]]
"""A calibration, and what it says of each point."""


def _classified(one: _Calibrated, areas_m2: Float[np.ndarray, "n"]) -> dict[str, Any]:
    """The class of each point, and the area of each class, then that which the classifier does not know."""
    calibration, labels = one[0], most_probable(one[1])
    every = np.ones(len(labels), bool)
    areas_cm2 = 1e4 * class_areas_m2(labels, areas_m2, every, len(calibration.classes))
    counts = np.where(labels == UNCLASSIFIED, _MISSING, labels).astype(np.uint16)
    return {
        "name": calibration.name,
        "classes": list(calibration.classes),
        "rest": rest_words(calibration.domain is not None),
        "labels": _base64(counts),
        "areas_cm2": areas_cm2.tolist(),
    }


def cloud_payload(
    cloud: SpectralCloud,
    spectra: CompressedSpectra,
    indices: Sequence[str] = (),
    calibrations: Sequence[Calibration] = (),
) -> dict[str, Any]:
    """Data of the page's viewer (``templates/cloud_data.js``), for JSON.

    Args:
        cloud: the points to show (`points_of_page`).
        spectra: spectra of the same points.
        indices: to offer, as `find_indices` reads them.
        calibrations: to offer; of a classifier the classes, and the probability of each.

    Raises:
        InputError: an index or a calibration cannot be computed.
    """
    order = np.argsort(cloud.wavelengths_nm)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    centre, reach_m = (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1e-9)
    areas_m2 = point_areas_m2(cloud.points)
    nm, material = cloud.wavelengths_nm, material_spectra(cloud)
    analysed, of_what = (cloud.spectra, "") if material is None else (material, ", of the material")
    calibrated = [(one, one.predictions(analysed, nm, only_inside=True)) for one in calibrations]
    scalars = [*_measures(analysed, nm, of_what, indices, calibrated)]
    of_material = set(band_property_names(cloud.wavelengths_nm, "material"))
    scalars += [
        _scalar(name, "column of the cloud", values, None)
        for name, values in cloud.extra.items()
        if name not in of_material
    ]
    return {
        "count": len(cloud.points),
        "centre_m": centre.tolist(),
        "reach_m": reach_m,
        "spacing": float(np.sqrt(np.median(areas_m2))) / reach_m,
        "areas_cm2": _scalar("", "", 1e4 * areas_m2, None),
        "positions": _base64(np.rint((cloud.points - centre) / reach_m * _INT16).astype(np.int16)),
        "normals": _base64(np.rint(unit_vectors(cloud.normals) * 127.0).astype(np.int8)),
        "wavelengths_nm": cloud.wavelengths_nm[order].tolist(),
        "mean": spectra.mean[order].tolist(),
        "rank": len(spectra.basis),
        "basis": _base64((spectra.scale[:, None] * spectra.basis[:, order]).astype(np.float32)),
        "coefficients": _base64(spectra.coefficients),
        "composites": [
            {"name": c.name, "tells": c.shows, "nm": list(c.wavelengths_nm)}
            for c in available_composites(cloud.wavelengths_nm)
        ],
        "scalars": scalars,
        "classifiers": [_classified(one, areas_m2) for one in calibrated if one[0].classes],
        "colour_map": _base64(np.rint(255.0 * colormaps[INDEX_COLOURS](np.arange(256))[:, :3]).astype(np.uint8)),
    }
