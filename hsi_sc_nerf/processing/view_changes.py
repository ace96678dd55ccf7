"""How the brightness of the object's points changes, from view to view and from place to place, before any training.

What changes with the direction that a point faces in the camera's frame is light or gloss that stands still with the
camera. It is fitted beside each frame's own brightness, and each sector of the object is predicted by the others: the
object's texture, which wrong poses and a hull beside the surface shift, and noise then count for nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.processing.sightings import Sightings

NORMAL_CELLS = 6
"""Cells of the normals' directions to the right and upwards in the camera's frame."""
MOST_CHANGE = 1.0
"""Relative changes are cut off here: larger ones are the chamber's pixels in a wrong mask."""
ALIKE = 12
"""A point's brightness is compared with that of so many others of the most similar spectra."""
_RIDGE = 1e-6
_LEAST_RIDGE = 1e-12


@dataclass(frozen=True)
class Change:
    """A change, root mean square, and the standard deviation of what is found."""

    rms: float
    noise: float


def change_with_direction(sightings: Sightings) -> Change:
    """Change of points' spectra with the direction that they face, relative to their brightness.

    Example:
        >>> seen = sightings(bins, masks, camera_to_worlds, intrinsics, hull)
        >>> change_with_direction(seen).rms
        0.083
    """
    s = sightings
    count, colours = len(s.positions_m), s.reflectance.shape[1]
    brightness = _mean_of(s.reflectance.mean(axis=1), s.point, count)
    scale = np.maximum(brightness, 1e-3)[s.point]
    kinds = [_indicators(_facing(s)), _indicators(s.frame)]
    cells = kinds[0].shape[1]
    shared = np.concatenate(kinds, axis=1)
    shared -= _mean_of(shared, s.point, count)[s.point]
    products = []
    for colour in range(colours):
        response = s.reflectance[:, colour] / scale
        response -= _mean_of(response, s.point, count)[s.point]
        response = response.clip(-MOST_CHANGE, MOST_CHANGE)
        products.append([_products(shared[rows], response[rows]) for rows in _rows_of(s.sector[s.point])])
    return _predicted(products, cells)


def change_with_height(sightings: Sightings) -> Change:
    """Relative change of brightness with height and slope among points of like spectra.

    Light from the chamber's walls and the lid's shade show here, and so does a material whose brightness alone
    changes with height.
    """
    s = sightings
    count = len(s.positions_m)
    spectra = _mean_of(s.reflectance, s.point, count)
    seen = np.unique(s.point)
    spectra = np.maximum(spectra[seen], 1e-4)
    brightness = np.log(spectra.mean(axis=1))
    shapes = spectra / np.linalg.norm(spectra, axis=1, keepdims=True)
    _, alike = cKDTree(shapes).query(shapes, min(ALIKE + 1, len(seen)))
    height, slope = (_tertile(values[seen]) for values in (s.positions_m[:, 2], s.normals[:, 2]))
    causes = _indicators(3 * height + slope)
    causes = causes - causes[alike].mean(axis=1)
    response = brightness - brightness[alike].mean(axis=1)
    rows = _rows_of(s.sector[seen])
    return _predicted([[_products(causes[part], response[part]) for part in rows]], causes.shape[1])


def _facing(sightings: Sightings) -> Int[np.ndarray, "n"]:
    """Cell of the normal's direction in the camera's frame."""
    cell = ((sightings.normal[:, :2] + 1.0) / 2.0 * NORMAL_CELLS).astype(int).clip(0, NORMAL_CELLS - 1)
    return cell[:, 0] * NORMAL_CELLS + cell[:, 1]


def change_of(variances: Sequence[float], sizes: Sequence[int]) -> Change:
    """The change whose mean square was found several times, independently; negative ones are noise."""
    error = float(np.std(variances, ddof=1) / np.sqrt(len(variances)))
    rms = float(np.sqrt(max(np.average(variances, weights=sizes), 0.0)))
    return Change(rms, float(np.sqrt(error)) if rms**2 <= error else error / (2.0 * rms))


def _mean_of(values: Float[np.ndarray, "n *k"], index: Int[np.ndarray, "n"], count: int) -> np.ndarray:
    """Mean of the rows of each index; 0 without any."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, index, values)
    number = np.maximum(np.bincount(index, minlength=count), 1)
    return total / number.reshape(-1, *[1] * (values.ndim - 1))


def _indicators(kind: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n kinds"]:
    return (kind[:, None] == np.unique(kind)).astype(float)


def _tertile(values: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    return np.searchsorted(np.quantile(values, [1 / 3, 2 / 3]), values)


def _rows_of(sector: Int[np.ndarray, "n"]) -> list[np.ndarray]:
    return [np.flatnonzero(sector == number) for number in np.unique(sector)]


def _products(
    causes: Float[np.ndarray, "n k"], response: Float[np.ndarray, "n"]
) -> tuple[np.ndarray, np.ndarray, int]:
    return causes.T @ causes, causes.T @ response, len(response)


def _predicted(products: Sequence[Sequence[tuple[np.ndarray, np.ndarray, int]]], wanted: int) -> Change:
    """What the first ``wanted`` causes explain in each sector as the other sectors say, over all colours."""
    explained, sizes = [], []
    for held in range(len(products[0])):
        covariance = 0.0
        for sectors in products:
            square = np.sum([part[0] for k, part in enumerate(sectors) if k != held], axis=0)
            right = np.sum([part[1] for k, part in enumerate(sectors) if k != held], axis=0)
            # Where all points face alike in all frames there is nothing to explain.
            ridge = max(_RIDGE * np.trace(square) / len(square), _LEAST_RIDGE) * np.eye(len(square))
            effects = np.linalg.solve(square + ridge, right)
            own_square, own_right, size = sectors[held]
            rest = own_right - own_square[:, wanted:] @ effects[wanted:]
            covariance += float(effects[:wanted] @ rest[:wanted]) / max(size, 1) / len(products)
        explained.append(covariance)
        sizes.append(size)
    return change_of(explained, sizes)
