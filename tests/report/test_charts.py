"""Charts of the report: positions on the page, gaps, escaping."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from hsi_sc_nerf.report.charts import Curve, line_chart

HOSTILE = '"><script>alert(1)</script> $\\alpha$'
LABELS = {"x_label": "wavelength (nm)", "y_label": "reflectance", "alt": "a chart"}
SVG = "{http://www.w3.org/2000/svg}"


def paths(svg, css_class):
    groups = [group for group in ElementTree.fromstring(str(svg)).iter() if group.get("class") == css_class]
    return [path.attrib["d"] for group in groups for path in group.iter(f"{SVG}path")]


def numbers(path):
    return np.array(re.findall(r"[ML] ?([\d.]+) ([\d.]+)", path), float)


def test_a_straight_line_is_straight_and_rises():
    x = np.linspace(400.0, 1000.0, 7)
    (path,) = paths(line_chart([Curve("", x, x / 1000.0 + 1e-9 * (x > 500))], **LABELS), "line")
    first, *_, last = numbers(path)
    assert first[0] < last[0]
    assert first[1] > last[1]
    slopes = np.diff(numbers(path), axis=0)
    np.testing.assert_allclose(slopes[:, 1] / slopes[:, 0], slopes[0, 1] / slopes[0, 0], rtol=1e-3)


def test_bands_in_any_order_are_one_line_and_one_band():
    x, y, spread = np.array([400.0, 500.0, 600.0, 700.0]), np.array([0.1, 0.4, 0.2, 0.3]), np.full(4, 0.05)
    charts = [
        line_chart([Curve("", x[order], y[order], spread[order])], **LABELS) for order in ([0, 1, 2, 3], [2, 0, 3, 1])
    ]
    for css_class in ("line", "band"):
        assert paths(charts[0], css_class) == paths(charts[1], css_class)


def test_decades_are_equally_far_apart():
    y = 10.0 ** -np.array([0.0, 2.0, 1.0, 3.0])
    (path,) = paths(line_chart([Curve("", np.arange(4.0), y)], logarithmic=True, **LABELS), "line")
    heights = numbers(path)[[0, 2, 1, 3], 1]
    steps = np.diff(heights)
    assert steps[0] > 10.0
    np.testing.assert_allclose(steps, steps[0], atol=0.01)


def test_what_is_not_measured_is_a_gap_in_line_and_band():
    y = np.array([1.0, 2.0, np.nan, 2.0, 1.0])
    svg = line_chart([Curve("a", np.arange(5.0), y, np.full(5, 0.1))], **LABELS)
    (line,) = paths(svg, "line")
    assert line.count("M") == 2
    alone = line_chart([Curve("", np.arange(4.0), np.array([1.0, np.nan, 2.0, np.nan]))], **LABELS)
    assert [len(numbers(path)) for path in paths(alone, "line")[1:]] == [2, 2]  # dots
    assert len(numbers(line)) == 4
    assert sum(band.count("M") for band in paths(svg, "band")) == 2
    assert ">a</" in svg


@pytest.mark.parametrize("spread", [None, np.full(1, 0.1)])
def test_a_single_band_is_a_dot_with_a_bar_of_its_spread(spread):
    svg = line_chart([Curve("", np.array([550.0]), np.array([0.4]), spread)], **LABELS)
    dot = numbers(paths(svg, "line")[-1])
    assert len(dot) == 2
    np.testing.assert_array_equal(dot[0], dot[1])
    if spread is not None:
        bar = numbers(paths(svg, "band")[-1])
        assert bar[:, 0].tolist() == dot[:, 0].tolist()
        assert bar[:, 1].max() > dot[0, 1] > bar[:, 1].min()


def test_a_band_lies_around_its_line():
    x = np.arange(3.0)
    svg = line_chart([Curve("", x, np.ones(3), np.full(3, 0.5)), Curve("", x, np.zeros(3))], **LABELS)
    band, (line, zero) = numbers(paths(svg, "band")[0]), map(numbers, paths(svg, "line"))
    unit = zero[0, 1] - line[0, 1]
    np.testing.assert_allclose(
        (band[:, 1].min(), band[:, 1].max()), line[0, 1] + unit * np.array([-0.5, 0.5]), atol=0.01
    )


@pytest.mark.slow
def test_colours_follow_the_page():
    x = np.arange(3.0)
    svg = line_chart([Curve(f"{i}", x, x + i, np.ones(3)) for i in range(8)], marks={"end": 1.0}, **LABELS)
    assert {f"var(--s{i})" for i in range(7)} <= set(re.findall(r"var\(--\w+\)", svg))
    assert not re.search(r"#[0-9a-f]{6}", svg)
    assert " id=" not in svg


@pytest.mark.slow
def test_names_cannot_become_markup():
    marks = {HOSTILE: 1.0}
    labels = {"x_label": HOSTILE, "y_label": HOSTILE, "alt": HOSTILE}
    svg = line_chart([Curve(HOSTILE, np.arange(3.0), np.ones(3))], marks=marks, **labels)
    assert "<script" not in svg
    root = ElementTree.fromstring(str(svg))
    assert [text.text for text in root.iter(f"{SVG}text")].count(HOSTILE) >= 4
    assert root.attrib["aria-label"] == HOSTILE


@pytest.mark.slow
@pytest.mark.parametrize("y", [np.full(3, np.nan), np.zeros(3), np.ones(3)])
@pytest.mark.parametrize("logarithmic", [False, True])
def test_constant_and_missing_curves_are_drawn_all_the_same(y, logarithmic):
    svg = line_chart([Curve("a", np.arange(3.0), y)], logarithmic=logarithmic, **LABELS)
    assert not re.search(r"\b(nan|inf)\b", svg)
