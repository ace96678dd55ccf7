"""Charts of the report: places on the page, gaps, escaping."""

import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from hsi_sc_nerf.report.charts import Curve, bar_chart, line_chart, nice_ticks

HOSTILE = '"><script>alert(1)</script>'
LABELS = {"x_label": "wavelength (nm)", "y_label": "reflectance", "alt": "a chart"}


def paths(svg, css_class):
    root = ElementTree.fromstring(str(svg))
    return [p.attrib["d"] for p in root.iter("path") if css_class in p.attrib["class"].split()]


def numbers(path):
    return np.array(re.findall(r"[ML]([\d.]+) ([\d.]+)", path), float)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (397.3, 1003.6, [400.0, 600.0, 800.0, 1000.0]),
        (-3.0, 3.0, [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]),
    ],
)
def test_ticks_are_round_and_inside(low, high, expected):
    np.testing.assert_allclose(nice_ticks(low, high), expected, atol=1e-12)


def test_a_straight_line_is_straight_and_fills_the_width():
    x = np.linspace(400.0, 1000.0, 7)
    (path,) = paths(line_chart([Curve("", x, x / 1000.0)], **LABELS), "line")
    places = numbers(path)
    np.testing.assert_allclose(np.diff(places, 2, axis=0), 0.0, atol=0.11)
    left, right = places[0, 0], places[-1, 0]
    (grid, *_) = paths(line_chart([Curve("", x, x / 1000.0)], **LABELS), "grid")
    assert grid.startswith(f"M{left:.1f} ")
    assert grid.endswith(f"H{right:.1f}")
    assert places[0, 1] > places[-1, 1]


def test_decades_are_equally_far_apart():
    (path,) = paths(
        line_chart([Curve("", np.arange(4.0), 10.0 ** -np.arange(4.0))], logarithmic=True, **LABELS), "line"
    )
    steps = np.diff(numbers(path)[:, 1])
    assert steps[0] > 10.0
    np.testing.assert_allclose(steps, steps[0], atol=0.11)


def test_what_is_not_measured_is_a_gap_in_line_and_band():
    y = np.array([1.0, 2.0, np.nan, 2.0, 1.0])
    svg = line_chart([Curve("a", np.arange(5.0), y, np.full(5, 0.1))], **LABELS)
    band, (legend, line) = paths(svg, "band")[0], paths(svg, "line")
    assert line.count("M") == 2
    assert len(numbers(line)) == 4
    assert (band.count("M"), band.count("Z")) == (2, 2)
    assert "h18" in legend


def test_a_band_lies_around_its_line():
    x = np.arange(3.0)
    svg = line_chart([Curve("", x, np.ones(3), np.full(3, 0.5)), Curve("", x, np.zeros(3))], **LABELS)
    band, (line, zero) = numbers(paths(svg, "band")[0]), map(numbers, paths(svg, "line"))
    unit = zero[0, 1] - line[0, 1]
    np.testing.assert_allclose(band[:3, 1], line[0, 1] - unit / 2.0, atol=0.11)
    np.testing.assert_allclose(band[3:, 1], line[0, 1] + unit / 2.0, atol=0.11)


def test_bars_are_as_high_as_their_numbers():
    svg = bar_chart(np.arange(4.0), np.array([1.0, np.nan, 2.0]), **LABELS)
    bars = re.findall(r"M[\d.]+ ([\d.]+)V([\d.]+)H", paths(svg, "bar")[0])
    heights = [float(foot) - float(top) for foot, top in bars]
    assert len(heights) == 2
    assert math.isclose(heights[1], 2.0 * heights[0], abs_tol=0.25)


def test_names_cannot_become_markup():
    marks = {HOSTILE: 1.0}
    labels = {"x_label": HOSTILE, "y_label": HOSTILE, "alt": HOSTILE}
    line = line_chart([Curve(HOSTILE, np.arange(3.0), np.ones(3))], marks=marks, **labels)
    for svg in (line, bar_chart(np.arange(3.0), np.ones(2), marks=marks, **labels)):
        assert "<script" not in svg
        root = ElementTree.fromstring(str(svg))
        assert HOSTILE in [text.text for text in root.iter("text")]
        assert root.attrib["aria-label"] == HOSTILE


@pytest.mark.parametrize("y", [np.full(3, np.nan), np.zeros(3), np.ones(3)])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_constant_and_missing_curves_are_drawn_all_the_same(y, logarithmic):
    svg = line_chart([Curve("a", np.arange(3.0), y)], logarithmic=logarithmic, **LABELS)
    assert "nan" not in svg
    assert "inf" not in svg
