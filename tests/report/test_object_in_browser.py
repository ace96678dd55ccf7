"""The object on the report's page, turned, picked, drawn on and saved in a browser."""

import re
from contextlib import contextmanager

import capture_factory as factory
import numpy as np
import pytest
from headless_browser import needs_browser
from page_of_a_ball import ball, colour_at, go_round, opened
from PIL import Image

from hsi_sc_nerf.analysis.drawn_regions import (
    DrawnRegion,
    propose_regions,
    read_drawn_regions,
    write_drawn_regions,
)
from hsi_sc_nerf.analysis.measurement import measure_traits
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.report.build import object_section
from hsi_sc_nerf.report.page import html_page

pytestmark = [pytest.mark.slow, needs_browser]


def picked_mm(page):
    """Position of the last picked point."""
    return np.array(re.findall(r"-?[\d.]+", page.locator(".picked li").last.inner_text()), float)


def test_the_object_turns_and_tells_its_spectra_in_a_browser(browser, report):
    """Colours that follow from the numbers, the spectrum of the point under a click."""
    with opened(browser, report, viewport={"width": 700, "height": 900}) as page:
        canvas = page.locator("#cloud canvas")
        canvas.scroll_into_view_if_needed()
        page.select_option("select[name=shown]", "band 0")

        def click(x, y):
            box = canvas.bounding_box()
            page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])

        # Viridis at its end for the bright half, at its middle for the other; nothing beside the ball.
        np.testing.assert_allclose(colour_at(page, 0.5, 0.25), [253, 231, 37, 255], atol=12)
        np.testing.assert_allclose(colour_at(page, 0.5, 0.72), [33, 145, 140, 255], atol=12)
        assert colour_at(page, 0.02, 0.02)[3] == 0

        click(0.5, 0.72)
        click(0.02, 0.02)
        assert page.locator(".picked li").count() == 1
        assert page.locator(".told").is_visible()
        assert np.linalg.norm(picked_mm(page)) == pytest.approx(30.0, abs=0.2)
        assert picked_mm(page)[2] < 0.0
        style = page.locator(".picked .line").evaluate(
            "line => [getComputedStyle(line)].map((s) => [s.stroke, s.fill])[0]"
        )
        assert style == ["rgb(0, 114, 178)", "none"]
        with page.expect_download() as download:
            page.click("button[name=save]")
        saved = np.loadtxt(download.value.path(), delimiter=",", skiprows=1)
        np.testing.assert_allclose(saved[:, 1], np.linspace(0.2, 0.4, len(saved)), atol=2e-3)


def test_regions_are_drawn_named_saved_and_measured_on_the_cloud(browser, run, report, tmp_path):
    """What is behind stays out; the file opens again, as proposals do; `traits` finds the same on the whole cloud."""
    with opened(browser, report, viewport={"width": 700, "height": 900}) as page:
        page.check("input[name=drawing]")
        go_round(page, 0.5, 0.7, 0.06)
        (line,) = page.locator(".regions p").all_inner_texts()
        count, area_cm2 = (float(part) for part in re.findall(r"([\d.]+) (?:points|cm²)", line))
        true_cm2 = 4.0 * np.pi * 3.0**2 * count / 4000
        # Neighbours of an even lattice are not those of points at random, for which test_cloud.py is narrower.
        assert area_cm2 == pytest.approx(true_cm2, rel=0.2)
        assert "NDVI" in line
        page.fill(".regions input:not([type])", "a, south")
        page.locator(".regions input:not([type])").press("Tab")
        page.select_option("select[name=deed]", "add")
        go_round(page, 0.5, 0.3, 0.06)
        assert "nan" not in page.locator(".regions p").inner_text().lower()
        page.select_option("select[name=deed]", "take")
        go_round(page, 0.5, 0.3, 0.08)
        page.select_option("select[name=deed]", "new")
        go_round(page, 0.5, 0.3, 0.06)
        go_round(page, 0.03, 0.03, 0.02)
        assert "goes round no point" in page.locator(".told").inner_text()
        assert page.locator(".picked .spread").count() == page.locator(".regions li").count() == 2
        with page.expect_download() as download:
            page.click("button[name=saveRegions]")
        download.value.save_as(tmp_path / "regions.json")
        with page.expect_download() as download:
            page.click("button[name=save]")
        header = download.value.path().read_text().splitlines()[0]
        assert header.startswith('wavelength_nm,"mean of a, south","standard deviation in a, south",')
        for _ in range(2):
            page.locator(".regions button").first.click()
        assert page.locator(".picked .spread").count() == 0
        page.set_input_files("input[name=loadRegions]", tmp_path / "regions.json")
        page.locator(".regions li").nth(1).wait_for()
        write_drawn_regions(tmp_path / "proposed.json", propose_regions(read_spectral_ply(run / "point_cloud.ply")))
        page.set_input_files("input[name=loadRegions]", tmp_path / "proposed.json")
        page.locator(".regions li").nth(2).wait_for()
        assert page.locator(".regions p").last.inner_text().startswith("4000 points, 11")
        assert page.locator(".regions input[type=radio]").last.is_checked()
        (tmp_path / "other.json").write_text("{")
        page.set_input_files("input[name=loadRegions]", tmp_path / "other.json")
        page.wait_for_selector(".told:not([hidden])")
        assert page.locator(".told").inner_text().startswith("other.json: the file is no JSON")
    south, north = read_drawn_regions(tmp_path / "regions.json")
    assert (south.name, south.chosen.sum()) == ("a, south", count)
    whole = ball(factory.WAVELENGTHS_NM, 40_000)
    traits = measure_traits(whole, splits=0, drawn_regions=[south, north]).traits
    found = {region.name: region for region in traits.regions}
    assert found["a, south"].area_m2 * 1e4 == pytest.approx(true_cm2, rel=0.1)
    np.testing.assert_allclose(found["a, south"].spectrum.mean, np.linspace(0.2, 0.4, 12), atol=2e-3)
    np.testing.assert_allclose(found[north.name].spectrum.mean, np.linspace(0.4, 0.8, 12), atol=4e-3)


@contextmanager
def opened_with(browser, cloud, path, points, **options):
    """A page of the object alone."""
    path.write_text(html_page("", "", {}, [object_section(cloud, points, **options)]), encoding="utf-8")
    with opened(browser, path, viewport={"width": 700, "height": 900}) as page:
        yield page


@pytest.mark.parametrize("points", [500, 20_000])
def test_regions_fit_a_page_of_other_points_and_are_refused_on_another_object(browser, tmp_path, points):
    """Proposed on 4000 points. A region is where the nearest of these is in it."""
    whole = ball(factory.WAVELENGTHS_NM, 40_000)
    drawn_on = ball(factory.WAVELENGTHS_NM, 4000).points
    upper = DrawnRegion("upper", drawn_on, drawn_on[:, 2] > 0.01)
    write_drawn_regions(tmp_path / "proposed.json", [upper, DrawnRegion("spot", drawn_on, drawn_on[:, 2] > 0.0299)])
    with opened_with(browser, whole, tmp_path / "page.html", points) as page:
        page.set_input_files("input[name=loadRegions]", tmp_path / "proposed.json")
        page.locator(".regions li").first.wait_for()
        found = region_mm(page, tmp_path / "again.json")["upper"]
        assert len(found) == pytest.approx(points / 3.0, rel=0.12)
        assert found[:, 2].min() > 9.0
        beside = [DrawnRegion("upper", drawn_on + np.array([0.05, 0.0, 0.0]), upper.chosen)]
        write_drawn_regions(tmp_path / "other.json", beside)
        page.set_input_files("input[name=loadRegions]", tmp_path / "other.json")
        page.locator(".told:not([hidden])", has_text="drawn on another object").wait_for()
        assert page.locator(".regions li").count() <= 2


def brush_over(page, *places):
    """Draw along a line, at fractions of the drawing's size."""
    canvas = page.locator("#cloud canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    for step, (x, y) in enumerate(places):
        page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"], steps=5)
        if step == 0:
            page.mouse.down()
    page.mouse.up()


def region_mm(page, path):
    """Places of the points of each region, as the page saves them, millimetres."""
    with page.expect_download() as download:
        page.click("button[name=saveRegions]")
    download.value.save_as(path)
    return {region.name: 1e3 * region.points_m[region.chosen] for region in read_drawn_regions(path)}


def test_a_brush_paints_what_is_seen_below_it_by_pointer_and_by_keys(browser, report, tmp_path):
    """As wide as it says and on the front only; more strokes add, shift takes away, points move between regions."""
    file = tmp_path / "regions.json"
    with opened(browser, report, viewport={"width": 700, "height": 900}) as page:
        canvas = page.locator("#cloud canvas")
        page.check("input[name=drawing]")
        page.select_option("select[name=tool]", "brush")
        page.locator("input[name=brush]").fill("60")
        # Pixels a millimetre at the ball's front, which is nearer to the camera, 4.1 away, by its radius.
        scale = canvas.bounding_box()["height"] / (2.0 * np.tan(0.3) * 3.1 * 30.0)
        brush_over(page, (0.5, 0.5))
        (dab,) = region_mm(page, file).values()
        camera = np.array([np.cos(0.25), 0.0, np.sin(0.25)])
        aside = np.linalg.norm(dab - (dab @ camera)[:, None] * camera, axis=1)
        assert (dab @ camera > 0.0).all()
        assert aside.max() == pytest.approx(60.0 / scale, rel=0.1)
        assert len(dab) == pytest.approx(4000 * (aside.max() / 60.0) ** 2, rel=0.25)

        brush_over(page, (0.35, 0.5), (0.65, 0.5))
        (stroke,) = region_mm(page, file).values()
        assert np.ptp(stroke[:, 1]) > 1.8 * np.ptp(dab[:, 1])
        assert np.ptp(stroke[:, 2]) < 1.2 * np.ptp(dab[:, 2])
        page.keyboard.down("Shift")
        brush_over(page, (0.5, 0.5))
        page.keyboard.up("Shift")
        (cut,) = region_mm(page, file).values()
        assert len(cut) == len(stroke) - len(dab)

        page.select_option("select[name=deed]", "new")
        brush_over(page, (0.5, 0.5))
        page.locator(".regions input[type=radio]").first.check()
        page.select_option("select[name=deed]", "move")
        brush_over(page, (0.52, 0.5))
        first, second = region_mm(page, file).values()
        assert len(first) > len(cut)
        assert len(second) < len(dab)
        assert len(np.unique(np.concatenate([first, second]), axis=0)) == len(first) + len(second)

        for _ in range(2):
            page.locator(".regions button").first.click()
        canvas.focus()
        for _ in range(8):
            page.keyboard.press("]")
        assert page.locator("input[name=brush]").input_value() == "76"
        assert page.locator(".tip").get_attribute("r") == "76"
        page.keyboard.press("Enter")
        (by_key,) = region_mm(page, file).values()
        assert len(by_key) > len(dab)
        canvas.focus()
        page.keyboard.press("Shift+Enter")
        assert page.locator(".regions li").count() == 0


def test_the_scale_bar_is_as_long_as_it_says_and_the_page_has_its_own_colours(browser, report):
    with opened(browser, report, viewport={"width": 700, "height": 900}) as page:
        canvas, bar = page.locator("#cloud canvas"), page.locator(".scale")
        mm = float(re.fullmatch(r"([\d.]+) mm", bar.inner_text())[1])
        of_canvas = bar.bounding_box()["width"] / canvas.bounding_box()["height"]
        # The ball, 30 mm in radius, has its largest side 60 mm as 2; the camera stands at 4.1 with 0.6 rad of view.
        assert mm == pytest.approx(of_canvas * 2.0 * 4.1 * np.tan(0.3) * 30.0, rel=0.02)
        # A printer lays the page out on a narrower sheet, and does not draw the object anew.
        paper = page.add_style_tag(content=".stage { width: 300px; }")
        assert bar.bounding_box()["width"] / canvas.bounding_box()["height"] == pytest.approx(of_canvas, rel=0.01)
        paper.evaluate("tag => tag.remove()")
        canvas.focus()
        for _ in range(12):
            page.keyboard.press("+")
        assert float(bar.inner_text()[:-3]) < mm
        ground = "getComputedStyle(document.body).backgroundColor"
        assert page.evaluate(ground) == "rgb(255, 255, 255)"
        page.select_option("select[name=theme]", "dark")
        assert page.evaluate(ground) == "rgb(20, 24, 28)"
        page.emulate_media(media="print", color_scheme="dark")
        # On paper the colours are those of a light page, and what is folded does not grow over the sheet's rest.
        colour, inside = (
            f"getComputedStyle(document.querySelector('{one}'))" for one in ("a", "details:not([open])")
        )
        assert page.evaluate(f"{colour}.color") == "rgb(0, 88, 138)"
        assert page.evaluate(f"{inside}.breakInside") == "avoid"
        assert page.evaluate(ground) == "rgb(255, 255, 255)"


def test_the_picture_is_saved_as_it_is_drawn(browser, report):
    """As many pixels as the drawing has, the object's colours, nothing behind the object; scale and colour bar."""
    with opened(browser, report, viewport={"width": 700, "height": 900}) as page:
        page.select_option("select[name=shown]", "band 0")
        with page.expect_download() as download:
            page.click("button[name=picture]")
        assert download.value.suggested_filename == "object.png"
        drawn = page.locator("#cloud canvas").evaluate("canvas => [canvas.height, canvas.width]")
        with Image.open(download.value.path()) as opened_picture:
            picture = np.asarray(opened_picture)
        height, width = drawn
        assert picture.shape[1:] == (width, 4)
        ends = picture[height + 15, [13, -14]]
        np.testing.assert_allclose(ends, [[68, 1, 84, 255], [253, 231, 37, 255]], atol=2)
        length = page.locator(".scale").evaluate("scale => scale.getBoundingClientRect().width")
        assert (picture[height - 14] == [0, 0, 0, 255]).all(axis=1).sum() == pytest.approx(length, abs=2.0)
        np.testing.assert_allclose(picture[height // 4, width // 2], [253, 231, 37, 255], atol=12)
        assert picture[2, 2, 3] == 0


def test_a_spectrum_is_picked_by_keyboard(browser, report):
    """The page is entered by tabulator; the cross shows where; arrows move what is under it."""
    with opened(browser, report, viewport={"width": 1280, "height": 900}) as page:
        for _ in range(40):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement.tagName") == "CANVAS":
                break
        assert page.locator(".cross").is_visible()
        page.keyboard.press("Enter")
        front = picked_mm(page)
        for _ in range(8):
            page.keyboard.press("ArrowUp")
        page.keyboard.press("Enter")
        above = picked_mm(page)
        assert above[2] > front[2] + 10.0
        for _ in range(16):
            page.keyboard.press("Shift+ArrowRight")
        page.keyboard.press("Enter")
        assert page.locator(".picked li").count() == 2
        assert page.locator(".told").is_visible()


def test_a_phone_shows_all_of_it_without_scrolling_sideways(browser, report):
    with opened(browser, report, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True) as page:
        size = "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
        assert page.locator("section > .card[open]").count() == 1
        width, height = page.evaluate(size)
        assert width == 390
        assert height < 5000
        page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
        assert page.evaluate(size)[0] == 390
        cut = "all => all.filter((one) => one.scrollWidth > one.clientWidth).map((one) => one.innerText)"
        assert page.locator(".wide").evaluate_all(cut) == []
        names = page.locator("tbody th").evaluate_all("all => all.map((one) => one.clientWidth)")
        assert min(names) >= 80
        reach = "all => all.map((one) => one.getBoundingClientRect().right)"
        assert max(page.locator("main :is(p, li, img, svg, canvas, .wide)").evaluate_all(reach)) <= 391
