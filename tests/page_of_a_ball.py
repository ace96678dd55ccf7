"""A ball on the report's page, and what a user does with it in a browser."""

from contextlib import contextmanager

import numpy as np
from headless_browser import quiet_page

from hsi_sc_nerf.export.cloud import SpectralCloud


def ball(wavelengths_nm, count=4000):
    """A ball of evenly spread points whose northern half has twice the reflectance of its southern."""
    z, azimuth = 1.0 - 2.0 * (np.arange(count) + 0.5) / count, np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    wide = np.sqrt(1.0 - z**2)
    normals = np.stack([wide * np.cos(azimuth), wide * np.sin(azimuth), z], axis=-1)
    shape = np.linspace(0.2, 0.4, len(wavelengths_nm))
    spectra = np.where(normals[:, 2:] > 0, 2.0, 1.0) * shape
    colours = np.full((count, 3), 128, np.uint8)
    return SpectralCloud(0.03 * normals, normals, colours, spectra, wavelengths_nm)


@contextmanager
def opened(browser, report, **window):
    """The report in a window of its own, with the object drawn."""
    with quiet_page(browser, report, **window) as page:
        assert page.locator("#cloud").get_attribute("data-state") == "ready"
        yield page


def colour_at(page, x, y):
    """Of the drawing, at fractions of its width and height."""
    read = """(canvas, [x, y]) => { const pixel = new Uint8Array(4), gl = canvas.getContext("webgl");
        gl.readPixels(x * canvas.width, (1 - y) * canvas.height, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
        return [...pixel]; }"""
    return page.locator("#cloud canvas").evaluate(read, [x, y])


def go_round(page, x, y, radius):
    """Draw a circle on the object, at fractions of the drawing's size."""
    canvas = page.locator("#cloud canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    for step, (right, down) in enumerate(zip(np.cos(turn), np.sin(turn), strict=True)):
        page.mouse.move(
            box["x"] + (x + radius * right) * box["width"], box["y"] + (y + radius * down) * box["height"]
        )
        if step == 0:
            page.mouse.down()
    page.mouse.up()
