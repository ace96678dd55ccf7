"""An object on several days on one mesh, that of the first: spectra and surface of each day at its vertices."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.change_features import surface_samples
from hsi_sc_nerf.analysis.change_registration import Attitude, find_attitude
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh
from hsi_sc_nerf.analysis.spectral_mesh import NEIGHBOURS, SpectralMesh, with_spectra
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import INCIDENCE, SpectralCloud, material_spectra
from hsi_sc_nerf.geometry.camera import Similarity

SAME_BAND_NM = 1.0
"""Bands of two days that are further apart are others."""
SEEN_WITHIN = 2.0
"""Smoothing radii from a vertex within which a day's cloud must have points: surfaces move."""


@dataclass(frozen=True)
class Day:
    """An object on a day.

    Attributes:
        name: name of the day.
        surface: the first day's mesh with this day's spectra.
        raised_m: distance of this day's points from the mesh along its normals.
        conditions: of the points around each vertex what makes their errors larger, the larger the worse: smallest
            incidence angle, how few views see them, how far they lie from a plane; 0 where the cloud does not tell.
        attitude: how the object was set down relative to the first day; None on that.
    """

    name: str
    surface: SpectralMesh
    raised_m: Float[np.ndarray, "v"]
    conditions: Float[np.ndarray, "v 3"]
    attitude: Attitude | None


def days_on_one_mesh(
    clouds: Sequence[SpectralCloud],
    names: Sequence[str],
    config: MeshConfig,
    max_incidence_deg: float,
    track: Callable[[list[Similarity]], Iterable[Similarity]] = iter,
) -> list[Day]:
    """Register each later cloud to the first, and bring its spectra and its surface to the first one's mesh.

    Spectra are the material's if all clouds have them.

    Args:
        clouds: clouds of one object, in the order of days.
        names: names of the days.
        config: configuration of the mesh.
        max_incidence_deg: points that no camera sees at a smaller angle give no spectra.
        track: wraps the starts of each registration, for a progress bar.

    Raises:
        InputError: the clouds have other bands, a cloud is too small, or a day cannot be registered.

    Example:
        >>> clouds = [read_spectral_ply(Path(day, "point_cloud.ply")) for day in ("monday", "friday")]
        >>> days = days_on_one_mesh(clouds, ("monday", "friday"), MeshConfig(), 65.0)
    """
    clouds = [cloud.with_ascending_bands() for cloud in clouds]
    nm = clouds[0].wavelengths_nm
    for cloud, name in zip(clouds, names, strict=True):
        if len(cloud.wavelengths_nm) != len(nm) or np.abs(cloud.wavelengths_nm - nm).max() > SAME_BAND_NM:
            raise InputError(f"{name}: has other bands than {names[0]}; export both with the same ones (--bands).")
    spectra = [material_spectra(cloud) for cloud in clouds]
    if any(one is None for one in spectra):
        kept = ("views", "spectral_std", INCIDENCE)
        clouds = [replace(one, extra={k: one.extra[k] for k in kept if k in one.extra}) for one in clouds]
        spectra = [cloud.spectra for cloud in clouds]
    known = [np.isfinite(one).all(axis=1) for one in spectra if one is not None]
    clouds = [cloud.select(rows) for cloud, rows in zip(clouds, known, strict=True)]
    samples = surface_samples(
        clouds, [one[rows] for one, rows in zip(spectra, known, strict=True) if one is not None], names
    )

    mesh = closed_mesh(clouds[0].points, clouds[0].normals, config)
    normals = mesh.vertex_normals()
    days: list[Day] = []
    for cloud, name, sample in zip(clouds, names, samples, strict=True):
        attitude, moved = None, cloud
        if days:
            try:
                attitude = find_attitude(sample, samples[0], track)
            except InputError as error:
                raise InputError(f"{name} beside {names[0]}: {error}") from error
            moved = replace(cloud, points=attitude.transform(cloud.points))
        surface = with_spectra(mesh, moved, SEEN_WITHIN * config.smoothing_radius_m, max_incidence_deg)
        near = cKDTree(moved.points).query(mesh.vertices, k=min(NEIGHBOURS, len(moved.points)))[1]
        offset = moved.points[near].mean(axis=1) - mesh.vertices
        raised_m = np.einsum("vj,vj->v", offset, normals)
        seen_raised_m = np.where(surface.seen, raised_m, np.nan)
        days.append(Day(name, surface, seen_raised_m, _conditions(moved, near), attitude))
    return days


def _conditions(cloud: SpectralCloud, near: Int[np.ndarray, "v k"]) -> Float[np.ndarray, "v 3"]:
    none = np.zeros(len(cloud))
    incidence, views = (cloud.extra.get(name, none)[near].mean(axis=1) for name in (INCIDENCE, "views"))
    off = cloud.points[near] - cloud.points[near].mean(axis=1, keepdims=True)
    # The smallest eigenvalue of the covariance is the variance across the plane that fits best.
    across = np.linalg.eigvalsh(np.einsum("vki,vkj->vij", off, off))[:, 0]
    return np.stack([incidence, -views, np.sqrt(np.maximum(across, 0.0))], axis=1)
