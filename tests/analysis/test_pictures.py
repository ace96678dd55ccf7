"""Pictures of traits whose regions were named by hand."""

import warnings

import numpy as np
import pytest

from hsi_sc_nerf.analysis import pictures
from hsi_sc_nerf.analysis.traits import WHOLE, MeanAndSd, RegionTraits, Traits

NM = np.linspace(400.0, 1000.0, 12)


@pytest.fixture
def figures(monkeypatch):
    """What was drawn, as it would be written."""
    drawn = []

    def keep(figure, path):
        figure.draw_without_rendering()
        drawn.append(figure)

    monkeypatch.setattr(pictures, "save_figure", keep)
    return drawn


def region(name):
    return RegionTraits(name, 4e-4, MeanAndSd(np.full(12, 0.4), np.full(12, 0.1)), {})


@pytest.mark.parametrize("name", ["a very long name of a region " * 8, "_stem", "$x^$ <b>", "a" * 200])
def test_any_name_is_in_the_legend_beside_curves_that_have_room(figures, tmp_path, name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pictures.draw_region_spectra(tmp_path / "spectra.png", NM, Traits([region(WHOLE), region(name)]))
    (figure,) = figures
    (legend,) = figure.legends
    told = [text.get_text().strip() for text in legend.get_texts()]
    assert told[0] == "whole surface (4.00 cm²)"
    assert told[1].startswith(name[:31].strip())
    assert told[1].endswith("(4.00 cm²)")
    (axes,) = figure.axes
    assert axes.get_position().width > 0.5
    assert legend.get_window_extent().x0 >= axes.get_window_extent().x1


def test_letters_that_the_font_lacks_are_boxes_without_a_warning(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pictures.draw_region_spectra(tmp_path / "spectra.png", NM, Traits([region(WHOLE), region("果柄 \N{PEAR}")]))
    assert (tmp_path / "spectra.png").stat().st_size > 0
