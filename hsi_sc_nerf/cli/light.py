"""The command ``material``: reflectance of the material beside that measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import between, check_options

if TYPE_CHECKING:
    from hsi_sc_nerf.export.cloud import SpectralCloud
    from hsi_sc_nerf.light.of_run import RunLight

_MATERIAL = "material_"


@dataclass(frozen=True)
class MaterialCommand:
    """Tell the material's reflectance apart from the light on the object, in a cloud of a trained run.

    The light stands still and the object turns, so that the light shows in how brightness changes from view to view,
    and shade follows from the shape. The cloud gets the columns material_397.32nm and so on beside scalar_397.32nm,
    irradiance and irradiance_std (both relative to the white reference, mean over bands). All else is kept.
    """

    cloud: tyro.conf.Positional[Path]
    """Spectral point cloud (PLY, metres), as `ns-export pointcloud` writes it."""
    load_config: Path
    """The config.yml of the run that it was exported from."""
    output: Path | None = None
    """File to write. By default NAME-material.ply in the folder of the cloud."""
    correct: Literal["auto", "always", "never"] = "auto"
    """Whether to correct the light. auto: where shading is found beyond noise. never: the material's columns hold
    what was measured."""
    white_azimuth_deg: float = between(-90.0, 90.0, default=0.0)
    """Direction that the white reference faced, degrees: 0 is to the camera, positive is to the right of it."""
    white_elevation_deg: float = between(-90.0, 90.0, default=0.0)
    """The same above the optical axis of the camera."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: cloud and run do not fit together or cannot be used, or the result cannot be written.
        """
        check_options(self)
        from hsi_sc_nerf.export.ply import read_spectral_ply, write_spectral_ply
        from hsi_sc_nerf.files import require_writable, write_json
        from hsi_sc_nerf.light.of_run import light_of_run
        from hsi_sc_nerf.models.trained_run import open_run

        output = self.output or self.cloud.with_name(f"{self.cloud.stem}-material.ply")
        require_writable(output.parent)
        cloud = read_spectral_ply(self.cloud)
        run = open_run(self.load_config)
        bands = bands_of(cloud.wavelengths_nm, run.model.wavelengths_nm, self.cloud)
        found = light_of_run(run, self._white_normal())
        corrected = self.correct == "always" or (self.correct == "auto" and found.evidence.shaded)
        write_spectral_ply(output, with_material(cloud, found, bands, corrected=corrected))
        write_json(output.with_suffix(".json"), summary(found, corrected=corrected))
        console, evidence = Console(), found.evidence
        shaded = "uneven light is found" if evidence.shaded else "no uneven light is found beyond noise"
        console.print(
            f"{shaded}: like spectra are as bright as the light says by the factor {evidence.profile:.2f} ± "
            f"{evidence.profile_std:.2f} (1: right, 0: even light); {'corrected' if corrected else 'not corrected'}.",
            soft_wrap=True,
        )
        console.print(f"{escape(str(output))}: {len(cloud):,} points.", soft_wrap=True)

    def _white_normal(self) -> Float[np.ndarray, "3"]:
        azimuth, elevation = np.deg2rad([self.white_azimuth_deg, self.white_elevation_deg])
        return np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])


def bands_of(cloud_nm: Float[np.ndarray, "selected"], run_nm: Float[np.ndarray, "bands"], path: Path) -> np.ndarray:
    """Index of each band of the cloud in the run.

    Raises:
        InputError: the run has no such band.
    """
    bands = np.abs(cloud_nm[:, None] - run_nm).argmin(axis=1)
    if np.abs(run_nm[bands] - cloud_nm).max() > 0.01:
        raise InputError(f"{path}: its bands are not those of the run; give the run that it was exported from.")
    return bands


def with_material(cloud: SpectralCloud, found: RunLight, bands: np.ndarray, *, corrected: bool) -> SpectralCloud:
    """The cloud with the columns of material and irradiance."""
    from hsi_sc_nerf.export.ply import band_property_names

    material, irradiance, std = cloud.spectra, np.ones(len(cloud)), np.zeros(len(cloud))
    if corrected:
        by_band, std = found.irradiance(cloud.points.astype(float))
        material, irradiance = cloud.spectra / by_band[:, bands], by_band.mean(axis=1)
    names = [name.replace("scalar_", _MATERIAL) for name in band_property_names(cloud.wavelengths_nm)]
    columns = dict(zip(names, material.T, strict=True)) | {"irradiance": irradiance, "irradiance_std": std}
    extra = {name: column for name, column in cloud.extra.items() if name not in columns}
    return replace(cloud, extra=extra | {name: column.astype(np.float32) for name, column in columns.items()})


def summary(found: RunLight, *, corrected: bool) -> dict[str, object]:
    """The light and what tells of it, ready for JSON."""
    from dataclasses import asdict

    light = found.light.fit.light
    return {
        "corrected": corrected,
        "shaded": found.evidence.shaded,
        "evidence": asdict(found.evidence),
        "scatter": found.light.fit.scatter,
        "light": {
            "chamber_harmonics": light.chamber.tolist(),
            "lamps": light.lamps.tolist(),
            "to_lamps": light.to_lamps.tolist(),
            "lamps_distance_m": 1.0 / light.nearness if light.nearness else None,
            "chamber_colour": light.chamber_colour.tolist(),
            "lamp_colour": light.lamp_colour.tolist(),
        },
    }
