"""The report as a page: complete, without anything to fetch, with every text escaped; and working in a browser."""

import json
import re
from contextlib import contextmanager
from html.parser import HTMLParser
from types import SimpleNamespace

import ball_run
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
from hsi_sc_nerf.analysis.maps import SurfaceMap
from hsi_sc_nerf.analysis.measurement import measure_traits
from hsi_sc_nerf.analysis.report import trait_content
from hsi_sc_nerf.analysis.size import Size
from hsi_sc_nerf.analysis.traits import WHOLE, MapMean, MeanAndSd, RegionTraits, Traits
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import read_spectral_ply, write_spectral_ply
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.report.build import ReportSources, object_section, write_report
from hsi_sc_nerf.report.dataset_sections import (
    calibration_section,
    inspection_section,
    masks_section,
    poses_section,
)
from hsi_sc_nerf.report.page import Section, html_page
from hsi_sc_nerf.report.run_sections import comparison_section, traits_section

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}"
SECTIONS = ["inspection", "object", "views", "bands", "spectra", "comparison", "traits", "training"]
SECTIONS += ["calibration", "masks", "poses", "settings"]
COMPARISON = {
    "scores": {
        name: {"threshold_m": at, "precision": 95.0, "recall": 97.5, "f_score": 96.25}
        for name, at in (("chosen", 0.002), ("knee", 0.0015))
    },
    **{
        way: {"mean_m": 1e-3, "median_m": 9e-4, "rms_m": 1.23e-3, "percentile_95_m": 2e-3, "largest_m": 3e-3}
        for way in ("cloud_to_reference", "reference_to_cloud")
    },
    "curves": {"thresholds_m": [0, 0.002], "precision": [0, 95], "recall": [0, 97], "f_score": [0, 96]},
}
TRAITS = trait_content(
    Size(0.0229, 0.25, 0.09, 0.07, 0.068, 0.078),
    {"scale": Size(0.0001, 0.002, 0.0001, 0.0001, 0.0001, 0.0001)},
    True,
    Traits(
        [
            RegionTraits(
                name, 0.02, MeanAndSd(np.full(3, 0.4), np.zeros(3)), {HOSTILE: MapMean(MeanAndSd(0.5, 0.1), 0.1, 0.0)}
            )
            for name in (WHOLE, HOSTILE)
        ],
        maps=[SurfaceMap(HOSTILE, "", np.zeros(3), lambda spectra: spectra[:, 0], unit=HOSTILE)],
    ),
    {},
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of an untrained run with the cloud of a ball, and with a name that would be markup."""
    folder = tmp_path_factory.mktemp("report")
    data = ball_run.write_ball_dataset(folder / "data")
    transforms = (data / "transforms.json").read_text()
    (data / "transforms.json").write_text(transforms.replace('"ball"', json.dumps(HOSTILE)))
    finding = {"name": "white", "level": "amber", "sentence": f"{folder}/session: {HOSTILE}", "values": {}}
    write_json(data / "report" / "inspection.json", {"session": f"{folder}/session", "findings": [finding]})
    run = ball_run.write_untrained_run(data, folder / "runs").parent
    write_spectral_ply(run / "point_cloud.ply", ball(factory.WAVELENGTHS_NM))
    (run / "comparison.json").write_text(json.dumps(COMPARISON))
    (run / "traits.json").write_text(json.dumps(TRAITS))
    return run


@pytest.fixture(scope="module")
def report(run):
    write_report(run, run / "report.html", ReportSources(indices=("NDVI", "own = R550 / R670")))
    return run / "report.html"


class Page(HTMLParser):
    """What a browser would make of the page: its elements and what they refer to."""

    def __init__(self, text):
        super().__init__()
        self.elements = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


@pytest.mark.slow
def test_the_page_is_complete_and_names_from_outside_stay_text(report, tmp_path_factory):
    text = report.read_text(encoding="utf-8")
    page = Page(text)
    assert [section["id"] for section in page.all("section")] == SECTIONS
    for tag, attrs in page.elements:
        assert not any(name.startswith("on") and name != "onsubmit" for name in attrs), (tag, attrs)
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert attrs.get(name, "#").startswith(("#", "data:")), (tag, attrs)
    assert all(image["alt"] for image in page.all("img"))
    assert all(svg["aria-label"] for svg in page.all("svg"))
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|WebSocket", text)
    addresses = re.findall(r"[a-z]+://[^\s\"'<]+", re.sub(r"base64,[\w+/=]+", "", text))
    assert set(addresses) <= {"http://www.w3.org/2000/svg"}  # a name, which nothing fetches

    assert str(tmp_path_factory.getbasetemp()) not in text  # folders of this machine
    assert "session: " in text
    assert "<img src=x" not in text
    assert text.count("{{ 7 * 7 }}") > 5
    assert len(page.all("script")) == 2
    assert '"name": "own"' in text
    assert '"tells": "R550 / R670: own formula"' in text
    for shown in ("96.2 %", "F-score at 2.0 mm", "1.230", "229.0 ± 1.0", "250.0 ± 2.0", "cm²", "mL"):
        assert shown in text
    assert "run <code>ns-train" in text  # it has no log
    assert not list(report.parent.glob(".*")) + list(report.parent.glob("*.tmp"))


def test_many_good_findings_are_folded_and_none_other():
    """What is to be looked at does not drown in what is good."""
    found = [Finding(str(i), "green", f"Check {i} is good.") for i in range(5)]
    odd = Finding("odd", "amber", "Look here.")
    page = html_page("a", "b", {}, [Section("few", "Few", [], found[:2]), Section("many", "Many", [], [*found, odd])])
    many = page.split('id="many"')[1]
    assert "Good:</strong> 5 checks" in many
    assert many.index("Look here.") < many.index("<details") < many.index("Check 4 is good.")
    assert "<details" not in page.split('id="few"')[1].split("</section>")[0]


@pytest.mark.slow
def test_sections_on_a_processed_session(flagged_dataset):
    dataset = open_packed(flagged_dataset)
    sections = [make(dataset) for make in (calibration_section, masks_section, poses_section)]
    text = html_page("a", "b", {}, sections)
    assert "is nothing known" not in text
    for shown in ("read noise", "values that are no measurement", "median over frames", "median step", "All frames"):
        assert shown in text
    assert len(Page(text).all("svg")) >= 4


def test_files_that_are_something_else_are_refused_and_nothing_is_written(run, tmp_path):
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "inspection.json").write_text('{"findings": ["white"]}')
    with pytest.raises(InputError, match=r"inspection\.json: holds no findings"):
        inspection_section(SimpleNamespace(root=tmp_path))
    dataset = open_packed(ball_run.write_ball_dataset(tmp_path / "ball"))
    for name, content, section in (
        ("calibration", {"dead": [[1], [1, 2]]}, calibration_section),
        ("calibration", {"noise": {"read_noise_counts": [10**400]}}, calibration_section),
        ("calibration", {"lamp_drift": [1]}, calibration_section),
        ("poses", {"reprojection_error_px": {"overall": "1"}}, poses_section),
        ("poses", {"frames": 3}, poses_section),
    ):
        write_json(dataset.root / f"{name}.json", content)
        with pytest.raises(InputError, match=rf"{name}\.json: holds no"):
            section(dataset)
    with pytest.raises(InputError, match=r"comparison\.json: holds no comparison"):
        comparison_section({"curves": {"thresholds_m": [1.0]}}, run / "comparison.json")
    with pytest.raises(InputError, match="holds no traits"):
        traits_section({"settings": {}}, run / "traits.json")
    (tmp_path / "broken.json").write_text("{")
    for sources, sentence in (
        (ReportSources(traits=tmp_path / "broken.json"), r"broken\.json: is not a JSON object"),
        (ReportSources(comparison=run / "no.json"), r"no\.json: there is no such file"),
        (ReportSources(views=0), "at least 1"),
        (ReportSources(indices=("own = R1240",)), "1240 nm"),
        (ReportSources(calibrations=(run / "no.csv",)), r"no\.csv: cannot be read"),
    ):
        with pytest.raises(InputError, match=sentence):
            write_report(run, tmp_path / "report.html", sources)
    with pytest.raises(InputError, match=r"config\.yml"):
        write_report(tmp_path, tmp_path / "report.html", ReportSources())
    assert not (tmp_path / "report.html").exists()


def picked_mm(page):
    """Position of the last picked point."""
    return np.array(re.findall(r"-?[\d.]+", page.locator(".picked li").last.inner_text()), float)


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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


@pytest.mark.slow
@needs_browser
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
