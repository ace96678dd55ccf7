"""Regions of interest: picked on the surface or made of classes; their mean spectra and how far these scatter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Bool, Float

from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError


@dataclass(frozen=True)
class PickedRegion:
    """What lies within a radius of a point.

    Attributes:
        name: of the region.
        centre_m: object frame.
        radius_m: around it.
    """

    name: str
    centre_m: tuple[float, float, float]
    radius_m: float

    def of(self, surface: SpectralMesh) -> Bool[np.ndarray, "v"]:
        """Which seen vertices lie in it.

        Raises:
            InputError: none does.
        """
        distance_m = np.linalg.norm(surface.mesh.vertices - np.array(self.centre_m), axis=1)
        chosen = surface.seen & (distance_m <= self.radius_m)
        if not chosen.any():
            raise InputError(
                f"region {self.name}: no seen surface within {self.radius_m:g} m of {self.centre_m}; the nearest is "
                f"{distance_m[surface.seen].min():.4f} m away: correct the point (metres) or enlarge the radius."
            )
        return chosen


@dataclass(frozen=True)
class RegionSpectrum:
    """Spectrum of a region, weighted by area.

    Attributes:
        name: of the region.
        area_m2: on the surface.
        mean: reflectance.
        sd: standard deviation over the region's surface.
    """

    name: str
    area_m2: float
    mean: Float[np.ndarray, "bands"]
    sd: Float[np.ndarray, "bands"]


def region_spectrum(name: str, surface: SpectralMesh, chosen: Bool[np.ndarray, "v"]) -> RegionSpectrum:
    """Mean and standard deviation of the spectra of the chosen vertices, weighted by their area."""
    mean, sd = weighted_mean_and_sd(surface.spectra[chosen], surface.areas_m2[chosen])
    return RegionSpectrum(name, float(surface.areas_m2[chosen].sum()), mean, sd)


def weighted_mean_and_sd(
    values: Float[np.ndarray, "n *rest"], weights: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "*rest"], Float[np.ndarray, "*rest"]]:
    """Mean and standard deviation over the first axis; NaN, where a value is not defined, does not count.

    Both are NaN where no value counts.
    """
    defined = np.isfinite(values)
    weight = np.where(defined, weights.reshape(-1, *[1] * (values.ndim - 1)), 0.0)
    with np.errstate(invalid="ignore"):
        weight = weight / weight.sum(axis=0)
        known = np.where(defined, values, 0.0)
        mean = (weight * known).sum(axis=0)
        return mean, np.sqrt((weight * np.square(known - mean)).sum(axis=0))


def read_regions(path: Path) -> list[PickedRegion]:
    """Read regions from YAML: ``NAME: {centre_m: [x, y, z], radius_m: r}`` each.

    Raises:
        InputError: the file is missing or does not say that.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        regions = []
        for name, entry in content.items():
            x_m, y_m, z_m = map(float, entry["centre_m"])
            regions.append(picked_region(str(name), x_m, y_m, z_m, float(entry["radius_m"])))
        return regions
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; give a YAML file of regions.") from error
    except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: is no list of regions ({error}); write a line like 'bruise: {{centre_m: [0.03, 0, 0.1], "
            "radius_m: 0.004}' for each."
        ) from error


def picked_region(name: str, x_m: float, y_m: float, z_m: float, radius_m: float) -> PickedRegion:
    """A region from its five words.

    Raises:
        InputError: the radius is not more than 0, or a number is not finite.
    """
    if not (np.isfinite([x_m, y_m, z_m]).all() and 0.0 < radius_m < np.inf):
        raise InputError(
            f"region {name}: needs x y z and a radius above 0, in metres, not {x_m} {y_m} {z_m} {radius_m}."
        )
    return PickedRegion(name, (x_m, y_m, z_m), radius_m)
