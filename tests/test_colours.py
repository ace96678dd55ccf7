"""Colours of maps and curves as colour-blind readers see them, by Machado et al. 2009 (severity 1)."""

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb

from hsi_sc_nerf.plotting import ANGLE_COLOURS, COLOURS, INDEX_COLOURS

SEEN_AS = {
    "all cones": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]
)
PAGE = Path(__file__).parents[1] / "hsi_sc_nerf" / "report" / "templates" / "page.css"


def lab(rgb, seen_as):
    """CIE L*a*b* (D65) of colours (sRGB) as a reader sees them."""
    rgb = np.asarray(rgb, float)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(linear @ np.transpose(SEEN_AS[seen_as]), 0.0, 1.0) @ TO_XYZ.T / TO_XYZ.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


@pytest.mark.parametrize("seen_as", SEEN_AS)
@pytest.mark.parametrize("name", [INDEX_COLOURS, ANGLE_COLOURS])
def test_maps_grow_lighter_so_that_values_keep_their_order_without_colour(name, seen_as):
    lightness = lab(colormaps[name](np.arange(256))[:, :3], seen_as)[:, 0]
    assert (lightness[8:] > lightness[:-8]).all()
    assert np.ptp(lightness) > 60.0


@pytest.mark.parametrize("seen_as", SEEN_AS)
def test_curves_and_classes_differ_in_colour_for_every_reader(seen_as):
    """In pictures, and on the page in light, as in print, and in dark; a difference of 2.3 is just noticeable."""
    sets = [COLOURS, *re.findall(r"--s0: (#\w+); --s1: (#\w+); --s2: (#\w+);\s+--s3: (#\w+); --s4: (#\w+); "
                                 r"--s5: (#\w+); --s6: (#\w+)", PAGE.read_text(encoding="utf-8"))]  # fmt: skip
    assert len(sets) == 4
    for colours in sets:
        seen = lab([to_rgb(colour) for colour in colours], seen_as)
        assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 7.0
