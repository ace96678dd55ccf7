"""Shading by the normal in the camera's frame: of a ball, of any camera, and learned from a known highlight."""

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from hsi_sc_nerf.fields.camera_shading import LIMB, CameraShading, smoothed_grid
from hsi_sc_nerf.geometry.camera import look_at, turntable_camera_to_world

SHAPE, CELL, RADIUS = (48, 48, 40), 0.05, 0.7
LOWER = torch.tensor([-1.2, -1.2, -1.0])
CHANNELS = 3


def pose(azimuth_deg: float) -> torch.Tensor:
    """Camera 3 units from the axis, 1 above the middle, which looks at it."""
    first = look_at(np.array([3.0, 0.0, 1.0]), np.zeros(3))
    return torch.from_numpy(turntable_camera_to_world(first, -azimuth_deg)).float()


def ball_opacity() -> torch.Tensor:
    indices = torch.stack(torch.meshgrid(*(torch.arange(n) for n in SHAPE), indexing="ij"), dim=-1)
    centres = LOWER + (indices + 0.5) * CELL
    opacity = (centres.norm(dim=-1) < RADIUS).float()
    return torch.where(centres.norm(dim=-1) < RADIUS + 4 * CELL, opacity, -1.0)


def shading(device="cpu", base=-RADIUS) -> CameraShading:
    torch.manual_seed(0)
    made = CameraShading(SHAPE, LOWER, CELL, CHANNELS, pose(20.0), torch.zeros(3), base)
    made.to(device).refresh(ball_opacity().to(device))
    return made


def shade(made, coefficients, points, origins) -> torch.Tensor:
    return made(coefficients, points, origins, made.normals(points))


def on_ball(count: int, seed: int = 0) -> torch.Tensor:
    return RADIUS * functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=-1)


def test_normals_of_a_ball_point_outwards():
    points = on_ball(500)
    cos = (shading().normals(points) * points / RADIUS).sum(dim=-1)
    assert torch.rad2deg(torch.acos(cos.clamp(max=1.0))).max() < 4.0


def test_a_mirrored_ray_that_meets_the_object_again_shows_nothing_behind_it():
    """A ball alone mirrors what is behind it all around. With a wall behind, the side towards the wall does not."""
    made, camera = shading(), pose(20.0)[:3, 3]
    points = on_ball(2000)
    to_camera = functional.normalize(camera - points, dim=-1)
    cosines = (to_camera * points / RADIUS).sum(dim=-1)
    limb = points[(cosines > 0.0) & (cosines < 0.15)]
    origins = camera.expand(len(limb), 3)
    torch.testing.assert_close(made.open_normals(limb, origins, made.normals(limb)), made.normals(limb))
    away = functional.normalize(-camera[:2], dim=0)
    indices = torch.stack(torch.meshgrid(*(torch.arange(n) for n in SHAPE), indexing="ij"), dim=-1)
    behind = (LOWER + (indices + 0.5) * CELL)[..., :2] @ away
    left = (LOWER + (indices + 0.5) * CELL)[..., :2] @ torch.stack([-away[1], away[0]])
    made.refresh(torch.where((behind > 0.5) & (left > 0.2), 1.0, ball_opacity()))
    to_left = limb[:, :2] @ torch.stack([-away[1], away[0]])
    is_open = (made.open_normals(limb, origins, made.normals(limb)) != 0.0).any(dim=-1)
    low = limb[:, 2].abs() < 0.2
    assert is_open[low & (to_left > 0.6)].float().mean() < 0.25  # some rays pass the wall by
    assert is_open[to_left < 0.0].all()


def test_object_and_support_have_functions_of_their_own():
    made, points = shading(base=0.0), on_ball(200)
    origins, coefficients = pose(50.0)[:3, 3].expand(200, 3), torch.ones(200, CHANNELS)
    with torch.no_grad():
        made.network.layers[-1].weight.fill_(0.1)
        before = shade(made, coefficients, points, origins)
        made.network.layers[0].weight[:, -1] += 1.0
    changed = (shade(made, coefficients, points, origins) - before).abs().amax(dim=-1) > 1e-3
    assert torch.equal(changed, points[:, 2] < 0.0)


def test_the_limb_has_the_shading_of_normals_before_it():
    """Normals at 80 degrees from the camera's axis are taken for those at 75, and those at 60 and 70 differ."""
    made, camera = shading(), pose(50.0)
    made.network.layers[-1].weight.data.fill_(0.1)
    for values in made.maps:
        values.data.normal_()
    aside = torch.tensor([math.cos(1.0), math.sin(1.0), 0.0])

    def at(angle_deg: float) -> torch.Tensor:
        angle = math.radians(angle_deg)
        normal = math.sin(angle) * aside + math.cos(angle) * torch.tensor([0.0, 0.0, 1.0])
        made._normals.copy_((camera[:3, :3] @ normal)[None, :, None, None, None])
        return shade(made, torch.ones(1, CHANNELS), torch.zeros(1, 3), camera[None, :3, 3])

    torch.testing.assert_close(at(80.0), at(math.degrees(math.asin(LIMB))))
    assert (at(70.0) - at(60.0)).abs().max() > 1e-3
    assert (at(70.0) - at(80.0)).abs().max() > 1e-3


def test_a_grid_without_matter_has_no_normals_and_finite_shading():
    made = shading()
    made.refresh(torch.full(SHAPE, -1.0))
    assert (made.normals(on_ball(5)) == 0.0).all()
    # The second ray begins on the axis, where a camera has no azimuth.
    origins = torch.tensor([[3.0, 0.0, 1.0], [0.0, 0.0, 5.0]])
    assert shade(made, torch.ones(2, CHANNELS), torch.full((2, 3), 9.0), origins).isfinite().all()


def test_smoothing_keeps_the_sum_and_has_the_stated_deviation():
    values = torch.zeros(31, 33, 35)
    values[15, 16, 17] = 1.0
    smoothed = smoothed_grid(values, 2.5)
    assert smoothed.sum() == pytest.approx(1.0, abs=1e-4)
    for axis, middle in enumerate((15, 16, 17)):
        profile = smoothed.sum(dim=[other for other in range(3) if other != axis])
        deviation = (profile * (torch.arange(len(profile)) - middle) ** 2).sum().sqrt()
        assert deviation == pytest.approx(2.5, rel=0.03)


@pytest.mark.parametrize("azimuth_deg", [20.0, 150.0, -75.0])
def test_the_camera_turns_with_the_azimuth(azimuth_deg):
    camera, vectors = pose(azimuth_deg), torch.randn(7, 3)
    (found,) = shading().across_image(camera[:3, 3].expand(7, 3), vectors)
    torch.testing.assert_close(found, vectors @ camera[:3, :2], atol=1e-5, rtol=0.0)


def test_training_begins_without_shading():
    coefficients = torch.randn(40, CHANNELS)
    origins = pose(50.0)[:3, 3].expand(40, 3)
    torch.testing.assert_close(shade(shading(), coefficients, on_ball(40), origins), coefficients)


def test_a_gain_beyond_reason_stays_finite():
    made = shading()
    made.network.layers[-1].bias.data.fill_(1e4)
    coefficients = torch.ones(4, CHANNELS, requires_grad=True)
    shaded = shade(made, coefficients, on_ball(4), torch.full((4, 3), 3.0))
    shaded.sum().backward()
    assert shaded.isfinite().all()
    assert coefficients.grad.isfinite().all()


def test_normals_return_with_the_weights():
    kept, new = shading().state_dict(), shading()
    new.refresh(torch.full(SHAPE, -1.0))
    new.load_state_dict(kept)
    torch.testing.assert_close(new.normals(on_ball(20)), shading().normals(on_ball(20)), atol=0.0, rtol=0.0)


def test_a_new_highlight_is_foretold_from_others():
    """Each point is seen from two sides in training; from others it shows a highlight that it never showed."""
    made, points = shading(), on_ball(1500)
    spectra = 0.5 + 0.3 * torch.sin(7.0 * points)
    cameras = [pose(azimuth_deg) for azimuth_deg in range(0, 360, 12)]

    def seen(camera: torch.Tensor) -> torch.Tensor:
        normals = functional.normalize(points, dim=-1) @ camera[:3, :3]
        half = functional.normalize(torch.tensor([-0.3, 0.4, 1.0]), dim=0)
        return spectra * (0.6 + 0.4 * normals[:, :1]) + 0.5 * torch.exp(-60.0 * (1.0 - normals @ half))[:, None]

    optimizer = torch.optim.Adam(made.parameters(), lr=1e-2)
    for step in range(200):
        camera = cameras[step % 15]
        facing = (points @ camera[:3, 2] > 0.0).nonzero()[:, 0][step % 2 :: 2]
        origins = camera[:3, 3].expand(len(facing), 3)
        error = shade(made, spectra[facing], points[facing], origins) - seen(camera)[facing]
        optimizer.zero_grad()
        error.square().mean().backward()
        optimizer.step()
    camera = cameras[22]
    facing = points @ camera[:3, 2] > 0.1
    shaded = shade(made, spectra[facing], points[facing], camera[:3, 3].expand(int(facing.sum()), 3))
    error = (shaded - seen(camera)[facing]).square().mean().sqrt()
    without = (spectra[facing] - seen(camera)[facing]).square().mean().sqrt()
    assert error < 0.2 * without


@pytest.mark.gpu
def test_shading_on_a_gpu_is_that_of_the_processor(device):
    origins = pose(50.0)[:3, 3].expand(40, 3)
    coefficients, points = torch.ones(40, CHANNELS), on_ball(40)
    here, there = shading(), shading(device)
    for made in (here, there):
        made.network.layers[-1].weight.data.fill_(0.1)
    found = shade(there, coefficients.to(device), points.to(device), origins.to(device))
    torch.testing.assert_close(found.cpu(), shade(here, coefficients, points, origins), atol=1e-4, rtol=1e-4)
