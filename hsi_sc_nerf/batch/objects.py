"""A session's rows of the table, one an object, from the files of its folder; damage becomes their status."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from hsi_sc_nerf.analysis.report import CM2_PER_M2, MM_PER_M, SIZES, each_object, scale_note
from hsi_sc_nerf.analysis.traits import WHOLE
from hsi_sc_nerf.batch import columns
from hsi_sc_nerf.batch.columns import Column, Value
from hsi_sc_nerf.batch.plan import STEPS
from hsi_sc_nerf.batch.session_steps import OPTIONAL_STEPS
from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.files import content_of, read_json
from hsi_sc_nerf.findings import INSPECTION_NAME
from hsi_sc_nerf.processing.session_checks import CHECKS_PATH

_AGAIN = "delete it and start the batch again"
_LEVELS = ("green", "amber", "red")
Cells = dict[Column, Value]
"""A row; what is missing has no value."""
Tells = Callable[[Mapping[str, Any]], Iterator[tuple[Column, Value]]]
"""What is to be read from the content of a file."""


def read_objects(folder: Path) -> tuple[list[Cells], Path | None]:
    """The row of the object whose results lie in ``folder``, or of each of several that stood on the table.

    Nothing there can make it fail.

    Returns:
        The rows, and the report, if there is one.

    Example:
        >>> (row,), report = read_objects(Path("season/objects/pear_01"))
        >>> row[STATUS]
        'done'
    """
    wrong: list[_Trouble] = []

    def each_tried(step: str, path: Path, tells: Tells) -> list[Cells]:
        """What a file tells of each object; nothing where it is not there or damaged."""
        if not path.is_file():
            return [{}]
        try:
            with content_of(path, f"results of the step {step}", _AGAIN):
                return [dict(tells(one)) for one in each_object(read_json(path, _AGAIN))]
        except InputError as error:
            wrong.append(_Trouble("damaged", step, str(error).replace(f"{folder}/", "")))
            return [{}]

    def tried(step: str, path: Path, tells: Tells) -> Cells:
        return each_tried(step, path, tells)[0]

    costs: Cells = {}
    for step in STEPS:
        found = tried(step, folder / "steps" / f"{step}.json", partial(_cost, step))
        if found.pop(columns.STATUS, None) == "failed":
            wrong.append(_Trouble("failed", step, str(found[columns.SENTENCE])))
        found.pop(columns.SENTENCE, None)
        costs |= found
    failed = [one.step for one in wrong if one.status == "failed" and one.step not in OPTIONAL_STEPS]
    # What lies there of later steps is of an earlier attempt.
    lost = STEPS[STEPS.index(failed[0]) :] if failed else ()
    for total, parts, combined in ((columns.TOTAL, columns.SECONDS, math.fsum), (columns.PEAK, columns.MEMORY, max)):
        known = [value for column in parts.values() if isinstance(value := costs.get(column), float)]
        if known:
            costs[total] = combined(known)

    checks = folder / "data" / CHECKS_PATH
    cells = tried("inspect", checks if checks.is_file() else folder / INSPECTION_NAME, _findings)
    pieces: list[Cells] = [{}]
    if "traits" not in lost:
        pieces = each_tried("traits", folder / "traits" / "traits.json", _traits)
    scores = {} if "evaluate" in lost else tried("evaluate", folder / "eval.json", _scores)
    serious = [one for one in wrong if one.status == "damaged" or one.step not in OPTIONAL_STEPS]
    status = serious[0].status if serious else "done" if pieces[0] and scores else "unfinished"
    told = (serious or wrong or [_Trouble("", "", "")])[0]
    state: Cells = {columns.STATUS: status, columns.STEP: told.step, columns.SENTENCE: told.sentence}
    report = folder / "report.html"
    rows = [cells | (costs if number == 0 else {}) | traits | scores | state for number, traits in enumerate(pieces)]
    return rows, report if report.is_file() and "report" not in lost else None


def _cost(step: str, content: Mapping[str, Any]) -> Iterator[tuple[Column, Value]]:
    """Of a step: whether it was done, failed or was skipped after a failure; the sentence; time and memory."""
    yield columns.STATUS, str(content["status"])
    # As an error's text it is one line, of a length that can be read.
    yield columns.SENTENCE, str(InputError(content.get("sentence") or ""))
    # Nothing was run, and 0 recorded, where a step was skipped.
    yield columns.SECONDS[step], _number(content.get("seconds")) or None
    yield columns.MEMORY[step], _number(content.get("peak_memory_mib")) or None


def _traits(content: Mapping[str, Any]) -> Iterator[tuple[Column, Value]]:
    # Lengths of a cloud without scale are none; times NaN, they leave their cells empty.
    metre = math.nan if scale_note(content) else 1.0
    mm, cm2 = MM_PER_M * metre, CM2_PER_M2 * metre
    if "piece" in content:
        yield columns.PIECE, _number(content["piece"])
        for column, at in zip(columns.PIECE_AT, content["centre_m"], strict=False):
            yield column, _number(at, mm)
    closed = bool(content["watertight"])
    for key, (_, _, factor) in SIZES.items():
        value, sd = columns.SIZE[key]
        if closed or key not in ("volume_l", "equivalent_diameter_m"):
            yield value, _number(content["size"][key], factor * metre)
            yield sd, _number((content["size_sd"] or {}).get(key), factor * metre)
    yield columns.WATERTIGHT, closed
    yield columns.SEEN_AREA, _number(content["seen_area_m2"], cm2)
    regions: Mapping[str, Any] = content["regions"]
    for key, value in regions[WHOLE]["reflectance"].items():
        if key in columns.REFLECTANCE:
            yield columns.REFLECTANCE[key], _number(value)
    for index, found in regions[WHOLE]["indices"].items():
        yield from zip(columns.index_columns(index), (_number(found["mean"]), _number(found["sd"])), strict=True)
    for name, found in regions[WHOLE]["calibrations"].items():
        of = columns.calibration_columns(name, str(content["calibrations"][name]["unit"]))
        yield from zip(of, (_number(found["mean"]), _number(found["sd"])), strict=True)
    for name, found in regions[WHOLE].get("classifiers", {}).items():
        for label, area_m2 in found["areas_m2"].items():
            area, sd = columns.classifier_columns(name, label)
            yield area, _number(area_m2, cm2)
            yield sd, _number(found["area_sds_m2"].get(label), cm2)
    if content["classes"]:
        yield from _classes(content["classes"], float(content["seen_area_m2"]), cm2)
    for name, region in regions.items():
        if name != WHOLE:
            area, *reflectance = columns.region_columns(name)
            yield area, _number(region["area_m2"], cm2)
            yield from zip(reflectance, (_number(region["reflectance"][key]) for key in ("mean", "std")), strict=True)
            for index, found in region["indices"].items():
                yield columns.region_index_column(name, index), _number(found["mean"])


def _classes(classes: Mapping[str, Any], seen_m2: float, cm2: float) -> Iterator[tuple[Column, Value]]:
    areas_m2 = {**classes["areas_m2"], "in no class": classes["unclassified_m2"]}
    mixtures_m2 = {**classes["mixture_areas_m2"], "in no class": classes["mixture_unclassified_m2"]}
    for name, area_m2 in areas_m2.items():
        area, fraction, mixture = columns.class_columns(name)
        yield area, _number(area_m2, cm2)
        yield fraction, _number(area_m2, 1.0 / seen_m2)
        yield mixture, _number(mixtures_m2[name], 1.0 / seen_m2)


def _scores(content: Mapping[str, Any]) -> Iterator[tuple[Column, Value]]:
    for key, column in columns.SCORES.items():
        yield column, _number(content["results"][key])


def _findings(content: Mapping[str, Any]) -> Iterator[tuple[Column, Value]]:
    levels = [(_LEVELS.index(finding["level"]), str(finding["name"])) for finding in content["findings"]]
    if levels:
        yield columns.QUALITY, _LEVELS[max(levels)[0]]
        yield columns.FLAGS, ";".join(dict.fromkeys(name for level, name in levels if level))


def _number(value: Any, factor: float = 1.0) -> float | None:
    """A number of a file in the column's unit; None where it is null or not finite.

    Raises:
        TypeError: it is something else.
    """
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{shown(value)} is no number")
    scaled = factor * float(value)
    return scaled if math.isfinite(scaled) else None


class _Trouble(NamedTuple):
    status: str
    step: str
    sentence: str
