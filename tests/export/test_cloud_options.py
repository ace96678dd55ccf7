from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from hsi_sc_nerf.cli.main import main
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.surface import even_points as even
from hsi_sc_nerf.surface.even_points import even_points
from hsi_sc_nerf.surface.outliers import OUTLIER_NEIGHBOURS, statistical_inliers
from hsi_sc_nerf.surface.regions import EVERYWHERE, Region, around_cylinder, chosen_bands, in_box, in_cylinder
from hsi_sc_nerf.surface.surface_mesh import SurfaceMesh

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
    np.testing.assert_allclose(around_cylinder((0.4, 0.5), 0.1, (0.0, 1.0)), [[0.3, 0.4, 0.0], [0.5, 0.6, 1.0]])


def test_two_regions_are_one() -> None:
    points = np.random.default_rng(0).random((50, 3))
    boxes = np.array([[[0.0, 0.2, 0.0], [0.8, 1.0, 1.0]], [[0.1, 0.0, 0.5], [1.0, 0.7, 1.0]]])
    first, second = (Region(lambda points, _, box=box: in_box(points, box), box) for box in boxes)
    both = EVERYWHERE & first & second
    np.testing.assert_array_equal(both.bounds, [[0.1, 0.2, 0.5], [0.8, 0.7, 1.0]])
    np.testing.assert_array_equal(both.holds(points, points), in_box(points, both.bounds))
    assert EVERYWHERE.holds(points, points).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obb_center": (0, 0, 0)}, "belong together"),
        ({"roi_box": (0, 0, 1, 1, 1, 0)}, "--roi-box"),
        ({"roi_cylinder": (0, 0, 0, 0, 1)}, "--roi-cylinder"),
        ({"roi_cylinder": (0, 0, 1, 1, 1)}, "--roi-cylinder"),
        ({"num_points": 0}, "--num-points"),
        ({"std_ratio": 0.0}, "--std-ratio"),
        ({"std_ratio": float("nan")}, "--std-ratio"),
    ],
)
def test_options_that_contradict_each_other(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        CloudOptions(**options)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--num-points", "0"], "--num-points and --num-rays-per-batch must be at least 1."),
        (["--roi-box", "0", "0", "1", "1", "1", "0"], "--roi-box takes the smallest x, y and z first"),
        (["--obb-center", "0", "0", "0"], "belong together"),
        ([], "config.yml: there is no such file"),
    ],
)
def test_bad_input_on_the_command_line_is_one_sentence(monkeypatch, capsys, tmp_path, words, message) -> None:
    given = ["export", "--load-config", str(tmp_path / "config.yml"), "--output-dir", str(tmp_path), *words]
    monkeypatch.setattr(sys, "argv", ["hsi-sc-nerf", *given])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line.startswith("Error: ")
    assert message in last_line


def test_too_few_points_for_outliers_all_stay() -> None:
    points = np.random.default_rng(0).random((OUTLIER_NEIGHBOURS + 1, 3))
    points[0] = 50.0
    np.testing.assert_array_equal(statistical_inliers(points, 0.1)[:1], [1])
    np.testing.assert_array_equal(statistical_inliers(points[:-1], 0.1), np.arange(OUTLIER_NEIGHBOURS))


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


def test_nothing_kept_is_nothing_found(monkeypatch) -> None:
    monkeypatch.setattr(even, "_LARGEST_ATTEMPT", 200_000)
    assert even_points(VERTICES, TRIANGLES, 100, lambda p: Rows(p[:0])) == []
    assert even_points(VERTICES, TRIANGLES[:0], 100, Rows) == []


@pytest.mark.parametrize("width", [0.2, 2e-3])
def test_a_narrow_region_is_searched_in_pieces(monkeypatch, width: float) -> None:
    """A 250th of the area is kept, or so little of it that the first sample misses it."""
    monkeypatch.setattr(even, "_LARGEST_ATTEMPT", 200_000)
    tried = []

    def keep(points: np.ndarray) -> Rows:
        tried.append(len(points))
        return Rows(points[(points[:, 1] > 1.0) & (points[:, 1] < 1.2) & (np.abs(points[:, 0] - 3.0) < width / 2)])

    found, again = (
        np.concatenate([part.points for part in even_points(VERTICES, TRIANGLES, 50, keep)]) for _ in "ab"
    )
    assert len(found) == 50
    np.testing.assert_array_equal(found, again)
    assert np.std(found[:, 1]) == pytest.approx(0.2 / np.sqrt(12), rel=0.25)
    assert max(tried) <= 200_000


def test_the_search_ends_with_what_was_found(monkeypatch) -> None:
    monkeypatch.setattr(even, "_LARGEST_ATTEMPT", 10_000)
    monkeypatch.setattr(even, "_TRIES_A_POINT", 3)
    parts = even_points(VERTICES, TRIANGLES, 5000, lambda p: Rows(p[p[:, 0] < 0.5]))
    assert sum(map(len, parts)) == pytest.approx(1500, rel=0.1)  # a 20th of three attempts


def test_triangles_near_a_box_are_those_that_may_reach_it() -> None:
    flat = np.concatenate([TRIANGLES, [[4, 4, 5]]])
    mesh = SurfaceMesh(VERTICES, flat)
    box = np.array([[1.2, 0.5, -1.0], [1.8, 1.5, 1.0]])
    np.testing.assert_array_equal(mesh.triangles_near(EVERYWHERE.bounds, 0.1), TRIANGLES)
    assert len(mesh.triangles_near(box, 0.19)) == 0
    np.testing.assert_array_equal(mesh.triangles_near(box, 0.21), TRIANGLES[[0, 1, 4, 5]])


def test_places_are_tried_in_proportion_to_what_is_kept() -> None:
    """A tenth of the area is kept: ten times as many places are tried, and not many more."""
    tried = []

    def keep(points: np.ndarray) -> Rows:
        tried.append(len(points))
        return Rows(points[points[:, 0] < 1.5])

    even_points(VERTICES, TRIANGLES, 5000, keep)
    assert sum(tried[1:]) < 1.1 * 50_000
    assert len(sample_surface(VERTICES, TRIANGLES, 10)) == 10
