"""Means over the area of outline pixels, in training and in views."""

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from small_trainer import untrained_pipeline

from hsi_sc_nerf.data.camera_rays import QUARTERS
from hsi_sc_nerf.models.supersampling import mean_over_pixels, outline_pixels, parts_of_pixels, supersampled_view

pytestmark = pytest.mark.usefixtures("quick_start")


def test_a_pixels_mean_and_parts_agree_with_a_loop():
    generator = torch.Generator().manual_seed(0)
    of_rays = torch.rand(3 + 2 * QUARTERS, 5, generator=generator)
    means = mean_over_pixels(of_rays, pixels=5)
    expected = [of_rays[0], of_rays[1], of_rays[2], of_rays[3:7].mean(0), of_rays[7:].mean(0)]
    torch.testing.assert_close(means, torch.stack(expected))
    of_pixels = torch.rand(5, generator=generator)
    parts = parts_of_pixels(of_pixels, rays=len(of_rays))
    # The sum over rays of what belongs to them is the sum over pixels of their means.
    torch.testing.assert_close((parts[:, None] * of_rays).sum(0), (of_pixels[:, None] * means).sum(0))


def test_one_ray_a_pixel_changes_nothing():
    values = torch.rand(6, 2)
    assert mean_over_pixels(values, pixels=6) is values
    assert parts_of_pixels(values[:, 0], rays=6).equal(values[:, 0])


def test_the_outline_has_two_sides():
    shown = torch.zeros(7, 9, dtype=torch.bool)
    shown[2:5, 3:7] = True
    pixels = {tuple(pixel) for pixel in outline_pixels(shown).tolist()}
    inside = {(y, x) for y in range(2, 5) for x in range(3, 7)} - {(3, 4), (3, 5)}
    beside = {(y, x) for y in (1, 5) for x in range(3, 7)} | {(y, x) for y in range(2, 5) for x in (2, 7)}
    assert pixels == inside | beside
    assert len(outline_pixels(torch.zeros(4, 4, dtype=torch.bool))) == 0


SIZE, RADIUS = 24, 0.3
CAMERA = Cameras(
    torch.eye(4)[None, :3], fx=24.0, fy=24.0, cx=12.0, cy=12.0, width=SIZE, height=SIZE, camera_type=CameraType(1)
)


def render_disc(rays):
    """A black disc of RADIUS one metre in front of a camera at the origin, before white."""
    at = rays.directions[..., :2] / -rays.directions[..., 2:]
    inside = (at.norm(dim=-1, keepdim=True) < RADIUS).float()
    spectral = (1.0 - inside).expand(*rays.shape, 3)
    return {"spectral": spectral.clone(), "rgb": spectral.clone(), "accumulation": inside, "depth": 2.0 - inside}


def test_a_views_outline_shows_the_fraction_that_the_object_covers():
    found = supersampled_view(render_disc, CAMERA, base=-10.0)
    # The fraction of each pixel by many points.
    axis = (np.arange(SIZE * 40) + 0.5) / 40 - SIZE / 2
    covered = np.hypot(axis[:, None], axis[None]) < RADIUS * 24.0
    fraction = covered.reshape(SIZE, 40, SIZE, 40).mean(axis=(1, 3))
    single = render_disc(CAMERA.generate_rays(0, keep_shape=True))["accumulation"][..., 0].numpy()
    opacity = found["accumulation"][..., 0].numpy()
    assert abs(opacity - fraction).max() < 0.3
    assert np.square(opacity - fraction).sum() < 0.25 * np.square(single - fraction).sum()
    np.testing.assert_allclose(found["spectral"][..., 0], 1.0 - opacity, atol=1e-6)
    assert set(np.unique(found["depth"])) == {1.0, 2.0}


def test_what_lies_below_the_base_has_no_outline():
    found = supersampled_view(render_disc, CAMERA, base=0.0)
    assert set(np.unique(found["accumulation"])) == {0.0, 1.0}


@pytest.mark.slow
def test_four_equal_rays_cost_what_one_does(tiny_dataset):
    """Losses of a batch do not depend on how many rays show a pixel, if all show the same."""
    pipeline = untrained_pipeline(tiny_dataset[0]).train()
    model, manager = pipeline.model, pipeline.datamanager
    model.prepare_step(0)
    sampler = manager.train_pixel_sampler
    pixels, on_outline = sampler.draw(0, 0.5, 0.8)
    assert on_outline > 0
    batch = {key: torch.from_numpy(value) for key, value in sampler.at(pixels).items()}
    order = torch.cat([torch.arange(len(pixels) - on_outline), torch.arange(on_outline).repeat_interleave(QUARTERS)])
    order[len(pixels) - on_outline :] += len(pixels) - on_outline
    indices = torch.from_numpy(pixels)
    found = []
    for rays in (manager._train_rays(indices), manager._train_rays(indices)[order]):
        outputs = model(rays)
        losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        found.append({name: value.item() for name, value in losses.items()})
    assert found[0].keys() >= {"free_space_loss", "distortion_loss", "hsi_loss", "angular_loss"}
    assert found[1] == pytest.approx(found[0], rel=1e-4)
    assert found[0]["free_space_loss"] > 0.0
