"""Classes on the surface by spectral angle, and the connected regions that they form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.analysis.poisson import pieces
from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.numerics import spectral_angle

UNCLASSIFIED = -1
_CHUNK_SPECTRA = 1 << 12


@dataclass(frozen=True)
class Region:
    """A connected part of one class.

    Attributes:
        label: number of the class.
        area_m2: on the surface.
        centre_m: mean place, weighted by area.
    """

    label: int
    area_m2: float
    centre_m: tuple[float, float, float]


def spectral_angles(
    spectra: Float[np.ndarray, "n bands"], references: Float[np.ndarray, "classes bands"]
) -> Float[np.ndarray, "n classes"]:
    """Angle of each spectrum to each reference, radians (paper, Eq. SAM)."""
    angles = np.empty((len(spectra), len(references)), np.float32)
    wanted = torch.from_numpy(np.asarray(references, np.float32))
    for start in range(0, len(spectra), _CHUNK_SPECTRA):
        some = torch.from_numpy(np.asarray(spectra[start : start + _CHUNK_SPECTRA], np.float32))
        for column, reference in enumerate(wanted):
            angles[start : start + len(some), column] = spectral_angle(some, reference.expand_as(some)).numpy()
    return angles


def classify(
    spectra: Float[np.ndarray, "n bands"], references: Float[np.ndarray, "classes bands"], threshold_rad: float
) -> Int[np.ndarray, "n"]:
    """The reference with the smallest spectral angle (Kruse et al. 1993), or -1 where it is over the threshold.

    Angles do not depend on brightness: shade does not change a class.
    """
    angles = spectral_angles(spectra, references)
    nearest = angles.argmin(axis=1)
    return np.where(angles.min(axis=1) <= threshold_rad, nearest, UNCLASSIFIED)


def vertex_areas_m2(mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Each vertex's share of the surface: a third of each of its triangles. They add up to the mesh's area."""
    thirds = np.repeat(mesh.triangle_areas_m2() / 3.0, 3)
    return np.bincount(mesh.triangles.ravel(), thirds, minlength=len(mesh.vertices))


def class_areas_m2(
    labels: Int[np.ndarray, "v"], areas_m2: Float[np.ndarray, "v"], seen: Bool[np.ndarray, "v"], classes: int
) -> Float[np.ndarray, "classes_and_none"]:
    """Area of each class, and as the last entry of what was seen but is in none."""
    places = np.where(labels == UNCLASSIFIED, classes, labels)
    return np.bincount(places[seen], areas_m2[seen], minlength=classes + 1)


def connected_regions(
    mesh: Mesh, labels: Int[np.ndarray, "v"], areas_m2: Float[np.ndarray, "v"], smallest_m2: float
) -> list[Region]:
    """Connected regions of equal class with at least ``smallest_m2``, the largest first; unclassified is no class."""
    a, b, c = labels[mesh.triangles].T
    same_ab, same_bc, same_ca = a == b, b == c, c == a
    t = mesh.triangles
    edges = np.concatenate([t[same_ab][:, [0, 1, 1]], t[same_bc][:, [1, 2, 2]], t[same_ca][:, [2, 0, 0]]])
    piece = pieces(edges, len(labels))
    area = np.bincount(piece, areas_m2)
    centre = np.stack([np.bincount(piece, areas_m2 * x) for x in mesh.vertices.T], axis=-1)
    label = np.full(len(area), UNCLASSIFIED)
    label[piece] = labels
    listed = np.flatnonzero((label != UNCLASSIFIED) & (area >= smallest_m2))
    return [
        Region(int(label[i]), float(area[i]), tuple((centre[i] / area[i]).tolist()))
        for i in listed[np.argsort(-area[listed])]
    ]
