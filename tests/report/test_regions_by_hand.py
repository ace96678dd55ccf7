"""Regions on the report's page as they are drawn, named, deleted and undone by mouse and keyboard in a browser."""

import csv
import json

import capture_factory as factory
import numpy as np
import pytest
from headless_browser import needs_browser
from page_of_a_ball import ball, colour_at, go_round, opened

from hsi_sc_nerf.analysis.drawn_regions import read_drawn_regions
from hsi_sc_nerf.report.build import object_section
from hsi_sc_nerf.report.page import html_page

pytestmark = [pytest.mark.slow, needs_browser]

ODD = "<b>\"a\"</b> & 'ä', 🍐;"
NAMES = ".regions input:not([type])"
FOCUS = "document.activeElement.getAttribute('aria-label') ?? document.activeElement.name"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "page.html"
    section = object_section(ball(factory.WAVELENGTHS_NM), 4000, ["NDVI"])
    path.write_text(html_page("", "", {}, [section]), encoding="utf-8")
    return path


@pytest.fixture
def page(browser, report):
    with opened(browser, report, viewport={"width": 700, "height": 900}) as page:
        page.check("input[name=drawing]")
        yield page


def names(page):
    return [box.input_value() for box in page.locator(NAMES).all()]


def saved(page, button):
    with page.expect_download() as download:
        page.click(f"button[name={button}]")
    return download.value.path()


def scale(page):
    """Changes with the zoom."""
    return page.locator(".scale").evaluate("bar => [bar.textContent, bar.style.width]")


def test_names_may_be_odd_but_not_alike_and_the_focus_stays(page):
    go_round(page, 0.5, 0.7, 0.06)
    go_round(page, 0.5, 0.5, 0.06)
    page.fill(f"{NAMES} >> nth=0", ODD)
    page.keyboard.press("Tab")
    assert page.evaluate(FOCUS) == f"Delete {ODD}"
    page.fill(f"{NAMES} >> nth=1", f" {ODD} ")
    page.keyboard.press("Enter")
    assert page.evaluate(FOCUS) == "Name of the region"
    assert names(page) == [ODD, f"{ODD} 2"]  # traits takes no two regions of one name
    page.fill(f"{NAMES} >> nth=1", " ")
    page.keyboard.press("Tab")
    assert names(page) == [ODD, f"{ODD} 2"]
    regions = read_drawn_regions(saved(page, "saveRegions"))
    assert [region.name for region in regions] == names(page)
    with saved(page, "save").open(encoding="utf-8", newline="") as file:
        header = next(csv.reader(file))
    assert header[1:] == [f"{kind} {name}" for name in names(page) for kind in ("mean of", "standard deviation in")]
    page.focus(".regions button >> nth=0")
    page.keyboard.press("Enter")
    assert page.evaluate(FOCUS) == f"Delete {ODD} 2"
    page.keyboard.press("Enter")
    assert page.evaluate(FOCUS) == "drawing"
    assert names(page) == []


def test_what_was_done_can_be_undone_step_by_step(page):
    """By key and by button; a region comes back with its points, its name, its place in the list and its colour."""
    words = page.locator(".regions p")
    go_round(page, 0.5, 0.7, 0.06)
    first = words.all_inner_texts()
    page.select_option("select[name=tool]", "brush")
    go_round(page, 0.5, 0.5, 0.06)
    both = words.all_inner_texts()
    page.fill(f"{NAMES} >> nth=0", "b")
    page.keyboard.press("Control+z")  # undoes what was typed, as everywhere
    assert words.count() == 2
    page.fill(f"{NAMES} >> nth=0", "a")
    page.keyboard.press("Enter")
    page.click(".regions button >> nth=0")
    page.select_option("select[name=deed]", "take")
    go_round(page, 0.5, 0.5, 0.03)
    assert words.all_inner_texts() != both[1:]
    page.select_option("select[name=deed]", "add")
    page.uncheck("input[name=drawing]")
    page.locator("#cloud canvas").click(position={"x": 200, "y": 200})  # takes the deleted region's colour
    page.keyboard.press("Control+z")
    assert words.all_inner_texts() == both[1:]
    page.keyboard.press("Control+z")
    assert words.all_inner_texts() == both
    assert names(page)[0] == "a"
    colours = page.locator(".controls .dot").evaluate_all("all => all.map((dot) => dot.style.background)")
    assert len(set(colours)) == len(colours)
    page.click("button[name=undo]")
    assert names(page)[0] == "region 1"
    page.click("button[name=undo]")
    assert words.all_inner_texts() == first
    assert page.locator("select[name=deed]").input_value() == "new"
    page.click("button[name=undo]")
    assert names(page) == []
    page.click("button[name=undo]")
    assert page.locator(".told").inner_text() == "There is nothing to undo."


def test_keys_and_buttons_of_the_browser_are_left_to_it_and_escape_stops_a_line(page):
    canvas = page.locator("#cloud canvas")
    canvas.focus()
    before = scale(page)
    for key in ("Control+-", "Meta+-", "Alt+-"):
        page.keyboard.press(key)
        assert scale(page) == before
    page.keyboard.press("-")
    assert scale(page) != before
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0
    page.mouse.move(x, y)
    page.mouse.down(button="right")
    # Where the menu opens, the page is not told that the button is up; that must not leave a line being drawn.
    for step in ((40, 0), (40, 40), (0, 40)):
        page.mouse.move(x + step[0], y + step[1])
    assert page.locator(".lasso").get_attribute("points") == ""
    page.mouse.up(button="right")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y)
    page.mouse.move(x + 60, y + 60)
    assert page.locator(".lasso").get_attribute("points") != ""
    page.keyboard.press("Escape")
    assert page.locator(".lasso").get_attribute("points") == ""
    drawn = colour_at(page, 0.5, 0.45)
    page.mouse.move(x, y + 60)
    page.mouse.up()
    assert colour_at(page, 0.5, 0.45) == drawn
    assert page.locator(".regions li").count() == page.locator(".picked li").count() == 0


def test_a_file_of_regions_is_opened_by_key_and_names_and_colours_are_whole_on_paper(page, tmp_path):
    go_round(page, 0.5, 0.5, 0.06)
    path = saved(page, "saveRegions")
    # The browser's own dialogue is not waited for: whether it comes in time depends on the machine.
    opens = "box => box.addEventListener('click', (event) => { event.preventDefault(); box.dataset.opened = 1; })"
    page.locator("input[name=loadRegions]").evaluate(opens)
    page.press("button[name=openRegions]", "Enter")
    page.locator("input[name=loadRegions][data-opened]").wait_for(state="attached")
    page.set_input_files("input[name=loadRegions]", path)
    page.locator(".regions li").nth(1).wait_for()
    page.fill(f"{NAMES} >> nth=1", "the upper half of the body")
    assert page.locator(NAMES).nth(1).evaluate("box => box.scrollWidth <= box.clientWidth")
    page.select_option("select[name=shown]", "band 0")
    page.emulate_media(media="print")
    # Browsers leave backgrounds away, unless they are told that these matter.
    for key in (".legend .bar", ".regions .dot"):
        assert page.locator(key).first.evaluate("one => getComputedStyle(one).printColorAdjust") == "exact"
    page.emulate_media(media="screen")


def test_the_object_comes_back_after_the_graphics_memory_was_taken_away(page):
    page.select_option("select[name=shown]", "band 0")
    before = colour_at(page, 0.5, 0.25)
    taken = "canvas => { window.taken = canvas.getContext('webgl').getExtension('WEBGL_lose_context'); }"
    page.locator("#cloud canvas").evaluate(taken)
    page.evaluate("new Promise((then) => { setTimeout(then, 300); taken.loseContext(); })")
    page.evaluate("new Promise((then) => { setTimeout(then, 300); taken.restoreContext(); })")
    assert colour_at(page, 0.5, 0.25) == before
    page.select_option("select[name=shown]", "composite 0")
    assert colour_at(page, 0.5, 0.25) != before


def test_regions_that_were_not_saved_are_not_lost_without_a_question(browser, report):
    page, asked = browser.new_page(reduced_motion="reduce"), []
    page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.accept()))
    for save in (False, True):
        page.goto(report.as_uri())
        page.check("input[name=drawing]")
        go_round(page, 0.5, 0.5, 0.06)
        if save:
            saved(page, "saveRegions")
        page.reload()
        assert asked == ["beforeunload"]
    page.close()


def test_who_comes_back_finds_the_controls_as_the_object_is_shown(browser, report):
    """A browser puts back what was chosen in forms, of which the object would know nothing."""
    page = browser.new_page(reduced_motion="reduce")
    chosen = "[...document.forms[0].elements].map((one) => [one.name, one.checked, one.value])"
    page.goto(report.as_uri())
    first = page.evaluate(chosen)
    page.check("input[name=shading]")
    page.fill("input[name=size]", "2.5")
    page.fill("input[name=band]", "3")
    page.select_option("select[name=theme]", "dark")
    page.goto("about:blank")
    page.go_back()
    page.wait_for_timeout(300)
    assert page.evaluate(chosen) == first
    page.close()


@pytest.mark.parametrize(
    "regions", [[], None, [{"name": "a"}], [{"points": [0]}], [{"name": " ", "points": [0]}], [None]]
)
def test_files_that_traits_would_refuse_are_refused_and_too_many_regions_cut_off(page, tmp_path, regions):
    places = ball(factory.WAVELENGTHS_NM).points
    content = {"kind": "hsi-sc-nerf regions", "points_m": places.tolist(), "regions": regions}
    (tmp_path / "regions.json").write_text(json.dumps(content))
    page.set_input_files("input[name=loadRegions]", tmp_path / "regions.json")
    page.locator(".told", has_text="the file holds no regions; give one that was saved here").wait_for()
    upper = np.flatnonzero(places[:, 2] > 0.0).tolist()
    content["regions"] = [{"name": "a", "points": upper}] * 7
    (tmp_path / "regions.json").write_text(json.dumps(content))
    page.set_input_files("input[name=loadRegions]", tmp_path / "regions.json")
    page.locator(".told", has_text="There are 6 regions, which is the most").wait_for()
    assert names(page) == ["a", *(f"a {number}" for number in range(2, 7))]
    page.click("button[name=undo]")
    assert names(page) == []
