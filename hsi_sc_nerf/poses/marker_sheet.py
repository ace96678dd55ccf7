"""Sheets of ArUco markers to print, with a ruler that shows whether the printer kept the size."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.poses.marker_detection import dictionary_by_name, marker_pattern

Paper = Literal["a4", "letter"]
PAPER_MM: dict[Paper, tuple[float, float]] = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}
RULER_MM = 100.0
_MARGIN_MM = 15.0
"""Printers leave up to this much of a sheet white."""
_HEAD_MM, _RULER_ZONE_MM, _LABEL_MM = 10.0, 22.0, 6.0
_MIN_QUIET_MODULES = 1.0
"""White around a marker that its detection needs, in cells of the marker."""


def marker_sheets(marker_side_m: float, dictionary: str, ids: Sequence[int], paper: Paper = "a4") -> list[Figure]:
    """Sheets with the markers, each with its number and size below it, and a ruler on each sheet.

    Args:
        dictionary: OpenCV's name, such as ``DICT_5X5_50``.

    Raises:
        InputError: the dictionary has no such markers, or one does not fit on a sheet.
    """
    known = len(dictionary_by_name(dictionary).bytesList)
    if not ids or not 0 <= min(ids) <= max(ids) < known:
        raise InputError(
            f"{dictionary} has the markers 0 to {known - 1}; ask for fewer, or take a larger dictionary."
        )
    width, height = PAPER_MM[paper]
    side = 1e3 * marker_side_m
    quiet = _MIN_QUIET_MODULES * side / len(marker_pattern(dictionary, ids[0]))
    across, down = side + 2.0 * quiet, side + 2.0 * quiet + _LABEL_MM
    columns = int((width - 2.0 * _MARGIN_MM) // across)
    rows = int((height - 2.0 * _MARGIN_MM - _HEAD_MM - _RULER_ZONE_MM) // down)
    if columns < 1 or rows < 1:
        raise InputError(f"a marker of {side:g} mm does not fit on {paper} paper; make --marker-side-m smaller.")
    sheets: list[Figure] = []
    for start in range(0, len(ids), columns * rows):
        figure = Figure(figsize=(width / 25.4, height / 25.4), facecolor="white")
        # In millimetres from the lower left corner.
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, width), ylim=(0.0, height))
        axes.axis("off")
        top = height - _MARGIN_MM
        title = f'{dictionary}, black squares of {side:g} mm: "marker_side_m": {marker_side_m:g} in session.json'
        axes.text(_MARGIN_MM, top, title, va="top", size=10)
        for position, number in enumerate(ids[start : start + columns * rows]):
            row, column = divmod(position, columns)
            left = _MARGIN_MM + column * across + quiet
            upper = top - _HEAD_MM - row * down - quiet
            _draw_marker(axes, marker_pattern(dictionary, number), left, upper, side)
            cut = Rectangle(
                (left - quiet, upper - side - quiet), across, across, fill=False, edgecolor="0.85", linewidth=0.3
            )
            axes.add_patch(cut)
            axes.text(left, upper - side - quiet - 1.0, f"{number}   {side:g} mm", va="top", size=7, color="0.4")
        _draw_ruler(axes)
        sheets.append(figure)
    return sheets


def write_marker_sheets(path: Path, sheets: Sequence[Figure]) -> None:
    """Write sheets as one PDF, a page each.

    Raises:
        InputError: the file is no .pdf, or cannot be written.
    """
    if path.suffix.lower() != ".pdf":
        raise InputError(f"{path}: sheets to print are PDF files; give a name that ends with .pdf.")
    memory = BytesIO()  # on a full disk Matplotlib fails in a way of its own
    with rc_context({"pdf.fonttype": 42}), PdfPages(memory) as pages:
        for sheet in sheets:
            pages.savefig(sheet)
    with atomic_write(path) as (temporary,):
        temporary.write_bytes(memory.getvalue())


def _draw_marker(axes: Axes, pattern: np.ndarray, left: float, upper: float, side: float) -> None:
    """The black cells as one outline: a picture would be smoothed by some viewers, and cells apart leave gaps."""
    cell = side / len(pattern)
    corners: Float[np.ndarray, "5 2"] = np.array([(0, 0), (1, 0), (1, -1), (0, -1), (0, 0)]) * cell
    cells = [
        Outline(corners + np.array([left + column * cell, upper - row * cell]), closed=True)
        for row, column in np.argwhere(pattern == 0)
    ]
    axes.add_patch(PathPatch(Outline.make_compound_path(*cells), facecolor="black", linewidth=0.0, snap=False))


def _draw_ruler(axes: Axes) -> None:
    ticks = np.arange(0.0, RULER_MM + 1.0, 10.0)
    axes.hlines(_MARGIN_MM + 8.0, _MARGIN_MM, _MARGIN_MM + RULER_MM, color="black", linewidth=0.8)
    axes.vlines(_MARGIN_MM + ticks, _MARGIN_MM + 8.0, _MARGIN_MM + 11.0, color="black", linewidth=0.8)
    text = (
        f"Measure this line: {RULER_MM:g} mm. If it is longer or shorter, print again at 100 %, not fitted to page."
    )
    axes.text(_MARGIN_MM, _MARGIN_MM + 6.0, text, va="top", size=8)
