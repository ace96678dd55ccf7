"""Colours and charts of the viewer, and which measured pixels rays meet."""

import matplotlib
import numpy as np
import pytest
import torch
from viser.transforms import SO3

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.plotting import BLANK, coloured
from hsi_sc_nerf.viewer.drawings import colour_bar, inline_image, spectra_plot
from hsi_sc_nerf.viewer.training_views import angle_to_measured, frame_pixels

LENS = PinholeIntrinsics(w=40, h=30, fl_x=50.0, fl_y=60.0, cx=19.0, cy=16.0)
STRAIGHT = (0.0, 0.0, 0.0, 0.0)


def test_colours_are_those_of_the_map_at_its_range(device):
    values = torch.tensor([[0.5, 0.9015, 1.3], [torch.nan, -9.0, 9.0]], device=device)
    table = matplotlib.colormaps["viridis"]
    expected = [[table(0)[:3], table(128)[:3], table(255)[:3]], [BLANK, table(0)[:3], table(255)[:3]]]
    np.testing.assert_allclose(coloured(values, (0.5, 1.3), "viridis").cpu(), expected, atol=1e-6)


def rays_through(lens, lines, samples):
    """OpenGL directions in the camera's frame through the middle of pixels."""
    x = (samples + 0.5 - lens.cx) / lens.fl_x
    y = (lines + 0.5 - lens.cy) / lens.fl_y
    return torch.stack([x, -y, -torch.ones_like(x)], dim=-1)


def test_rays_meet_the_pixels_that_they_were_made_from(device):
    lines, samples = torch.meshgrid(torch.arange(-3, 33), torch.arange(-3, 43), indexing="ij")
    rotation = torch.from_numpy(SO3.exp(np.array([0.3, -1.1, 2.0])).as_matrix()).float()
    directions = 3.0 * rays_through(LENS, lines, samples) @ rotation.T
    pixels, seen = frame_pixels(directions.to(device), rotation.to(device), LENS, STRAIGHT)
    np.testing.assert_array_equal(pixels.cpu()[..., 0], lines)
    np.testing.assert_array_equal(pixels.cpu()[..., 1], samples)
    np.testing.assert_array_equal(seen.cpu(), (lines >= 0) & (lines < 30) & (samples >= 0) & (samples < 40))
    assert not frame_pixels(-directions.to(device), rotation.to(device), LENS, STRAIGHT)[1].any()


def test_angle_to_measured_is_that_of_two_spectra_where_seen_and_valid(device):
    angles = torch.linspace(0.0, 1.0, 6).reshape(2, 3)
    rendered = torch.stack([angles.cos(), angles.sin(), torch.zeros(2, 3)], dim=-1)
    seen = torch.tensor([[True, False, True], [True, True, False]])
    measured = torch.tensor([2.0, 0.0, 0.0]).repeat(4, 1)
    measured[1, 2], valid = 77.0, torch.ones(4, 3, dtype=torch.bool)
    valid[1, 2] = False  # another band's number is no measurement
    valid[2, :2] = False  # one band left: no angle
    result = angle_to_measured(*(t.to(device) for t in (rendered, measured, valid, seen)))
    np.testing.assert_allclose(result.cpu(), [[0.0, np.nan, 0.4], [np.nan, 0.8, np.nan]], atol=1e-6)


@pytest.mark.slow
def test_drawings_are_pictures_in_markdown():
    wavelengths_nm = np.linspace(400.0, 1000.0, 7)
    plot = spectra_plot(wavelengths_nm, {"rendered": np.full(7, 0.5), "measured": np.full(7, np.nan)}, "a point")
    for png in (plot, colour_bar((0.0, 0.2), "magma", "angle")):
        assert png.startswith(b"\x89PNG")
        assert inline_image(png, "text").startswith("![text](data:image/png;base64,iVBOR")


def test_bands_in_any_order_make_one_line():
    nm, spectrum, order = np.linspace(400.0, 700.0, 4), np.array([0.1, 0.4, 0.3, 0.6]), np.array([2, 0, 3, 1])
    shuffled = spectra_plot(nm[order], {"here": spectrum[order]}, "one")
    assert shuffled == spectra_plot(nm, {"here": spectrum}, "one")
