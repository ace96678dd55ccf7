"""The occupancy grid begins as the hull of a known ball, and follows a field's density."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from ball_run import write_ball_dataset
from capture_factory import SPHERE_CENTRE_M, SPHERE_RADIUS_M

from hsi_sc_nerf.fields.occupancy_grid import (
    GRID_CELLS,
    HULL_MARGIN_M,
    OccupancyGrid,
    bounds_from_masks,
    grid_over,
    pixels_of_cells,
)
from hsi_sc_nerf.packed.dataset import Container, open_packed

SHAPE, CELL_M = (40, 40, 54), 0.003


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return open_packed(write_ball_dataset(tmp_path_factory.mktemp("ball")))


def without_mask(dataset):
    """The first frame with an empty mask."""
    empty = np.zeros((dataset.intrinsics.h, dataset.intrinsics.w), bool)
    return SimpleNamespace(camera_to_world=dataset.frames[0].camera_to_world, mask=lambda: empty)


def centres_m(lower_m):
    return lower_m + (np.indices(SHAPE).reshape(3, -1).T + 0.5) * CELL_M


def test_matter_holds_the_ball_and_solid_is_within_it(ball):
    lower_m = ball.scene_box_m[0]
    matter, solid = bounds_from_masks(ball, ball.frames, SHAPE, lower_m, CELL_M)
    from_centre_m = np.linalg.norm(centres_m(lower_m) - SPHERE_CENTRE_M, axis=1).reshape(SHAPE)
    assert matter[from_centre_m < SPHERE_RADIUS_M + HULL_MARGIN_M / 2].all()
    assert solid[from_centre_m < SPHERE_RADIUS_M - 2 * CELL_M].all()
    # Cameras that all look down at one angle leave cones on the ball, and two of the ten may miss it.
    height_m = centres_m(lower_m)[:, 2].reshape(SHAPE)
    at_height = abs(height_m - SPHERE_CENTRE_M[2]) < SPHERE_RADIUS_M / 2
    assert not matter[at_height & (from_centre_m > SPHERE_RADIUS_M + 6 * HULL_MARGIN_M)].any()
    assert not solid[at_height & (from_centre_m > SPHERE_RADIUS_M + 2 * CELL_M)].any()
    assert matter[height_m < ball.object_box_m[0, 2] - CELL_M].all()


def test_nothing_lies_on_a_container_of_known_height_but_the_object(ball):
    # Two millimetres below the middles of the next layer of cells.
    height_m = CELL_M * (np.floor(ball.object_box_m[0, 2] / CELL_M) + 0.5) - 0.002
    stands_on = replace(ball, container=Container(diameter_m=0.12, height_m=height_m))
    lower_m = ball.scene_box_m[0]
    centres = centres_m(lower_m).reshape(*SHAPE, 3)
    z_m = centres[..., 2]
    # Outside the hull of the ball, whose margin is two cells and more.
    beside = np.hypot(centres[..., 0], centres[..., 1]) < 0.06
    beside &= np.linalg.norm(centres - SPHERE_CENTRE_M, axis=-1) > SPHERE_RADIUS_M + 3 * HULL_MARGIN_M + 2 * CELL_M
    matter, _ = bounds_from_masks(stands_on, ball.frames, SHAPE, lower_m, CELL_M)
    assert beside.any()
    assert matter[beside & (z_m < height_m)].all()
    assert not matter[beside & (z_m > height_m + CELL_M / 2) & (z_m < height_m + HULL_MARGIN_M + CELL_M)].any()


def test_masks_that_miss_the_object_in_a_few_frames_cut_nothing_off(ball):
    lower_m = ball.scene_box_m[0]
    frames = ball.frames * 2
    whole, solid = bounds_from_masks(ball, frames, SHAPE, lower_m, CELL_M)
    cut, solid_cut = bounds_from_masks(ball, [without_mask(ball)] * 3 + list(frames[3:]), SHAPE, lower_m, CELL_M)
    assert (cut & whole).sum() > 0.95 * whole.sum()
    # What begins solid is agreed on by nearly all masks.
    assert solid.any()
    assert not solid_cut.any()


def test_without_a_hull_all_may_hold_matter(ball):
    matter, solid = bounds_from_masks(ball, [without_mask(ball)] * 4, SHAPE, ball.scene_box_m[0], CELL_M)
    assert matter.all()
    assert not solid.any()


def test_pixels_of_cells_hold_the_masks(ball):
    lower_m = ball.scene_box_m[0]
    _, solid = bounds_from_masks(ball, ball.frames, SHAPE, lower_m, CELL_M)
    pixels = pixels_of_cells(solid, lower_m, CELL_M, ball.camera_to_worlds, ball.intrinsics)
    masks = np.stack([frame.mask() for frame in ball.frames])
    assert pixels[masks].all()
    assert pixels.mean() < 3.0 * masks.mean()


def box():
    return torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])


def grid_with(*matter, solid=None):
    """Over the box, with matter in these cells."""
    cells, begins_solid = (torch.zeros(grid_over(box())[0], dtype=torch.bool) for _ in range(2))
    cells[matter] = True
    begins_solid[matter if solid is None else solid] = True
    return OccupancyGrid(box(), cells, begins_solid)


def test_grid_covers_the_box():
    shape, cell = grid_over(box())
    assert shape == (GRID_CELLS, GRID_CELLS, GRID_CELLS // 2)
    assert cell == pytest.approx(2.0 / GRID_CELLS)


def test_refreshed_cells_are_as_opaque_as_the_field_and_others_stay_empty():
    grid = grid_with(slice(24, 40))
    torch.manual_seed(0)
    grid.refresh_all(lambda points: torch.where(points[:, :1] < -0.5, 100.0, 0.0))
    expected = 1.0 - np.exp(-100.0 * grid.cell)
    assert (grid.opacity[40:] == -1.0).all()
    np.testing.assert_allclose(grid.opacity[24:31].numpy(), expected, rtol=0.1)
    np.testing.assert_allclose(grid.opacity[33:40].numpy(), 0.0, atol=1e-6)


def test_a_cell_with_one_dense_point_is_thin():
    grid = grid_with(slice(16))
    torch.manual_seed(0)
    for step in range(0, 320, 8):
        grid.refresh(lambda points: torch.where(torch.rand(len(points), 1) < 0.02, 1e9, 0.0), step)
    assert grid.opacity[:16].mean() == pytest.approx(0.02, abs=0.005)


def test_random_points_lie_in_their_cells():
    across = slice(10, 30), slice(5, 9)
    grid = grid_with(slice(10, 20), *across, solid=(slice(10, 15), *across))
    points, is_solid = grid.random_points(4000)
    x = (points[:, 0] + 1.0) / grid.cell
    assert ((x >= 10) & (x <= 20)).all()
    assert ((x < 15) == is_solid).float().mean() > 0.999
