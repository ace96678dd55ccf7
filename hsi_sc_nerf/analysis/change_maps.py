"""What changed on a surface from one day to another: spectrum, brightness, bands, indices and the surface itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_features import COMPONENTS, surface_gradients
from hsi_sc_nerf.analysis.change_regions import OUTSIDE, ChangedRegion, changed_regions, limit_of_blank_m2
from hsi_sc_nerf.analysis.change_significance import (
    FALSE_DISCOVERIES,
    Significance,
    significance,
    surface_patches,
)
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.registration import robust_radius
from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.indices.formula import SpectralIndex, index_values
from hsi_sc_nerf.spectra import require_bands

SPECTRUM, BRIGHTNESS, SURFACE = "spectrum", "brightness", "surface"
CLASSES = "classes"
"""Name of the files with maps of classes."""
MISPLACED_M = 0.0003
"""Distance between the spectra of one point in two runs that blur and smoothing cause, beside the error of the
registration."""
RIM_M = 0.006
"""Patches this near to what is not seen lie at its rim: seen at grazing angles, beside what the object stands on."""
_LEAST_PATCHES = 20


@dataclass(frozen=True)
class Quantity:
    """One property's change on the surface.

    Attributes:
        name: ``spectrum``, ``brightness``, ``surface``, ``R680`` or the name of an index.
        unit: unit of the change; "rad" of the spectral angle, "mm" of the surface, else "1".
        change: after less before at each vertex; of the spectrum, the spectral angle between the two. NaN where it is
            not known.
        p: adjusted for false discoveries, of the patch of each vertex; 1 where it is not known.
        test: test of the patches and of the whole surface.
        region: number of each vertex's region, -1 outside.
        regions: areas that changed beyond noise, and otherwise than the whole surface, the largest first.
        limit_m2: regions up to this area are undecided (`limit_of_blank_m2`); 0 with a repeat.
    """

    name: str
    unit: str
    change: Float[np.ndarray, "v"]
    p: Float[np.ndarray, "v"]
    test: Significance
    region: Int[np.ndarray, "v"]
    regions: list[ChangedRegion]
    limit_m2: float = 0.0

    @property
    def counted(self) -> int:
        """How many regions, the first ones, are larger than the limit."""
        return sum(one.area_m2 > self.limit_m2 for one in self.regions)

    @property
    def changed(self) -> Bool[np.ndarray, "v"]:
        """Which vertices lie in a region that counts."""
        return (self.region != OUTSIDE) & (self.region < self.counted)

    @property
    def undecided(self) -> Bool[np.ndarray, "v"]:
        """Which vertices lie in a region that is no larger than the limit."""
        return self.region >= self.counted

    @property
    def whole(self) -> tuple[float, float]:
        """Change of the whole surface and its standard deviation; of the spectrum, as an angle."""
        if self.name == SPECTRUM:
            return float(np.linalg.norm(self.test.whole)), float(np.linalg.norm(self.test.whole_sd))
        return float(self.test.whole[0]), float(self.test.whole_sd[0])


def changes(
    before: Day,
    after: Day,
    bands_nm: Sequence[float],
    indices: Sequence[SpectralIndex],
    session_sd: float,
    repeat: Day | None = None,
) -> dict[str, Quantity]:
    """The change of each quantity from one day to another, tested patch by patch, by name.

    Args:
        before: on the first day's mesh.
        after: on the same mesh.
        bands_nm: wavelengths whose reflectance is compared.
        indices: that are compared.
        session_sd: relative standard deviation of the reflectance that the white references of two sessions make
            alike for the whole surface, as a level and as a slope over the bands.
        repeat: another capture of the day before, on the same mesh. What is no larger than between these two is no
            change. Without it, regions up to the limit of blank are undecided.

    Raises:
        InputError: too little of the surface is seen on both days, a wavelength has no band near it, or an index has
            the name of another quantity.
    """
    require_own_names(bands_nm, indices)
    one, other = before.surface, after.surface
    days = [before, after] if repeat is None else [before, after, repeat]
    seen = one.seen & other.seen
    patches = surface_patches(one.mesh.vertices, one.areas_m2, seen)
    for day in days[1:]:
        if len(np.unique(patches.of_vertex[seen & day.surface.seen])) < _LEAST_PATCHES:
            raise InputError(
                f"{day.name} beside {before.name}: hardly any surface is seen in both; give clouds of one object."
            )
    misplaced_m = _misplaced_m(before, after, one.mesh.vertices)
    hidden = one.mesh.vertices[~np.all([day.surface.seen for day in days], axis=0)]
    to_rim_m = cKDTree(hidden).query(patches.centres_m)[0] if len(hidden) else np.full(len(patches.areas_m2), np.inf)
    worst = patches.means(np.max([day.conditions for day in days], axis=0), one.areas_m2)
    conditions = np.column_stack([worst, -to_rim_m])
    modes = session_sd * np.stack([np.ones(len(one.wavelengths_nm)), np.linspace(-1.0, 1.0, len(one.wavelengths_nm))])
    typical = np.median(one.spectra[seen], axis=0)[None]
    usual, *moved = (
        _scalars(one.spectra[seen] * factor, one.wavelengths_nm, bands_nm, indices)
        for factor in (1.0, *(1.0 + modes))
    )
    quantities = (len(one.wavelengths_nm) > 1) + len(usual) + 1  # spectrum, scalars, surface
    limit_m2 = limit_of_blank_m2(float(one.areas_m2[seen].sum())) if repeat is None else 0.0

    def tested(
        name: str,
        unit: str,
        values: Sequence[Float[np.ndarray, "v k"]],
        shared: Float[np.ndarray, "k"],
        shown: Float[np.ndarray, "v"] | None = None,
    ) -> Quantity:
        each_day = zip(days, values, strict=True)
        first, last, *again = (np.where(day.surface.seen[:, None], each, np.nan) for day, each in each_day)
        of_patches, *of_repeat = (patches.means(each - first, one.areas_m2) for each in (last, *again))
        gradients = np.linalg.norm(surface_gradients(patches.centres_m, patches.means(first, one.areas_m2)), axis=2)
        off = np.nan_to_num(gradients) * misplaced_m * (name != SURFACE)
        errors = of_repeat[0] if of_repeat else None
        at_rim = to_rim_m < RIM_M
        test = significance(of_patches, patches.centres_m, off, shared, conditions, errors, at_rim, quantities)
        p = np.where(seen, test.p[patches.of_vertex], 1.0)
        beyond, significant = last - first - test.whole, test.p < FALSE_DISCOVERIES
        region, regions = changed_regions(one.mesh, one.areas_m2, patches, first, beyond, significant, test.noise)
        change = (last - first)[:, 0] if shown is None else np.where(seen, shown, np.nan)
        return Quantity(name, unit, change, p, test, region, regions, limit_m2)

    found: dict[str, Quantity] = {}
    if len(one.wavelengths_nm) > 1:
        units = [unit_vectors(day.surface.spectra) for day in days]
        # Principal components of the changes of spectra.
        vectors = np.linalg.eigh(np.cov((units[1] - units[0])[seen], rowvar=False))[1]
        axes = vectors[:, ::-1][:, : min(COMPONENTS, len(vectors) - 1)].T
        shared = unit_vectors(typical * (1.0 + modes)) - unit_vectors(typical)
        angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(units[1] - units[0], axis=1) / 2.0, 0.0, 1.0))
        found[SPECTRUM] = tested(
            SPECTRUM, "rad", [each @ axes.T for each in units], np.linalg.norm(shared @ axes.T, axis=0), angle
        )
    measured = [_scalars(day.surface.spectra, one.wavelengths_nm, bands_nm, indices) for day in days]
    for name in usual:
        values = [each[name][:, None] for each in measured]
        # An index of hardly any light is not defined.
        since = [patches.means(each - values[0], one.areas_m2) for each in values[1:]]
        if np.isfinite(since).all(axis=0).sum() >= _LEAST_PATCHES:
            # The typical spectrum itself may be one that the index is not defined of.
            shared = np.linalg.norm([[np.nanmedian(each[name] - usual[name])] for each in moved], axis=0)
            found[name] = tested(name, "1", values, shared)
    found[SURFACE] = tested(SURFACE, "mm", [1e3 * day.raised_m[:, None] for day in days], np.zeros(1))
    return found


def require_own_names(bands_nm: Sequence[float], indices: Sequence[SpectralIndex]) -> None:
    """Check that no index has the name of another quantity, which one of the two would replace.

    Names of files and columns are in lower case, so that names may not differ in case only.

    Args:
        bands_nm: wavelengths whose reflectance is compared.
        indices: that are compared.

    Raises:
        InputError: an index has the name of another quantity.
    """
    taken = {name.casefold(): name for name in (SPECTRUM, BRIGHTNESS, SURFACE, CLASSES, *map(_band_name, bands_nm))}
    for index in indices:
        if other := taken.get(index.name.casefold()):
            raise InputError(
                f"the index '{index.definition}' has the name of another quantity that is compared, {other}; give it "
                "a name of its own (--index)."
            )
        taken[index.name.casefold()] = index.name


def _band_name(wavelength_nm: float) -> str:
    return f"R{wavelength_nm:g}"


def _scalars(
    spectra: Float[np.ndarray, "n bands"],
    nm: Float[np.ndarray, "bands"],
    bands_nm: Sequence[float],
    indices: Sequence[SpectralIndex],
) -> Mapping[str, Float[np.ndarray, "n"]]:
    """Logarithm of brightness (its change is relative), reflectances and indices, by name."""
    values = {BRIGHTNESS: np.log(np.maximum(spectra.mean(axis=1), 1e-4))}
    for wavelength in bands_nm:
        (band,) = require_bands(nm, [wavelength], "--band-nm")
        values[_band_name(wavelength)] = spectra[:, band]
    return values | {index.name: index_values(index, spectra, nm) for index in indices}


def _misplaced_m(before: Day, after: Day, vertices_m: Float[np.ndarray, "v 3"]) -> float:
    """Standard deviation of the distance between what is taken for one place on two days."""
    radius_m, variance = robust_radius(vertices_m), MISPLACED_M**2
    for attitude in (before.attitude, after.attitude):
        if attitude is not None:
            variance += radius_m**2 * (np.deg2rad(attitude.turn_sd_deg) ** 2 + attitude.growth_sd**2)
    return float(np.sqrt(variance))
