"""A mesh with a spectrum at each vertex, from the cloud around it; as PLY."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    INCIDENCE,
    LIGHT_COLUMNS,
    SpectralCloud,
    band_property_names,
    material_spectra,
    write_spectral_ply,
)
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.spectra import nearest_bands, to_8_bit

NEIGHBOURS = 8
_EDGE_NEIGHBOURS = 24
"""Nearest points by which the edge of a cloud is found. Fewer lie on one side by chance."""
_ON_EDGE, _AT_POINT = 4.0 / (3.0 * np.pi), 0.1
"""Distance of a half disc's centroid from the middle of its straight side, and that of a point at the vertex itself,
as fractions of the distance of the furthest of these points."""
_CHUNK_VERTICES = 1 << 13


@dataclass(frozen=True)
class LitSpectra:
    """Reflectance as measured, and the light on the vertices.

    Attributes:
        measured: relative to the white reference at its place.
        irradiance: relative to that on the white reference, mean over bands; NaN if the cloud has lost it.
        irradiance_std: its standard deviation; NaN where it is not known.
    """

    measured: Float[np.ndarray, "v bands"]
    irradiance: Float[np.ndarray, "v"]
    irradiance_std: Float[np.ndarray, "v"]


@dataclass(frozen=True)
class SpectralMesh:
    """A closed mesh with spectra on its vertices.

    Attributes:
        mesh: metres, object frame.
        spectra: reflectance, of the material where the cloud has it; unseen vertices have that of the nearest seen
            points.
        wavelengths_nm: band centres.
        seen: vertices with points of the cloud nearby and around them; False on the closed base.
        lit: reflectance as measured and the light that it was measured in, where the cloud tells the two apart.
        scatter: standard deviation of a vertex's measured reflectance, mean over bands, by how much frames disagree;
            NaN where fewer than two frames see it. None if the cloud does not tell.
        metric: whether lengths are metres; else nothing gave the scale.
    """

    mesh: Mesh
    spectra: Float[np.ndarray, "v bands"]
    wavelengths_nm: Float[np.ndarray, "bands"]
    seen: Bool[np.ndarray, "v"]
    lit: LitSpectra | None = None
    scatter: Float[np.ndarray, "v"] | None = None
    metric: bool = True

    @cached_property
    def areas_m2(self) -> Float[np.ndarray, "v"]:
        """Surface area of each vertex, which is found once."""
        return self.mesh.vertex_areas_m2()


def with_spectra(
    mesh: Mesh, cloud: SpectralCloud, seen_within_m: float, max_incidence_deg: float = np.inf
) -> SpectralMesh:
    """Give each vertex the distance-weighted mean spectrum of the `NEIGHBOURS` nearest points.

    Points whose spectrum is not finite are ignored; `hsi-sc-nerf sample` writes NaN where no view sees a point. A
    cloud by `hsi-sc-nerf material` gives the material's spectra, and those measured beside them; points without a
    known material are ignored as well.

    Args:
        mesh: in the frame of the cloud.
        cloud: the points that the mesh was made from.
        seen_within_m: vertices without a point at this distance, or beyond the edge of the points, are unseen.
        max_incidence_deg: points with a larger `INCIDENCE` are ignored, because their pixels are mixed.

    Raises:
        InputError: that leaves no point.
    """
    known, material = np.isfinite(cloud.spectra).all(axis=1), material_spectra(cloud)
    if not known.any():
        raise InputError("no point of the cloud has a spectrum; export the cloud again.")
    if material is not None:
        known &= np.isfinite(material).all(axis=1)
    if not known.any():
        raise InputError(
            "no point of the cloud that has a spectrum has a known material; give `hsi-sc-nerf sample` as --material "
            "the cloud that `hsi-sc-nerf material` made of the same object, or leave that option out."
        )
    used = np.flatnonzero(known & (cloud.extra.get(INCIDENCE, np.zeros(len(cloud))) <= max_incidence_deg))
    if len(used) == 0:
        raise InputError(
            f"no point of the cloud is seen at {max_incidence_deg:g} degrees or less from the front; raise "
            "--max-incidence-deg."
        )
    points = cloud.points[used]
    count = np.arange(1, min(_EDGE_NEIGHBOURS, len(used)) + 1)
    distance_m, neighbours = cKDTree(points).query(mesh.vertices, count, workers=-1)
    seen = (distance_m[:, 0] <= seen_within_m) & ~_beyond_edge(mesh, points, neighbours)
    distance_m, neighbours = distance_m[:, :NEIGHBOURS], neighbours[:, :NEIGHBOURS]
    weights = np.exp(-2.0 * (distance_m / np.maximum(distance_m[:, -1:], 1e-12)) ** 2).astype(np.float32)
    weights /= weights.sum(axis=1, keepdims=True)

    def mean(values: Float[np.ndarray, "n columns"]) -> Float[np.ndarray, "v columns"]:
        found = np.empty((len(neighbours), values.shape[1]), np.float32)
        for start in range(0, len(found), _CHUNK_VERTICES):
            chunk = slice(start, start + _CHUNK_VERTICES)
            found[chunk] = np.einsum("vk,vkb->vb", weights[chunk], values[used[neighbours[chunk]]])
        return found

    spectra, lit, scatter = mean(cloud.spectra), None, None
    if material is not None:
        none = np.full(len(cloud), np.nan)
        light = mean(np.stack([cloud.extra.get(name, none) for name in LIGHT_COLUMNS], axis=1))
        spectra, lit = mean(material), LitSpectra(spectra, *light.T)
    if {"views", "spectral_std"} <= set(cloud.extra):
        with np.errstate(divide="ignore", invalid="ignore"):
            of_points = cloud.extra["spectral_std"] / np.sqrt(cloud.extra["views"])
        scatter = mean(of_points[:, None])[:, 0]
    return SpectralMesh(mesh, spectra, cloud.wavelengths_nm, seen, lit, scatter, cloud.metric)


def _beyond_edge(
    mesh: Mesh, points: Float[np.ndarray, "n 3"], neighbours: Int[np.ndarray, "v k"]
) -> Bool[np.ndarray, "v"]:
    """Vertices whose nearest points lie more to one side, along the surface, than on a straight edge of points."""
    found, normals = np.zeros(len(neighbours), bool), mesh.vertex_normals()
    for start in range(0, len(found), _CHUNK_VERTICES):
        chunk = slice(start, start + _CHUNK_VERTICES)
        offset, normal = points[neighbours[chunk]] - mesh.vertices[chunk, None], normals[chunk, None]
        offset = offset - (offset * normal).sum(axis=-1, keepdims=True) * normal
        distance_m, aside_m = np.linalg.norm(offset, axis=-1), np.linalg.norm(offset.mean(axis=1), axis=-1)
        reach_m = distance_m.max(axis=1)
        found[chunk] = (aside_m > _ON_EDGE * reach_m) & (distance_m.min(axis=1) > _AT_POINT * reach_m)
    return found


def write_spectral_mesh(path: Path, surface: SpectralMesh, extra: dict[str, Float[np.ndarray, "v"]]) -> None:
    """Write a spectral PLY whose points are the vertices, with triangles.

    Columns beside the bands: ``seen`` (1 where spectra were measured, 0 on the closed base), those in ``extra``, and,
    where they are told apart, those of material and light.

    Raises:
        InputError: the file cannot be written.
    """
    mesh, measured = surface.mesh, surface.spectra
    if surface.lit is not None:
        measured = surface.lit.measured
        names = [*band_property_names(surface.wavelengths_nm, "material"), *LIGHT_COLUMNS]
        values = [*surface.spectra.T, surface.lit.irradiance, surface.lit.irradiance_std]
        extra = extra | dict(zip(names, values, strict=True))
    colours = to_8_bit(measured[:, nearest_bands(surface.wavelengths_nm, paper.PSEUDO_RGB_NM)])
    points, normals = mesh.vertices.astype(np.float32), mesh.vertex_normals().astype(np.float32)
    columns = {"seen": surface.seen.astype(np.float32), **extra}
    cloud = SpectralCloud(points, normals, colours, measured, surface.wavelengths_nm, columns, surface.metric)
    write_spectral_ply(path, cloud, mesh.triangles)
