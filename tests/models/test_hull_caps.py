"""What lies over an object's top is cleared unless measured pixels are then met much worse."""

import numpy as np
import pytest
import torch
from ball_run import fill_with_ball, write_ball_dataset, write_untrained_run
from capture_factory import SPHERE_CENTRE_M, SPHERE_RADIUS_M

from hsi_sc_nerf.fields.occupancy_grid import grid_over
from hsi_sc_nerf.models.hull_caps import MOST_RISE, clear_cap, top_layer
from hsi_sc_nerf.models.trained_run import open_trained_run

CENTRE_M = torch.from_numpy(SPHERE_CENTRE_M).float()


@pytest.mark.parametrize("top", [3, 12, 14])
def test_the_lowest_layer_that_pixels_do_without_may_hold_the_top(top):
    tried = []

    def rise_without(layer):
        tried.append(layer)
        return MOST_RISE if layer >= top else MOST_RISE + 0.01

    assert top_layer(np.arange(2, 15), rise_without) == top
    assert tried == list(range(14, top - 2, -1))


def test_a_top_that_pixels_ask_for_stays_whole():
    assert top_layer(np.arange(2, 15), lambda _: 5.0) is None
    assert top_layer(np.arange(2, 15), lambda _: np.nan) is None
    assert top_layer(np.arange(0), lambda _: 0.0) is None


def test_pixels_that_are_met_better_without_a_layer_do_not_need_it():
    assert top_layer(np.arange(4, 7), lambda _: -0.5) == 4


@pytest.mark.slow
def test_a_cap_on_a_ball_is_cleared_for_good_and_the_ball_stays(tmp_path):
    run = open_trained_run(write_untrained_run(write_ball_dataset(tmp_path / "data"), tmp_path))
    grid = run.model.occupancy
    _, cell_m = grid_over(run.dataset.scene_box_m)
    low_m = torch.from_numpy(run.dataset.scene_box_m[0]).float()
    centres_m = low_m + (torch.from_numpy(np.indices(grid.opacity.shape)).permute(1, 2, 3, 0) + 0.5) * cell_m

    def ball(points_m):
        return (points_m - CENTRE_M).norm(dim=-1) < SPHERE_RADIUS_M

    def with_cap(points_m):
        sideways, up = (points_m - CENTRE_M)[..., :2].norm(dim=-1), (points_m - CENTRE_M)[..., 2]
        return ball(points_m) | ((sideways < 0.008) & (up > 0.0) & (up < SPHERE_RADIUS_M + 0.006))

    fill_with_ball(run, with_cap)
    above_m = centres_m[..., 2] - CENTRE_M[2] - SPHERE_RADIUS_M
    cap, training = above_m > 1.5 * float(cell_m), run.model.training
    assert grid.opacity[cap].max() > 0.5
    clear_cap(run.model, run.manager, step=100)
    assert run.model.training == training
    grid.refresh_all(run.model.field.density_fn)  # the field still has it
    assert (grid.opacity[cap] == -1.0).all()
    assert grid.opacity[ball(centres_m)].min() >= 0.0
    before = grid.opacity.clone()
    clear_cap(run.model, run.manager, step=200)
    assert torch.equal(grid.opacity[ball(centres_m)], before[ball(centres_m)])
