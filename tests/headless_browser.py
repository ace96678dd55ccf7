"""Chromium without a screen, where one is installed, for the tests that look at pages as users do."""

import shutil
from contextlib import contextmanager

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no browser")


def launch(playwright):
    """A browser that draws WebGL in software, and is given time on a busy machine."""
    return playwright.chromium.launch(
        executable_path=CHROMIUM,
        args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        timeout=120_000,
    )


@contextmanager
def quiet_page(browser, path, **window):
    """A file in a window of its own; it must say nothing on the console and fetch nothing."""
    page = browser.new_page(reduced_motion="reduce", **window)
    page.set_default_timeout(120_000)
    messages, requests = [], []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    yield page
    assert messages == []
    assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [path.as_uri()]
    page.close()
