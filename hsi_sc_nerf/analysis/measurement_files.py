"""The files of `hsi-sc-nerf traits`: page, tables, mesh and pictures."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.analysis import pictures, report
from hsi_sc_nerf.analysis.class_maps import ClassMap, rest_words
from hsi_sc_nerf.analysis.library import SpectralLibrary, write_library
from hsi_sc_nerf.analysis.maps import SurfaceMap, numbered
from hsi_sc_nerf.analysis.measurement import Measurement
from hsi_sc_nerf.analysis.spectral_mesh import write_spectral_mesh
from hsi_sc_nerf.analysis.traits import Traits
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.spectra import available_composites

_PICTURES = (
    *("classes.png", "classes_by_mixture.png", "calibration_*.png", "region_spectra.png", "composites.png"),
    *("indices.png", "calibrations.png", "components.png", "endmembers.png"),
)
_TABLES = ("traits.md", "traits.json", "spectra.csv", "regions.sli", "regions.hdr", "mesh.ply")


def write_measurement(folder: Path | str, measured: Measurement, name: str) -> dict[str, Any]:
    """Write pictures, mesh and tables, and last ``traits.md``, the page that links them.

    Pictures of an earlier result in the same folder that this one does not have are deleted.

    Args:
        folder: to write to.
        measured: the traits.
        name: name of the cloud, which the page states.

    Returns:
        The content of ``traits.json``.

    Raises:
        InputError: the files cannot be written.

    Example:
        >>> found = measure_traits(read_spectral_ply("point_cloud.ply"))
        >>> write_measurement("traits", found, "apple, day 1")
    """
    folder, surface, traits, components = Path(folder), measured.surface, measured.traits, measured.components
    views = pictures.SideViews(surface.mesh)
    drawn, extra = {}, {}
    if (found := traits.classes) is not None:
        for caption, picture, column, labels in (
            ("Classes by angle", "classes.png", "class", found.labels),
            ("Classes by mixture", "classes_by_mixture.png", "class_by_mixture", found.mixture_labels),
        ):
            pictures.draw_classes(folder / picture, found.names, labels, surface, views)
            drawn[caption], extra[column] = picture, labels.astype("float32")
    every: list[SurfaceMap | ClassMap] = [*traits.maps, *traits.class_maps]
    columns = dict(zip((one.name for one in every), numbered([one.column for one in every]), strict=True))
    for one in traits.class_maps:
        picture = f"{columns[one.name]}.png"
        pictures.draw_classes(folder / picture, one.classes, one.labels, surface, views, rest_words(one.limited))
        drawn[f"Classes by {one.name}"], extra[columns[one.name]] = picture, one.labels.astype("float32")
    drawn["Spectra of regions"] = "region_spectra.png"
    pictures.draw_region_spectra(folder / "region_spectra.png", surface.wavelengths_nm, traits)
    if available_composites(surface.wavelengths_nm):
        drawn["Composites"] = "composites.png"
        pictures.draw_composites(folder / "composites.png", surface, views)
    maps = {
        ("Indices", "indices.png"): {one.caption: one.values for one in traits.maps if one.definition},
        ("Calibrations", "calibrations.png"): {one.caption: one.values for one in traits.maps if not one.definition},
    }
    extra |= {columns[one.name]: one.values.astype("float32") for one in traits.maps}
    if components is not None:
        scores, fractions = components.columns()
        maps |= {
            ("Principal components", "components.png"): scores,
            ("Fractions of endmembers", "endmembers.png"): fractions,
        }
        extra |= {name: column.astype("float32") for name, column in (scores | fractions).items()}
        write_library(folder / "endmembers.csv", components.endmembers)
    for (caption, picture), of_picture in maps.items():
        if of_picture:
            pictures.draw_maps(folder / picture, of_picture, surface, views)
            drawn[caption] = picture
    write_spectral_mesh(folder / "mesh.ply", surface, extra)
    write_spectra(folder / "spectra.csv", surface.wavelengths_nm, traits)
    write_library(folder / "regions.sli", measured.region_spectra())
    content = replace(measured, settings={"cloud": name, **measured.settings}).content()
    write_json(folder / "traits.json", content)
    report.write_traits_page(folder / "traits.md", name, content, drawn)
    delete_earlier(folder, keep=(*_TABLES, *drawn.values()))
    return content


def is_replaced(path: Path, folder: Path, also: Collection[str] = ()) -> bool:
    """Whether a result in a folder, or in those of its pieces, replaces or deletes a file.

    Args:
        path: the file.
        folder: for the result.
        also: names of further files that are written there.
    """
    places = (folder, *folder.glob("piece-*"))
    written = (place / name for place in places for name in (*_TABLES, *also))
    return path.is_file() and any(one.is_file() and one.samefile(path) for one in written)


def delete_earlier(folder: Path, keep: Collection[str] = ()) -> None:
    """Delete the files of `write_measurement` in a folder, and the folder, if nothing else is in it.

    ``endmembers.csv`` stays, as do proposed regions: both may be what a command was given.

    Args:
        folder: that an earlier result may lie in.
        keep: names of files that belong to the present one.

    Raises:
        InputError: a file cannot be deleted.
    """
    try:
        for path in [path for name in (*_PICTURES, *_TABLES) for path in folder.glob(name) if path.name not in keep]:
            path.unlink()
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    except OSError as error:
        raise InputError(
            f"{error.filename}: is of an earlier result and cannot be deleted ({error.strerror}); delete it, "
            "or choose another folder."
        ) from error


def write_spectra(path: Path, wavelengths_nm: Float[np.ndarray, "bands"], traits: Traits) -> None:
    """``spectra.csv``: a line a band; of each region the mean and the standard deviation over its surface.

    Where material and light are told apart, both the material's and those as measured.
    """
    titles, columns = [], []
    for region in traits.regions:
        kinds = {"": region.spectrum}
        if region.light is not None:
            kinds = {" material": region.spectrum, " measured": region.light.measured}
        for kind, spectrum in kinds.items():
            titles += [f"{region.name}{kind} mean", f"{region.name}{kind} SD"]
            columns += [spectrum.mean, spectrum.sd]
    write_library(path, SpectralLibrary(tuple(titles), wavelengths_nm, np.stack(columns)))
