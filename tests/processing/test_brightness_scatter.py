"""Scatter and texture of points whose brightness is known: noise, a steady change of the light, and a pattern."""

import numpy as np
import pytest

from hsi_sc_nerf.processing.brightness_scatter import LARGEST_STEP_DEG, brightness_scatter
from hsi_sc_nerf.processing.effects import LEAST_SCATTER_PERCENT, scattered_brightness
from hsi_sc_nerf.processing.view_changes import PointViews

POINTS = 1500


def cameras(azimuths_deg) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(azimuths_deg), 1, 1))
    azimuth = np.deg2rad(azimuths_deg)
    poses[:, :3, 3] = np.stack([0.4 * np.cos(azimuth), 0.4 * np.sin(azimuth), np.full(len(azimuth), 0.2)], axis=-1)
    return poses


def seen_ball(azimuths_deg, noise=0.0, texture=0.0, lamp=0.5, seed=0) -> tuple[PointViews, np.ndarray]:
    """Points of a ball before a lamp beside the camera, and poses in an order that is not that of the azimuths."""
    rng = np.random.default_rng(seed)
    poses = cameras(rng.permutation(azimuths_deg))
    normals = rng.standard_normal((POINTS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    to_cameras = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    sideways = np.stack([-to_cameras[:, 1], to_cameras[:, 0], np.zeros(len(poses))], axis=-1)
    point, frame = np.nonzero(normals @ to_cameras.T > 0.5)
    light = 1.0 + lamp * (normals[point] * sideways[frame]).sum(axis=1)
    pattern = 1.0 + texture * rng.standard_normal(POINTS)
    brightness = 0.3 * pattern[point] * light * (1.0 + noise * rng.standard_normal(len(point)))
    in_camera = np.tile([0.0, 0.0, 1.0], (len(point), 1))
    return PointViews(point, frame, in_camera, np.tile(brightness[:, None], 6), 0.04 * normals, normals), poses


@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize("texture", [0.0, 0.08])
def test_noise_and_texture_are_told_apart(noise, texture):
    found = brightness_scatter(*seen_ball(np.arange(0.0, 360.0, 10.0), noise, texture))
    assert found is not None
    assert found.scatter.rms == pytest.approx(noise, rel=0.1)
    assert found.scatter.noise < 0.05 * noise
    # The lamp shades neighbours, which are 3 mm apart here, differently by 0.02.
    assert found.texture == pytest.approx(np.hypot(texture * np.sqrt(1.25), 0.02), abs=0.01)


def test_light_that_changes_steadily_is_no_scatter():
    steady = brightness_scatter(*seen_ball(np.arange(0.0, 360.0, 10.0), lamp=0.5))
    assert steady is not None
    assert 100.0 * steady.scatter.rms < LEAST_SCATTER_PERCENT / 2.0


def test_frames_far_apart_and_few_frames_tell_nothing():
    assert brightness_scatter(*seen_ball(np.arange(0.0, 360.0, LARGEST_STEP_DEG + 1.0), 0.03)) is None
    assert brightness_scatter(*seen_ball(np.array([0.0, 10.0]), 0.03)) is None
    assert brightness_scatter(*seen_ball(np.arange(0.0, 91.0, 10.0), 0.03)) is not None  # part of a turn


def test_scatter_decides_where_it_is_large_and_not_small_beside_the_texture():
    turn = np.arange(0.0, 360.0, 10.0)
    decisions = [
        scattered_brightness(brightness_scatter(*seen_ball(turn, noise, texture))).present
        for noise, texture in ((0.03, 0.02), (0.03, 0.12), (0.008, 0.0))
    ]
    assert decisions == [True, False, False]
    unknown = scattered_brightness(None)
    assert (unknown.present, unknown.evidence) == (False, None)
