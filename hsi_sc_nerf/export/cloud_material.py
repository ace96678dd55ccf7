"""The material's reflectance: on a cloud, by the light in its run, and from there at any point of the object.

The irradiance in that cloud is that of the view that gave a point its material: the object turns under lamps that
stand still. The material's reflectance is the same in all views, so that it is what other points and views get.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    CHUNK_POINTS,
    GLOSS,
    LIGHT_COLUMNS,
    SpectralCloud,
    band_property_names,
    material_spectra,
    read_spectral_ply,
)
from hsi_sc_nerf.light.fit import WHITE_STD
from hsi_sc_nerf.light.of_run import RunLight
from hsi_sc_nerf.spectra import same_bands

NEIGHBOURS = 4
"""Points of the cloud whose mean a point gets."""
MAX_DISTANCE_M = 0.003
"""A point further from all of the cloud's has no known material."""


@dataclass(frozen=True, eq=False)
class CloudMaterial:
    """Reflectance of the material at the points of a cloud.

    Attributes:
        points_m: object frame.
        spectra: reflectance of the material, finite.
        relative_std: standard deviation of the irradiance over the irradiance; NaN where it is not known.
    """

    points_m: Float[np.ndarray, "n 3"]
    spectra: Float[np.ndarray, "n bands"]
    relative_std: Float[np.ndarray, "n"]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points_m)

    def at(self, points_m: Float[np.ndarray, "m 3"]) -> tuple[Float[np.ndarray, "m bands"], Float[np.ndarray, "m"]]:
        """Distance-weighted mean of the nearest points' spectra, and the relative standard deviation of their light.

        Args:
            points_m: object frame. Those further than `MAX_DISTANCE_M` from the cloud, or not finite, get NaN.
        """
        spectra = np.full((len(points_m), self.spectra.shape[1]), np.nan, np.float32)
        std = np.full(len(points_m), np.nan, np.float32)
        count = np.arange(1, min(NEIGHBOURS, len(self.points_m)) + 1)
        finite = np.flatnonzero(np.isfinite(points_m).all(axis=1))
        for start in range(0, len(finite), CHUNK_POINTS):
            rows = finite[start : start + CHUNK_POINTS]
            distance_m, nearest = self._tree.query(points_m[rows], count, workers=-1)
            near = distance_m[:, 0] <= MAX_DISTANCE_M
            rows, distance_m, nearest = rows[near], distance_m[near], nearest[near]
            weights = 1.0 / (distance_m + 1e-6)
            weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
            spectra[rows] = np.einsum("mk,mkb->mb", weights, self.spectra[nearest])
            std[rows] = (weights * self.relative_std[nearest]).sum(axis=1)
        return spectra, std


def with_material(
    cloud: SpectralCloud, found: RunLight, run_nm: Float[np.ndarray, "bands"], *, corrected: bool
) -> SpectralCloud:
    """The cloud with the columns of material and irradiance, and that of gloss if some was found.

    Args:
        found: the light in the run.
        corrected: whether the light is taken out; else the material is what was measured.

    Raises:
        InputError: the run lacks a band of the cloud.
    """
    bands = require_bands_of_run(cloud, run_nm, "the cloud")
    # Shade that is found but not corrected is an error of unknown size.
    std = np.full(len(cloud), np.nan if found.evidence.shaded else WHITE_STD)
    material, irradiance, gloss = cloud.spectra, np.ones(len(cloud)), {}
    if corrected:
        at = found.material(cloud.spectra, cloud.points.astype(float), bands)
        material, irradiance, std = at.spectra, at.irradiance, at.irradiance_std
        gloss = {} if at.gloss is None else {GLOSS: at.gloss}
    names = band_property_names(cloud.wavelengths_nm, "material")
    columns = dict(zip([*names, *LIGHT_COLUMNS], [*material.T, irradiance, std], strict=True)) | gloss
    extra = {name: column for name, column in cloud.extra.items() if name not in {*columns, GLOSS}}
    return replace(cloud, extra=extra | {name: column.astype(np.float32) for name, column in columns.items()})


def require_bands_of_run(
    cloud: SpectralCloud, run_nm: Float[np.ndarray, "bands"], what: str
) -> Int[np.ndarray, "selected"]:
    """Index of each band of a cloud in its run.

    Raises:
        InputError: the run has no such band.
    """
    bands = same_bands(run_nm, cloud.wavelengths_nm)
    if bands is None:
        raise InputError(f"{what}: its bands are not those of the run; give the run that it was exported from.")
    return bands


def read_material(path: Path, wavelengths_nm: Float[np.ndarray, "bands"]) -> CloudMaterial:
    """The material in a PLY file by `hsi-sc-nerf material`.

    Raises:
        InputError: the file cannot be read, has no material's columns, or other bands.

    Example:
        >>> material = read_material(Path("point_cloud-material.ply"), run.dataset.wavelengths_nm)
        >>> spectra, relative_std = material.at(points_m)
    """
    cloud = read_spectral_ply(path)
    bands = same_bands(wavelengths_nm, cloud.wavelengths_nm)
    if bands is None or bands.tolist() != [*range(len(wavelengths_nm))]:
        raise InputError(f"{path}: its bands are not those of the run; take the cloud of the same run.")
    spectra = material_spectra(cloud)
    if spectra is None or not set(LIGHT_COLUMNS) <= set(cloud.extra):
        raise InputError(f"{path}: has no columns of the material; take the cloud by `hsi-sc-nerf material`.")
    known = np.isfinite(spectra).all(axis=1)
    if not known.any():
        raise InputError(f"{path}: none of its points has a material's spectrum; make it again.")
    irradiance, std = (cloud.extra[name][known] for name in LIGHT_COLUMNS)
    return CloudMaterial(cloud.points[known], spectra[known], std / irradiance)
