"""The page of all objects: one HTML file with a table to sort and filter, distributions and a scatter of traits."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from PIL import Image

from hsi_sc_nerf.batch import columns
from hsi_sc_nerf.batch.columns import Column
from hsi_sc_nerf.batch.plan import OBJECTS_NAME
from hsi_sc_nerf.batch.session_list import OBJECT, SESSION, SETTINGS
from hsi_sc_nerf.batch.tables import BatchTable
from hsi_sc_nerf.files import atomic_write, read_picture
from hsi_sc_nerf.inspection.inspect import THUMBNAIL_GAMMA
from hsi_sc_nerf.report.page import data_address, own_text, page_template

PAGE_NAME = "index.html"
THUMBNAIL_PX = 80
_THUMBNAIL_QUALITY = 60
_PACKAGE = "hsi_sc_nerf.batch"
_SCRIPTS = ("statistics.js", "table.js", "charts.js", "overview.js")
# Columns of the table at first; the others can be switched on.
_SHOWN = {columns.FLAGS, columns.TOTAL, columns.SCORES["sam"]}
_SHOWN |= {columns.SIZE[key][0] for key in ("volume_l", "area_m2", "height_m")}
_HIDDEN_OF_LIST = {OBJECT, SESSION, *SETTINGS}
# What the page shows in a way of its own, and the trait that its charts begin with.
_SPECIAL = {
    "status": columns.STATUS,
    "step": columns.STEP,
    "sentence": columns.SENTENCE,
    "quality": columns.QUALITY,
    "flags": columns.FLAGS,
    "volume": columns.SIZE["volume_l"][0],
    "piece": columns.PIECE,
}


def write_overview(table: BatchTable, out: Path, done: Callable[[int], None] | None = None) -> Path:
    """Write the page, completely or not at all.

    Args:
        table: table of the batch in ``out``.
        out: where it is written to; the objects' folders lie there.
        done: called with the number of objects whose picture is made.

    Raises:
        InputError: the operating system refused to write.

    Example:
        >>> write_overview(read_table(Path("season")), Path("season"))
        PosixPath('season/index.html')
    """
    text = page_template(_PACKAGE, "overview.html").render(
        title=f"{len(table.rows)} {'object' if len(table.rows) == 1 else 'objects'}",
        key_figures=_key_figures(table),
        payload=_payload(table, out, done),
        styles=own_text("hsi_sc_nerf.report", "page.css") + own_text(_PACKAGE, "overview.css"),
        scripts=Markup("\n").join(own_text(_PACKAGE, name) for name in _SCRIPTS),
    )
    with atomic_write(out / PAGE_NAME) as (temporary,):
        temporary.write_text(text, encoding="utf-8")
    return out / PAGE_NAME


def thumbnail(data: Path) -> str:
    """Address of a small picture of the object in the packed dataset ``data``: its first frame that can be read.

    What its mask leaves out is transparent. Empty where there is no picture.
    """
    for path in sorted((data / "images").glob("*.png")):
        picture = read_picture(path, 3)
        if picture is None:
            continue
        mask = read_picture(data / "masks" / path.name, 1)
        if mask is None or mask.shape != picture.shape[:2] or not mask.any():
            mask = np.full(picture.shape[:2], 255, np.uint8)
        image = Image.fromarray(np.dstack([picture, mask])).crop(Image.fromarray(mask).getbbox())
        # Premultiplied, as Pillow resizes it, so that the background does not bleed in; brightened as a photograph.
        image.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX), Image.Resampling.BOX)
        pixels = np.asarray(image).astype(float) / 255.0
        pixels[..., :3] **= THUMBNAIL_GAMMA
        return data_address(Image.fromarray(np.rint(255.0 * pixels).astype(np.uint8)), quality=_THUMBNAIL_QUALITY)
    return ""


def _key_figures(table: BatchTable) -> dict[str, str]:
    statuses, seconds = (table.values(table.columns[table.places[of]]) for of in (columns.STATUS, columns.TOTAL))
    figures = {state: str(statuses.count(state)) for state in ("done", "failed", "damaged", "unfinished")}
    figures = {state: count for state, count in figures.items() if count != "0" or state in ("done", "failed")}
    known = [value for value in seconds if isinstance(value, float)]
    if known:
        figures["median time of an object"] = f"{statistics.median(known):.0f} s"
        figures["time of all steps"] = f"{math.fsum(known) / 3600.0:.2f} h"
    return figures


def _payload(table: BatchTable, out: Path, done: Callable[[int], None] | None) -> dict[str, Any]:
    """What the scripts need: columns, rows, and of each row the picture and the address of its report."""
    shown = {table.places[column] for column in _SHOWN}
    described = [
        {
            "label": _label(column),
            "unit": column.unit,
            "definition": column.definition,
            "group": column.group,
            "kind": column.kind,
            "spread": table.columns.index(column.spread) if column.spread else None,
            "shown": number in shown
            or (column.group == "index" and column.spread is not None)
            or (column.group == "class" and column.name.endswith("_fraction") and "_mixture_" not in column.name)
            or (column.group == "list" and column.name not in _HIDDEN_OF_LIST),
        }
        for number, column in enumerate(table.columns)
    ]
    names = [column.name for column in table.columns]
    object_at = names.index(OBJECT)
    pictures = []
    for number, row in enumerate(table.rows, start=1):
        pictures.append(thumbnail(out / OBJECTS_NAME / str(row[object_at]) / "data"))
        if done is not None:
            done(number)
    return {
        "columns": described,
        "rows": list(zip(*map(table.values, table.columns), strict=True)),
        "pictures": pictures,
        "reports": [path and quote(path.relative_to(out).as_posix()) for path in table.reports],
        "places": {"object": object_at, "session": names.index(SESSION)}
        | {name: table.places[column] for name, column in _SPECIAL.items() if column in table.places},
    }


def _label(column: Column) -> str:
    """The column's name for the eye: of the list of sessions as it is, of ours without its unit."""
    if column.group == "list":
        return column.name
    return column.name.removesuffix(columns.safe_name("x", unit=column.unit)[1:]).replace("_", " ")
