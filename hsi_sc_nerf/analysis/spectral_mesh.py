"""A mesh with a spectrum at each vertex, from the cloud around it; as PLY."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import INCIDENCE, SpectralCloud
from hsi_sc_nerf.export.ply import write_spectral_ply
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.spectra import nearest_bands, to_8_bit

NEIGHBOURS = 8
_CHUNK_VERTICES = 1 << 13


@dataclass(frozen=True)
class SpectralMesh:
    """A closed mesh with spectra on its vertices.

    Attributes:
        mesh: metres, object frame.
        spectra: reflectance; unseen vertices have that of the nearest seen points.
        wavelengths_nm: band centres.
        seen: vertices with points of the cloud nearby; False on the closed base.
    """

    mesh: Mesh
    spectra: Float[np.ndarray, "v bands"]
    wavelengths_nm: Float[np.ndarray, "bands"]
    seen: Bool[np.ndarray, "v"]

    @cached_property
    def areas_m2(self) -> Float[np.ndarray, "v"]:
        """Surface area of each vertex: a third of each of its triangles. The areas add up to the mesh's area."""
        thirds = np.repeat(self.mesh.triangle_areas_m2() / 3.0, 3)
        return np.bincount(self.mesh.triangles.ravel(), thirds, minlength=len(self.mesh.vertices))


def with_spectra(
    mesh: Mesh, cloud: SpectralCloud, seen_within_m: float, max_incidence_deg: float = np.inf
) -> SpectralMesh:
    """Give each vertex the distance-weighted mean spectrum of the `NEIGHBOURS` nearest points.

    Points whose spectrum is not finite are ignored; `hsi-sc-nerf sample` writes NaN where no view sees a point.

    Args:
        mesh: in the frame of the cloud.
        cloud: the points that the mesh was made from.
        seen_within_m: vertices without a point at this distance are unseen.
        max_incidence_deg: points with a larger `INCIDENCE` are ignored, because their pixels are mixed.

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
    """Write a spectral PLY whose points are the vertices, with triangles.

    Columns beside the bands: ``seen`` (1 where spectra were measured, 0 on the closed base) and those in ``extra``.

    Raises:
        InputError: the file cannot be written.
    """
    mesh = surface.mesh
    colours = to_8_bit(surface.spectra[:, nearest_bands(surface.wavelengths_nm, paper.PSEUDO_RGB_NM)])
    points, normals = mesh.vertices.astype(np.float32), mesh.vertex_normals().astype(np.float32)
    columns = {"seen": surface.seen.astype(np.float32), **extra}
    cloud = SpectralCloud(points, normals, colours, surface.spectra, surface.wavelengths_nm, columns)
    write_spectral_ply(path, cloud, mesh.triangles)
