"""The command ``material``: reflectance of the material beside that measured."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.export.cloud import GLOSS, LIGHT_COLUMNS
from hsi_sc_nerf.packed.of_run import require_dataset_of_run
from hsi_sc_nerf.settings_file import between, check_options

if TYPE_CHECKING:
    from hsi_sc_nerf.export.cloud import SpectralCloud
    from hsi_sc_nerf.light.known_light import KnownLight
    from hsi_sc_nerf.light.of_run import RunLight
    from hsi_sc_nerf.models.trained_run import TrainedRun

UNCERTAIN = 0.05
"""Irradiance that is more uncertain than this, relative to it, is warned of."""
OTHER_LIGHT = 0.1
"""A taken light is warned of if brightness changes from view to view by more or less than this, relative to what the
light says. A lamp of another place or strength gives 0.12 and more, the right one 0.01 (docs/validation/light.md)."""


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
    """File to write; its name ends in .ply, .las, .nc or .zarr. By default NAME-material.ply in the folder of the
    cloud."""
    correct: Literal["auto", "always", "never"] = "auto"
    """Whether to correct the light. auto: where shading is found beyond noise. never: the material's columns hold
    what was measured."""
    light: Path | None = None
    """File NAME-material.json of another object, whose light is taken instead of being found on this one. The object
    must have stood in the same chamber, before the same camera and with the same white reference; best is a round,
    matte body without gloss, captured once for each chamber. An object with upright sides alone, such as an ear of
    maize, shows how high a lamp stands only by its shadow on what it stands on."""
    white_azimuth_deg: float = between(-90.0, 90.0, default=0.0)
    """Direction that the white reference faced, degrees: 0 faces the camera; positive turns towards the right edge of
    the camera's picture, negative towards the left. Not used with --light, whose session had its own."""
    white_elevation_deg: float = between(-90.0, 90.0, default=0.0)
    """The same above the optical axis of the camera."""
    white_height_m: float | None = between(-0.5, 2.0, default=None)
    """Height over the disc at which the white reference was held, on the turntable's axis, metres. It matters where
    lamps are near. None takes the height at which the camera looks. Not used with --light."""

    def main(self, run: TrainedRun | None = None) -> None:
        """Run the command.

        Args:
            run: that of ``load_config``, where it is open already.

        Raises:
            InputError: cloud and run do not fit together or cannot be used, or the result cannot be written.
        """
        known = self.checked_light()
        require_dataset_of_run(self.load_config)
        from hsi_sc_nerf.export.cloud import band_property_names, read_spectral_ply, run_name, stream
        from hsi_sc_nerf.export.cloud_material import require_bands_of_run, with_material
        from hsi_sc_nerf.export.formats import format_of, require_format, write_cloud
        from hsi_sc_nerf.files import require_writable, write_json
        from hsi_sc_nerf.light.of_run import light_of_run
        from hsi_sc_nerf.models.trained_run import open_trained_run

        output = self.output or self.cloud.parent / f"{self.cloud.stem}-material.ply"
        require_writable(output.parent)
        file_format, stem = format_of(output), output.with_suffix("")
        cloud = read_spectral_ply(self.cloud)
        extra = {*cloud.extra, *LIGHT_COLUMNS, GLOSS, *band_property_names(cloud.wavelengths_nm, "material")}
        require_format(stem, file_format, len(cloud.wavelengths_nm), len(extra))
        if run is None:
            run = open_trained_run(self.load_config)
        require_bands_of_run(cloud, run.model.wavelengths_nm, str(self.cloud))
        found = light_of_run(run, self._white_normal(), known, self.white_height_m)
        corrected = self.correct == "always" or (self.correct == "auto" and found.evidence.shaded)
        result = with_material(cloud, found, run.model.wavelengths_nm, corrected=corrected)
        told = light_summary(found, result, corrected=corrected, light_from=self.light)
        written = replace(stream(result), run=run_name(self.load_config), metric=run.dataset.metric)
        write_cloud(stem, written, file_format)
        write_json(output.with_suffix(".json"), told)
        console = Console(soft_wrap=True, highlight=False)
        for line in sentences(told):
            console.print(line, style="yellow" if line.startswith("Warning") else None)
        console.print(f"{escape(str(output))}: {len(cloud):,} points.")

    def checked_light(self) -> KnownLight | None:
        """The light that is taken, if any, after a check of the numbers.

        Raises:
            InputError: a number lies outside its range, or the light cannot be read.
        """
        from hsi_sc_nerf.light.known_light import read_light

        check_options(self)
        return None if self.light is None else read_light(self.light)

    def _white_normal(self) -> Float[np.ndarray, "3"]:
        azimuth, elevation = np.deg2rad([self.white_azimuth_deg, self.white_elevation_deg])
        return np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])


def sentences(told: dict[str, Any]) -> list[str]:
    """What a `light_summary` says of the light, in words; what warns begins with that word."""
    evidence, std = told["evidence"], told["relative_std"]
    decided = "the material's columns are corrected" if told["corrected"] else "nothing is corrected"
    lines = [
        f"{'Uneven light is found' if told['shaded'] else 'No uneven light is found beyond noise'}; {decided}. "
        f"Between points of similar spectra, brightness differs {evidence['profile']:.2f} ± "
        f"{evidence['profile_std']:.2f} times as much as the light that was found predicts; 1 means that the light "
        "is right, 0 that the light is even."
    ]
    gloss = told.get("gloss")
    if told["corrected"] and gloss is not None:
        mirrored, error = 100.0 * gloss["reflectance"], 100.0 * gloss["std"]
        lines.append(
            f"The highlights of the lamps show that the skin mirrors {mirrored:.1f} ± {error:.1f} % of the light; "
            "the material's columns are without it (column gloss)."
        )
    if told.get("support_unknown"):
        lines.append(
            "Warning: the container is not known, so the shade of what the object stands on is left out; state "
            "container_diameter_m and container_height_m in session.json, and process the session again."
        )
    if told.get("light_from") is not None and abs(evidence["turning"] - 1.0) > OTHER_LIGHT:
        lines.append(
            f"Warning: brightness changes from view to view by {evidence['turning']:.2f} times what the light of "
            f"{told['light_from']} says; has a lamp or the camera been moved? Leave out --light, or capture it anew."
        )
    if told["corrected"] and (std is None or std > UNCERTAIN):
        by = "an unknown amount" if std is None else f"{100.0 * std:.0f} % (irradiance_std)"
        lines.append(
            f"Warning: the light is uncertain by {by}, and so is the material; do not compare its brightness with "
            "that of other objects."
        )
    return lines


def light_summary(
    found: RunLight, cloud: SpectralCloud, *, corrected: bool, light_from: Path | None = None
) -> dict[str, Any]:
    """The light, what tells of it, and its median uncertainty in a cloud `with_material`, ready for JSON.

    Args:
        light_from: file that the light was taken from.
    """
    irradiance, std = (cloud.extra[name] for name in LIGHT_COLUMNS)
    gloss = found.light.fit.gloss
    return {
        "corrected": corrected,
        "shaded": found.evidence.shaded,
        "evidence": asdict(found.evidence),
        "relative_std": float(np.median(std / irradiance)) if np.isfinite(std).all() else None,
        "light_from": None if light_from is None else str(light_from),
        "support_unknown": found.support_unknown,
        "scatter": found.light.fit.scatter,
        "gloss": None if gloss is None else {"reflectance": gloss.reflectance, "std": gloss.std},
        "light": found.stationary.values(),
    }
