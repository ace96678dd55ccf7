"""Classes on the surface: by spectral angle, by linear unmixing, and the connected regions that they form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.numerics import spectral_angle

UNCLASSIFIED = -1
SMALLEST_REGION_M2 = 5e-6
"""Smaller connected regions are not listed; their area still counts."""
_CHUNK_SPECTRA = 1 << 12


@dataclass(frozen=True)
class ConnectedRegion:
    """A connected part of one class.

    Attributes:
        label: number of the class.
        area_m2: surface area.
        centre_m: mean position, weighted by area, object frame.
    """

    label: int
    area_m2: float
    centre_m: tuple[float, float, float]


def spectral_angles(
    spectra: Float[np.ndarray, "n bands"], references: Float[np.ndarray, "classes bands"]
) -> Float[np.ndarray, "n classes"]:
    """Angle between each spectrum and each reference, radians in [0, pi] (paper, Eq. SAM)."""
    angles = np.empty((len(spectra), len(references)), np.float32)
    targets = torch.from_numpy(np.asarray(references, np.float32))
    for start in range(0, len(spectra), _CHUNK_SPECTRA):
        some = torch.from_numpy(np.asarray(spectra[start : start + _CHUNK_SPECTRA], np.float32))
        for column, reference in enumerate(targets):
            angles[start : start + len(some), column] = spectral_angle(some, reference.expand_as(some)).numpy()
    return angles


def classify(
    spectra: Float[np.ndarray, "n bands"], references: Float[np.ndarray, "classes bands"], threshold_rad: float
) -> Int[np.ndarray, "n"]:
    """Spectral angle mapper: the index of the reference with the smallest spectral angle (Kruse et al. 1993).

    The angle does not depend on brightness, so shade does not change a class.

    -1 is returned where every angle exceeds ``threshold_rad``.

    Example:
        >>> references = np.array([[0.1, 0.5], [0.5, 0.1]])
        >>> classify(np.array([[0.2, 0.9], [0.3, 0.3]]), references, threshold_rad=0.1)
        array([ 0, -1])
    """
    angles = spectral_angles(spectra, references)
    nearest = angles.argmin(axis=1)
    return np.where(angles.min(axis=1) <= threshold_rad, nearest, UNCLASSIFIED)


def class_areas_m2(
    labels: Int[np.ndarray, "v"], areas_m2: Float[np.ndarray, "v"], seen: Bool[np.ndarray, "v"], classes: int
) -> Float[np.ndarray, "classes_and_none"]:
    """Area of each class; the last entry is the seen area that is in no class."""
    classes_of = np.where(labels == UNCLASSIFIED, classes, labels)
    return np.bincount(classes_of[seen], areas_m2[seen], minlength=classes + 1)


def connected_regions(
    mesh: Mesh, labels: Int[np.ndarray, "v"], areas_m2: Float[np.ndarray, "v"], smallest_m2: float
) -> list[ConnectedRegion]:
    """Connected regions of one class with an area of at least ``smallest_m2``, in descending order of area."""
    piece = mesh.pieces(labels)
    area = np.bincount(piece, areas_m2)
    centre = np.stack([np.bincount(piece, areas_m2 * x) for x in mesh.vertices.T], axis=-1)
    label = np.full(len(area), UNCLASSIFIED)
    label[piece] = labels
    listed = np.flatnonzero((label != UNCLASSIFIED) & (area >= smallest_m2))
    return [
        ConnectedRegion(int(label[i]), float(area[i]), tuple((centre[i] / area[i]).tolist()))
        for i in listed[np.argsort(-area[listed])]
    ]


def unmix(
    spectra: Float[np.ndarray, "n bands"], endmembers: Float[np.ndarray, "endmembers bands"]
) -> tuple[Float[np.ndarray, "n endmembers"], Float[np.ndarray, "n"]]:
    """Linear spectral unmixing: the fraction of each endmember in each spectrum.

    Non-negative least squares (Heinz and Chang 2001, "Fully constrained least squares linear spectral mixture
    analysis"). The fractions are scaled to add up to 1 afterwards, so that they do not depend on brightness.

    Returns:
        Fractions in [0, 1], which add up to 1 (all 0 where a spectrum holds no endmember), and the spectral angle
        between spectrum and mixture, radians (pi / 2 there).
    """
    wide = np.asarray(endmembers, float)
    # Mixtures lie in the space that the endmembers span, where the problem has as many rows as there are endmembers.
    axes, coordinates = np.linalg.qr(wide.T)
    amounts = np.zeros((len(spectra), len(wide)))
    for row, projected in zip(amounts, np.asarray(spectra, float) @ axes, strict=True):
        row[:] = nnls(coordinates, projected)[0]
    total = amounts.sum(axis=1, keepdims=True)
    fractions = np.divide(amounts, total, out=np.zeros_like(amounts), where=total > 0.0)
    measured, mixed = (torch.from_numpy(np.asarray(one, np.float32)) for one in (spectra, amounts @ wide))
    return fractions, spectral_angle(measured, mixed).numpy()
