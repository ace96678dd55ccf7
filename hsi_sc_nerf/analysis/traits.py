"""Traits of a spectral mesh: classes and their areas; spectra of regions, and means of indices and calibrations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.class_maps import ClassAreas, ClassMap, class_areas
from hsi_sc_nerf.analysis.classes import (
    SMALLEST_REGION_M2,
    UNCLASSIFIED,
    ConnectedRegion,
    class_areas_m2,
    classify,
    connected_regions,
    unmix,
)
from hsi_sc_nerf.analysis.drawn_regions import DrawnRegion
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.maps import SurfaceMap, propagated_std, require_own_names
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError

WHOLE = "whole surface"


@dataclass(frozen=True)
class RegionOfInterest:
    """The surface within ``radius_m`` of ``centre_m`` (object frame).

    Raises:
        InputError: the radius is not more than 0, or a number is not finite.
    """

    name: str
    centre_m: tuple[float, float, float]
    radius_m: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.centre_m).all() and 0.0 < self.radius_m < np.inf):
            raise InputError(
                f"region {self.name}: needs x y z and a radius above 0, in metres, not "
                f"{' '.join(map(str, (*self.centre_m, self.radius_m)))}."
            )

    def of(self, surface: SpectralMesh) -> Bool[np.ndarray, "v"]:
        """The seen vertices in the region.

        Raises:
            InputError: there are none.
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
class Classes:
    """A classification of the surface.

    Attributes:
        names: names of the classes.
        labels: class of each vertex by spectral angle; -1 where it is in no class or unseen.
        threshold_rad: largest spectral angle of a class's spectra to its reference.
        areas_m2: areas of each class.
        unclassified_m2: seen area in no class.
        mixture_labels: class whose fraction in each vertex's spectrum, by linear unmixing, exceeds one half; -1 where
            no class does, where the spectrum is no mixture of the library's, or unseen.
        mixture_areas_m2: areas of each class by ``mixture_labels``.
        mixture_unclassified_m2: seen area in no class by ``mixture_labels``.
        regions: connected regions, in descending order of area.
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
class RegionLight:
    """What a part of the surface reflects as measured, and the light on it.

    Attributes:
        measured: reflectance of each band relative to the white reference at its place.
        irradiance: relative to that on the white reference.
        irradiance_std: standard deviation of its mean; the part's points share the error. NaN where it is not known.
    """

    measured: MeanAndSd
    irradiance: MeanAndSd
    irradiance_std: float


@dataclass(frozen=True)
class MapMean:
    """Mean of a map over a region.

    Attributes:
        surface: mean and standard deviation over the surface.
        std: standard deviation of the mean, by how much frames disagree, what pixels mix, and by what the map itself
            errs; NaN where it is not known.
        outside: fraction of the area that was not counted, because no value is known of it.
    """

    surface: MeanAndSd
    std: float
    outside: float


@dataclass(frozen=True)
class RegionTraits:
    """Traits of a part of the surface: all that was seen, a class, or a region of interest.

    Attributes:
        name: name of the part.
        area_m2: on the surface.
        spectrum: reflectance of each band, of the material where it is told apart from the light.
        maps: mean of each map on the surface by name.
        reflectance_std: standard deviation of the spectrum's mean over the bands; NaN where it is not known.
        light: where the two are told apart.
        class_areas: areas of each classifier by its name.
    """

    name: str
    area_m2: float
    spectrum: MeanAndSd
    maps: Mapping[str, MapMean]
    reflectance_std: float = math.nan
    light: RegionLight | None = None
    class_areas: Mapping[str, ClassAreas] = field(default_factory=dict)


@dataclass(frozen=True)
class Traits:
    """Traits of a surface from its spectra: of its regions, the whole seen surface first, its classes, its maps, and
    the maps of classifiers."""

    regions: list[RegionTraits]
    classes: Classes | None = None
    maps: Sequence[SurfaceMap] = ()
    class_maps: Sequence[ClassMap] = ()

    @property
    def seen_m2(self) -> float:
        """Seen area; the rest is the closed base."""
        return self.regions[0].area_m2


def analyse(
    surface: SpectralMesh,
    regions: Sequence[RegionOfInterest | DrawnRegion] = (),
    classes: Classes | None = None,
    pixel_m: float | None = None,
    maps: Sequence[SurfaceMap] = (),
    class_maps: Sequence[ClassMap] = (),
) -> Traits:
    """Spectra of the whole seen surface, its classes and the regions of interest, means of maps, areas of class maps.

    Args:
        surface: the mesh with its spectra.
        regions: of interest.
        pixel_m: side of a pixel on the object; None if it is not known, and with it how far means scatter.

    Raises:
        InputError: two regions or maps have one name, a region holds no seen surface, or nothing was seen.

    Example:
        >>> analyse(surface, maps=index_maps(surface, indices)).regions[0].spectrum.mean
    """
    chosen: dict[str, Bool[np.ndarray, "v"]] = {WHOLE: surface.seen}
    if not surface.seen.any():
        raise InputError("no part of the mesh has points of the cloud near it; raise the smoothing radius.")
    require_own_names([*(one.name for one in maps), *(one.name for one in class_maps)])
    if classes is not None:
        chosen |= {name: where for i, name in enumerate(classes.names) if (where := classes.labels == i).any()}
    for region in regions:
        if region.name in chosen:
            raise InputError(f"two regions are named {region.name}; give each picked region a name of its own.")
        chosen[region.name] = region.of(surface)

    def of_region(name: str, where: Bool[np.ndarray, "v"]) -> RegionTraits:
        areas_m2 = surface.areas_m2[where]
        spectrum, light = region_spectrum(surface, where), _light(surface, where)
        noise = _noise_std(surface, where, pixel_m, light)
        std, blurred = math.nan, None
        if pixel_m is not None and not math.isnan(noise):
            # By how much frames disagree over the region's pixels, what they mix, and what is known of its light.
            blurred = _blurred(surface, where, pixel_m)
            mixed = weighted_mean_and_sd(blurred.mean(axis=1), areas_m2).mean - spectrum.mean.mean()
            shared = 0.0 if light is None else spectrum.mean.mean() * light.irradiance_std / light.irradiance.mean
            std = math.hypot(noise, mixed, shared)
        return RegionTraits(
            name,
            float(areas_m2.sum()),
            spectrum,
            {one.name: _map_mean(one, where, surface, spectrum, noise, blurred) for one in maps},
            std,
            light,
            {one.name: class_areas(one, where, surface, pixel_m) for one in class_maps},
        )

    return Traits([of_region(name, where) for name, where in chosen.items()], classes, maps, class_maps)


def region_spectrum(surface: SpectralMesh, chosen: Bool[np.ndarray, "v"]) -> MeanAndSd:
    """Mean and standard deviation of the chosen vertices' spectra, weighted by their area."""
    return weighted_mean_and_sd(surface.spectra[chosen], surface.areas_m2[chosen])


def _noise_std(
    surface: SpectralMesh, chosen: Bool[np.ndarray, "v"], pixel_m: float | None, light: RegionLight | None
) -> float:
    """Standard deviation of a region's reflectance in a band, by how much frames disagree over its pixels."""
    if surface.scatter is None or pixel_m is None:
        return math.nan
    areas_m2, scatter = surface.areas_m2[chosen], surface.scatter[chosen]
    known = np.isfinite(scatter)
    if not known.any():
        return math.nan
    pixels = max(1.0, areas_m2.sum() / pixel_m**2)
    noise = float(areas_m2[known] @ scatter[known] / areas_m2[known].sum()) / math.sqrt(pixels)
    return noise if light is None else noise / float(light.irradiance.mean)


def _map_mean(
    one: SurfaceMap,
    chosen: Bool[np.ndarray, "v"],
    surface: SpectralMesh,
    spectrum: MeanAndSd,
    noise: float,
    blurred: Float[np.ndarray, "chosen bands"] | None,
) -> MapMean:
    """The mean of a map over the chosen vertices; its noise is that of the region's mean spectrum."""
    values, areas_m2 = one.values[chosen], surface.areas_m2[chosen]
    std = math.hypot(propagated_std(one.of, spectrum.mean, noise), one.error)
    if blurred is not None:
        std = math.hypot(std, weighted_mean_and_sd(one.of(blurred) - values, areas_m2).mean)
    undefined = float(areas_m2[np.isnan(values)].sum() / areas_m2.sum())
    return MapMean(weighted_mean_and_sd(values, areas_m2), std, undefined)


def _blurred(
    surface: SpectralMesh, chosen: Bool[np.ndarray, "v"], pixel_m: float
) -> Float[np.ndarray, "chosen bands"]:
    """The chosen vertices' spectra after one more blur over a pixel: what pixels mixed, they mix again."""
    at, neighbours = (surface.mesh.vertices[where] for where in (chosen, surface.seen))
    pairs = cKDTree(at).sparse_distance_matrix(cKDTree(neighbours), pixel_m, output_type="coo_matrix")
    weight = coo_array((surface.areas_m2[surface.seen][pairs.col], (pairs.row, pairs.col)), pairs.shape).tocsr()
    return (weight @ surface.spectra[surface.seen].astype(float)) / weight.sum(axis=1)[:, None]


def _light(surface: SpectralMesh, chosen: Bool[np.ndarray, "v"]) -> RegionLight | None:
    if surface.lit is None:
        return None
    areas_m2, lit = surface.areas_m2[chosen], surface.lit
    return RegionLight(
        weighted_mean_and_sd(lit.measured[chosen], areas_m2),
        weighted_mean_and_sd(lit.irradiance[chosen], areas_m2),
        float((areas_m2 @ lit.irradiance_std[chosen]) / areas_m2.sum()),
    )


def weighted_mean_and_sd(values: Float[np.ndarray, "n *rest"], weights: Float[np.ndarray, "n"]) -> MeanAndSd:
    """Weighted mean and standard deviation over the first axis.

    Values that are not finite do not count; both are NaN where no value counts.
    """
    defined = np.isfinite(values)
    weight = np.where(defined, weights.reshape(-1, *[1] * (values.ndim - 1)), 0.0)
    with np.errstate(invalid="ignore"):
        weight = weight / weight.sum(axis=0)
        known = np.where(defined, values, 0.0)
        mean = (weight * known).sum(axis=0)
        return MeanAndSd(mean, np.sqrt((weight * np.square(known - mean)).sum(axis=0)))


def classified(surface: SpectralMesh, library: SpectralLibrary, threshold_rad: float) -> Classes:
    """Classify the seen vertices against a library, brought to the surface's bands.

    Library spectra of one name are references of one class. By angle, a vertex belongs to the class of the reference
    with the smallest spectral angle; by mixture, to the class with a fraction above one half, which keeps blurred
    edges in place.

    Raises:
        InputError: the library does not cover the bands.
    """
    references = library.at(surface.wavelengths_nm).spectra
    names = tuple(dict.fromkeys(library.names))
    # Index -1 finds the last entry.
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
        regions=connected_regions(surface.mesh, labels, surface.areas_m2, SMALLEST_REGION_M2),
    )
