import cv2
import numpy as np
import torch

from hsi_sc_nerf.data.dataparser import CAMERA_ROTATION, pinhole_cameras
from hsi_sc_nerf.geometry.camera import (
    PinholeIntrinsics,
    image_coordinates,
    in_camera_frame,
    look_at,
    pixel_rays,
    turntable_camera_to_world,
)
from hsi_sc_nerf.models.backgrounds import Background, interpolate_image

LENS = PinholeIntrinsics(60, 40, 80.0, 85.0, 31.0, 18.5)
STRAIGHT = (0.0, 0.0, 0.0, 0.0)
CURVED = (-0.25, 0.1, 0.003, -0.002)
SPECTRUM = torch.tensor([0.9, 0.8, 0.7])


def pixel_centres():
    y, x = np.mgrid[: LENS.h, : LENS.w] + 0.5
    return np.stack([x, y], -1)


def rays_of_frame(angle_deg, pixels):
    """Directions and rotations of a frame's rays, as the data manager makes them."""
    pose = turntable_camera_to_world(look_at([0.5, 0.1, 0.3], [0.0, 0.0, 0.05]), angle_deg)
    _, directions = pixel_rays(LENS, pose, pixels)
    rotations = np.broadcast_to(pose[:3, :3].reshape(9), (*pixels.shape[:-1], 9)).copy()
    return torch.from_numpy(directions).float(), torch.from_numpy(rotations).float()


def background(image, cell_px=1, distortion=STRAIGHT):
    return Background(SPECTRUM, image, cell_px, LENS, distortion)


def random_image(lines=LENS.h, samples=LENS.w):
    return 0.1 + 0.8 * torch.rand(lines, samples, 3, generator=torch.Generator().manual_seed(0))


def test_every_frame_sees_the_picture_itself(device):
    image = random_image()
    module = background(image).to(device)
    for angle_deg in (0.0, 30.0, 200.0):
        directions, rotations = rays_of_frame(angle_deg, pixel_centres())
        seen = module(directions.to(device), rotations.to(device)).cpu()
        torch.testing.assert_close(seen, image, atol=2e-4, rtol=0)


def test_image_coordinates_agree_with_opencv():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.35, 0.35, (50, 2)), -np.ones((50, 1))], 1) * rng.uniform(0.1, 3, (50, 1))
    in_opencv = points * [1.0, -1.0, -1.0]
    expected, _ = cv2.projectPoints(in_opencv, np.zeros(3), np.zeros(3), LENS.matrix(), np.array(CURVED))
    pixels, forward = image_coordinates(torch.from_numpy(points), LENS, CURVED)
    assert forward.all()
    np.testing.assert_allclose(pixels.numpy(), expected[:, 0], atol=1e-9)


def test_rays_of_a_distorted_camera_find_their_own_pixel():
    """Through nerfstudio's ray generator, which takes the lens's distortion off the pixels."""
    pose = turntable_camera_to_world(look_at([0.5, 0.1, 0.3], [0.0, 0.0, 0.05]), 40.0)
    cameras = pinhole_cameras(pose[None], LENS, np.array(CURVED))
    rays = cameras.generate_rays(camera_indices=0)
    camera_directions = in_camera_frame(rays.directions, rays.metadata[CAMERA_ROTATION])
    pixels, _ = image_coordinates(camera_directions, LENS, CURVED)
    np.testing.assert_allclose(pixels.numpy(), pixel_centres(), atol=2e-3)
    image = random_image()
    seen = background(image, distortion=CURVED)(rays.directions, rays.metadata[CAMERA_ROTATION])
    torch.testing.assert_close(seen, image, atol=2e-3, rtol=0)


def test_bilinear_between_centres_and_held_beyond_them():
    image = torch.tensor([[0.0, 1.0], [2.0, 3.0]])[..., None]
    positions = torch.tensor([[0.5, 0.5], [1.0, 0.5], [1.0, 1.0], [0.5, 1.25], [-3.0, 0.0], [9.0, 9.0]])
    expected = torch.tensor([0.0, 0.5, 1.5, 1.5, 0.0, 3.0])
    torch.testing.assert_close(interpolate_image(image, positions)[:, 0], expected)
    torch.testing.assert_close(interpolate_image(image, positions.view(2, 3, 2))[..., 0], expected.view(2, 3))


def test_a_coarse_picture_of_a_ramp():
    """Cells of four pixels hold a ramp's mean; between their centres the look-up is the ramp again."""
    ramp = torch.arange(0.5, 60.0)[None, :, None].expand(40, 60, 3) / 60.0
    coarse = ramp.reshape(10, 4, 15, 4, 3).mean((1, 3))
    directions, rotations = rays_of_frame(70.0, pixel_centres())
    seen = background(coarse, cell_px=4)(directions, rotations)
    torch.testing.assert_close(seen[:, 2:-2], ramp[:, 2:-2], atol=1e-4, rtol=0)


def test_viewers_and_backward_rays_see_the_median_spectrum():
    module = background(random_image())
    directions, rotations = rays_of_frame(0.0, pixel_centres())
    torch.testing.assert_close(module(directions, None), SPECTRUM.expand(40, 60, 3))
    torch.testing.assert_close(module(-directions, rotations), SPECTRUM.expand(40, 60, 3))
    sideways = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    identity = torch.eye(3).reshape(1, 9).expand(2, 9)
    torch.testing.assert_close(module(sideways, identity), SPECTRUM.expand(2, 3))


def test_nothing_is_learned_and_the_picture_is_saved():
    assert not list(background(random_image()).parameters())
    assert set(background(random_image()).state_dict()) == {"image", "spectrum"}


def test_one_spectrum_behind_every_ray():
    directions, rotations = rays_of_frame(30.0, pixel_centres())
    torch.testing.assert_close(background(None)(directions, rotations), SPECTRUM.expand(40, 60, 3))
    assert set(background(None).state_dict()) == {"spectrum"}
