"""A turning ball under a lamp, which shades nothing but itself: its irradiance is known in closed form."""

import numpy as np
import scipy.sparse

from hsi_sc_nerf.light.stationary_light import even_directions
from hsi_sc_nerf.light.views import ElementViews, Transfer, TurningElements

DIRECTIONS = even_directions(2048)
TO_LAMP = np.array([-0.5, 0.55, 0.67]) / np.linalg.norm([-0.5, 0.55, 0.67])
FACING = np.array([0.0, 0.0, 1.0])
FRAMES, RADIUS_M, ELEVATION = 12, 0.04, 0.4


def turning_ball(count: int = 300, centres_m: np.ndarray | float = 0.0) -> TurningElements:
    """Elements of a ball that sees no other, or parts of such balls about some centres, before a turning camera."""
    return _turning(even_directions(count), centres_m)


def upright_post(count: int = 300) -> TurningElements:
    """Elements of an upright cylinder, likewise."""
    azimuth = 2.0 * np.pi * np.arange(count) / count
    heights_m = np.random.default_rng(4).uniform(-0.06, 0.06, count)
    normals = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    return _turning(normals, heights_m[:, None] * np.array([0.0, 0.0, 1.0]))


def _turning(normals: np.ndarray, centres_m: np.ndarray | float) -> TurningElements:
    count = len(normals)
    cosines = np.maximum(normals @ DIRECTIONS.T, 0.0)
    transfer = Transfer(
        (cosines / cosines.sum(axis=1, keepdims=True)).astype(np.float32), scipy.sparse.csr_array((count, count))
    )
    rotations = []
    for azimuth in 2.0 * np.pi * np.arange(FRAMES) / FRAMES:
        back = np.array([np.cos(ELEVATION) * np.cos(azimuth), np.cos(ELEVATION) * np.sin(azimuth), np.sin(ELEVATION)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotations.append(np.stack([right, np.cross(back, right), back], axis=1))
    on_object = np.ones(count, bool)
    return TurningElements(
        RADIUS_M * normals + centres_m, normals, on_object, transfer, DIRECTIONS, np.array(rotations)
    )


def measured(ball, lamp, seed=0, noise=0.005, lamp_colour=(1.0, 1.0), distance_m=None):
    """What views show, the true irradiance and the true materials; all relative to a white that faces the camera."""
    rng = np.random.default_rng(seed)
    normals = ball.normals
    material = rng.uniform(0.1, 0.8, (len(normals), 2))
    element, frame, irradiance = [], [], []
    for index, rotation in enumerate(ball.rotations):
        in_camera = normals @ rotation
        seen = np.flatnonzero(in_camera[:, 2] > 0.35)
        to_lamp, fall = TO_LAMP, 1.0
        if distance_m is not None:
            to_lamp = distance_m * TO_LAMP - ball.positions[seen] @ rotation
            fall = (distance_m / np.linalg.norm(to_lamp, axis=1)) ** 2
            to_lamp /= np.linalg.norm(to_lamp, axis=1, keepdims=True)
        cosines = np.maximum((in_camera[seen] * to_lamp).sum(axis=1), 0.0) * fall
        white = 1.0 - lamp + lamp * np.array(lamp_colour) * TO_LAMP[2]
        irradiance.append((1.0 - lamp + lamp * np.array(lamp_colour) * cosines[:, None]) / white)
        element.append(seen)
        frame.append(np.full(len(seen), index))
    element, irradiance = np.concatenate(element), np.concatenate(irradiance)
    shown = material[element] * irradiance * (1.0 + noise * rng.standard_normal((len(element), 1)))
    of_object, no_std = np.ones(len(element), bool), np.zeros(len(element))
    return ElementViews(element, np.concatenate(frame), shown, of_object, of_object, no_std), irradiance, material
