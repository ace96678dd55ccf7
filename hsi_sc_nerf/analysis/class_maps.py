"""Maps of classifiers that were fitted elsewhere: the class of each vertex, and areas with what they may err by."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.analysis.calibrations import Calibration
from hsi_sc_nerf.analysis.classes import UNCLASSIFIED, class_areas_m2
from hsi_sc_nerf.analysis.maps import column_of
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh

OUTSIDE = "outside of what the classifier knows"
"""Words for surface whose spectra it was not fitted on, which no class has as its name."""
WITHOUT_LIMITS = "no class (the classifier's table states no limits)"
"""Words for surface without a value where nothing tells which spectra it was fitted on."""


@dataclass(frozen=True, eq=False)
class ClassMap:
    """What a classifier says of a surface.

    Attributes:
        name: name of the classifier.
        classes: their names.
        probabilities: of each class; NaN where the surface is unseen, or its spectrum unlike all that the classifier
            was fitted on.
        shaken: labels of the same spectra with one more draw of their noise; None where that is not known.
        resampling_error: fraction of the classified area whose class resampling the spectra changes.
        limited: whether it tells which spectra it was fitted on.
    """

    name: str
    classes: tuple[str, ...]
    probabilities: Float[np.ndarray, "v classes"]
    shaken: Int[np.ndarray, "v"] | None = None
    resampling_error: float = 0.0
    limited: bool = True

    @cached_property
    def labels(self) -> Int[np.ndarray, "v"]:
        """The most probable class of each vertex; -1 for none."""
        return most_probable(self.probabilities)

    @property
    def column(self) -> str:
        """Its column in a cloud, as `SurfaceMap.column`."""
        return column_of("calibration", self.name)


@dataclass(frozen=True)
class ClassAreas:
    """Areas of a classifier's classes in a region.

    Attributes:
        areas_m2: areas of the surface whose most probable class is each.
        stds_m2: their standard deviations, without that of the mesh's size; NaN where pixels are not known.
        outside_m2: area whose spectra are unlike all that the classifier was fitted on.
    """

    areas_m2: Float[np.ndarray, "classes"]
    stds_m2: Float[np.ndarray, "classes"]
    outside_m2: float


def class_map(surface: SpectralMesh, classifier: Calibration) -> ClassMap:
    """A classifier's probabilities at each vertex.

    Raises:
        InputError: the classifier needs wavelengths that the surface's bands do not reach.
    """
    seen, nm = surface.seen, surface.wavelengths_nm
    spectra = surface.spectra[seen].astype(float)
    probabilities = np.full((len(seen), len(classifier.classes)), np.nan)
    probabilities[seen] = classifier.predictions(spectra, nm, only_inside=True)
    shaken = None
    if surface.scatter is not None:
        scatter = surface.scatter if surface.lit is None else surface.scatter / surface.lit.irradiance
        noise = np.nan_to_num(scatter[seen])[:, None] * np.random.default_rng(0).standard_normal(spectra.shape)
        shaken = np.full(len(seen), UNCLASSIFIED)
        shaken[seen] = most_probable(classifier.predictions(spectra + noise, nm))
        shaken[np.isnan(probabilities[:, 0])] = UNCLASSIFIED
    limited = classifier.domain is not None
    found = ClassMap(classifier.name, classifier.classes, probabilities, shaken, limited=limited)
    known, changed = found.labels[seen] != UNCLASSIFIED, 0.0
    if (coarse := classifier.coarser(nm)) is not None and known.any():
        other = most_probable(classifier.predictions(spectra[:, coarse], nm[coarse]))
        weights = surface.areas_m2[seen][known]
        changed = float(weights @ (other != found.labels[seen])[known] / weights.sum()) / 3.0
    return replace(found, resampling_error=changed)


def class_areas(
    one: ClassMap, region: Bool[np.ndarray, "v"], surface: SpectralMesh, pixel_m: float | None
) -> ClassAreas:
    """Areas of the classes in a region, and their standard deviations.

    The standard deviation of an area has three known causes. The first is the difference between the area and its
    expectation ``sum(area * probability)``, which is doubt that a whole region shares. The second is the doubt of
    each pixel, with the variance ``probability * (1 - probability)``, independent from pixel to pixel. The third is
    the noise of the spectra: half of the area that one more draw of the noise moves to or from the class, also
    independent from pixel to pixel.

    Args:
        one: the classifier's map.
        region: seen vertices.
        surface: the mesh.
        pixel_m: side of a pixel on the object; None if it is not known.
    """
    count = len(one.classes)
    areas_m2 = class_areas_m2(one.labels, surface.areas_m2, region, count)
    known = region & (one.labels != UNCLASSIFIED)
    stds_m2 = np.full(count, math.nan)
    if pixel_m is not None:
        probable, weights = one.probabilities[known], surface.areas_m2[known]
        of_class = one.labels[known][:, None] == np.arange(count)
        expected = weights @ (of_class - probable)
        doubt = weights @ (probable * (1.0 - probable))
        if one.shaken is not None:
            moved = (one.shaken[known][:, None] == np.arange(count)) != of_class
            doubt = doubt + weights @ moved / 2.0
        stds_m2 = np.sqrt(expected**2 + pixel_m**2 * doubt)
    return ClassAreas(areas_m2[:-1], stds_m2, float(areas_m2[-1]))


def rest_words(limited: bool) -> str:
    """Words for surface that a classifier gives no class.

    Args:
        limited: whether it tells which spectra it was fitted on.
    """
    return OUTSIDE if limited else WITHOUT_LIMITS


def most_probable(probabilities: Float[np.ndarray, "n classes"]) -> Int[np.ndarray, "n"]:
    """Number of each row's most probable class; -1 where a probability is missing."""
    none = np.isnan(probabilities).any(axis=1)
    return np.where(none, UNCLASSIFIED, np.where(none[:, None], 0.0, probabilities).argmax(axis=1))
