"""Traits as a page, as JSON and as a table of spectra."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.analysis.size import Size
from hsi_sc_nerf.analysis.traits import WHOLE, Traits
from hsi_sc_nerf.files import atomic_write, write_json
from hsi_sc_nerf.spectra.composites import COMPOSITES
from hsi_sc_nerf.tables import markdown_table

_SIZES = {
    "area_m2": ("surface area", "m²", 1.0),
    "volume_l": ("volume", "L", 1.0),
    "height_m": ("height", "mm", 1000.0),
    "largest_diameter_m": ("largest diameter", "mm", 1000.0),
    "smallest_diameter_m": ("smallest diameter", "mm", 1000.0),
    "equivalent_diameter_m": ("diameter of the sphere of equal volume", "mm", 1000.0),
}
_CM2_PER_M2 = 1e4
_LISTED_REGIONS = 20


def write_page(
    path: Path,
    title: str,
    size: Size,
    spread: Size | None,
    watertight: bool,
    traits: Traits,
    pictures: Mapping[str, str],
) -> None:
    """The page ``traits.md``: sizes, classes, indices, composites and pictures.

    Args:
        path: the file.
        title: what was measured.
        size: of the object.
        spread: standard deviation of each size; None where none was asked for.
        watertight: whether the mesh is closed; without it, the volume means nothing.
        traits: what the spectra tell.
        pictures: file names by caption.
    """
    closed_cm2 = (size.area_m2 - traits.seen_m2) * _CM2_PER_M2
    parts = [f"# Traits of {title}", "## Size", _size_table(size, spread)]
    state = "watertight" if watertight else "NOT watertight, so its volume cannot be trusted"
    uncertain = (
        " ± is the standard deviation that random halves of the cloud tell: it does not hold errors that many points "
        "share, as those of scale, poses or training."
        if spread
        else ""
    )
    parts.append(
        f"The mesh is {state}. {closed_cm2:.1f} cm² of its area, the base above all, were not seen but closed."
        f"{uncertain}"
    )
    if traits.classes is not None:
        parts += _class_tables(traits)
    for heading, table, digits in (("Indices", traits.indices, 3), ("Composites", traits.composites, 3)):
        names = list(table[WHOLE])
        if names:
            titles = [f"{name}, {_nm(name)}" if name in COMPOSITES else name for name in names]
            rows = [
                [region, *(_plus_minus(values[name].mean, values[name].sd, digits) for name in names)]
                for region, values in table.items()
            ]
            parts += [f"## {heading}", markdown_table(["region", *titles], rows)]
    if traits.composites[WHOLE]:
        parts.append(
            "Mean ± standard deviation over the surface, weighted by area; of composites the reflectance shown as "
            "red, green and blue. Area and volume are the same for each composite: all bands share one geometry."
        )
    parts += [f"## Pictures\n\n{_picture(caption, name)}" for caption, name in list(pictures.items())[:1]]
    parts += [_picture(caption, name) for caption, name in list(pictures.items())[1:]]
    with atomic_write(path) as (temporary,):
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def write_traits_json(
    path: Path, size: Size, spread: Size | None, watertight: bool, traits: Traits, settings: Mapping[str, Any]
) -> None:
    """Everything but spectra, in metres, square metres and litres; NaN is null."""
    classes = traits.classes
    content: dict[str, Any] = {
        "settings": dict(settings),
        "size": asdict(size),
        "size_sd": asdict(spread) if spread else None,
        "watertight": watertight,
        "seen_area_m2": traits.seen_m2,
        "classes": None
        if classes is None
        else {
            "threshold_rad": classes.threshold_rad,
            "areas_m2": dict(zip(classes.names, classes.areas_m2.tolist(), strict=True)),
            "unclassified_m2": classes.unclassified_m2,
            "mixture_areas_m2": dict(zip(classes.names, classes.mixture_areas_m2.tolist(), strict=True)),
            "mixture_unclassified_m2": classes.mixture_unclassified_m2,
            "regions": [{**asdict(region), "label": classes.names[region.label]} for region in classes.regions],
        },
        "regions": {region.name: {"area_m2": region.area_m2} for region in traits.spectra},
    }
    for key, table in (("indices", traits.indices), ("composites", traits.composites)):
        for region, values in table.items():
            content["regions"][region][key] = {
                name: {"mean": _plain(value.mean), "sd": _plain(value.sd)} for name, value in values.items()
            }
    write_json(path, content)


def write_spectra(path: Path, wavelengths_nm: Float[np.ndarray, "bands"], traits: Traits) -> None:
    """``spectra.csv``: a line a band; of each region the mean and the standard deviation over its surface."""
    titles = [title for region in traits.spectra for title in (f"{region.name} mean", f"{region.name} SD")]
    columns = [column for region in traits.spectra for column in (region.mean, region.sd)]
    with atomic_write(path) as (temporary,), temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["wavelength_nm", *titles])
        for band, wavelength in enumerate(wavelengths_nm):
            writer.writerow([f"{wavelength:.6g}", *(f"{column[band]:.6g}" for column in columns)])


def _size_table(size: Size, spread: Size | None) -> str:
    rows = []
    for key, (name, unit, factor) in _SIZES.items():
        value = getattr(size, key) * factor
        sd = getattr(spread, key) * factor if spread else None
        rows.append([name, f"{value:.4g} ± {sd:.1g}" if sd is not None else f"{value:.4g}", unit])
    return markdown_table(["trait", "value", "unit"], rows)


def _class_tables(traits: Traits) -> list[str]:
    classes = traits.classes
    assert classes is not None
    known = zip(classes.names, classes.areas_m2, classes.mixture_areas_m2, strict=True)
    areas = [*known, ("in no class", classes.unclassified_m2, classes.mixture_unclassified_m2)]
    counts = [sum(region.label == index for region in classes.regions) for index in range(len(classes.names))]
    rows = [
        [
            name,
            f"{area * _CM2_PER_M2:.2f}",
            f"{area / traits.seen_m2:.1%}",
            str(count),
            f"{mixture * _CM2_PER_M2:.2f}",
            f"{mixture / traits.seen_m2:.1%}",
        ]
        for (name, area, mixture), count in zip(areas, [*counts, ""], strict=True)
    ]
    listed = [
        [classes.names[region.label], f"{region.area_m2 * _CM2_PER_M2:.2f}"]
        + [f"{1000.0 * x:.1f}" for x in region.centre_m]
        for region in classes.regions[:_LISTED_REGIONS]
    ]
    return [
        "## Classes",
        "By angle: all places whose spectral angle to the class is the smallest, and at most "
        f"{classes.threshold_rad:g} rad. By mixture: all places of which the class makes up more than half, their "
        "spectra taken for mixtures of the library's; where the library has all that the surface is made of, these "
        "tell spots with soft edges better.",
        markdown_table(
            ["class", "by angle, cm²", "of what was seen", "regions", "by mixture, cm²", "of what was seen"], rows
        ),
        f"The largest {len(listed)} of {len(classes.regions)} connected regions, with their middles:",
        markdown_table(["class", "area, cm²", "x, mm", "y, mm", "z, mm"], listed),
    ]


def _nm(name: str) -> str:
    return ", ".join(f"{wavelength:g}" for wavelength in COMPOSITES[name].wavelengths_nm) + " nm"


def _plus_minus(mean: np.ndarray, sd: np.ndarray, digits: int) -> str:
    return ", ".join(
        f"{a:.{digits}f} ± {b:.{digits}f}" for a, b in zip(np.atleast_1d(mean), np.atleast_1d(sd), strict=True)
    )


def _plain(value: np.ndarray) -> Any:
    if np.ndim(value):
        return [_plain(one) for one in value]
    return float(value) if np.isfinite(value) else None


def _picture(caption: str, name: str) -> str:
    return f"{caption}:\n\n![{caption}]({name})"
