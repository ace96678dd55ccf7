"""Changes of brightness with the direction that a point faces, and with its height, on sightings of a known ball."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.processing.sightings import Sightings
from hsi_sc_nerf.processing.view_changes import change_of, change_with_direction, change_with_height

FRAMES, COLOURS = 24, 3
NOISE = 0.02


def ball(light=lambda normal: 1.0, shade=lambda height: 1.0, drift=0.0, turn_deg=360.0, shifted=0.0, seed=0):
    """Points on a ball with a texture, seen at less than 60 degrees, and the relative light of each sighting."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = 0.4 + 0.1 * np.sin(9.0 * normals[:, :1] + np.arange(COLOURS)) + 0.1 * rng.random((900, 1))
    camera = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # right, up, towards it
    point, frame, seen, lit = [], [], [], []
    for k in range(FRAMES):
        facing = normals @ Rotation.from_euler("z", turn_deg * k / FRAMES, degrees=True).as_matrix().T @ camera
        rows = np.flatnonzero(facing[:, 2] > 0.5)
        point.append(rows)
        frame.append(np.full(len(rows), k))
        seen.append(facing[rows])
        lit.append(light(facing[rows]) * (1.0 - drift * k / FRAMES) * np.ones(len(rows)))
    point, frame, seen, lit = map(np.concatenate, (point, frame, seen, lit))
    reflectance = albedo[point] * (lit * shade(normals[point, 2]))[:, None]
    # A wrong pose shows another part of the texture, here and there.
    reflectance *= 1.0 + shifted * rng.normal(size=(len(point), 1)) + NOISE * rng.normal(size=reflectance.shape)
    return Sightings(point, frame, seen, reflectance, 0.04 * normals, normals), lit


def within_points(seen, values):
    means = np.bincount(seen.point, values) / np.maximum(np.bincount(seen.point), 1)
    return float(np.sqrt(np.mean((values / means[seen.point] - 1.0) ** 2)))


@pytest.mark.parametrize("strength", [0.3, 0.05])
def test_a_lamp_shows_by_as_much_as_it_changes_points(strength):
    seen, lit = ball(light=lambda normal: 1.0 + strength * normal[:, 0])
    change = change_with_direction(seen)
    assert change.rms == pytest.approx(within_points(seen, lit), rel=0.1)
    assert change.noise < 0.1 * change.rms


@pytest.mark.parametrize(
    "disturbed", [{}, {"drift": 0.2, "turn_deg": 120.0}, {"shifted": 0.1}, {"shade": lambda z: 0.7 + 0.3 * z}]
)
def test_what_does_not_go_with_the_direction_is_no_view_dependence(disturbed):
    change = change_with_direction(ball(**disturbed)[0])
    assert change.rms < max(3.0 * change.noise, 0.005)
    assert change.noise < 0.01


def test_shade_shows_with_height_among_like_spectra():
    shaded = change_with_height(ball(shade=lambda z: 0.8 + 0.2 * z)[0])
    assert 0.05 < shaded.rms < 0.2
    even = change_with_height(ball()[0])
    assert even.rms < max(3.0 * even.noise, 0.01)


def test_change_of_independent_findings():
    change = change_of([0.04, 0.04, 0.04, 0.08], [1, 1, 1, 1])
    assert change.rms == pytest.approx(np.sqrt(0.05))
    assert change.noise == pytest.approx(0.01 / (2.0 * np.sqrt(0.05)))
    nothing = change_of([0.01, -0.01, 0.01, -0.01], [1, 1, 1, 1])
    assert nothing.rms == 0.0
    assert nothing.noise == pytest.approx(np.sqrt(0.01 * np.sqrt(4 / 3) / 2.0))


def test_points_that_face_alike_in_all_frames_show_no_change():
    seen = ball()[0]
    one_frame = replace(seen, frame=np.zeros_like(seen.frame), normal=np.zeros_like(seen.normal))
    assert change_with_direction(one_frame).rms == 0.0
