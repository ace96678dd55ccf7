"""What a frame measures of elements of a plane that the camera looks down on."""

import numpy as np

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.light.elements import MISPLACED_PX, Elements, observe

SIZE, DISTANCE_M, PIXEL_M = 32, 1.0, 0.01
EDGE = 20
"""The first bright sample."""


def test_measurements_are_uncertain_where_brightness_changes_from_pixel_to_pixel():
    half = SIZE / 2 * PIXEL_M
    corners = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    places = np.random.default_rng(0).uniform(-0.8 * half, 0.8 * half, (400, 2))
    positions, normals = np.pad(places, ((0, 0), (0, 1))), np.tile([0.0, 0.0, 1.0], (400, 1))
    elements = Elements(positions, normals, np.ones(400, bool), plane, np.zeros(2, int))
    pose = np.eye(4)
    pose[2, 3] = DISTANCE_M
    focal = DISTANCE_M / PIXEL_M
    views = observe(
        elements,
        pose[None],
        PinholeIntrinsics(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2),
        (0.0, 0.0, 0.0, 0.0),
        np.ones((1, SIZE, SIZE), bool),
        lambda frame, line, sample: np.where(sample >= EDGE, 0.6, 0.2)[:, None] * np.ones(3),
        1e-4,
    )
    beyond_edge = positions[views.element, 0] / PIXEL_M + SIZE / 2 - EDGE
    close = np.abs(beyond_edge) < 0.45
    assert close.any()
    expected = 0.4 + 0.4 * beyond_edge[close]
    np.testing.assert_allclose(views.reflectance[close, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(views.own_std[close], MISPLACED_PX * 0.4 / expected, rtol=1e-5)
    np.testing.assert_allclose(views.own_std[np.abs(beyond_edge) > 0.55], 0.0, atol=1e-9)
