"""Charts of the report as inline SVG, drawn by matplotlib.

The colours are variables of the page's style sheet, so that a chart can be read in light and dark mode and in print.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from hsi_sc_nerf.plotting import STYLE, logarithmic_axis, new_figure

_SERIES = ("#0072b2", "#d55e00", "#00805f", "#b0568c", "#603a00", "#2f93cf", "#1c2126")
_TEXT, _FAINT, _RULE = "#1c2126", "#5b6670", "#d9dee3"
# Colours that are drawn, and the variables of the style sheet that stand in the page instead.
_VARIABLES = {_FAINT: "faint", _RULE: "rule"} | {colour: f"s{i}" for i, colour in enumerate(_SERIES)}
_STYLE = STYLE | {
    "axes.edgecolor": _FAINT,
    "axes.labelcolor": _TEXT,
    "axes.spines.left": False,
    "grid.color": _RULE,
    "text.color": _TEXT,
    "text.parse_math": False,
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "ytick.minor.size": 0,
    "svg.fonttype": "none",
}
_SVG = "http://www.w3.org/2000/svg"
_WIDTH_IN, _HEIGHT_IN, _LEGEND_ROW_IN = 4.8, 2.4, 0.2
"""A phone shows an inch in 76 px, so that letters are 9 px high."""
_LEGEND_CHARACTERS = 54
_DOT_PT = 4.0
# Smallest value of a logarithmic axis as a fraction of the largest; a curve that touches 0 would use up all the axis.
_SMALLEST_FRACTION = 1e-6


@dataclass(frozen=True, eq=False)
class Curve:
    """A line of a chart.

    Attributes:
        name: for the legend; curves of an empty name have no entry there.
        x: positions.
        y: values; NaN leaves a gap.
        spread: half the height of a band around the line; None for none.
        dashed: draw it dashed.
    """

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    spread: Float[np.ndarray, "n"] | None = None
    dashed: bool = False


def _from_left_to_right(curve: Curve) -> Curve:
    order = np.argsort(curve.x, kind="stable")
    spread = None if curve.spread is None else curve.spread[order]
    return replace(curve, x=curve.x[order], y=curve.y[order], spread=spread)


def line_chart(
    curves: Sequence[Curve],
    *,
    x_label: str,
    y_label: str,
    alt: str,
    from_zero: bool = False,
    logarithmic: bool = False,
    marks: Mapping[str, float] | None = None,
) -> Markup:
    """Curves over a common axis, as an ``svg`` element.

    Args:
        curves: at least one, drawn in the order of ``x``, as bands need not be in a file; NaN is a gap.
        x_label: with its unit.
        y_label: with its unit.
        alt: description for readers who do not see the chart.
        from_zero: the vertical axis includes 0.
        logarithmic: the vertical axis is logarithmic; values that are not positive lie at its lower end.
        marks: vertical lines by name.

    Example:
        >>> wavelengths_nm = np.linspace(400.0, 1000.0, 204)
        >>> curve = Curve("measured", wavelengths_nm, np.sin(wavelengths_nm / 100.0))
        >>> svg = line_chart([curve], x_label="wavelength (nm)", y_label="reflectance", alt="A spectrum")
    """
    curves = [_from_left_to_right(curve) for curve in curves]
    named = [curve.name for curve in curves if curve.name]
    columns = max(1, _LEGEND_CHARACTERS // (8 + max(map(len, named), default=0)))
    rows = -(-len(named) // columns)
    with rc_context(_STYLE):
        figure = new_figure(_WIDTH_IN, _HEIGHT_IN + _LEGEND_ROW_IN * rows)
        axes = figure.subplots()
        values = [edge for c in curves for edge in ((c.y,) if c.spread is None else (c.y - c.spread, c.y + c.spread))]
        low, high = _value_range(np.concatenate(values), from_zero, logarithmic)
        if logarithmic:
            logarithmic_axis(axes, "y")
        axes.set_ylim(low, high)
        for index, curve in enumerate(curves):
            colour = _SERIES[index % len(_SERIES)]
            if curve.spread is not None:
                lower, upper = (np.maximum(curve.y + side * curve.spread, low) for side in (-1.0, 1.0))
                band = axes.fill_between(curve.x, lower, upper)
                band.remove()  # matplotlib writes a collection as references by identifiers; a patch needs none
                for path in band.get_paths():
                    axes.add_patch(PathPatch(path, color=colour, alpha=0.22, linewidth=0, gid="band"))
            axes.plot(
                curve.x,
                np.maximum(curve.y, low),
                color=colour,
                linewidth=1.3,
                linestyle="--" if curve.dashed else "-",
                label=curve.name or None,
                gid="line",
            )
            for alone in _alone(curve.y):  # which neither line nor band shows
                for gid, reach, alpha in (("line", 0.0 * curve.y, 1.0), ("band", curve.spread, 0.22)):
                    if reach is None:
                        continue
                    ends = np.maximum(curve.y[alone] + reach[alone] * np.array([-1.0, 1.0]), low)
                    dot = axes.plot(curve.x[[alone, alone]], ends, color=colour, alpha=alpha, gid=gid)[0]
                    dot.set(linewidth=_DOT_PT, solid_capstyle="round")
        if named:
            figure.legend(loc="outside upper left", ncols=columns, fontsize=9)
        axes.set(xlabel=x_label, ylabel=y_label)
        axes.grid(axis="x", visible=False)
        _draw_marks(axes, marks or {})
        axes.margins(x=0.0)
        return _inline_svg(figure, alt)


def _alone(values: Float[np.ndarray, "n"]) -> Int[np.ndarray, "alone"]:
    """Indices of the values without another one beside them: all of a single band, or between gaps."""
    known = np.pad(np.isfinite(values), 1)
    return np.flatnonzero(known[1:-1] & ~known[:-2] & ~known[2:])


def _value_range(values: Float[np.ndarray, "n"], from_zero: bool, logarithmic: bool) -> tuple[float, float]:
    """Ends of an axis that holds the finite values, with a margin."""
    finite = values[np.isfinite(values) & ((values > 0) | (not logarithmic))]
    if not len(finite):
        return (0.1, 1.0) if logarithmic else (0.0, 1.0)
    low, high = float(finite.min()), float(finite.max())
    if logarithmic:
        return max(low, high * _SMALLEST_FRACTION) / 1.2, high * 1.2
    if from_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return (low if from_zero and low == 0.0 else low - margin), high + margin


def _draw_marks(axes: Axes, marks: Mapping[str, float]) -> None:
    """The named vertical lines that lie within the axis, with their names above it."""
    low, high = axes.get_xlim()
    for row, (name, value) in enumerate(marks.items()):
        if low <= value <= high:
            axes.axvline(value, color=_FAINT, linewidth=0.8, linestyle=(0.0, (3.0, 3.0)))
            side = "right" if value > (low + high) / 2.0 else "left"
            offset_pt = (3 if side == "left" else -3, 2 + 10 * row)
            axes.annotate(
                name,
                (value, 1.0),
                offset_pt,
                xycoords=axes.get_xaxis_transform(),
                textcoords="offset points",
                ha=side,
                color=_FAINT,
            )


def _inline_svg(figure: Figure, alt: str) -> Markup:
    """The figure as SVG for an HTML page: without metadata, identifiers and font names."""
    memory = io.BytesIO()
    figure.savefig(memory, format="svg", transparent=True)
    drawn = ElementTree.fromstring(memory.getvalue())
    for parent in list(drawn.iter()):
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}metadata", f"{{{_SVG}}}defs"):
                parent.remove(child)
        identifier = parent.attrib.pop("id", None)
        if identifier in ("line", "band"):
            parent.set("class", identifier)
        # Nothing is drawn beyond the axes, and identifiers would have to be unique on the page.
        parent.attrib.pop("clip-path", None)
        if "style" in parent.attrib:
            style = re.sub(r"font-family: [^;]*;", "", parent.attrib["style"])
            for colour, variable in _VARIABLES.items():
                style = style.replace(colour, f"var(--{variable})")
            parent.set("style", style)
    svg = ElementTree.Element(
        f"{{{_SVG}}}svg", {"class": "chart", "role": "img", "viewBox": drawn.attrib["viewBox"], "aria-label": alt}
    )
    ElementTree.SubElement(svg, f"{{{_SVG}}}title").text = alt
    svg.extend(drawn)
    ElementTree.register_namespace("", _SVG)
    return Markup(ElementTree.tostring(svg, encoding="unicode"))
