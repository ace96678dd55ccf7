from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, turntable_camera_to_world
from hsi_sc_nerf.surface import surface_points
from hsi_sc_nerf.surface.depth_renders import DepthRenders
from hsi_sc_nerf.surface.regions import EVERYWHERE, box_region
from hsi_sc_nerf.surface.surface_points import SurfaceMesh, SurfacePoints, even_points, surface_mesh


def at(points: np.ndarray) -> SurfacePoints:
    """Surface points of which only the positions matter."""
    return SurfacePoints(points, points, np.zeros(len(points), int), points[:, :2], np.zeros(len(points)))


def test_the_intersection_of_two_boxes_is_a_box() -> None:
    points = np.random.default_rng(0).random((50, 3))
    first = box_region(np.array([[0.0, 0.2, 0.0], [0.8, 1.0, 1.0]]))
    second = box_region(np.array([[0.1, 0.0, 0.5], [1.0, 0.7, 1.0]]))
    both = EVERYWHERE & first & second
    np.testing.assert_array_equal(both.bounds, [[0.1, 0.2, 0.5], [0.8, 0.7, 1.0]])
    inside = ((points >= both.bounds[0]) & (points <= both.bounds[1])).all(axis=1)
    np.testing.assert_array_equal(both.contains(points, points), inside)
    assert 0 < inside.sum() < 50


# Two squares in the plane, the second of nine times the area, cut unevenly into triangles.
VERTICES = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [5, 0, 0], [5, 3, 0], [2, 3, 0], [2.2, 0.1, 0]], float
)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 8], [5, 6, 8], [6, 7, 8], [7, 4, 8]])


def test_as_many_points_as_asked_for_evenly_over_what_is_kept() -> None:
    points = even_points(VERTICES, TRIANGLES, 9000, lambda p: at(p[(p[:, 0] < 0.5) | (p[:, 0] > 2.0)])).points
    assert len(points) == 9000
    assert not ((points[:, 0] > 0.5) & (points[:, 0] < 2.0)).any()
    # 9.5 units of area in squares of a quarter unit: 38 squares with 237 points each.
    squares = np.floor(points[:, :2] * 2).astype(int)
    counts = np.unique(squares, axis=0, return_counts=True)[1]
    assert len(counts) == 38
    assert counts.std() / counts.mean() < 1.2 / np.sqrt(237)


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.2, 2e-3])
def test_a_narrow_region_is_searched_in_pieces(width: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A 250th of the area is kept, or so little of it that the first sample misses it."""
    tried = []
    monkeypatch.setattr(surface_points, "MAX_BATCH", 200_000)

    def keep(points: np.ndarray) -> SurfacePoints:
        tried.append(len(points))
        return at(points[(points[:, 1] > 1.0) & (points[:, 1] < 1.2) & (np.abs(points[:, 0] - 3.0) < width / 2)])

    found, again = (even_points(VERTICES, TRIANGLES, 50, keep).points for _ in "ab")
    assert len(found) == 50
    np.testing.assert_array_equal(found, again)
    assert np.std(found[:, 1]) == pytest.approx(0.2 / np.sqrt(12), rel=0.25)
    assert max(tried) <= 200_000


def test_the_search_ends_with_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_points, "MAX_BATCH", 10_000)
    monkeypatch.setattr(surface_points, "MAX_CANDIDATES", 3)
    found = even_points(VERTICES, TRIANGLES, 5000, lambda p: at(p[p[:, 0] < 0.5]))
    assert len(found) == pytest.approx(35_000 / 20, rel=0.1)  # the first sample and three batches
    assert len(even_points(VERTICES, TRIANGLES, 100, lambda p: at(p[:0]))) == 0


def test_triangles_in_a_box_are_those_that_may_reach_it() -> None:
    flat = np.concatenate([TRIANGLES, [[4, 4, 5]]])
    mesh = SurfaceMesh(VERTICES, flat)
    box, margin = np.array([[1.2, 0.5, -1.0], [1.8, 1.5, 1.0]]), np.array([[-1.0], [1.0]])
    np.testing.assert_array_equal(mesh.triangles_in(EVERYWHERE.bounds), TRIANGLES)
    assert len(mesh.triangles_in(box + 0.19 * margin)) == 0
    np.testing.assert_array_equal(mesh.triangles_in(box + 0.21 * margin), TRIANGLES[[0, 1, 4, 5]])


def test_candidates_are_in_proportion_to_the_fraction_kept() -> None:
    """A tenth of the area is kept: ten times as many candidates, and not many more."""
    tried = []

    def keep(points: np.ndarray) -> SurfacePoints:
        tried.append(len(points))
        return at(points[points[:, 0] < 1.5])

    even_points(VERTICES, TRIANGLES, 5000, keep)
    assert sum(tried) < 1.1 * 50_000


RADIUS = 0.3
BALL_LENS = PinholeIntrinsics(96, 96, 150.0, 150.0, 48.0, 48.0)


def ball_from_all_sides() -> DepthRenders:
    """Depth maps of a ball around the origin, from eight cameras that look down on it."""
    pose = look_at(np.array([1.2, 0.0, 0.4]), np.zeros(3))
    poses = np.stack([turntable_camera_to_world(pose, angle) for angle in range(0, 360, 45)])
    lines, samples = np.indices((BALL_LENS.h, BALL_LENS.w))
    depths, points = [], []
    for frame in poses:
        eye, rays = pixel_rays(BALL_LENS, frame, np.stack([samples, lines], axis=-1) + 0.5)
        along = -(rays * eye).sum(axis=-1)
        inside = along**2 - (eye**2).sum() + RADIUS**2
        depths.append(np.where(inside > 0.0, along - np.sqrt(np.maximum(inside, 0.0)), np.inf))
        points.append((eye + rays * depths[-1][..., None])[inside > 0.0])
    maps = torch.from_numpy(np.stack(depths)).float()
    turned = torch.from_numpy(poses).float()
    return DepthRenders(turned, BALL_LENS, (0.0,) * 4, maps, 1, torch.isfinite(maps), np.concatenate(points))


def test_the_base_is_found_down_to_what_the_object_stands_on() -> None:
    """A ball sunk in a dense support, whose top is the floor of the object's box."""
    floor = -0.22

    def density_fn(points: torch.Tensor) -> torch.Tensor:
        outside = points.norm(dim=-1, keepdim=True) - RADIUS
        return 10.0 * torch.exp(-outside / 0.003).clamp(max=40.0) + 40.0 * (points[..., 2:] < floor)

    field = SimpleNamespace(density_fn=density_fn, rise_length=0.0)
    model = SimpleNamespace(field=field, occupancy=None, device="cpu")
    box = np.array([[-0.4, -0.4, floor], [0.4, 0.4, 0.4]])
    mesh = surface_mesh(model, ball_from_all_sides(), box, 4096)
    vertices = mesh.vertices[np.unique(mesh.triangles)]
    above = vertices[:, 2] - floor
    radii = np.linalg.norm(vertices, axis=1)
    lowest = (above > 0.0) & (above < 0.005)
    assert lowest.sum() > 300
    assert np.median(radii[lowest]) == pytest.approx(RADIUS, abs=0.006)
    assert np.quantile(abs(radii[above > 0.02] - RADIUS), 0.999) < 0.005
