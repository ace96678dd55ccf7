"""Matter that hangs in the air is cleared, unless measured pixels are then met worse."""

import numpy as np
import pytest
import torch
from ball_run import fill_with_ball, write_ball_dataset, write_untrained_run
from capture_factory import SPHERE_CENTRE_M, SPHERE_RADIUS_M

from hsi_sc_nerf.fields.occupancy_grid import grid_over
from hsi_sc_nerf.models.floating_matter import clear_floating_matter, floating_pieces
from hsi_sc_nerf.models.trained_run import open_trained_run

CENTRE_M = torch.from_numpy(SPHERE_CENTRE_M).float()
BESIDE_M = CENTRE_M + torch.tensor([0.0, 0.052, 0.01])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return open_trained_run(write_untrained_run(write_ball_dataset(folder / "data"), folder))


def ball(points_m):
    return (points_m - CENTRE_M).norm(dim=-1) < SPHERE_RADIUS_M


def block(shape, *corners):
    opacity = np.zeros(shape, np.float32)
    for low, high in corners:
        opacity[tuple(slice(*ends) for ends in zip(low, high, strict=True))] = 0.9
    return opacity


def test_small_pieces_above_the_support_that_touch_nothing_float():
    opacity = block((30, 30, 30), ((0, 0, 0), (30, 30, 15)), ((5, 5, 20), (7, 7, 22)), ((20, 20, 18), (24, 24, 22)))
    (larger, with_larger), (smaller, with_smaller) = floating_pieces(opacity, lowest=12)
    assert larger[20:24, 20:24, 18:22].all()
    assert [larger.sum(), smaller.sum()] == [4**3, 2**3]
    assert [with_larger.sum(), with_smaller.sum()] == [6**3, 4**3]


def test_what_stands_on_the_support_touches_by_a_corner_is_large_or_a_speck_does_not_float():
    standing = block((30, 30, 30), ((0, 0, 0), (30, 30, 8)), ((5, 5, 9), (7, 7, 11)))
    touching = block((30, 30, 30), ((0, 0, 0), (10, 10, 10)), ((10, 10, 10), (11, 11, 20)))
    large = block((30, 30, 30), ((0, 0, 0), (30, 30, 8)), ((5, 5, 12), (15, 15, 22)))
    speck = block((30, 30, 30), ((0, 0, 0), (30, 30, 8)), ((5, 5, 12), (6, 7, 14)))
    nothing = -np.ones((30, 30, 30), np.float32)
    assert not any(floating_pieces(one, lowest=10) for one in (standing, touching, large, speck, nothing))
    assert len(floating_pieces(standing, lowest=9)) == 1


def test_cells_beyond_the_hull_and_of_other_pieces_are_not_around_a_piece():
    opacity = block((20, 20, 20), ((0, 0, 0), (20, 20, 8)), ((5, 5, 10), (7, 7, 12)), ((8, 5, 10), (10, 7, 12)))
    opacity[4] = -1.0
    found = floating_pieces(opacity, lowest=9)
    assert len(found) == 2
    for _, cells in found:
        assert not cells[4].any()
        assert (opacity[cells] > 0.1).sum() == 8


def test_a_piece_that_hides_the_chamber_is_cleared_for_good(run):
    def with_blob(points_m):
        return ball(points_m) | ((points_m - BESIDE_M).norm(dim=-1) < 0.005)

    fill_with_ball(run, with_blob)
    grid, training = run.model.occupancy, run.model.training
    _, cell_m = grid_over(run.dataset.scene_box_m)
    low_m = torch.from_numpy(run.dataset.scene_box_m[0]).float()
    centres_m = low_m + (torch.from_numpy(np.indices(grid.opacity.shape)).permute(1, 2, 3, 0) + 0.5) * cell_m
    of_blob, of_ball = (centres_m - BESIDE_M).norm(dim=-1) < 0.005, ball(centres_m)
    assert grid.opacity[of_blob].mean() > 0.5
    assert clear_floating_matter(run.model, run.manager, step=100) == 1
    assert run.model.training == training
    assert clear_floating_matter(run.model, run.manager, step=200) == 0
    grid.refresh_all(run.model.field.density_fn)  # the field still has it
    assert (grid.opacity[of_blob] == -1.0).all()
    assert grid.opacity[of_ball].min() >= 0.0


def test_a_piece_of_the_object_that_touches_nothing_stays(run):
    run.model.occupancy.opacity.fill_(0.0)

    def cut(points_m):
        height_m = points_m[..., 2] - CENTRE_M[2]
        return ball(points_m) & ((height_m < 0.031) | (height_m > 0.0365))

    fill_with_ball(run, cut)
    before = run.model.occupancy.opacity.clone()
    assert len(floating_pieces(before.numpy(), lowest=80)) == 1
    assert clear_floating_matter(run.model, run.manager, step=100) == 0
    assert torch.equal(run.model.occupancy.opacity, before)
