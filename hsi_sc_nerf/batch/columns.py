"""The columns of the table of all objects: names that R and pandas read as they are, units, definitions, types.

Most are the same in every table. Those of classes, regions and further indices come from what was found.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from hsi_sc_nerf.analysis.report import SIZES
from hsi_sc_nerf.batch.plan import STEPS
from hsi_sc_nerf.indices.catalogue import CATALOGUE, USUAL

Kind = Literal["number", "text", "truth"]
Value = float | str | bool | None
"""None where there is none."""

GROUPS = ("status", "size", "spectrum", "index", "class", "region", "score", "quality", "cost")
"""What columns tell, in their order in the table; the columns of the list of sessions stand before them."""
_UNIT_SUFFIXES = {"cm²": "cm2", "mL": "ml", "mm": "mm", "dB": "db", "MiB": "mib", "%": "percent"}


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes:
        name: letters, digits and low lines; ends in the unit, where it has one.
        unit: as it is printed; empty for a pure number or a text.
        definition: what stands in it.
        group: what it tells, of `GROUPS`, or "list" for a column of the list of sessions.
        kind: type of its values.
        spread: the column of how uncertain these values are, or how they spread; None where there is none.
    """

    name: str
    unit: str
    definition: str
    group: str
    kind: Kind = "number"
    spread: Column | None = None


def safe_name(*parts: str, unit: str = "") -> str:
    """Name of a column from words and a unit.

    Example:
        >>> safe_name("region", "blush (left)", "area", unit="cm²")
        'region_blush_left_area_cm2'
    """
    words = re.sub(r"[\W_]+", "_", "_".join(parts).lower()).strip("_")
    # A user's calibration has any unit, such as mg/g.
    suffix = _UNIT_SUFFIXES.get(unit, re.sub(r"[\W_]+", "_", unit.lower()).strip("_"))
    # R wants a letter first.
    return ("" if words[:1].isalpha() else "x_") + words + (suffix and f"_{suffix}")


def measured(name: str, unit: str, definition: str, group: str, spread: str = "") -> tuple[Column, ...]:
    """The column of a number, and the one of its standard deviation, where it is said what that is of (``spread``).

    Example:
        >>> [column.name for column in measured("volume", "mL", "enclosed volume", "size", "by all known causes")]
        ['volume_ml', 'volume_sd_ml']
    """
    sd = f"standard deviation {spread} of: {definition}"
    of_spread = Column(safe_name(name, "sd", unit=unit), unit, sd, group) if spread else None
    own = Column(safe_name(name, unit=unit), unit, definition, group, spread=of_spread)
    return (own,) if of_spread is None else (own, of_spread)


_NOTES = {"area_m2": ", base included"} | dict.fromkeys(
    ("volume_l", "equivalent_diameter_m"), "; empty where the mesh is not closed"
)
_SD, _SPREAD = "by all known causes", "over the object's surface"

STATUS = Column(
    "status",
    "",
    "done; failed (a step did), damaged (a result cannot be read) or unfinished (a result is not there yet)",
    "status",
    "text",
)
STEP = Column("step", "", "the step that failed or whose result is damaged", "status", "text")
SENTENCE = Column("sentence", "", "what was wrong there, and what to do", "status", "text")
PIECE = Column(
    "piece",
    "",
    "number of the object among those that stand on the table, 1 the largest; times and memory, which all of a "
    "session share, stand in its first row",
    "status",
)
"""Only in tables with such a session, and so are the next two."""
PIECE_AT = tuple(
    Column(f"piece_{axis}_mm", "mm", f"{axis} of the middle of the piece, object frame", "status") for axis in "xy"
)
SIZE = {
    key: measured(key.rpartition("_")[0], unit, name + _NOTES.get(key, ""), "size", _SD)
    for key, (name, unit, _) in SIZES.items()
}
"""Value and uncertainty, by the key of the size in ``traits.json``."""
SEEN_AREA = Column("seen_area_cm2", "cm²", "surface area that cameras saw; the rest is the closed base", "size")
WATERTIGHT = Column("watertight", "", "whether the mesh is closed", "size", "truth")
_REFLECTED = measured(
    "reflectance",
    "",
    "reflectance of the seen surface, mean over the bands; the material's, where light was told apart",
    "spectrum",
    _SD,
)
_LIT = measured(
    "irradiance", "", "light on the seen surface relative to that on the white reference", "spectrum", _SD
)
_LIT_REFLECTED = measured(
    "reflectance_measured", "", "the same as measured, with the light on the object", "spectrum"
)
_REFLECTANCE_KEYS = ("mean", "std", "measured", "irradiance", "irradiance_std")
REFLECTANCE = dict(zip(_REFLECTANCE_KEYS, (*_REFLECTED, *_LIT_REFLECTED, *_LIT), strict=True))
"""Columns by the key of the region's reflectance in ``traits.json``."""
SCORES = {
    "sam": Column("sam_rad", "rad", "spectral angle of held-out views, inside the mask", "score"),
    "rmse": Column("rmse", "", "root of the mean squared error of their reflectance, inside the mask", "score"),
    "psnr": Column("psnr_db", "dB", "peak signal-to-noise ratio of them, inside the mask", "score"),
    "ssim": Column("ssim", "", "structural similarity of them, inside the mask", "score"),
}
"""Columns by the key in ``eval.json``."""
QUALITY = Column("quality", "", "worst level of inspect's and process's checks: green, amber, red", "quality", "text")
FLAGS = Column("flags", "", "names of the checks that are not green, with semicolons between", "quality", "text")
SECONDS = {step: Column(f"{step}_s", "s", f"wall time of the step {step}", "cost") for step in STEPS}
MEMORY = {step: Column(f"{step}_memory_mib", "MiB", f"peak memory of the step {step}", "cost") for step in STEPS}
TOTAL = Column("total_s", "s", "wall time of all steps that ran", "cost")
PEAK = Column("peak_memory_mib", "MiB", "largest peak memory of these steps", "cost")


def index_columns(name: str) -> tuple[Column, ...]:
    """Mean of a spectral index over the seen surface, and how it spreads there."""
    known = CATALOGUE.get(name)
    formula = f", {known.expression}" if known else ""
    return measured(name, "", f"{name}{formula}: mean over the seen surface", "index", _SPREAD)


def calibration_columns(name: str, unit: str) -> tuple[Column, ...]:
    """Mean of a calibration's prediction over the seen surface, and how it spreads there."""
    return measured(name, unit, f"prediction of the calibration {name}: mean over the seen surface", "index", _SPREAD)


def classifier_columns(name: str, label: str) -> tuple[Column, ...]:
    """Area of a classifier's class on the seen surface, and its standard deviation."""
    return measured(f"{name} {label} area", "cm²", f"area of the class {label} by {name}", "class", _SD)


def class_columns(name: str) -> tuple[Column, Column, Column]:
    """Area of a class by spectral angle, and its fractions of the seen area by angle and by mixture."""
    part = f"part of the seen area in the class {name}"
    return (
        Column(safe_name("class", name, "area", unit="cm²"), "cm²", f"area of the class {name} by angle", "class"),
        Column(safe_name("class", name, "fraction"), "", f"{part} by angle", "class"),
        Column(safe_name("class", name, "mixture_fraction"), "", f"{part} by mixture", "class"),
    )


def region_columns(name: str) -> tuple[Column, ...]:
    """Area and reflectance of a region of interest, or of what is in a class."""
    area = Column(safe_name("region", name, "area", unit="cm²"), "cm²", f"area of the region {name}", "region")
    meaning = f"reflectance of the region {name}, mean over the bands"
    return area, *measured(f"region_{name}_reflectance", "", meaning, "region", _SD)


def region_index_column(region: str, index: str) -> Column:
    """Mean of a spectral index over a region."""
    return Column(safe_name("region", region, index), "", f"{index}: mean over the region {region}", "region")


STANDING = (
    *(STATUS, STEP, SENTENCE),
    *(column for pair in SIZE.values() for column in pair),
    *(SEEN_AREA, WATERTIGHT, *REFLECTANCE.values()),
    *(column for name in USUAL for column in index_columns(name)),
    *(*SCORES.values(), QUALITY, FLAGS, *SECONDS.values(), *MEMORY.values(), TOTAL, PEAK),
)
"""The columns of every table, also where all values are missing."""
