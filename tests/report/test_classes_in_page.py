"""The classes of a classifier on the page: their colours, their areas on the object and in drawn regions."""

import re
from dataclasses import replace

import capture_factory as factory
import numpy as np
import pytest
from headless_browser import needs_browser
from page_of_a_ball import ball, colour_at, go_round, opened

from hsi_sc_nerf.analysis.calibrations import Calibration, Domain
from hsi_sc_nerf.report.build import object_section
from hsi_sc_nerf.report.page import html_page

BANDS = len(factory.WAVELENGTHS_NM)
SPHERE_CM2 = 4.0 * np.pi * 3.0**2


def halves(largest_q=np.inf):
    """A classifier of the ball's bright northern and dark southern half; beyond Q it knows no spectrum."""

    def predict(spectra):
        return np.stack([spectra[:, 0] < 0.3, spectra[:, 0] >= 0.3], axis=1).astype(float)

    first = np.eye(BANDS)[:, :1]
    domain = Domain(np.zeros(BANDS), np.ones(BANDS), first, first, np.ones(1), np.inf, largest_q)
    every, none = np.ones(BANDS, bool), np.full(BANDS, np.nan)
    return Calibration(
        "half", "", 0.0, factory.WAVELENGTHS_NM, (), every, none, predict, domain, ("south", "outside")
    )


@pytest.mark.slow
@needs_browser
def test_classes_have_colours_and_areas_on_the_object_and_in_regions(browser, tmp_path):
    """A second classifier knows nothing of the bright half: grey, and named so, although a class is named outside."""
    both = [halves(), replace(halves(2.0), name="dark half")]
    section = object_section(ball(factory.WAVELENGTHS_NM), 4000, ["NDVI"], both)
    path = tmp_path / "page.html"
    path.write_text(html_page("", "", {}, [section]), encoding="utf-8")
    with opened(browser, path, viewport={"width": 700, "height": 900}) as page:
        page.select_option("select[name=shown]", "classes 0")
        np.testing.assert_allclose(colour_at(page, 0.5, 0.72)[:3], [0, 114, 178], atol=2)
        np.testing.assert_allclose(colour_at(page, 0.5, 0.25)[:3], [213, 94, 0], atol=2)
        areas = [float(area) for area in re.findall(r"([\d.]+) cm²", page.locator(".legend").inner_text())]
        # Neighbours of an even lattice are not those of points at random.
        np.testing.assert_allclose(areas, [SPHERE_CM2 / 2.0, SPHERE_CM2 / 2.0, 0.0], rtol=0.2)
        page.check("input[name=drawing]")
        go_round(page, 0.5, 0.7, 0.06)
        told = page.locator(".regions p").inner_text()
        whole, south, north = (
            float(re.search(rf"{word} ?([\d.]+) cm²", told)[1]) for word in (r"points,", "half: south", "outside")
        )
        assert south == pytest.approx(whole, rel=0.01)
        assert north == 0.0
        page.locator(".regions button").click()
        page.select_option("select[name=shown]", "classes 1")
        np.testing.assert_allclose(colour_at(page, 0.5, 0.25)[:3], [128, 128, 128], atol=2)
        assert re.search(r"outside 0\.00 cm².*outside of what the classifier knows [1-9]", page.inner_text(".legend"))
        rows = [row.split("\n") for row in page.locator("table tbody tr").all_inner_texts()]
        assert [row[:2] for row in rows[3:5]] == [["dark half", "south"], ["dark half", "outside"]]


@pytest.mark.slow
@needs_browser
def test_a_region_tells_for_which_part_a_calibration_has_a_value(browser, tmp_path):
    dark = replace(halves(2.0), name="water", unit="%", predict=lambda spectra: spectra[:, :1], classes=())
    section = object_section(ball(factory.WAVELENGTHS_NM), 4000, ["NDVI"], [dark])
    path = tmp_path / "page.html"
    path.write_text(html_page("", "", {}, [section]), encoding="utf-8")
    with opened(browser, path, viewport={"width": 700, "height": 900}) as page:
        page.check("input[name=drawing]")
        for height, radius in ((0.7, 0.06), (0.3, 0.06), (0.55, 0.2)):
            go_round(page, 0.5, height, radius)
        south, north, both = page.locator(".regions p").all_inner_texts()
    assert re.search(r"water 0\.200 ± [\d.e-]+ %$", south)
    assert north.endswith("water no value")
    part = re.search(r"water 0\.200 ± \S+ % \(of (\d+) % of the points, the others have no value\)$", both)
    assert 20 < int(part[1]) < 80
