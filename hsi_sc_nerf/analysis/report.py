"""Traits as JSON, as tables with units, and as a page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hsi_sc_nerf.analysis.class_maps import ClassAreas, ClassMap, rest_words
from hsi_sc_nerf.analysis.components import Components
from hsi_sc_nerf.analysis.maps import SurfaceMap
from hsi_sc_nerf.analysis.size import Size, combined
from hsi_sc_nerf.analysis.traits import WHOLE, MapMean, RegionTraits, Traits
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.terminal import markdown_table, markdown_text

# Name, unit, and the unit's factor on metres, square metres or litres.
SIZES = {
    "area_m2": ("surface area", "cm²", 1e4),
    "volume_l": ("volume", "mL", 1e3),
    "height_m": ("height", "mm", 1e3),
    "largest_diameter_m": ("largest diameter", "mm", 1e3),
    "smallest_diameter_m": ("smallest diameter", "mm", 1e3),
    "equivalent_diameter_m": ("diameter of the sphere of equal volume", "mm", 1e3),
}
PIECES = "pieces"
"""Key of ``traits.json`` that holds the traits of each of several objects, in place of those of one."""
_CAUSES = {
    "points": "the scatter of the points",
    "base": "the unseen base",
    "detail": "detail finer than the smoothing",
    "scale": "the scale",
    "surface": "the place of the surface",
    "hollows": "the depth of hollows",
}
"""Words for the causes of `size_uncertainty`."""
CM2_PER_M2, MM_PER_M = 1e4, 1e3
_LISTED_REGIONS = 20
_ROUNDING = 1e-6
"""A smaller standard deviation, as a fraction of the value, is that of single precision."""
_MAP_NOTE = (
    "Mean ± standard deviation over the surface, weighted by area; in brackets, where it is known, the standard "
    "deviation of the mean, by how much frames disagree and by what pixels mix."
)


class TraitTable(NamedTuple):
    """A table with its heading, and what a reader must know of it."""

    heading: str
    note: str
    header: list[str]
    rows: list[list[str]]


def trait_content(
    size: Size, uncertainty: Mapping[str, Size], watertight: bool, traits: Traits, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """``traits.json``: everything but spectra, in metres, square metres and litres; NaN is null.

    Args:
        size: size of the object.
        uncertainty: standard deviation of each size by its cause; empty if it was not determined.
        watertight: whether the mesh encloses a volume.
        traits: from the spectra.
        settings: settings of the command.
    """
    classes = traits.classes
    relative_sd = combined(uncertainty).area_m2 / size.area_m2 if uncertainty else 0.0
    return {
        "settings": dict(settings),
        "size": asdict(size),
        "size_sd": asdict(combined(uncertainty)) if uncertainty else None,
        "size_sd_by_cause": {cause: asdict(part) for cause, part in uncertainty.items()},
        "watertight": watertight,
        "seen_area_m2": traits.seen_m2,
        "indices": [one.definition for one in traits.maps if one.definition],
        "calibrations": {
            one.name: {"unit": one.label, "error": one.error} | _bounds(one)
            for one in traits.maps
            if not one.definition
        },
        "classifiers": {one.name: {"classes": list(one.classes)} | _bounds(one) for one in traits.class_maps},
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
        "regions": {
            region.name: {
                "area_m2": region.area_m2,
                "indices": {one.name: _plain_mean(region.maps[one.name]) for one in traits.maps if one.definition},
                "calibrations": {
                    one.name: _plain_mean(region.maps[one.name]) for one in traits.maps if not one.definition
                },
                "classifiers": {
                    one.name: _plain_areas(one.classes, region.class_areas[one.name], relative_sd)
                    for one in traits.class_maps
                },
                "reflectance": _plain_reflectance(region),
            }
            for region in traits.regions
        },
    }


def component_content(components: Components) -> dict[str, Any]:
    """What ``traits.json`` says of principal components and endmembers."""
    return {
        "supported": components.supported,
        "variance_fractions": components.variance_fractions.tolist(),
        "mean_fractions": np.nanmean(components.fractions, axis=0).tolist(),
    }


def each_object(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Of the content of ``traits.json`` that of each object: of one, itself.

    Raises:
        ValueError: it holds none.
    """
    pieces = content.get(PIECES, [content])
    if not isinstance(pieces, list) or not pieces or not all(isinstance(one, Mapping) for one in pieces):
        raise ValueError(f"{PIECES} is no list of traits")
    return pieces


def scale_note(content: Mapping[str, Any]) -> str:
    """That the sizes of an object of ``traits.json`` are no metres; empty where the scale was known."""
    unknown = content.get("settings", {}).get("metric") is False
    return "Sizes are wrong: nothing gave the session's scale, and 1 m is the camera's distance." if unknown else ""


def trait_tables(content: Mapping[str, Any]) -> list[TraitTable]:
    """Sizes, classes and indices in mm, cm² and mL, from the content of ``traits.json``.

    Raises:
        AttributeError, KeyError, TypeError, ValueError: it is no such content.
    """
    size, spread, seen_m2 = content["size"], content["size_sd"], content["seen_area_m2"]
    state = "watertight" if content["watertight"] else "NOT watertight, so its volume cannot be trusted"
    closed_cm2 = CM2_PER_M2 * (size["area_m2"] - seen_m2)
    note = f"The mesh is {state}. {closed_cm2:.1f} cm² of its area, mainly the base, were not seen but closed."
    note = f"{scale_note(content)} {note}".lstrip()
    if spread:
        note += f" ± is the standard deviation by {_listed(content['size_sd_by_cause'])}."
        missing = [words for cause, words in _CAUSES.items() if cause not in content["size_sd_by_cause"]]
        if missing:
            note += f" Not known, and not in it: {', '.join(missing)}."
    rows = [
        [name, _with_sd(factor * size[key], factor * spread[key]) if spread else f"{factor * size[key]:.4g}", unit]
        for key, (name, unit, factor) in SIZES.items()
    ]
    tables = [TraitTable("Size", note, ["trait", "value", "unit"], rows)]
    if content["classes"]:
        tables += _class_tables(content["classes"], seen_m2)
    tables.append(_reflectance_table(content["regions"]))
    regions = {name: region["indices"] for name, region in content["regions"].items()}
    if names := list(regions[WHOLE]):
        rows = [[region, *(_map_mean(values[name]) for name in names)] for region, values in regions.items()]
        tables.append(TraitTable("Indices", _MAP_NOTE, ["region", *names], rows))
    if calibrations := content.get("calibrations"):
        tables.append(_calibration_table(calibrations, content["regions"]))
    if classifiers := content.get("classifiers"):
        tables.append(_classifier_table(classifiers, content["regions"]))
    if components := content.get("components"):
        pairs = zip(components["variance_fractions"], components["mean_fractions"], strict=True)
        rows = [[str(number), f"{a:.2%}", f"{b:.1%}"] for number, (a, b) in enumerate(pairs, 1)]
        note = (
            f"The noise supports {components['supported']} directions. Endmembers are the purest spectra of the "
            "surface (endmembers.csv, which --library takes); their fractions are means over the mesh's points."
        )
        header = ["number", "variance of the principal component", "fraction of the endmember"]
        tables.append(TraitTable("Components", note, header, rows))
    return tables


def _calibration_table(calibrations: Mapping[str, Any], regions: Mapping[str, Any]) -> TraitTable:
    rows = [
        [region, name, calibrations[name]["unit"], _map_mean(value), _outside(value, calibrations[name])]
        for region, values in regions.items()
        for name, value in values["calibrations"].items()
    ]
    note = (
        f"{_MAP_NOTE} It counts the calibration's own error. Outside: area whose spectra it does not know, if "
        "its table states limits."
    )
    for name, of in calibrations.items():
        if of["resampling_error"]:
            note += (
                f" Its bands are not the cloud's: resampling changes {name} by {of['resampling_error']:.2g} (RMS)."
            )
    return TraitTable("Calibrations", note, ["region", "calibration", "unit", "value", "outside"], rows)


def _classifier_table(classifiers: Mapping[str, Any], regions: Mapping[str, Any]) -> TraitTable:
    rows = []
    for region, values in regions.items():
        for name, found in values["classifiers"].items():
            sds = found["area_sds_m2"]
            areas = [(label, area, sds.get(label)) for label, area in found["areas_m2"].items()]
            rest = rest_words(classifiers[name].get("limits", True))
            for label, area, sd in (*areas, (rest, found["outside_m2"], None)):
                shown = f"{CM2_PER_M2 * area:.2f}" if sd is None else _with_sd(CM2_PER_M2 * area, CM2_PER_M2 * sd)
                rows.append([region, name, label, shown, f"{area / values['area_m2']:.1%}"])
    note = (
        "Area of the surface whose most probable class is each; ± is its standard deviation by the classifier's own "
        "doubt, the noise of the spectra and the size of the mesh, and is left out where the dataset (--data) is not "
        "known. Areas outside have spectra that it was not fitted on, which only a table with limits tells."
    )
    for name, of in classifiers.items():
        if of["resampling_error"]:
            note += (
                f" Its bands are not the cloud's: resampling changes the class by {name} of "
                f"{of['resampling_error']:.1%} of the area."
            )
    return TraitTable("Classifiers", note, ["region", "classifier", "class", "area, cm²", "of the region"], rows)


def _outside(value: Mapping[str, Any], calibration: Mapping[str, Any]) -> str:
    """Fraction of the area without a value."""
    return f"{value['outside']:.1%}" + ("" if calibration.get("limits", True) else " (no limits stated)")


def _map_mean(value: Mapping[str, float | None]) -> str:
    if value["mean"] is None:
        return "no value"
    std = value.get("std")
    return _with_sd(value["mean"], value["sd"], digits=3) + ("" if std is None else f" ({std:.2g})")


def _listed(causes: Iterable[str]) -> str:
    *rest, last = (_CAUSES[cause] for cause in causes)
    return f"{', '.join(rest)} and {last}" if rest else last


def _reflectance_table(content: Mapping[str, Mapping[str, Any]]) -> TraitTable:
    """Area and brightness of each region with its uncertainty, and the light on it where it is known."""
    regions = {name: region["reflectance"] for name, region in content.items()}
    header = ["region", "seen area, cm²", "reflectance"]
    note = "Mean over the bands; ± is its standard deviation"
    told = all(value["std"] is not None for value in regions.values())
    note += "." if told else ", which is left out where the dataset (--data) or the number of views is not known."
    lit = "irradiance" in regions[WHOLE]
    if lit:
        header += ["as measured", "irradiance"]
        note += (
            " The reflectance is the material's, and so are spectra, indices and classes; spectra.csv has the "
            "measured spectra as well. Irradiance is relative to that on the white reference."
        )
    rows = []
    for name, value in regions.items():
        row = [name, f"{CM2_PER_M2 * content[name]['area_m2']:.2f}", _with_sd(value["mean"], value["std"])]
        if lit:
            row += [f"{value['measured']:.3f}", _with_sd(value["irradiance"], value["irradiance_std"])]
        rows.append(row)
    return TraitTable("Reflectance", note, header, rows)


def _class_tables(classes: Mapping[str, Any], seen_m2: float) -> list[TraitTable]:
    areas = classes["areas_m2"] | {"in no class": classes["unclassified_m2"]}
    mixtures = classes["mixture_areas_m2"] | {"in no class": classes["mixture_unclassified_m2"]}
    labels = [region["label"] for region in classes["regions"]]
    rows = [
        [
            *(name, f"{CM2_PER_M2 * area:.2f}", f"{area / seen_m2:.1%}", str(labels.count(name))),
            *(f"{CM2_PER_M2 * mixtures[name]:.2f}", f"{mixtures[name] / seen_m2:.1%}"),
        ]
        for name, area in areas.items()
    ]
    listed = [
        [region["label"], f"{CM2_PER_M2 * region['area_m2']:.2f}", *(f"{1e3 * x:.1f}" for x in region["centre_m"])]
        for region in classes["regions"][:_LISTED_REGIONS]
    ]
    note = (
        "By angle: surface whose spectral angle to the class is the smallest, and at most "
        f"{classes['threshold_rad']:g} rad. By mixture: surface where the class's fraction exceeds one half, by "
        "linear unmixing with the library. If the library holds all materials of the surface, areas by mixture are "
        "better for spots with soft edges."
    )
    header = ["class", "by angle, cm²", "of seen area", "regions", "by mixture, cm²", "of seen area"]
    note_of_regions = f"The largest {len(listed)} of {len(labels)} connected regions, with their centres."
    return [
        TraitTable("Classes", note, header, rows),
        TraitTable("Connected regions", note_of_regions, ["class", "area, cm²", "x, mm", "y, mm", "z, mm"], listed),
    ]


def write_traits_page(path: Path, title: str, content: Mapping[str, Any], pictures: Mapping[str, str]) -> None:
    """Write ``traits.md``: the tables of ``content``, and pictures (file names by caption)."""
    parts = [f"# Traits of {markdown_text(title)}"]
    for table in trait_tables(content):
        parts += [f"## {table.heading}", markdown_table(table.header, table.rows), table.note]
    parts += ["## Pictures", *(f"{caption}:\n\n![{caption}]({name})" for caption, name in pictures.items())]
    with atomic_write(path) as (temporary,):
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _plain_reflectance(region: RegionTraits) -> dict[str, float | None]:
    """Mean over the bands and its uncertainty; where light is told apart, the same as measured, and the light."""
    values = {"mean": region.spectrum.mean.mean(), "std": region.reflectance_std}
    if (light := region.light) is not None:
        values |= {"measured": light.measured.mean.mean(), "irradiance": light.irradiance.mean}
        values["irradiance_std"] = light.irradiance_std
    return _plain(values)


def _bounds(one: SurfaceMap | ClassMap) -> dict[str, float | bool | None]:
    """How well a calibration fits the surface's bands and spectra; no error where no spectrum has a value."""
    return _plain({"resampling_error": one.resampling_error}) | {"limits": one.limited}


def _plain_areas(names: Sequence[str], found: ClassAreas, relative_sd: float) -> dict[str, Any]:
    """Ready for JSON, with the mesh's own uncertainty, which all areas share."""
    stds_m2 = np.hypot(found.stds_m2, relative_sd * found.areas_m2)
    return {
        "areas_m2": dict(zip(names, found.areas_m2.tolist(), strict=True)),
        "area_sds_m2": {name: std for name, std in zip(names, stds_m2.tolist(), strict=True) if math.isfinite(std)},
        "outside_m2": found.outside_m2,
    }


def _plain_mean(value: MapMean) -> dict[str, float | None]:
    surface = value.surface
    return _plain({"mean": surface.mean, "sd": surface.sd, "std": value.std, "outside": value.outside})


def _plain(numbers: Mapping[str, Any]) -> dict[str, float | None]:
    """Ready for JSON: null for what is not finite."""
    return {name: float(value) if math.isfinite(value) else None for name, value in numbers.items()}


def _with_sd(value: float | None, sd: float | None, digits: int = 2) -> str:
    """The standard deviation with so many digits that count, the value with as many decimals; of None nothing."""
    if value is None or sd is None or not (math.isfinite(sd) and sd > _ROUNDING * abs(value)):
        shown = f"{math.nan if value is None else value:.4g}"
        return shown if sd is None else f"{shown} ± {sd:.2g}"
    decimals = max(0, digits - 1 - math.floor(math.log10(float(f"{sd:.1e}"))))
    return f"{value:.{decimals}f} ± {sd:.{decimals}f}"
