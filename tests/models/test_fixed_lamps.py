"""Lamps that stand still, seen from the object's frame: a function of place and viewing direction, and a simple one.

The object turns by an angle, so in its frame the lamps turn back by it. Seen by one fixed camera, a point's viewing
direction tells that angle, and so what the lamps do to it: view dependence can hold their shading.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nerfstudio.utils.math import components_from_spherical_harmonics

from hsi_sc_nerf.geometry.camera import look_at, rotation_about_z, turntable_camera_to_world

CAMERA = look_at(np.array([0.4, 0.0, 0.25]), np.array([0.0, 0.0, 0.06]))
REACH_M = 0.4
"""The camera's distance from the axis."""
ANGLES_DEG = np.arange(0.0, 360.0, 3.0)


def viewing_directions(point):
    """Unit directions in which the frames see a point of the object, in its frame."""
    eyes = np.stack([turntable_camera_to_world(CAMERA, angle)[:3, 3] for angle in ANGLES_DEG])
    directions = point - eyes
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def angle_of_view_deg(point, direction):
    """The turntable's angle at which the camera sees ``point`` along ``direction``.

    Going back from the point along the ray's track on the disc one meets the camera's circle once, for the point lies
    inside it; where on the circle is the angle.
    """
    track = -direction[:2] / np.linalg.norm(direction[:2])
    along = point[:2] @ track
    eye = point[:2] + (np.sqrt(along**2 + REACH_M**2 - point[:2] @ point[:2]) - along) * track
    return -np.rad2deg(np.arctan2(eye[1], eye[0])) % 360.0


def lamp_shading(normal, lamp):
    """Cosine of the lamp's incidence on a surface of the object in each frame; 0 where it faces away."""
    lamps = np.stack([rotation_about_z(-angle)[:3, :3] @ lamp for angle in ANGLES_DEG])
    return np.maximum(lamps @ normal, 0.0)


@pytest.mark.parametrize("point", [(0.0, 0.0, 0.1), (0.03, -0.02, 0.15), (-0.1, 0.1, 0.0), (0.0, 0.39, 0.02)])
def test_place_and_direction_tell_the_turntables_angle(point):
    point = np.array(point)
    found = [angle_of_view_deg(point, direction) for direction in viewing_directions(point)]
    difference = (np.array(found) - ANGLES_DEG + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)


def test_from_beyond_the_cameras_circle_a_direction_fits_two_angles():
    """The condition is needed: a wall of the chamber, held in the object's frame, is seen so twice in a turn."""
    directions = viewing_directions(np.array([0.8, 0.0, 0.25]))
    azimuth = np.rad2deg(np.unwrap(np.arctan2(directions[:, 1], directions[:, 0])))
    assert np.ptp(azimuth) < 90.0
    steps = np.diff(azimuth)
    assert (steps > 0).any()
    assert (steps < 0).any()


@pytest.mark.parametrize("elevation_deg", [20.0, 50.0, 80.0])
@pytest.mark.parametrize("side_deg", [0.0, 60.0])
def test_the_directions_encoding_holds_a_lamps_shading(elevation_deg, side_deg):
    """A linear map of the encoding that the field's head is given comes within 2 % of a single bare lamp's light."""
    elevation, side = np.deg2rad([elevation_deg, side_deg])
    lamp = np.array([np.cos(elevation) * np.cos(side), np.cos(elevation) * np.sin(side), np.sin(elevation)])
    point, normal = np.array([0.035, 0.01, 0.1]), np.array([0.9, 0.3, 0.3])
    normal /= np.linalg.norm(normal)
    shading = lamp_shading(normal, lamp)
    # As the field does: directions moved into [0, 1], four levels.
    moved = torch.from_numpy((viewing_directions(point) + 1.0) / 2.0)
    encoded = components_from_spherical_harmonics(4, moved).numpy()
    held = encoded @ np.linalg.lstsq(encoded, shading, rcond=None)[0]
    assert np.sqrt(np.mean((held - shading) ** 2)) < 0.02
    # What a field without view dependence is left with.
    assert shading.std() > 0.1


def test_a_lamp_that_never_sets_is_linear_in_the_direction():
    """Where a surface always faces the lamp, shading is a turning cosine, and so is the direction, parallax apart."""
    lamp = np.array([0.4, 0.3, np.sqrt(1.0 - 0.25)])
    normal = np.array([0.3, 0.0, np.sqrt(1.0 - 0.09)])
    shading = lamp_shading(normal, lamp)
    for point, limit in (((0.0, 0.0, 0.1), 1e-12), ((0.03, 0.0, 0.1), 0.1)):
        directions = viewing_directions(np.array(point))
        terms = np.concatenate([directions[:, :2], np.ones((len(directions), 1))], axis=1)
        rest = shading - terms @ np.linalg.lstsq(terms, shading, rcond=None)[0]
        assert np.abs(rest).max() < limit * shading.std()
