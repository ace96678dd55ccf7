"""The page of all objects: complete, small, every text escaped; and working in a browser."""

import base64
import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import numpy as np
import pytest
from batch_folder import traits_of, write_object, write_season, write_sessions
from headless_browser import needs_browser, quiet_page
from PIL import Image

from hsi_sc_nerf.batch.columns import calibration_columns
from hsi_sc_nerf.batch.page import thumbnail, write_overview
from hsi_sc_nerf.batch.tables import read_table
from hsi_sc_nerf.cli.batch import CollectCommand
from hsi_sc_nerf.files import write_png

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}"
COUNT = 60


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    """Sixty objects; the last but one is far too large, the last one failed."""
    out = write_season(tmp_path_factory.mktemp("season"), COUNT)
    CollectCommand(out).main()
    return out


def picture_of(address):
    assert len(address) <= 6000
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))).convert("RGBA"))


def test_a_thumbnail_is_the_object_cut_out_and_brightened(tmp_path):
    write_object(tmp_path)
    picture = picture_of(thumbnail(tmp_path / "data"))
    assert picture.shape[0] == picture.shape[1] == 47  # the ball's 47 pixels, not enlarged
    assert picture[0, 0, 3] < 10
    expected = 255.0 * (np.array([90, 40, 30]) / 255.0) ** (1.0 / 2.2)
    np.testing.assert_allclose(picture[23, 23], [*expected, 255], atol=6)


def test_a_thumbnail_is_small_whatever_the_picture_and_empty_without_one(tmp_path):
    assert thumbnail(tmp_path) == ""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"\x89PNG damaged")
    assert thumbnail(tmp_path) == ""
    noise = np.random.default_rng(0).integers(0, 256, (300, 400, 3), np.uint8)
    write_png(tmp_path / "images" / "b.png", noise)
    assert picture_of(thumbnail(tmp_path)).shape[:2] == (60, 80)
    write_png(tmp_path / "images" / "b.png", noise[:80, :80])
    assert picture_of(thumbnail(tmp_path)).shape[:2] == (80, 80)


def test_the_page_needs_nothing_else_and_texts_from_outside_stay_texts(tmp_path):
    write_sessions(tmp_path, [("a", "s", HOSTILE), ("ä", "s", "")], ("object", "session", HOSTILE))
    write_object(tmp_path / "objects" / "a", traits_of(regions=(HOSTILE,)), "report", HOSTILE)
    write_object(tmp_path / "objects" / "ä")
    text = write_overview(read_table(tmp_path), tmp_path).read_text(encoding="utf-8")
    assert "<img src=x" not in text
    assert text.count("</script>") == 2
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|WebSocket|innerHTML|insertAdjacent", text)
    assert set(re.findall(r"[a-z]+://[^\s\"'<]+", text)) <= {"http://www.w3.org/2000/svg"}
    payload = json.loads(re.search(r'id="objects">(.*?)</script>', text, re.DOTALL)[1])
    assert payload["reports"] == [None, "objects/%C3%A4/report.html"]
    assert payload["columns"][2]["label"] == HOSTILE


@pytest.mark.parametrize("unit", ["", "mL", "%", "mg/g", "g/100 g"])
def test_a_label_leaves_out_the_whole_unit(tmp_path, unit):
    write_sessions(tmp_path, [("a", "s")], ("object", "session"))
    write_object(tmp_path / "objects" / "a")
    table, found = read_table(tmp_path), calibration_columns("dry matter", unit)
    table = replace(table, columns=(*table.columns, *found), rows=[[*row, 1.0, 0.1] for row in table.rows])
    text = write_overview(table, tmp_path).read_text(encoding="utf-8")
    payload = json.loads(re.search(r'id="objects">(.*?)</script>', text, re.DOTALL)[1])
    assert [one["label"] for one in payload["columns"][-2:]] == ["dry matter", "dry matter sd"]


def names(page):
    return page.locator("tbody th").all_inner_texts()


def column(page, title):
    """Texts of a column of the table."""
    titles = page.locator("thead th").all_inner_texts()
    at = [one.strip(" ↑↓") for one in titles].index(title)
    return page.locator(f"tbody tr > :nth-child({at + 1})").all_inner_texts()


def rows_of(out):
    with (out / "traits.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def odd_ones(rows, trait, group=None):
    """Names of the outliers, slowly, by the printed rule."""
    found = set()
    for value in {row[group] if group else "" for row in rows}:
        some = [row for row in rows if row[trait] and (not group or row[group] == value)]
        numbers = np.array([float(row[trait]) for row in some])
        middle = np.median(numbers)
        far = 3.5 * 1.4826 * np.median(np.abs(numbers - middle))
        found |= {row["object"] for row, number in zip(some, numbers, strict=True) if abs(number - middle) > far > 0}
    return found


@pytest.mark.slow
@needs_browser
def test_sorting_by_mouse_and_keyboard_with_missing_values_last(browser, season):
    with quiet_page(browser, season / "index.html", viewport={"width": 1300, "height": 900}) as page:
        listed = [row["object"] for row in rows_of(season)]
        assert names(page) == listed
        # Each name stands in its own cell, not over the next one.
        right = "(all) => all.map((one) => one.getBoundingClientRect().right)"
        ends = zip(
            page.locator("tbody th .object > span").evaluate_all(right),
            page.locator("tbody th").evaluate_all(right),
            strict=True,
        )
        assert all(of_name < of_cell for of_name, of_cell in ends)
        volumes = {row["object"]: float(row["volume_ml"] or "nan") for row in rows_of(season)}
        page.click("thead button:text('volume, mL')")
        up = sorted(listed[:-1], key=volumes.get)
        assert names(page) == [*up, listed[-1]]
        page.keyboard.press("Enter")  # the button keeps the focus
        assert names(page) == [*reversed(up), listed[-1]]
        assert page.locator("thead [aria-sort=descending]").inner_text().startswith("volume, mL")
        assert column(page, "volume, mL")[0] == "▲ 400.0 ± 2.0"
        page.click("thead button:text('object')")
        assert names(page) == listed
        # On paper each sheet has the heads of the columns, whose words are whole.
        page.emulate_media(media="print")
        style = "one => [getComputedStyle(one).breakInside, getComputedStyle(one.querySelector('th')).overflowWrap]"
        assert page.locator("thead").evaluate(style) == ["avoid", "break-word"]


@pytest.mark.slow
@needs_browser
def test_search_and_choices_leave_rows_and_points_out(browser, season):
    with quiet_page(browser, season / "index.html", viewport={"width": 1300, "height": 900}) as page:
        page.fill("input[name=words]", "PEAR_05 focus")
        assert names(page) == [f"pear_05{i}" for i in range(10)]
        assert page.locator("[name=count]").inner_text() == f"10 of {COUNT} shown"
        assert page.locator("#scatter .point").count() == 9  # one failed
        page.click("button[type=reset]")
        page.select_option(".facets label:has-text('day') select", "=7")
        assert set(column(page, "day")) == {"7"}
        page.click("button[type=reset]")
        page.select_option(".facets label:has-text('status') select", "=failed")
        assert names(page) == [f"pear_{COUNT - 1:03d}"]
        assert column(page, "status") == ["failed (process) f_07.raw: is 12 bytes too short; copy it again."]
        assert page.locator("#scatter .missing").is_visible()
        page.fill("input[name=words]", "no such words")
        assert names(page) == []


@pytest.mark.slow
@needs_browser
def test_numbers_of_the_user_are_shown_as_they_are(browser, tmp_path):
    """A date and the number of a tag are not rounded as a trait is."""
    dates, tags = ["20261123", "20261125"], ["4.00123456", "123456.75"]
    write_sessions(tmp_path, [*zip("ab", "ss", dates, tags, strict=True)], ("object", "session", "date", "tag"))
    for name in "ab":
        write_object(tmp_path / "objects" / name)
    CollectCommand(tmp_path).main()
    with quiet_page(browser, tmp_path / "index.html") as page:
        assert (column(page, "date"), column(page, "tag")) == (dates, tags)
        assert column(page, "volume, mL")[0].startswith("250.0 ±")
        page.select_option("select[name=x]", label="date")
        told = page.locator("#scatter .point").all_text_contents()
        assert [one for date in dates for one in told if date in one] == told


@pytest.mark.slow
@needs_browser
def test_groups_have_strips_medians_and_outliers_of_their_own(browser, season):
    with quiet_page(browser, season / "index.html", viewport={"width": 1300, "height": 900}) as page:
        rows = rows_of(season)
        for group in (None, "genotype", "day"):
            page.select_option("select[name=group]", label=group or "all objects")
            page.select_option("select[name=y]", label="volume, mL")
            told = page.locator(".outliers a").all_inner_texts()
            assert {one.split()[0] for one in told} == odd_ones(rows, "volume_ml", group)
            marked = page.locator("tbody tr:has(td .odd)").locator("th").all_inner_texts()
            assert set(marked) == odd_ones(rows, "volume_ml", group) | odd_ones(rows, "ndvi", group)
        assert "pear_058 ▲" in told
        page.select_option("select[name=group]", label="genotype")
        volumes = [float(row["volume_ml"]) for row in rows if row["genotype"] == "A"]
        titles = page.locator("#distribution svg > text:not(.tick)").all_text_contents()
        assert titles == [f"A (30, median {np.median(volumes):.4g})", titles[1]]
        assert titles[1].startswith("B (29, ")
        assert page.locator("#distribution .point").count() == COUNT - 1


@pytest.mark.slow
@needs_browser
def test_points_of_the_scatter_lie_where_their_traits_are(browser, season):
    with quiet_page(browser, season / "index.html", viewport={"width": 1300, "height": 900}) as page:
        page.select_option("select[name=x]", label="volume, mL")
        page.select_option("select[name=up]", label="ndvi")
        page.select_option("select[name=group]", label="genotype")
        rows = {row["object"]: row for row in rows_of(season) if row["volume_ml"]}
        read = "all => all.map((one) => [one.textContent, one.getAttribute('transform'), one.getAttribute('fill')])"
        points = page.locator("#scatter .point").evaluate_all(read)
        assert len(points) == COUNT - 1
        objects = [rows[text.split(":")[0]] for text, _, _ in points]
        places = np.array([re.findall(r"-?[\d.]+", moved) for _, moved, _ in points], float)
        for axis, (trait, sign) in enumerate((("volume_ml", 1.0), ("ndvi", -1.0))):
            values = np.array([float(row[trait]) for row in objects])
            assert sign * np.corrcoef(values, places[:, axis])[0, 1] > 0.9999
        colours = {(row["genotype"], colour) for row, (_, _, colour) in zip(objects, points, strict=True)}
        assert colours == {("A", "var(--s0)"), ("B", "var(--s1)")}
        assert page.locator(".legend li").all_inner_texts() == ["A (30)", "B (29)"]
        assert page.locator("#scatter .ring").count() >= 1


@pytest.mark.slow
@needs_browser
def test_rows_and_points_lead_to_reports_and_columns_can_be_switched(browser, season):
    page = browser.new_page()
    for link in ("tbody a", "#scatter a"):
        page.goto((season / "index.html").as_uri())
        page.locator(link).first.click()
        page.wait_for_url("**/report.html")
        assert page.title() == "report of pear_000"
    page.goto((season / "index.html").as_uri())
    assert page.locator("tbody tr").last.locator("a").count() == 0  # it failed
    page.click("summary")
    page.locator("label", has_text="train memory, MiB").locator("input").check()
    assert column(page, "train memory, MiB")[0] == "300"
    page.close()


@pytest.mark.slow
@needs_browser
def test_who_comes_back_from_a_report_finds_the_page_as_it_was(browser, season):
    """The browser puts the controls back; the rows, columns and charts must be those that they say."""
    page = browser.new_page()
    page.goto((season / "index.html").as_uri())
    page.fill("input[name=words]", "pear_05")
    page.select_option(".facets label:has-text('genotype') select", "=A")
    page.select_option("select[name=y]", label="ndvi")
    page.click("summary")
    page.locator("label", has_text="train memory, MiB").locator("input").check()
    for _ in range(2):
        page.click("thead button:text('volume, mL')")
    read = "() => ['table', '#distribution', '[name=count]'].map((one) => document.querySelector(one).textContent)"
    before = page.evaluate(read)
    assert page.locator("tbody tr").count() == 5
    page.locator("tbody a").first.click()
    page.wait_for_url("**/report.html")
    page.go_back()
    page.wait_for_url("**/index.html")
    page.locator("tbody tr").first.wait_for()
    assert page.evaluate(read) == before
    page.close()


@pytest.mark.slow
@needs_browser
def test_hostile_names_are_shown_and_do_nothing(browser, tmp_path):
    write_sessions(tmp_path, [("ä", "s", HOSTILE), ("b", "s", "x")], ("object", "session", HOSTILE))
    write_object(tmp_path / "objects" / "ä", traits_of(regions=(HOSTILE,)))
    write_object(tmp_path / "objects" / "b", failed="train", sentence=HOSTILE)
    CollectCommand(tmp_path).main()
    with quiet_page(browser, tmp_path / "index.html") as page:
        page.select_option("select[name=group]", label=HOSTILE)
        assert names(page) == ["ä", "b"]
        assert HOSTILE in column(page, "status")[1]
        assert page.locator("img[src=x]").count() == 0
        assert page.locator("#distribution svg > text", has_text=f"{HOSTILE} (1").count() == 1
        page.click("summary")
        page.locator("label", has_text=re.compile("class .* mixture fraction")).locator("input").first.check()
        link = page.locator("tbody a").first.evaluate("link => link.href")
        assert Path(url2pathname(urlparse(link).path)) == tmp_path / "objects" / "ä" / "report.html"


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_scrolls_the_table_and_not_the_page(browser, season, scheme):
    window = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "color_scheme": scheme}
    with quiet_page(browser, season / "index.html", **window) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        page.locator(".scrolled").evaluate("one => one.scrollTo(600, 400)")
        box = page.locator("tbody th").nth(8).bounding_box()
        assert 0 <= box["x"] < 40  # the name stays beside its numbers
        assert box["width"] < 180


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("count", [1, 1000])
def test_one_and_a_thousand_objects_can_be_looked_at(browser, tmp_path, count):
    write_sessions(tmp_path, [(f"a{i}", "s", str(i % 200), "x") for i in range(count)])
    for number in range(min(count, 3)):
        write_object(tmp_path / "objects" / f"a{number}")
    CollectCommand(tmp_path).main()
    assert (tmp_path / "index.html").stat().st_size < 1_000_000
    with quiet_page(browser, tmp_path / "index.html") as page:
        assert page.locator("tbody tr").count() == count
        page.select_option("select[name=group]", label="genotype")
        page.click("thead button:text('status')")
        assert page.locator("tbody tr").first.inner_text().split()[0] == "a0"
