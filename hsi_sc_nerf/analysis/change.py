"""Days beside the first one: what changed since then, which areas grew since the day before, and areas of classes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Int

from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_maps import BRIGHTNESS, SPECTRUM, Quantity, changes
from hsi_sc_nerf.analysis.change_regions import GrownRegion, connected_to, grown_regions
from hsi_sc_nerf.analysis.change_significance import FALSE_DISCOVERIES
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.measurement import class_references
from hsi_sc_nerf.analysis.traits import classified
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.indices.formula import SpectralIndex


@dataclass(frozen=True)
class ClassChange:
    """The class by mixture of each vertex on two days.

    Attributes:
        names: names of the classes.
        before: number of the class on the first day; -1 in no class, or unseen.
        after: the same on the later day; that of the first day where spectrum and brightness did not change beyond
            noise.
    """

    names: tuple[str, ...]
    before: Int[np.ndarray, "v"]
    after: Int[np.ndarray, "v"]


@dataclass(frozen=True)
class DayComparison:
    """A day beside the first one, and its areas beside those of the day before it.

    Attributes:
        before: name of the first day.
        after: the day.
        quantities: changes since the first day, by name.
        earlier: name of the day before it.
        grown: regions of each quantity that had changed since the first day, on the day before and on this one; not
            of those that were left out the day before.
        classes: regions of each class, on the first day and on this one; empty without a library.
        class_map: their maps; None without a library.
        left_out: indices that are defined on too little of the surface to be compared.
    """

    before: str
    after: Day
    quantities: Mapping[str, Quantity]
    earlier: str
    grown: Mapping[str, list[GrownRegion]]
    classes: Mapping[str, list[GrownRegion]]
    class_map: ClassChange | None = None
    left_out: tuple[str, ...] = ()


def compare_days(
    days: Sequence[Day],
    bands_nm: Sequence[float],
    indices: Sequence[SpectralIndex],
    session_sd: float,
    library: SpectralLibrary | None = None,
    angle_rad: float = np.inf,
    repeat: Day | None = None,
) -> Iterable[DayComparison]:
    """Compare each day with the first, one after the other.

    Args:
        days: on one mesh, at least two.
        bands_nm: wavelengths whose reflectance is compared.
        indices: that are compared.
        session_sd: `hsi_sc_nerf.analysis.change_maps.changes`.
        library: spectra to classify the surface by.
        angle_rad: largest spectral angle of a class.
        repeat: another capture of the first day, `hsi_sc_nerf.analysis.change_maps.changes`.

    Raises:
        InputError: too little is seen on both days, or the library or a wavelength does not fit the bands.

    Example:
        >>> days = days_on_one_mesh(clouds, ("monday", "friday"), MeshConfig(), 65.0)
        >>> indices = find_indices(["NDVI"], clouds[0].wavelengths_nm)
        >>> for one in compare_days(days, (670.0,), indices, 0.01):
        ...     print(one.after.name, [region.area_m2 for region in one.quantities["NDVI"].regions])
    """
    first, earlier = days[0], None
    mesh, areas_m2 = first.surface.mesh, first.surface.areas_m2
    library = None if library is None else class_references(library, first.surface.wavelengths_nm)
    at_first = None if library is None else classified(first.surface, library, angle_rad)
    for before, after in pairwise(days):
        quantities = changes(first, after, bands_nm, indices, session_sd, repeat)
        grown = {}
        for name, quantity in quantities.items():
            if earlier is not None and name not in earlier:
                continue  # left out the day before, so that nobody knows what has grown since
            then = np.zeros_like(quantity.changed) if earlier is None else earlier[name].changed
            grown[name] = grown_regions(mesh, areas_m2, then, quantity.changed)
        classes, class_map = {}, None
        if library is not None and at_first is not None:
            labels, now = at_first.mixture_labels, classified(after.surface, library, angle_rad).mixture_labels
            class_map = ClassChange(at_first.names, labels, np.where(_beyond_noise(quantities, mesh), now, labels))
            classes = {
                name: grown_regions(mesh, areas_m2, class_map.before == number, class_map.after == number)
                for number, name in enumerate(class_map.names)
            }
        left_out = tuple(index.name for index in indices if index.name not in quantities)
        yield DayComparison(first.name, after, quantities, before.name, grown, classes, class_map, left_out)
        earlier = quantities


def _beyond_noise(quantities: Mapping[str, Quantity], mesh: Mesh) -> Bool[np.ndarray, "v"]:
    """Where the spectrum or its brightness changed; elsewhere another class is noise at the edge of two.

    Significant patches beside the regions count as well; without a repeat, only those that touch one.
    """
    beyond = np.zeros(len(mesh.vertices), bool)
    for name in {SPECTRUM, BRIGHTNESS} & set(quantities):
        one = quantities[name]
        told = one.changed | (one.p < FALSE_DISCOVERIES)
        beyond[connected_to(mesh, told, one.changed) if one.limit_m2 else told] = True
    return beyond
