"""Everything that `hsi-sc-nerf traits` measures on a cloud, in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.calibrations import Calibration, calibration_map, read_calibration
from hsi_sc_nerf.analysis.class_maps import class_map
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh, open_edges
from hsi_sc_nerf.analysis.components import Components, find_components
from hsi_sc_nerf.analysis.drawn_regions import DrawnRegion
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.maps import index_maps, require_own_names
from hsi_sc_nerf.analysis.report import component_content, trait_content
from hsi_sc_nerf.analysis.size import (
    Size,
    pixel_on_object_m,
    size_of,
    size_uncertainty,
    sizes_to_find,
    systematic_errors,
)
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh, with_spectra
from hsi_sc_nerf.analysis.standing_pieces import one_piece
from hsi_sc_nerf.analysis.traits import WHOLE, RegionOfInterest, Traits, analyse, classified
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG, SpectralCloud
from hsi_sc_nerf.indices.catalogue import find_indices
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.terminal import progress_bar


@dataclass(frozen=True)
class Measurement:
    """An object's size, and what is on its surface.

    Attributes:
        surface: the closed mesh with its spectra.
        size: size of the mesh.
        uncertainty: standard deviation of each size by its cause; empty without splits.
        traits: spectra, indices, calibrations and classes of the regions.
        components: principal components and endmembers; None if none were to be found.
        settings: that it was made with.
    """

    surface: SpectralMesh
    size: Size
    uncertainty: Mapping[str, Size]
    traits: Traits
    components: Components | None
    settings: Mapping[str, Any]

    def __repr__(self) -> str:
        size, names = self.size, ", ".join(region.name for region in self.traits.regions)
        return f"<Measurement: {1e3 * size.volume_l:.4g} mL, {1e4 * size.area_m2:.4g} cm²; {names}>"

    def content(self) -> dict[str, Any]:
        """All but spectra, as ``traits.json`` holds it: metres, square metres, litres."""
        watertight = open_edges(self.surface.mesh) == 0
        content = trait_content(self.size, self.uncertainty, watertight, self.traits, self.settings)
        return content | ({"components": component_content(self.components)} if self.components else {})

    def region_spectra(self) -> SpectralLibrary:
        """The mean spectra of the whole surface, the classes and the regions, by name."""
        names, spectra = zip(*((one.name, one.spectrum.mean) for one in self.traits.regions), strict=True)
        return SpectralLibrary(names, self.surface.wavelengths_nm, np.stack(spectra))


def measure_traits(
    cloud: SpectralCloud,
    dataset: PackedDataset | None = None,
    *,
    mesh: MeshConfig | None = None,
    splits: int = 6,
    max_incidence_deg: float = MAX_INCIDENCE_DEG,
    library: SpectralLibrary | None = None,
    angle_rad: float = paper.CLASSIFICATION_ANGLE_RAD,
    regions: Mapping[str, Sequence[float]] | None = None,
    drawn_regions: Sequence[DrawnRegion] = (),
    indices: Sequence[str] = (),
    calibrations: Sequence[Path | str | Calibration] = (),
    components: int = 0,
    piece: int | None = None,
) -> Measurement:
    """Measure an object's size, and the spectra, indices and classes on its surface, as `hsi-sc-nerf traits` does.

    Args:
        cloud: metres, z up.
        dataset: that the cloud was made from, for the height of the base and the uncertainty of scale and pixels.
        mesh: settings of the mesh.
        splits: random splits of the cloud, for the uncertainty of the sizes; 0 for none.
        max_incidence_deg: spectra come from points that are seen at this angle at most.
        library: reference spectra to classify by.
        angle_rad: largest spectral angle to a class.
        regions: x, y, z of the centre and radius of each region of interest by its name, metres.
        drawn_regions: regions that were drawn in the report (`read_drawn_regions`).
        indices: names of the catalogue, or formulas as ``"CRI = 1/R510 - 1/R550"``.
        calibrations: tables (`read_calibration`), or what was read of them.
        components: principal components and endmembers to look for, at most.
        piece: which of several objects that stand on the table, from 1; None where there is but one.

    Raises:
        InputError: a file or a number cannot be used, or the cloud holds several objects and none is chosen.

    Example:
        >>> found = measure_traits(read_spectral_ply("point_cloud.ply"), indices=["PRI"], splits=0)
        >>> found.size.volume_l, found.traits.regions[0].maps["PRI"].surface.mean
        (0.21, 0.04)
    """
    of_classes = set(library.names if library else ()) | {WHOLE}
    names = [*(regions or ()), *(one.name for one in drawn_regions), *of_classes]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two regions or classes are named {twice[0]}; give each region a name of its own.")
    config = on_container(MeshConfig() if mesh is None else mesh, dataset)
    cloud = one_piece(cloud, piece, config)
    if dataset is not None and not dataset.metric:  # which another program's copy of a cloud does not say
        cloud = replace(cloud, metric=False)
    picked = [RegionOfInterest(name, (x, y, z), radius) for name, (x, y, z, radius) in (regions or {}).items()]
    found_indices = find_indices(indices, cloud.wavelengths_nm)
    read = [one if isinstance(one, Calibration) else read_calibration(one) for one in calibrations]
    require_own_names([*(one.name for one in found_indices), *(one.name for one in read)])
    for calibration in read:
        calibration.interpolation(cloud.wavelengths_nm)  # which refuses before the work
    if library is not None:
        library = class_references(library, cloud.wavelengths_nm)

    console = Console(stderr=True)
    with console.status("closing the surface"):
        closed = closed_mesh(cloud.points, cloud.normals, config)
    uncertainty: dict[str, Size] = {}
    if splits:
        systematic = None
        if dataset is not None:
            systematic = systematic_errors(closed, dataset, base_known=config.base_height_m is not None)
        with progress_bar("uncertainty", "meshes", sizes_to_find(splits, systematic)) as done:
            uncertainty = size_uncertainty(cloud.points, cloud.normals, closed, config, splits, systematic, done=done)
    with console.status("spectra on the surface"):
        surface = with_spectra(closed, cloud, config.smoothing_radius_m, max_incidence_deg)
        classes = classified(surface, library, angle_rad) if library else None
        pixel_m = None if dataset is None else pixel_on_object_m(dataset)
        maps = index_maps(surface, found_indices)
        maps += [calibration_map(surface, one) for one in read if not one.classes]
        class_maps = [class_map(surface, one) for one in read if one.classes]
        traits = analyse(surface, [*picked, *drawn_regions], classes, pixel_m, maps, class_maps)
        unsupervised = find_components(surface, components) if components else None
    settings = {**asdict(config), "splits": splits, "max_incidence_deg": max_incidence_deg}
    if not cloud.metric:
        settings["metric"] = False
    return Measurement(surface, size_of(closed), uncertainty, traits, unsupervised, settings)


def class_references(library: SpectralLibrary, wavelengths_nm: Float[np.ndarray, "bands"]) -> SpectralLibrary:
    """The spectra of a library that classes are made of, at the bands of a cloud.

    ``regions.sli`` also holds the mean of the whole surface, which is no class and is left out.

    Raises:
        InputError: nothing else is in the library, or it does not cover the bands.
    """
    names = tuple(name for name in library.names if name != WHOLE)
    if not names:
        raise InputError(
            f"the spectral library has only the mean of the {WHOLE}, which is no class; give one with spectra of "
            "classes, such as the regions.sli of an object with regions (--roi)."
        )
    return library.only(names).at(wavelengths_nm)


def on_container(mesh: MeshConfig, dataset: PackedDataset | None) -> MeshConfig:
    """Settings of the mesh; the height of the dataset's container is that of the base, unless they give one."""
    if mesh.base_height_m is not None or dataset is None or dataset.container is None:
        return mesh
    return replace(mesh, base_height_m=dataset.container.height_m)
