"""Chromium without a screen, where one is installed, for the tests that look at pages as users do."""

import shutil

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
