"""Traits of a spectral mesh: classes and their areas; indices, composites and spectra of regions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.analysis.classes import (
    UNCLASSIFIED,
    ConnectedRegion,
    class_areas_m2,
    classify,
    connected_regions,
    unmix,
)
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.spectra.bands import covered
from hsi_sc_nerf.spectra.composites import COMPOSITES, Composite
from hsi_sc_nerf.spectra.composites import composite as composite_of
from hsi_sc_nerf.spectra.indices import INDICES, SpectralIndex, index_values

WHOLE = "whole surface"


@dataclass(frozen=True)
class Classes:
    """A classification of the surface.

    Attributes:
        names: of the classes.
        labels: number of each vertex's class; -1 where it is in none or was not seen.
        threshold_rad: largest spectral angle of a class's spectra to its reference.
        areas_m2: of each class.
        unclassified_m2: seen, but in no class.
        mixture_labels: number of the class that makes up more than half of each vertex, its spectrum taken for a
            mixture of the library's; -1 where none does, where it is no such mixture, or was not seen.
        mixture_areas_m2: of each class by these.
        mixture_unclassified_m2: seen, but in no class by these.
        regions: connected regions, the largest first.
    """

    names: tuple[str, ...]
    labels: Int[np.ndarray, "v"]
    threshold_rad: float
    areas_m2: Float[np.ndarray, "classes"]
    unclassified_m2: float
    mixture_labels: Int[np.ndarray, "v"]
    mixture_areas_m2: Float[np.ndarray, "classes"]
    mixture_unclassified_m2: float
    regions: list[ConnectedRegion]


@dataclass(frozen=True)
class MeanAndSd:
    """Mean and standard deviation over a region's surface, weighted by area."""

    mean: Float[np.ndarray, "*values"]
    sd: Float[np.ndarray, "*values"]


@dataclass(frozen=True)
class Traits:
    """What the spectra of a surface tell.

    Attributes:
        seen_m2: area that was seen; the rest is the closed base.
        spectra: of the whole seen surface, each class and each picked region.
        indices: of each region, by the names of region and index.
        composites: reflectance in each composite's three bands, by the names of region and composite.
        classes: None without a library.
    """

    seen_m2: float
    spectra: list[RegionSpectrum]
    indices: dict[str, dict[str, MeanAndSd]]
    composites: dict[str, dict[str, MeanAndSd]]
    classes: Classes | None = field(default=None)


def classified(
    surface: SpectralMesh, library: SpectralLibrary, threshold_rad: float, smallest_region_m2: float
) -> Classes:
    """Classify the seen vertices against a library, brought to the surface's bands.

    A class is what the library has under one name. By angle, a place belongs to the class of its nearest reference;
    by mixture, to the class that holds most of it: a blurred edge stays where it was, because half is half.

    Raises:
        InputError: the library does not cover the bands.
    """
    references = library.at(surface.wavelengths_nm).spectra
    names = tuple(dict.fromkeys(library.names))
    # The last entry is what the index -1 finds.
    class_of = np.array([*(names.index(name) for name in library.names), UNCLASSIFIED])
    spectra = surface.spectra[surface.seen]
    labels, mixture_labels = (np.full(len(surface.seen), UNCLASSIFIED) for _ in range(2))
    labels[surface.seen] = class_of[classify(spectra, references, threshold_rad)]
    fractions, angles = unmix(spectra, references)
    by_class = fractions @ np.eye(len(names))[class_of[:-1]]
    most = (by_class.max(axis=1) > 0.5) & (angles <= threshold_rad)
    mixture_labels[surface.seen] = np.where(most, by_class.argmax(axis=1), UNCLASSIFIED)

    areas_m2, mixture_areas_m2 = (
        class_areas_m2(of, surface.areas_m2, surface.seen, len(names)) for of in (labels, mixture_labels)
    )
    return Classes(
        names=names,
        labels=labels,
        threshold_rad=threshold_rad,
        areas_m2=areas_m2[:-1],
        unclassified_m2=float(areas_m2[-1]),
        mixture_labels=mixture_labels,
        mixture_areas_m2=mixture_areas_m2[:-1],
        mixture_unclassified_m2=float(mixture_areas_m2[-1]),
        regions=connected_regions(surface.mesh, labels, surface.areas_m2, smallest_region_m2),
    )


def known_composites(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[Composite]:
    """Those of the named composites that the bands can show."""
    return [one for one in COMPOSITES.values() if covered(wavelengths_nm, one.wavelengths_nm).all()]


def known_indices(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[SpectralIndex]:
    """Those of the named indices that the bands have."""
    return [one for one in INDICES.values() if covered(wavelengths_nm, one.wavelengths_nm).all()]


def analyse(surface: SpectralMesh, picked: Sequence[RegionOfInterest] = (), classes: Classes | None = None) -> Traits:
    """Spectra, indices and composites of the whole seen surface, of each class on it and of the picked regions.

    Raises:
        InputError: two regions have one name, a picked region holds no seen surface, or nothing was seen.
    """
    chosen: dict[str, Bool[np.ndarray, "v"]] = {WHOLE: surface.seen}
    if not surface.seen.any():
        raise InputError("no part of the mesh has points of the cloud near it; raise the smoothing radius.")
    if classes is not None:
        chosen |= {name: where for i, name in enumerate(classes.names) if (where := classes.labels == i).any()}
    for region in picked:
        if region.name in chosen:
            raise InputError(f"two regions are named {region.name}; give each picked region a name of its own.")
        chosen[region.name] = region.of(surface)

    nm = surface.wavelengths_nm
    index_maps = {index.name: index_values(index, surface.spectra, nm) for index in known_indices(nm)}
    composite_maps = {
        one.name: composite_of(surface.spectra, nm, one.wavelengths_nm, one.name) for one in known_composites(nm)
    }

    def over(maps: dict[str, np.ndarray], where: Bool[np.ndarray, "v"]) -> dict[str, MeanAndSd]:
        return {
            name: MeanAndSd(*weighted_mean_and_sd(values[where], surface.areas_m2[where]))
            for name, values in maps.items()
        }

    return Traits(
        seen_m2=float(surface.areas_m2[surface.seen].sum()),
        spectra=[region_spectrum(name, surface, where) for name, where in chosen.items()],
        indices={name: over(index_maps, where) for name, where in chosen.items()},
        composites={name: over(composite_maps, where) for name, where in chosen.items()},
        classes=classes,
    )


@dataclass(frozen=True)
class RegionOfInterest:
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


def read_regions(path: Path) -> list[RegionOfInterest]:
    """Read regions from YAML: ``NAME: {centre_m: [x, y, z], radius_m: r}`` each.

    Raises:
        InputError: the file is missing or does not say that.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        regions = []
        for name, entry in content.items():
            x_m, y_m, z_m = map(float, entry["centre_m"])
            regions.append(region_of_interest(str(name), x_m, y_m, z_m, float(entry["radius_m"])))
        return regions
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; give a YAML file of regions.") from error
    except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: is no list of regions ({error}); write a line like 'bruise: {{centre_m: [0.03, 0, 0.1], "
            "radius_m: 0.004}' for each."
        ) from error


def region_of_interest(name: str, x_m: float, y_m: float, z_m: float, radius_m: float) -> RegionOfInterest:
    """A region from its five words.

    Raises:
        InputError: the radius is not more than 0, or a number is not finite.
    """
    if not (np.isfinite([x_m, y_m, z_m]).all() and 0.0 < radius_m < np.inf):
        raise InputError(
            f"region {name}: needs x y z and a radius above 0, in metres, not {x_m} {y_m} {z_m} {radius_m}."
        )
    return RegionOfInterest(name, (x_m, y_m, z_m), radius_m)
