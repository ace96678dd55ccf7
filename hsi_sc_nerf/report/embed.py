"""Pictures inside the page, as data URIs."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup
from PIL import Image, UnidentifiedImageError

from hsi_sc_nerf.errors import InputError

WIDEST_PX = 1600
"""Wider pictures are made smaller: no screen shows more of them in a page."""
_QUALITY = 82


def embedded_array(image: UInt8[np.ndarray, "h w 3"], alt: str) -> Markup:
    """An ``img`` of an array, without loss; the page shows its pixels as squares."""
    return _img(Image.fromarray(np.ascontiguousarray(image)), alt, lossless=True, css_class="pixels")


def embedded_file(path: Path, alt: str) -> Markup:
    """An ``img`` of a picture file, made smaller where it is large.

    Raises:
        InputError: the file is no readable picture.
    """
    try:
        with Image.open(path) as opened:
            image = opened.convert("RGB")
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: is no readable picture ({error}); delete it, or make it again.") from error
    if image.width > WIDEST_PX:
        image = image.resize((WIDEST_PX, round(image.height * WIDEST_PX / image.width)), Image.Resampling.LANCZOS)
    return _img(image, alt, lossless=False, css_class="picture")


def _img(image: Image.Image, alt: str, lossless: bool, css_class: str) -> Markup:
    memory = io.BytesIO()
    image.save(memory, "WEBP", lossless=lossless, quality=_QUALITY)
    tag = Markup('<img class="{}" alt="{}" width="{}" height="{}" src="data:image/webp;base64,{}">')
    return tag.format(css_class, alt, image.width, image.height, base64.b64encode(memory.getvalue()).decode())
