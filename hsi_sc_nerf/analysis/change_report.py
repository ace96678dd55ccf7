"""What changed over days as change.json, as a table with a row a region and pair of days, as a page, as PLY."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hsi_sc_nerf.analysis.change import DayComparison
from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_maps import SPECTRUM, SURFACE
from hsi_sc_nerf.analysis.report import CM2_PER_M2
from hsi_sc_nerf.analysis.spectral_mesh import write_spectral_mesh
from hsi_sc_nerf.analysis.traits import WHOLE
from hsi_sc_nerf.files import atomic_write, nan_to_none, write_json
from hsi_sc_nerf.terminal import markdown_table, markdown_text

COLUMNS = (
    *("before", "after", "kind", "name", "region", "unit", "change", "change_sd", "p"),
    *("area_before_cm2", "area_after_cm2", "area_change_cm2", "area_change_sd_cm2", "x_mm", "y_mm", "z_mm"),
)
"""Columns of change.csv."""
CHANGED, UNDECIDED = "change", "undecided"
"""Kinds of rows: regions that count, and those up to the limit of blank."""
_PAGE_REGIONS = 12


def change_rows(comparisons: Sequence[DayComparison]) -> list[dict[str, Any]]:
    """The rows of change.csv: of each quantity the whole surface and its regions, those up to the limit of blank as a
    kind of their own; areas grown since the day before, and regions of classes that changed. Absent numbers are None.
    """
    rows: list[dict[str, Any]] = []
    for one in comparisons:
        areas_m2 = one.after.surface.areas_m2
        for name, quantity in one.quantities.items():
            head = {"before": one.before, "after": one.after.name, "name": name, "unit": quantity.unit}
            change, sd = quantity.whole
            changed_m2 = float(areas_m2[quantity.changed].sum())
            whole = {"region": WHOLE, "change": change, "change_sd": sd, "p": quantity.test.whole_p}
            rows.append(head | {"kind": CHANGED, **whole, **_areas(0.0, changed_m2)})
            for number, region in enumerate(quantity.regions):
                inside = quantity.region == number
                mean = float(np.average(quantity.change[inside], weights=areas_m2[inside]))
                told = {"region": str(number + 1), "change": mean, "p": float(quantity.p[inside].min())}
                if name != SPECTRUM:
                    told["change_sd"] = float(quantity.test.noise[0])
                told |= _areas(0.0, region.area_m2, region.centre_m) | {
                    "area_change_sd_cm2": CM2_PER_M2 * region.area_sd_m2
                }
                rows.append(head | {"kind": CHANGED if number < quantity.counted else UNDECIDED} | told)
        # Beside the first day, the regions themselves are what grew.
        grown = one.grown if one.earlier != one.before else {}
        for kind, before, groups in (("grown", one.earlier, grown), ("class", one.before, one.classes)):
            rows += [
                {"before": before, "after": one.after.name, "kind": kind, "name": name, "region": str(number + 1)}
                | _areas(region.before_m2, region.after_m2, region.centre_m)
                for name, regions in groups.items()
                for number, region in enumerate(regions)
                if region.before_m2 != region.after_m2
            ]
    return [dict.fromkeys(COLUMNS) | row for row in rows]


def _areas(before_m2: float, after_m2: float, centre_m: Sequence[float] = ()) -> dict[str, float]:
    before, after = CM2_PER_M2 * before_m2, CM2_PER_M2 * after_m2
    told = {"area_before_cm2": before, "area_after_cm2": after, "area_change_cm2": after - before}
    return told | dict(zip(("x_mm", "y_mm", "z_mm"), (1e3 * x for x in centre_m), strict=False))


def write_change_tables(
    folder: Path,
    comparisons: Sequence[DayComparison],
    settings: Mapping[str, Any],
    pictures: Mapping[str, str],
    repeat: Day | None = None,
) -> None:
    """Write change.csv, change.md, and last change.json; NaN is null or empty.

    Args:
        folder: for the files.
        comparisons: comparisons of the days.
        settings: that are kept in change.json.
        pictures: names of files by title.
        repeat: another capture of the first day, if the noise is also taken from it.

    Raises:
        InputError: a file cannot be written.
    """
    rows = change_rows(comparisons)
    with (
        atomic_write(folder / "change.csv") as (temporary,),
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows([_cell(row[column]) for column in COLUMNS] for row in rows)
    parts = ["# Change over time", *_set_down(comparisons, repeat)]
    parts += ["## What changed", *_table([row for row in rows if row["kind"] == CHANGED])]
    parts += [
        f"Left out of {markdown_text(one.after.name)}: {', '.join(map(markdown_text, one.left_out))}, which has a "
        "value on hardly any of the surface of both days."
        for one in comparisons
        if one.left_out
    ]
    parts += _undecided(comparisons, [row for row in rows if row["kind"] == UNDECIDED])
    for kind, heading in (("grown", "Areas since the day before"), ("class", "Areas of classes")):
        if some := [row for row in rows if row["kind"] == kind]:
            parts += [f"## {heading}", *_table(some)]
    parts += ["## Pictures", *(f"{title}:\n\n![{title}]({name})" for title, name in pictures.items())]
    parts.append("[The days as a film](change.mp4)")
    with atomic_write(folder / "change.md") as (temporary,):
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    write_json(folder / "change.json", _content(comparisons, rows, settings, repeat))


def _content(
    comparisons: Sequence[DayComparison],
    rows: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    repeat: Day | None,
) -> dict[str, Any]:
    days = []
    for one in comparisons:
        noise = {
            name: {
                "noise": quantity.test.noise.tolist(),
                "correlation_length_m": quantity.test.length_m,
                "independent_parts": quantity.test.independent,
                "patches": len(quantity.test.p),
            }
            for name, quantity in one.quantities.items()
        }
        days.append(_placed(one.after) | {"limit_of_blank_m2": _limit_m2(one) or None, "noise": noise})
    return {
        "settings": dict(settings),
        "first_day": comparisons[0].before,
        "repeat": None if repeat is None else _placed(repeat),
        "classes": None if (labelled := comparisons[0].class_map) is None else list(labelled.names),
        "days": days,
        "rows": [nan_to_none(row) for row in rows],
    }


def _placed(day: Day) -> dict[str, Any]:
    assert day.attitude is not None
    attitude = asdict(day.attitude) | {"transform": day.attitude.transform.matrix().tolist()}
    return {"name": day.name, "attitude": nan_to_none(attitude)}


def _set_down(comparisons: Sequence[DayComparison], repeat: Day | None) -> list[str]:
    rows = []
    for day in (*(one.after for one in comparisons), *([] if repeat is None else [repeat])):
        found = day.attitude
        assert found is not None
        rows.append(
            [
                *(day.name, f"{found.turn_deg:.2f} ± {found.turn_sd_deg:.2f}", f"{found.tip_deg:.1f}"),
                *(f"{found.growth:.4f} ± {found.growth_sd:.4f}", f"{1e3 * found.residual_m:.2f}"),
                "none" if math.isnan(found.rival_p) else f"{found.rival_turn_deg:.0f}° away, p = {found.rival_p:.1g}",
            ]
        )
    header = ["day", "turn, °", "tip, °", "size relative to the first day", "distance of the surfaces, mm"]
    note = (
        f"Compared with {markdown_text(comparisons[0].before)}. The turn is about the table's axis, ± is a standard "
        "deviation, and p the probability that another attitude fits so much worse by chance."
    )
    if repeat is not None:
        note += f" What is no larger than between it and {markdown_text(repeat.name)} is no change."
    return ["## How the object was set down", markdown_table([*header, "next best attitude"], rows), note]


def _undecided(comparisons: Sequence[DayComparison], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the limit of blank is and which regions are below it; nothing with a repeat."""
    limit_m2 = max(_limit_m2(one) for one in comparisons)
    if limit_m2 == 0.0:
        return []
    told = (
        f"Two captures of one day show regions of up to {CM2_PER_M2 * limit_m2:.2g} cm² that are no change (limit "
        "of blank). "
    )
    if not rows:
        return [told + "No region here is as small."]
    told += (
        "Those of this table are no larger and are not counted; a second capture of the first day (--repeat) decides."
    )
    return ["## Undecided: below the limit of blank", told, *_table(rows)]


def _limit_m2(one: DayComparison) -> float:
    return max(quantity.limit_m2 for quantity in one.quantities.values())


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    columns = [name for name in COLUMNS[:13] if name != "kind" and any(row[name] is not None for row in rows)]
    listed = [row for row in rows if row["region"] == WHOLE or int(row["region"]) <= _PAGE_REGIONS]
    cells = [[_cell(row[name], ".3g") for name in columns] for row in listed]
    header = [name.replace("_cm2", ", cm²").replace("_", " ") for name in columns]
    return [markdown_table(header, cells)] + (
        [f"The largest {_PAGE_REGIONS} regions of each; change.csv has all."] if len(listed) < len(rows) else []
    )


def _cell(value: Any, numbers: str = ".6g") -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return format(value, numbers) if isinstance(value, float) else str(value)


def write_change_ply(path: Path, first: Day, comparisons: Sequence[DayComparison]) -> None:
    """The first day's mesh and spectra; of each later day change, p-value and region of each quantity.

    Columns are named ``QUANTITY_KIND_DAY``: ``ndvi_change_1``, ``ndvi_p_1`` and ``ndvi_region_1`` of the second
    cloud. A region's number is 0 outside and negative if it is undecided. The surface's change is in metres, as all
    lengths of the file. With a library there are ``class_before`` and, of the second cloud, ``class_after_1``:
    numbers of classes, -1 for none.
    """
    extra = {}
    for day, one in enumerate(comparisons, start=1):
        for name, quantity in one.quantities.items():
            word = re.sub(r"\W+", "_", name.lower())
            extra[f"{word}_change_{day}"] = quantity.change * (1e-3 if name == SURFACE else 1.0)
            extra[f"{word}_p_{day}"] = quantity.p
            extra[f"{word}_region_{day}"] = np.where(quantity.undecided, -1.0, 1.0) * (quantity.region + 1.0)
        if one.class_map is not None:
            extra |= {"class_before": one.class_map.before, f"class_after_{day}": one.class_map.after}
    write_spectral_mesh(path, first.surface, {name: column.astype(np.float32) for name, column in extra.items()})
