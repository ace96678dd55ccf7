"""The documentation's pictures of pages in a browser: a run's report and the viewer, as a user has them.

    uv run python benchmarks/browser_pictures.py RUN --pictures docs/images
    uv run python benchmarks/browser_pictures.py RUN --cloud point_cloud.ply --only-object  # that card of the report

Needs playwright and Chromium. RUN is the folder of a trained run of an apple or a pear, with its dataset in place.
"""

from __future__ import annotations

import math
import re
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from headless_browser import launch

from hsi_sc_nerf.analysis.drawn_regions import PAGE_POINTS
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.report.build import object_section, write_report
from hsi_sc_nerf.report.page import html_page

REPORT_PX, VIEWER_PX, PHONE_PX = (1200, 1300), (1100, 900), (390, 844)
REGIONS = {"bruise": (0.415, 0.565, 0.1), "skin": (0.66, 0.62, 0.09)}
"""Circles that are drawn in the report: centre and radius as fractions of the drawing's width and height."""
ON_THE_OBJECT = (0.5, 0.33)
"""Point of the report's drawing that is clicked, likewise."""
CLICKED_PX = (390, 330)
"""Point of the viewer that is clicked."""
FIRST_PICTURE_S = 300
"""A picture at full size takes a minute or two on two cores."""
NOTHING = b'<svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>'


@dataclass(frozen=True)
class BrowserPictures:
    """Take both pictures of a run."""

    run: tyro.conf.Positional[Path]
    """Folder of the run, with its ``config.yml``."""
    cloud: Path | None = None
    """Point cloud of the run; without it, points are sampled from the model."""
    pictures: Path = Path("docs/images")
    """Folder of the pictures."""
    only_object: bool = False
    """Take only the report's card of the object, of --cloud, for which nothing is rendered; in dark mode and at a
    phone's width as well."""

    def main(self) -> None:
        """Write the report, start the viewer, and take a picture of each."""
        from playwright.sync_api import sync_playwright

        with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
            chromium, report = launch(playwright), Path(folder) / "report.html"
            if self.only_object and self.cloud is not None:
                card = object_section(read_spectral_ply(self.cloud), PAGE_POINTS)
                report.write_text(html_page("The report", "", {}, [card]), encoding="utf-8")
                self._report(chromium, report)
                return
            write_report(self.run, report, self.cloud)
            self._report(chromium, report)
            with viewer(self.run / "config.yml") as address:
                self._viewer(chromium, address)

    def _report(self, chromium: Any, report: Path) -> None:
        page = _page(chromium, REPORT_PX)
        page.goto(report.as_uri())
        canvas = page.locator("#cloud[data-state=ready] canvas")
        canvas.scroll_into_view_if_needed()
        box = canvas.bounding_box()

        def at(x: float, y: float) -> tuple[float, float]:
            return box["x"] + x * box["width"], box["y"] + y * box["height"]

        page.mouse.click(*at(*ON_THE_OBJECT))
        page.check("input[name=drawing]")
        for name, (x, y, radius) in REGIONS.items():
            turns = [2.0 * math.pi * step / 36 for step in range(37)]
            places = [at(x + radius * math.cos(turn), y + radius * math.sin(turn)) for turn in turns]
            page.mouse.move(*places[0])
            page.mouse.down()
            for place in places:
                page.mouse.move(*place)
            page.mouse.up()
            page.locator(".regions input:not([type])").last.fill(name)
            page.keyboard.press("Tab")
        page.uncheck("input[name=drawing]")
        page.evaluate("scrollTo(0, 0)")
        page.screenshot(path=self.pictures / "report.png")
        if self.only_object:
            page.emulate_media(color_scheme="dark")
            page.screenshot(path=self.pictures / "report_dark.png")
            page.set_viewport_size({"width": PHONE_PX[0], "height": PHONE_PX[1]})
            page.screenshot(path=self.pictures / "report_phone.png", full_page=True)

    def _viewer(self, chromium: Any, address: str) -> None:
        from playwright.sync_api import expect

        page = _page(chromium, VIEWER_PX)
        # The logo is on nerfstudio's server.
        page.route(re.compile(r"^https://"), lambda route: route.fulfill(body=NOTHING, content_type="image/svg+xml"))
        page.goto(address, wait_until="domcontentloaded")
        expect(page.get_by_label("Output type", exact=True)).to_have_value("rgb", timeout=1000 * FIRST_PICTURE_S)
        for label, name in (("Output type", "composite"), ("Composite", "CIR")):
            page.get_by_label(label, exact=True).click()
            page.get_by_role("option", name=name, exact=True).click()
        # The camera of a training view, where there is a measured spectrum.
        row = page.get_by_text("Training view", exact=True).locator("xpath=ancestor::div[2]")
        row.get_by_role("textbox").fill("1")
        page.keyboard.press("Enter")
        page.get_by_label("Click for spectrum").check()
        answer = page.get_by_text(re.compile(r"x -?[\d.]+, y .* mm, opacity"))
        for _ in range(FIRST_PICTURE_S):
            page.mouse.click(*CLICKED_PX)
            page.wait_for_timeout(1000)
            if answer.count():
                break
        answer.scroll_into_view_if_needed()
        page.wait_for_timeout(1000 * FIRST_PICTURE_S // 3)  # until the picture of full size is there
        page.screenshot(path=self.pictures / "viewer.png")


@contextmanager
def viewer(config: Path) -> Iterator[str]:
    """`ns-viewer` of a run, as long as it is looked at; its address."""
    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    words = ["--load-config", str(config), "--viewer.websocket-port", str(port)]
    with tempfile.TemporaryFile("w+") as log:
        command = Path(sys.executable).with_name("ns-viewer")
        process = subprocess.Popen([command, *words], stdout=log, stderr=subprocess.STDOUT)
        try:
            for _ in range(FIRST_PICTURE_S):
                with socket.socket() as tried:
                    tried.settimeout(1.0)
                    if tried.connect_ex(("localhost", port)) == 0:
                        break
                try:
                    process.wait(1.0)
                except subprocess.TimeoutExpired:
                    continue
                log.seek(0)
                raise SystemExit(f"ns-viewer ended: {log.read()[-2000:]}")
            yield f"http://localhost:{port}"
        finally:
            process.terminate()
            process.wait()


def _page(chromium: Any, size_px: tuple[int, int]) -> Any:
    page = chromium.new_page(viewport={"width": size_px[0], "height": size_px[1]}, reduced_motion="reduce")
    page.set_default_timeout(1000 * FIRST_PICTURE_S)
    return page


if __name__ == "__main__":
    tyro.cli(BrowserPictures).main()
