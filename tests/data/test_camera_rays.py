"""Rays of training pixels: as nerfstudio's, or four over the area of a pixel."""

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.model_components.ray_generators import RayGenerator
from torch.nn.functional import normalize

from hsi_sc_nerf.data.camera_rays import QUARTERS, CameraRays, rays_through_quarters
from hsi_sc_nerf.data.dataparser import pinhole_cameras
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, turntable_camera_to_world

PARTS = ("origins", "directions", "pixel_area", "camera_indices")


def cameras(distortion=(0.0, 0.0, 0.0, 0.0)) -> Cameras:
    first = np.eye(4)
    first[:3, 3] = [0.1, -0.2, 0.9]
    poses = np.stack([turntable_camera_to_world(first, angle) for angle in (0.0, 50.0, 170.0)])
    return pinhole_cameras(
        poses, PinholeIntrinsics(30, 20, 60.0, 58.0, 14.2, 10.3), np.array(distortion), np.arange(3)
    )


DISTORTED = (-0.2, 0.05, 0.003, -0.002)
PIXELS = torch.tensor([[0, 0, 0], [2, 19, 29], [1, 7, 3], [2, 4, 25], [0, 12, 12]])


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), DISTORTED])
def test_rays_through_centres_are_nerfstudios(distortion, device):
    made = cameras(distortion)
    found, expected = CameraRays(made.to(device))(PIXELS.to(device)), RayGenerator(made)(PIXELS)
    for name in PARTS:
        torch.testing.assert_close(getattr(found, name).cpu(), getattr(expected, name), rtol=1e-5, atol=1e-6)
    assert found.metadata.keys() == expected.metadata.keys()
    for name, value in expected.metadata.items():
        torch.testing.assert_close(found.metadata[name].cpu(), value, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), DISTORTED])
def test_the_last_pixels_have_the_rays_of_a_camera_of_twice_the_resolution(distortion, device):
    made = cameras(distortion)
    found = CameraRays(made.to(device))(PIXELS.to(device), quartered=2)
    assert found.shape == (3 + 2 * QUARTERS,)
    finer = cameras(distortion)
    finer.rescale_output_resolution(2.0)
    quarters = torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]])
    within = torch.cat([torch.cat([pixel[:1].expand(4, 1), 2 * pixel[1:] + quarters], dim=1) for pixel in PIXELS[3:]])
    single, four = RayGenerator(made)(PIXELS[:3]), RayGenerator(finer)(within)
    for name in ("origins", "directions", "camera_indices"):
        expected = torch.cat([getattr(rays, name) for rays in (single, four)])
        torch.testing.assert_close(getattr(found, name).cpu(), expected, rtol=1e-5, atol=2e-6)


def test_the_quarters_lie_around_the_centre():
    made, pixels = cameras(), torch.tensor([[3, 8], [19, 0]])
    rays, centres = rays_through_quarters(made, pixels), made.generate_rays(camera_indices=0)
    assert rays.shape == (2, QUARTERS)
    middle = normalize(rays.directions.mean(dim=1), dim=-1)
    torch.testing.assert_close(middle, centres.directions[pixels[:, 0], pixels[:, 1]], rtol=0, atol=1e-5)
    assert rays.directions.unique(dim=1).shape[1] == QUARTERS
