"""The sampler by an occupancy grid: which rays it samples, and what it gives for the others."""

import numpy as np
import pytest
import torch
from ball_run import write_ball_dataset
from nerfstudio.cameras.rays import RayBundle

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.fields.occupancy_grid import OccupancyGrid, grid_over
from hsi_sc_nerf.fields.spectral_field import START_DENSITIES, SpectralField
from hsi_sc_nerf.models.backgrounds import make_background
from hsi_sc_nerf.models.occupancy_sampler import OccupancySampler, build_occupancy
from hsi_sc_nerf.packed.dataset import open_packed

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


@pytest.fixture(scope="module")
def ball_grid():
    shape, cell = grid_over(BOX)
    centres = BOX[0] + cell * (torch.from_numpy(np.indices(shape)).permute(1, 2, 3, 0) + 0.5)
    radius = centres.norm(dim=-1)
    return OccupancyGrid(BOX, radius < 0.6, radius < 0.5)


def rays_along_x(y):
    origins = torch.stack([torch.full_like(y, -3.0), y, torch.zeros_like(y)], dim=-1)
    return RayBundle(
        origins=origins,
        directions=torch.tensor([1.0, 0.0, 0.0]).expand(len(y), 3),
        pixel_area=torch.full((len(y), 1), 1e-6),
        nears=torch.full((len(y), 1), 2.0),
        fars=torch.full((len(y), 1), 4.0),
    )


def test_only_rays_that_meet_matter_are_sampled(ball_grid):
    sampler = OccupancySampler(ball_grid, num_samples=8)
    rays = rays_along_x(torch.tensor([-0.9, -0.3, 0.0, 0.7]))
    samples, *proposals = sampler(rays)
    assert proposals == [[], []]
    assert sampler.rays.tolist() == [1, 2]
    assert samples.frustums.shape == (2, 8)
    assert (samples.frustums.get_positions().norm(dim=-1) < 0.65).all()
    values = torch.tensor([[1.0], [2.0]])
    outputs = sampler.of_all_rays({"depth": values, "accumulation": values, "weights_list": [values]}, rays)
    assert {name: value[:, 0].tolist() for name, value in outputs.items() if name != "weights_list"} == {
        "depth": [4.0, 1.0, 2.0, 4.0],
        "accumulation": [0.0, 1.0, 2.0, 0.0],
    }


@pytest.mark.parametrize(("in_training", "expected"), [(None, 8), (3, 3), (20, 8)])
def test_a_stage_may_train_with_fewer_samples_but_renders_with_all(ball_grid, in_training, expected):
    sampler = OccupancySampler(ball_grid, num_samples=8)
    sampler.samples_in_training = in_training
    rays = rays_along_x(torch.tensor([0.0]))
    assert sampler.train()(rays)[0].frustums.shape == (1, expected)
    assert sampler.eval()(rays)[0].frustums.shape == (1, 8)


def test_a_bundle_that_meets_nothing_keeps_one_ray_without_length(ball_grid):
    sampler = OccupancySampler(ball_grid, num_samples=8)
    samples, *_ = sampler(rays_along_x(torch.tensor([0.9, -0.8])))
    assert samples.frustums.shape == (1, 8)
    assert (samples.deltas == 0.0).all()


def test_every_ray_is_sampled_where_that_is_wanted(ball_grid):
    sampler = OccupancySampler(ball_grid, num_samples=8, every_ray=True)
    samples, *_ = sampler(rays_along_x(torch.tensor([0.9, 0.0])))
    assert samples.frustums.shape == (2, 8)
    assert samples.deltas.sum(dim=1).flatten().tolist() == pytest.approx([0.0, 1.2 * 8 / 9], abs=0.05)


@pytest.mark.slow
def test_the_field_begins_solid_inside_the_hull(ball_grid):
    torch.manual_seed(0)
    field = SpectralField(
        BOX, num_bands=3, num_images=1, num_levels=8, max_res=64, log2_hashmap_size=14, implementation="torch"
    )
    field.start_solid(ball_grid.random_points)
    radius = torch.tensor([0.0, 0.2, 0.4, 0.57])
    points = torch.nn.functional.normalize(torch.randn(500, 1, 3), dim=-1) * radius[:, None]
    with torch.no_grad():
        density = field.density_fn(points)[..., 0].log().mean(dim=0).exp()
    solid, thin = START_DENSITIES
    assert (density[:3] > solid / 3).all()
    assert density[3] < 6 * thin
    assert all(parameter.grad is None for parameter in field.parameters())


def test_a_scene_that_is_not_the_datasets_box_is_refused(tmp_path):
    dataset = open_packed(write_ball_dataset(tmp_path))
    with pytest.raises(InputError, match="num-proposal-iterations"):
        build_occupancy(dataset, dataset.frames, BOX)


def test_what_a_checkpoint_replaces_has_its_shape_and_is_not_looked_for(tmp_path):
    dataset = open_packed(write_ball_dataset(tmp_path))
    sides = torch.from_numpy(np.ptp(dataset.scene_box_m, axis=0)).float()
    aabb = torch.stack([-sides, sides]) / sides.max()
    found = build_occupancy(dataset, dataset.frames, aabb), make_background(dataset, dataset.frames, picture=True)
    for frame in dataset.frames:
        frame.mask_path.unlink()
        frame.cube_path.unlink()
    empty = (
        build_occupancy(dataset, dataset.frames, aabb, True),
        make_background(dataset, dataset.frames, picture=True, from_checkpoint=True),
    )
    for module, replaced in zip(found, empty, strict=True):
        replaced.load_state_dict(module.state_dict())
        assert all(torch.equal(v, replaced.state_dict()[k]) for k, v in module.state_dict().items())
    assert found[1].cell_px == empty[1].cell_px
