"""The bar in the viewer's picture, seen through a pinhole as a browser sees it."""

from types import SimpleNamespace

import numpy as np
import pytest
from viser.transforms import SO3

from hsi_sc_nerf.viewer.scale_bar import draw_scale_bar, round_length, scale_bar

CENTRE, UNITS_PER_M = np.array([0.3, -0.2, 0.5]), 37.0


def camera_at(distance_m, aspect=1.5, turn=(0.4, -1.3, 2.1), fov=0.6, aside=0.1):
    """A camera that has the object's centre at this depth, a little beside the middle of its picture."""
    rotation = SO3.exp(np.array(turn))
    right, _, ahead = rotation.as_matrix().T
    position = CENTRE - UNITS_PER_M * (distance_m * ahead + aside * distance_m * right)
    return SimpleNamespace(position=position, wxyz=rotation.wxyz, fov=fov, aspect=aspect)


def picture_of(camera, points):
    """Places in a picture whose upper and lower edges are at -1 and 1, and depths."""
    seen = (points - camera.position) @ SO3(camera.wxyz).as_matrix()
    return seen[:, :2] / (seen[:, 2:] * np.tan(camera.fov / 2.0)), seen[:, 2]


@pytest.mark.parametrize(
    ("longest", "length"), [(0.0199, 0.01), (0.02, 0.02), (0.0499, 0.02), (0.7, 0.5), (1.0, 1.0), (3e-4, 2e-4)]
)
def test_lengths_are_1_2_and_5_times_powers_of_ten(longest, length):
    assert round_length(longest) == length


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.2])
@pytest.mark.parametrize("distance_m", [0.02, 0.31, 0.45, 9.0])
def test_the_bar_is_as_long_in_the_picture_as_its_length_at_the_objects_centre(distance_m, aspect):
    camera = camera_at(distance_m, aspect)
    length_m, ends = scale_bar(camera, CENTRE, UNITS_PER_M)
    right = SO3(camera.wxyz).as_matrix()[:, 0]
    (start, end), depths = picture_of(camera, ends)
    (left_end, right_end), _ = picture_of(camera, np.stack([CENTRE, CENTRE + length_m * UNITS_PER_M * right]))
    np.testing.assert_allclose(end - start, right_end - left_end, atol=1e-9)
    # In the lower left corner, before the object, and of a size that is read with ease.
    assert -aspect < start[0] < end[0] < 0.0
    assert 0.5 < start[1] < 1.0
    assert (depths < 0.5 * distance_m * UNITS_PER_M).all()
    assert 0.2 <= (end - start)[0] / min(1.0, aspect) <= 0.5


class Browser:
    """What a browser shows of the bar."""

    def __init__(self, camera):
        self.camera, self.shown = camera, {}
        self.scene = SimpleNamespace(add_spline_catmull_rom=self.add, add_label=self.add)

    def add(self, name, what, **options):
        self.shown[name] = (what, options)


def test_the_bar_follows_the_camera_and_goes_where_the_object_is_behind_it():
    browser = Browser(camera_at(0.45))
    draw_scale_bar(browser, CENTRE, UNITS_PER_M)
    *lines, (text, label) = browser.shown.values()
    _, ends = scale_bar(browser.camera, CENTRE, UNITS_PER_M)
    assert text == "50 mm"
    np.testing.assert_allclose(label["position"], ends.mean(axis=0))
    dark, light = (line[0] for line in lines)
    np.testing.assert_allclose(dark, ends)
    # The light line lies on the dark one: at the same pixels of the picture, before it.
    pixels, depths = zip(*(picture_of(browser.camera, line) for line in (dark, light)), strict=True)
    np.testing.assert_allclose(*pixels, atol=1e-9)
    assert (depths[1] < depths[0]).all()
    others = {
        "10 mm": [camera_at(0.1)],
        "": [camera_at(-0.45), camera_at(0.45, aspect=0.0), camera_at(0.45, aspect=np.nan)],
    }
    for expected, cameras in others.items():
        for browser.camera in cameras:
            draw_scale_bar(browser, CENTRE, UNITS_PER_M)
            assert browser.shown["/scale_bar/length"][0] == expected
            assert {options["visible"] for _, options in browser.shown.values()} == {bool(expected)}
    assert len(browser.shown) == 3
