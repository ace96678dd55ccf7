"""Pictures of what changed on a surface, from four sides, and the days as a film."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.change import DayComparison
from hsi_sc_nerf.analysis.change_days import Day
from hsi_sc_nerf.analysis.change_maps import SPECTRUM, Quantity
from hsi_sc_nerf.analysis.change_significance import FALSE_DISCOVERIES
from hsi_sc_nerf.analysis.classes import UNCLASSIFIED
from hsi_sc_nerf.analysis.pictures import (
    GREY,
    SideViews,
    class_key,
    draw_rows,
    in_legend,
    paint_classes,
    paint_values,
    show_rows,
)
from hsi_sc_nerf.files import atomic_write
from hsi_sc_nerf.plotting import ANGLE_COLOURS, INDEX_COLOURS, STYLE, new_figure
from hsi_sc_nerf.rendering.pictures import open_video
from hsi_sc_nerf.spectra import nearest_bands

_FRAMES_PER_SECOND, _HELD_FRAMES, _FADE_FRAMES = 10, 15, 10
_SMALLEST_P = 1e-6
_BOTH_WAYS = "RdBu_r"


@rc_context(STYLE)
def draw_change(path: Path, first: Day, one: DayComparison, quantity: Quantity, views: SideViews) -> None:
    """A quantity on the four sides: before, after, its change, and the p-values; grey is not seen on both days.

    Regions up to the limit of blank are striped.
    """
    scale, p_scale = _scale(quantity), (0.0, -np.log10(_SMALLEST_P), INDEX_COLOURS)
    lit = paint_values(-np.log10(np.clip(quantity.p, _SMALLEST_P, 1.0)), *p_scale)
    lit[~quantity.changed] *= 0.6
    undecided = quantity.undecided
    tested = "p-value, -log10\noutlined areas lit" + ("\nundecided striped" if undecided.any() else "")
    rows = {
        "before": views.on_white(_natural(first, first)),
        "after": views.on_white(_natural(one.after, first)),
        f"{quantity.name}\nchange ({quantity.unit})": views.on_white(paint_values(quantity.change, *scale)),
        tested: views.on_white(np.where(np.isfinite(quantity.change)[:, None], lit, GREY), undecided),
    }
    draw_rows(path, rows, (None, None, scale, p_scale))


@rc_context(STYLE)
def draw_class_change(path: Path, first: Day, one: DayComparison, views: SideViews) -> None:
    """The classes on the four sides: before, after, and the new class where it is another one; grey is unseen.

    Raises:
        AssertionError: the days were compared without a library.
    """
    found, seen = one.class_map, first.surface.seen
    assert found is not None
    moved = np.where(found.after == found.before, UNCLASSIFIED, found.after)
    rows = {
        label: views.on_white(paint_classes(labels, seen))
        for label, labels in (("before", found.before), ("after", found.after), ("after, where\nanother", moved))
    }
    there = {
        number: in_legend(name)
        for number, name in enumerate(found.names)
        if (found.before == number).any() or (found.after == number).any()
    }
    draw_rows(path, rows, key=class_key(there, "in no class; in the last row: as before"))


@rc_context(STYLE)
def write_film(path: Path, first: Day, comparisons: Sequence[DayComparison], views: SideViews, shown: str) -> None:
    """The days one after the other on one mesh, faded into each other: pseudo-RGB, and change since the first.

    Args:
        path: path of the film, MP4.
        first: the first day.
        comparisons: the later days.
        views: views of the mesh.
        shown: name of the quantity.
    """
    last = comparisons[-1].quantities[shown]
    scale = _scale(last)
    stills = [_frame(first, first, paint_values(0.0 * last.change, *scale), views, shown)]
    for one in comparisons:
        changed = one.quantities[shown]
        # 0 where nothing is significant, and NaN where nothing is known.
        lit = paint_values(changed.change * (changed.p < FALSE_DISCOVERIES), *scale)
        stills.append(_frame(one.after, first, lit, views, shown, changed.undecided))
    with atomic_write(path) as (temporary,), open_video(temporary, _FRAMES_PER_SECOND) as add_frame:
        for before, after in pairwise([*stills, stills[-1]]):
            for _ in range(_HELD_FRAMES):
                add_frame(before)
            for part in np.arange(1, _FADE_FRAMES + 1) / _FADE_FRAMES:
                add_frame(np.rint((1.0 - part) * before + part * after).astype(np.uint8))


def _frame(
    day: Day,
    first: Day,
    change: Float[np.ndarray, "v 3"],
    views: SideViews,
    shown: str,
    undecided: Bool[np.ndarray, "v"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    figure = new_figure(7.5, 4.2)
    figure.suptitle(day.name)
    natural, changed = views.on_white(_natural(day, first)), views.on_white(change, undecided)
    show_rows(figure, {"pseudo-RGB": natural, f"{shown}\nsince {first.name}": changed})
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _natural(day: Day, first: Day) -> Float[np.ndarray, "v 3"]:
    """Pseudo-RGB, brightened alike on all days."""
    bands = nearest_bands(day.surface.wavelengths_nm, paper.PSEUDO_RGB_NM)
    brightest = np.percentile(first.surface.spectra[first.surface.seen][:, bands], 99.0)
    values = np.clip(day.surface.spectra[:, bands].astype(float) / max(brightest, 1e-6), 0.0, 1.0)
    values[~day.surface.seen] = GREY
    return values


def _scale(quantity: Quantity) -> tuple[float, float, str]:
    """Ends and colours of a change's scale, up to its 99th percentile."""
    size = np.abs(quantity.change[np.isfinite(quantity.change)])
    high = max(float(np.percentile(size, 99.0)) if len(size) else 0.0, 1e-6)
    return (0.0, high, ANGLE_COLOURS) if quantity.name == SPECTRUM else (-high, high, _BOTH_WAYS)
