"""Charts as inline SVG: lines with a band of uncertainty around them, and bars. Numbers and texts in, markup out.

Colours come from the page's style sheet (classes ``s0`` to ``s6``), so that a chart is readable in light and dark
mode and in print. Names and labels are escaped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

SERIES_COLOURS = 7
"""How many colours the style sheet has; further curves begin anew."""
_WIDTH, _HEIGHT = 640.0, 300.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 66.0, 14.0, 12.0, 46.0
_LEGEND_ROW, _LETTER = 20.0, 7.4
_TICKS = 6
# Of the largest value that a logarithmic axis reaches down to: below, a curve that touches zero would use it all up.
_SMALLEST_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class Curve:
    """A line of a chart.

    Attributes:
        name: for the legend; curves of an empty name have no entry there.
        x: positions.
        y: values; NaN leaves a gap.
        spread: half the height of a band around the line; None for none.
        dashed: draw it dashed.
        colour: number of its colour; None: its place among the curves.
        thin: draw it thin and faint.
    """

    name: str
    x: Float[np.ndarray, "n"]
    y: Float[np.ndarray, "n"]
    spread: Float[np.ndarray, "n"] | None = None
    dashed: bool = False
    colour: int | None = None
    thin: bool = False

    @property
    def style(self) -> str:
        """Classes of the style sheet."""
        return "line" + " dashed" * self.dashed + " thin" * self.thin


def nice_ticks(low: float, high: float, count: int = _TICKS) -> list[float]:
    """About ``count`` round numbers (1, 2 or 5 times a power of ten apart) within ``low`` to ``high``."""
    span = high - low
    if not math.isfinite(span) or span <= 0.0:
        return [low]
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if span / (power * factor) <= count)
    first = math.ceil(low / step - 1e-9)
    return [step * i for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    decades = range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)
    ticks = [10.0**decade for decade in decades]
    return ticks[:: max(1, math.ceil(len(ticks) / _TICKS))] if len(ticks) > 1 else [low, high]


def _label(value: float, ticks: Sequence[float], logarithmic: bool = False) -> str:
    """A tick's number with as many digits as it takes to tell it from its neighbours."""
    if value == 0.0:
        return "0"
    if logarithmic:
        return f"{value:.2g}".replace("e-0", "e-")
    step = min((abs(b - a) for a, b in pairwise(ticks)), default=abs(value))
    if abs(value) >= 1e6 or abs(value) < 1e-4:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    decimals = max(0, math.ceil(-math.log10(step) - 1e-9)) if step > 0 else 2
    return f"{value:.{min(decimals, 6)}f}"


@dataclass(frozen=True)
class _Axis:
    """Values ``low`` to ``high`` on the page from ``start`` to ``end``."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = False

    def place(self, values: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
        """Where values lie; on a logarithmic axis what is not above its low end lies at it."""
        places, low, high = np.asarray(values, float), self.low, self.high
        if self.logarithmic:
            places, low, high = np.log10(np.maximum(places, low)), math.log10(low), math.log10(high)
        return self.start + (places - low) / (high - low) * (self.end - self.start)

    @property
    def ticks(self) -> list[float]:
        return _log_ticks(self.low, self.high) if self.logarithmic else nice_ticks(self.low, self.high)


def _range(values: Float[np.ndarray, "n"], from_zero: bool, logarithmic: bool) -> tuple[float, float]:
    """Ends of an axis that holds the finite values, with a little room."""
    finite = values[np.isfinite(values) & ((values > 0) | (not logarithmic))]
    if not len(finite):
        return (0.1, 1.0) if logarithmic else (0.0, 1.0)
    low, high = float(finite.min()), float(finite.max())
    if logarithmic:
        low = max(low, high * _SMALLEST_SHARE)
        return low / 1.2, high * 1.2
    if from_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return (low if from_zero and low == 0.0 else low - room), high + room


def _path(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> str:
    """SVG path through the finite points, with gaps at the others."""
    parts, pen = [], "M"
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if math.isfinite(a) and math.isfinite(b):
            parts.append(f"{pen}{a:.1f} {b:.1f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(parts)


def _band(x: Float[np.ndarray, "n"], lower: Float[np.ndarray, "n"], upper: Float[np.ndarray, "n"]) -> str:
    """SVG path round the area between two lines; a piece for each run of finite points."""
    finite = np.isfinite(lower) & np.isfinite(upper)
    pieces = np.split(np.arange(len(x)), np.flatnonzero(np.diff(finite.astype(int))) + 1)
    around = [np.concatenate([piece, piece[::-1]]) for piece in pieces if finite[piece].all() and len(piece) > 1]
    ys = [np.concatenate([upper[ring[: len(ring) // 2]], lower[ring[len(ring) // 2 :]]]) for ring in around]
    return "".join(_path(x[ring], y) + "Z" for ring, y in zip(around, ys, strict=True))


def _legend(entries: Sequence[tuple[str, int, str]]) -> tuple[Markup, float]:
    """Legend in rows over the plot, and the height that it takes."""
    parts, x, row = [], _LEFT, 0
    for name, colour, style in entries:
        width = 34.0 + _LETTER * len(name)
        if x + width > _WIDTH and x > _LEFT:
            x, row = _LEFT, row + 1
        y = 12.0 + _LEGEND_ROW * row
        line = Markup('<path class="{} s{}" d="M{:.0f} {:.0f}h18"/>').format(style, colour, x, y)
        parts.append(line + Markup('<text x="{:.0f}" y="{:.0f}">{}</text>').format(x + 23.0, y + 4.0, name))
        x += width
    return Markup("").join(parts), (_LEGEND_ROW * (row + 1) if entries else 0.0)


def _frame(x: _Axis, y: _Axis, x_label: str, y_label: str) -> Markup:
    """Grid, numbers and labels."""
    parts = []
    for tick in y.ticks:
        at = float(y.place(tick))
        parts.append(Markup('<path class="grid" d="M{:.1f} {:.1f}H{:.1f}"/>').format(x.start, at, x.end))
        text = Markup('<text class="number" x="{:.1f}" y="{:.1f}" text-anchor="end">{}</text>')
        parts.append(text.format(x.start - 6.0, at + 4.0, _label(tick, y.ticks, y.logarithmic)))
    for tick in x.ticks:
        at = float(x.place(tick))
        text = Markup('<text class="number" x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>')
        parts.append(text.format(at, y.start + 17.0, _label(tick, x.ticks)))
        parts.append(Markup('<path class="axis" d="M{:.1f} {:.1f}v4"/>').format(at, y.start))
    parts.append(Markup('<path class="axis" d="M{:.1f} {:.1f}H{:.1f}"/>').format(x.start, y.start, x.end))
    label = Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="middle">{}</text>')
    parts.append(label.format((x.start + x.end) / 2.0, y.start + 38.0, x_label))
    middle = (y.start + y.end) / 2.0
    upright = Markup('<text transform="translate(14 {:.1f}) rotate(-90)" text-anchor="middle">{}</text>')
    parts.append(upright.format(middle, y_label))
    return Markup("").join(parts)


def _marks(marks: Mapping[str, float], x: _Axis, y: _Axis) -> Markup:
    """Named vertical lines."""
    parts = []
    for row, (name, value) in enumerate(marks.items()):
        if not x.low <= value <= x.high:
            continue
        at = float(x.place(value))
        right = at > (x.start + x.end) / 2.0
        parts.append(Markup('<path class="mark" d="M{:.1f} {:.1f}V{:.1f}"/>').format(at, y.start, y.end))
        text = Markup('<text class="number" x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>')
        parts.append(
            text.format(at + (-4.0 if right else 4.0), y.end + 11.0 + 14.0 * row, "end" if right else "start", name)
        )
    return Markup("").join(parts)


def _svg(body: Markup, alt: str, height: float) -> Markup:
    opening = Markup('<svg class="chart" role="img" viewBox="0 0 {:.0f} {:.0f}" aria-label="{}">')
    return opening.format(_WIDTH, height, alt) + Markup("<title>{}</title>").format(alt) + body + Markup("</svg>")


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
    """Curves over a common axis.

    Args:
        curves: at least one; NaN is a gap.
        x_label: with its unit.
        y_label: with its unit.
        alt: what a reader who does not see it should know.
        from_zero: the vertical axis begins at 0.
        logarithmic: the vertical axis is logarithmic; what is not positive lies at its foot.
        marks: vertical lines by name.
    """
    colours = [(i if c.colour is None else c.colour) % SERIES_COLOURS for i, c in enumerate(curves)]
    named = [(c.name, colour, c.style) for c, colour in zip(curves, colours, strict=True) if c.name]
    legend, legend_height = _legend(named)
    top = _TOP + legend_height
    bottom = top + _HEIGHT - _TOP - _BOTTOM
    xs = np.concatenate([np.asarray(c.x, float) for c in curves])
    edges = [c.y if c.spread is None else np.concatenate([c.y - c.spread, c.y + c.spread]) for c in curves]
    ys = np.concatenate([np.asarray(edge, float) for edge in edges])
    finite = xs[np.isfinite(xs)]
    low_x, high_x = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    x = _Axis(low_x, high_x if high_x > low_x else low_x + 1.0, _LEFT, _WIDTH - _RIGHT)
    y = _Axis(*_range(ys, from_zero, logarithmic), bottom, top, logarithmic)
    parts = [legend, _frame(x, y, x_label, y_label), _marks(marks or {}, x, y)]
    for curve, colour in zip(curves, colours, strict=True):
        if curve.spread is not None:
            lower, upper = y.place(curve.y - curve.spread), y.place(curve.y + curve.spread)
            shape = Markup('<path class="band s{}" d="{}"/>')
            parts.append(shape.format(colour, _band(x.place(curve.x), lower, upper)))
    for curve, colour in zip(curves, colours, strict=True):
        line = Markup('<path class="{} s{}" d="{}"/>')
        parts.append(line.format(curve.style, colour, _path(x.place(curve.x), y.place(curve.y))))
    return _svg(Markup("").join(parts), alt, bottom + _BOTTOM)


def bar_chart(
    edges: Float[np.ndarray, "n_and_1"],
    heights: Float[np.ndarray, "n"],
    *,
    x_label: str,
    y_label: str,
    alt: str,
    marks: Mapping[str, float] | None = None,
) -> Markup:
    """Bars that stand on 0 between neighbouring edges, a histogram for instance; a bar of NaN is left out.

    Args:
        edges: ascending.
        heights: not negative.
        x_label: with its unit.
        y_label: with its unit.
        alt: what a reader who does not see it should know.
        marks: vertical lines by name.
    """
    x = _Axis(float(edges[0]), float(edges[-1]), _LEFT, _WIDTH - _RIGHT)
    y = _Axis(*_range(np.asarray(heights, float), True, False), _HEIGHT - _BOTTOM, _TOP)
    left, right, top = x.place(edges[:-1]), x.place(edges[1:]), y.place(heights)
    gap = min(1.0, 0.15 * float(right[0] - left[0]))
    bars = "".join(
        f"M{a + gap / 2:.1f} {y.start:.1f}V{t:.1f}H{b - gap / 2:.1f}V{y.start:.1f}Z"
        for a, b, t in zip(left.tolist(), right.tolist(), top.tolist(), strict=True)
        if math.isfinite(t)
    )
    frame = _frame(x, y, x_label, y_label)
    return _svg(
        frame + Markup('<path class="bar s0" d="{}"/>').format(bars) + _marks(marks or {}, x, y), alt, _HEIGHT
    )
