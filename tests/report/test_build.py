"""The report as a page: complete, without anything to fetch, with every text escaped; and working in a browser."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from headless_browser import launch, needs_browser

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.ply import SpectralCloud, write_spectral_ply
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.report import build
from hsi_sc_nerf.report.build import ReportSources, write_report
from hsi_sc_nerf.report.held_out_views import HeldOutView, inner_places, place_spectra, score_view
from hsi_sc_nerf.report.result_sections import comparison_section, trait_rows, traits_section
from hsi_sc_nerf.report.run_sections import settings_section

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&{{ 7 * 7 }}"
SECTIONS = ["object", "views", "bands", "spectra", "comparison", "traits", "training"]
SECTIONS += ["calibration", "masks", "poses", "settings"]
COMPARISON = {
    "scores": {
        name: {"threshold_m": at, "precision": 95.0, "recall": 97.5, "f_score": 96.25}
        for name, at in (("chosen", 0.002), ("knee", 0.0015))
    },
    "cloud_to_reference": {"mean_m": 1e-3, "median_m": 9e-4, "rms_m": 1.23e-3, "percentile_95_m": 2e-3},
    "curves": {"thresholds_m": [0, 0.002], "precision": [0, 95], "recall": [0, 97], "f_score": [0, 96]},
}
TRAITS = {
    "settings": {"depth": 8},
    "size": {"area_m2": 0.0229, "volume_l": 0.25},
    "size_sd": {"area_m2": 0.0001, "volume_l": 0.002},
    "watertight": True,
    "classes": {"areas_m2": {HOSTILE: 0.0004, "rot_l": 0.0001}, "regions": [{"label": "bruise", "area_m2": 0.0004}]},
    "regions": {
        "whole": {"indices": {"NDVI": {"mean": 0.5, "sd": None}}},
        "mean": {"area_m2": 0.0003, "indices": {"NDVI": {"mean": 0.4, "sd": 0.1}}},
        "mean_sd": {"area_m2": 0.0002},
    },
    "firmness": {"value": 12.5, "unit": "N", "uncertainty": 0.5},
}


def held_out_view(dataset, index):
    frame = dataset.frames[index]
    measured, valid = (torch.from_numpy(part) for part in unpack(frame.cube()))
    rendered, mask = measured + 0.01, torch.from_numpy(frame.mask())
    places = place_spectra(
        measured.numpy(), rendered.numpy(), frame.mask(), inner_places(frame.mask(), 4, 2), 2.0, valid.numpy()
    )
    rgb = frame.pseudo_rgb()
    return HeldOutView(score_view(HOSTILE, rendered, measured, mask, valid), rgb, rgb, places)


def ball(wavelengths_nm, count=4000):
    """A ball whose northern half has twice the reflectance of its southern."""
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shape = np.linspace(0.2, 0.4, len(wavelengths_nm))
    spectra = np.where(normals[:, 2:] > 0, 2.0, 1.0) * shape
    colours = np.full((count, 3), 128, np.uint8)
    return SpectralCloud(0.03 * normals, normals, colours, spectra, wavelengths_nm)


@pytest.fixture
def run(flagged_dataset, tmp_path, monkeypatch):
    """A run's folder with a cloud; its model is not opened, its views are not rendered."""
    dataset = replace(open_packed(flagged_dataset), object_name=HOSTILE)
    write_spectral_ply(tmp_path / "point_cloud.ply", ball(dataset.wavelengths_nm))
    views = [held_out_view(dataset, index) for index in (2, 7)]
    opened = SimpleNamespace(dataset=dataset, manager=SimpleNamespace(eval_dataset=views))
    monkeypatch.setattr(build, "_opened", lambda folder: opened)
    monkeypatch.setattr(build, "_rendered", lambda run, count: views[:count])
    settings = settings_section({"name": HOSTILE}, {"name": "default"}, {"python": "3"})
    monkeypatch.setattr(build, "_settings", lambda folder: settings)
    return tmp_path


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


def check_page(text):
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
    return page


@pytest.mark.slow
def test_a_run_without_comparison_traits_and_logs(run):
    write_report(run, run / "report.html", ReportSources())
    text = (run / "report.html").read_text(encoding="utf-8")
    check_page(text)
    for command in ("hsi-sc-nerf compare", "hsi-sc-nerf traits", "ns-train"):
        assert f"run <code>{command}" in text
    assert sorted(path.name for path in run.iterdir()) == ["point_cloud.ply", "report.html"]


@pytest.mark.slow
def test_names_from_outside_stay_text(run):
    (run / "comparison.json").write_text(json.dumps(COMPARISON))
    (run / "traits.json").write_text(json.dumps(TRAITS))
    write_report(run, run / "report.html", ReportSources())
    text = (run / "report.html").read_text(encoding="utf-8")
    page = check_page(text)
    assert "<img src=x" not in text
    assert text.count("{{ 7 * 7 }}") > 3
    assert "49" not in text.split("<main>")[0].split("<body>")[1]
    assert len(page.all("script")) == 2
    for shown in ("96.2 %", "F-score at 2.0 mm", "1.230", "0.0229", "12.5"):
        assert shown in text


def test_traits_are_entries_with_their_units_and_spreads():
    rows = {row[0]: row[1:] for row in trait_rows({k: v for k, v in TRAITS.items() if k != "settings"})}
    assert rows["size, area"] == ("0.0229", "0.0001", "m²")
    assert rows["size, volume"] == ("0.25", "0.002", "L")
    assert rows["watertight"] == ("yes", "", "")
    assert rows[f"classes, areas, {HOSTILE}"] == ("0.0004", "", "m²")
    assert rows["classes, regions, bruise 1, area"] == ("0.0004", "", "m²")
    assert rows["regions, whole, indices, NDVI"] == ("0.5", "", "")
    # A user's names are names, though they look like our words.
    assert rows["classes, areas, rot_l"] == ("0.0001", "", "m²")
    assert rows["regions, mean, area"] == ("0.0003", "", "m²")
    assert rows["regions, mean, indices, NDVI"] == ("0.4", "0.1", "")
    assert rows["regions, mean_sd, area"] == ("0.0002", "", "m²")
    assert rows["firmness"] == ("12.5", "0.5", "N")
    assert not any("size sd" in name for name in rows)


def test_files_that_are_something_else_are_refused_and_nothing_is_written(run):
    with pytest.raises(InputError, match=r"comparison\.json: is no comparison"):
        comparison_section({"curves": {"thresholds_m": [1.0]}}, run / "comparison.json")
    with pytest.raises(InputError, match="holds no traits"):
        traits_section({"settings": {}}, run / "traits.json")
    (run / "traits.json").write_text("{")
    for sources, sentence in (
        (ReportSources(), r"traits\.json: is no readable JSON"),
        (ReportSources(comparison=run / "no.json"), r"no\.json: there is no such file"),
        (ReportSources(views=0), "at least 1"),
    ):
        with pytest.raises(InputError, match=sentence):
            write_report(run, run / "report.html", sources)
    assert not (run / "report.html").exists()


@pytest.mark.slow
@needs_browser
def test_the_object_turns_and_tells_its_spectra_in_a_browser(run):
    """No message in the console, colours that follow from the numbers, the spectrum of the point under a click."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright")
    write_report(run, run / "report.html", ReportSources())
    with sync_api.sync_playwright() as playwright:
        browser = launch(playwright)
        page = browser.new_page(viewport={"width": 700, "height": 600}, reduced_motion="reduce")
        page.set_default_timeout(120_000)
        messages, requests = [], []
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto((run / "report.html").as_uri())
        assert page.locator("#cloud").get_attribute("data-state") == "ready"
        canvas = page.locator("#cloud canvas")
        canvas.scroll_into_view_if_needed()
        page.select_option("select[name=shown]", "band 0")

        def colour_at(x, y):
            """Of the drawing, at shares of its width and height."""
            read = """(canvas, [x, y]) => { const pixel = new Uint8Array(4), gl = canvas.getContext("webgl");
                gl.readPixels(x * canvas.width, (1 - y) * canvas.height, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
                return [...pixel]; }"""
            return canvas.evaluate(read, [x, y])

        def click(x, y):
            box = canvas.bounding_box()
            page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])

        # Viridis at its end for the bright half, at its middle for the other; nothing beside the ball.
        np.testing.assert_allclose(colour_at(0.5, 0.25), [253, 231, 37, 255], atol=12)
        np.testing.assert_allclose(colour_at(0.5, 0.65), [33, 145, 140, 255], atol=12)
        assert colour_at(0.02, 0.02)[3] == 0

        click(0.5, 0.65)
        click(0.02, 0.02)
        assert page.locator(".picked li").count() == 1
        place = [float(word) for word in re.findall(r"-?[\d.]+", page.locator(".picked li").inner_text())]
        assert np.linalg.norm(place) == pytest.approx(30.0, abs=0.2)
        assert place[2] < 0.0
        with page.expect_download() as download:
            page.click("button[name=save]")
        saved = np.loadtxt(download.value.path(), delimiter=",", skiprows=1)
        np.testing.assert_allclose(saved[:, 1], np.linspace(0.2, 0.4, len(saved)), atol=2e-3)
        before = canvas.screenshot()
        canvas.press("ArrowUp")
        assert canvas.screenshot() != before
        assert messages == []
        assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [(run / "report.html").as_uri()]
        browser.close()
