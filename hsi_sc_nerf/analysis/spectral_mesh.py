"""A mesh with a spectrum at each vertex, from the cloud around it; as PLY."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.classes import vertex_areas_m2
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import INCIDENCE, SpectralCloud
from hsi_sc_nerf.export.ply import write_spectral_ply
from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands, to_8_bit

NEIGHBOURS = 8
_CHUNK_VERTICES = 1 << 13


@dataclass(frozen=True)
class SpectralMesh:
    """A closed mesh with spectra on its vertices.

    Attributes:
        mesh: metres, object frame.
        spectra: reflectance; at vertices that were not seen, of the nearest points that were.
        wavelengths_nm: band centres.
        seen: which vertices have points near them whose spectra were used; the closed base has none.
    """

    mesh: Mesh
    spectra: Float[np.ndarray, "v bands"]
    wavelengths_nm: Float[np.ndarray, "bands"]
    seen: Bool[np.ndarray, "v"]

    @cached_property
    def areas_m2(self) -> Float[np.ndarray, "v"]:
        """Surface area of each vertex."""
        return vertex_areas_m2(self.mesh)


def with_spectra(
    mesh: Mesh, cloud: SpectralCloud, seen_within_m: float, max_incidence_deg: float = np.inf
) -> SpectralMesh:
    """Give each vertex the mean spectrum of the `NEIGHBOURS` nearest points, near ones weighing more.

    Points whose spectrum is not finite are left out: `hsi-sc-nerf sample` writes NaN where no view sees a point.

    Args:
        mesh: in the frame of the cloud.
        cloud: the points it was made from.
        seen_within_m: a vertex with no point as near as this was not seen.
        max_incidence_deg: points whose column `INCIDENCE` is larger are left out: their pixels smear the surface, and
            at its rim show what lies beside it.

    Raises:
        InputError: that leaves no point.
    """
    known = np.isfinite(cloud.spectra).all(axis=1)
    if not known.any():
        raise InputError("no point of the cloud has a spectrum; export the cloud again.")
    used = np.flatnonzero(known & (cloud.extra.get(INCIDENCE, np.zeros(len(cloud))) <= max_incidence_deg))
    if len(used) == 0:
        raise InputError(
            f"no point of the cloud is seen at {max_incidence_deg:g} degrees or less from the front; raise "
            "--max-incidence-deg."
        )
    tree = cKDTree(cloud.points[used])
    spectra = np.empty((len(mesh.vertices), cloud.spectra.shape[1]), np.float32)
    seen = np.empty(len(mesh.vertices), bool)
    count = min(NEIGHBOURS, len(used))
    for start in range(0, len(spectra), _CHUNK_VERTICES):
        chunk = slice(start, start + _CHUNK_VERTICES)
        distance_m, neighbour = tree.query(mesh.vertices[chunk], np.arange(1, count + 1), workers=-1)
        weight = np.exp(-2.0 * (distance_m / np.maximum(distance_m[:, -1:], 1e-12)) ** 2).astype(np.float32)
        weight /= weight.sum(axis=1, keepdims=True)
        spectra[chunk] = np.einsum("vk,vkb->vb", weight, cloud.spectra[used[neighbour]])
        seen[chunk] = distance_m[:, 0] <= seen_within_m
    return SpectralMesh(mesh, spectra, cloud.wavelengths_nm, seen)


def write_mesh(path: Path, surface: SpectralMesh, extra: dict[str, Float[np.ndarray, "v"]]) -> None:
    """Write the mesh as a spectral PLY whose points are the vertices, followed by the triangles.

    Columns beside the bands: ``seen`` (1 where there are spectra, 0 on what was closed) and those in ``extra``.

    Raises:
        InputError: the file cannot be written.
    """
    mesh = surface.mesh
    colours = to_8_bit(surface.spectra[:, nearest_bands(surface.wavelengths_nm, paper.PSEUDO_RGB_NM)])
    cloud = SpectralCloud(
        mesh.vertices.astype(np.float32),
        mesh.vertex_normals().astype(np.float32),
        colours,
        surface.spectra,
        surface.wavelengths_nm,
        {"seen": surface.seen.astype(np.float32), **extra},
    )
    write_spectral_ply(path, cloud, mesh.triangles)
