from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.even_points import even_points
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.regions import chosen_bands, in_box, in_cylinder

WAVELENGTHS_NM = np.linspace(400.0, 1000.0, 204)


def test_bands_by_wavelength_and_by_range() -> None:
    np.testing.assert_array_equal(chosen_bands(WAVELENGTHS_NM, ()), np.arange(204))
    chosen = WAVELENGTHS_NM[chosen_bands(WAVELENGTHS_NM, ("670", "500-510", "505"))]
    assert np.abs(chosen[-1] - 670) < 1.5
    inside = (WAVELENGTHS_NM >= 500) & (WAVELENGTHS_NM <= 510)
    np.testing.assert_array_equal(chosen[:-1], WAVELENGTHS_NM[inside])
    assert (np.diff(chosen) > 0).all()


@pytest.mark.parametrize(
    ("word", "message"),
    [("red", "neither a wavelength"), ("1200", "--bands 1200 needs a band"), ("700-600", "none lies")],
)
def test_bands_that_are_not_there(word: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        chosen_bands(WAVELENGTHS_NM, (word,))


def test_box_and_cylinder() -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 1.0], [0.4, 0.4, 0.5], [0.0, 0.0, 1.1]])
    box = np.array([[0.0, 0.0, 0.0], [0.45, 0.5, 1.0]])
    np.testing.assert_array_equal(in_box(points, box), [True, False, True, True, False])
    np.testing.assert_array_equal(in_cylinder(points, (0.0, 0.0), 0.5, (0.0, 1.0)), [True, True, True, False, False])
    np.testing.assert_array_equal(
        in_cylinder(points, (0.4, 0.4), 0.1, (0.0, 1.0)), [False, False, False, True, False]
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obb_center": (0, 0, 0)}, "belong together"),
        ({"roi_box": (0, 0, 1, 1, 1, 0)}, "--roi-box"),
        ({"roi_cylinder": (0, 0, 0, 0, 1)}, "--roi-cylinder"),
        ({"roi_cylinder": (0, 0, 1, 1, 1)}, "--roi-cylinder"),
        ({"num_points": 0}, "--num-points"),
    ],
)
def test_options_that_contradict_each_other(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CloudOptions(**options)


def test_nerfstudios_options_become_ours() -> None:
    stock = SimpleNamespace(
        num_points=7, std_ratio=2.0, normal_method="open3d", save_world_frame=True, load_config="x"
    )
    options = CloudOptions.from_nerfstudio(stock)
    assert (options.num_points, options.std_ratio, options.normal_method) == (7, 2.0, "open3d")
    assert options.keep_turntable is False


class Rows:
    """Points that can be picked."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = points

    def __len__(self) -> int:
        return len(self.points)

    def select(self, keep: np.ndarray) -> Rows:
        return Rows(self.points[keep])


# Two squares in the plane, the second of nine times the area, cut unevenly into triangles.
VERTICES = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [5, 0, 0], [5, 3, 0], [2, 3, 0], [2.2, 0.1, 0]], float
)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 8], [5, 6, 8], [6, 7, 8], [7, 4, 8]])


def test_as_many_points_as_asked_for_evenly_over_what_is_kept() -> None:
    parts = even_points(VERTICES, TRIANGLES, 9000, lambda p: Rows(p[(p[:, 0] < 0.5) | (p[:, 0] > 2.0)]))
    points = np.concatenate([part.points for part in parts])
    assert len(points) == 9000
    assert not ((points[:, 0] > 0.5) & (points[:, 0] < 2.0)).any()
    # 9.5 units of area in squares of a quarter unit: 38 squares with 237 points each.
    squares = np.floor(points[:, :2] * 2).astype(int)
    counts = np.unique(squares, axis=0, return_counts=True)[1]
    assert len(counts) == 38
    assert counts.std() / counts.mean() < 1.2 / np.sqrt(237)


def test_nothing_kept_is_nothing_found() -> None:
    assert even_points(VERTICES, TRIANGLES, 100, lambda p: Rows(p[:0])) == []


def test_places_are_tried_in_proportion_to_what_is_kept() -> None:
    """A tenth of the area is kept: ten times as many places are tried, and not many more."""
    tried = []

    def keep(points: np.ndarray) -> Rows:
        tried.append(len(points))
        return Rows(points[points[:, 0] < 1.5])

    even_points(VERTICES, TRIANGLES, 5000, keep)
    assert sum(tried[1:]) < 1.1 * 50_000
    assert len(sample_surface(VERTICES, TRIANGLES, 10)) == 10
