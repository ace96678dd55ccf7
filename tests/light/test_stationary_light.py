"""Directions and functions of direction against their integrals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.light.material import RAY_DIRECTIONS
from hsi_sc_nerf.light.stationary_light import (
    DEGREE_OF_TERM,
    LOBE_WIDTH_RAD,
    even_directions,
    harmonics,
    lobes,
    tangents,
)


def test_even_directions_integrate_polynomials():
    x, y, z = even_directions(4096).T
    np.testing.assert_allclose([x.mean(), y.mean(), z.mean()], 0.0, atol=1e-3)
    np.testing.assert_allclose([(x * x).mean(), (z * z).mean(), (x * y).mean()], [1 / 3, 1 / 3, 0.0], atol=1e-3)
    np.testing.assert_allclose(np.maximum(z, 0.0).mean(), 0.25, atol=1e-5)


def test_harmonics_are_orthonormal_and_begin_with_one():
    terms = harmonics(even_directions(8192))
    np.testing.assert_allclose(terms.T @ terms / 8192, np.eye(9), atol=1e-3)
    np.testing.assert_allclose(terms[:, 0], 1.0)
    assert DEGREE_OF_TERM.tolist() == [0] + 3 * [1] + 5 * [2]


def test_a_turn_mixes_harmonics_of_one_degree_alone():
    directions = even_directions(512)
    turned = harmonics(directions @ Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix())
    mixing = np.linalg.lstsq(harmonics(directions), turned, rcond=None)[0]
    np.testing.assert_allclose(mixing[DEGREE_OF_TERM[:, None] != DEGREE_OF_TERM], 0.0, atol=1e-9)
    np.testing.assert_allclose(mixing.T @ mixing, np.eye(9), atol=1e-9)


def test_a_lobe_lies_around_its_middle_and_lights_what_faces_it_with_one():
    towards = even_directions(7)
    directions = even_directions(4096)
    radiance = lobes(directions, towards)
    middles = radiance.T @ directions
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    np.testing.assert_allclose((middles * towards).sum(axis=1), 1.0, atol=1e-4)
    facing = (radiance * np.maximum(directions @ towards.T, 0.0)).mean(axis=0) * 4.0
    np.testing.assert_allclose(facing, 1.0)


def test_a_lobe_lights_as_a_lamp_far_away_and_little_beyond_the_terminator():
    """On surfaces turned away from it; a wider lobe is found too strong."""
    directions = even_directions(RAY_DIRECTIONS)
    radiance = lobes(directions, np.array([[0.0, 0.6, 0.8]]))[:, 0]
    for degrees in (0, 30, 60, 80, 90, 95, 110):
        normal = Rotation.from_rotvec([np.deg2rad(degrees), 0.0, 0.0]).apply([0.0, 0.6, 0.8])
        found = 4.0 * (np.maximum(directions @ normal, 0.0) * radiance).mean()
        # Half a lobe is above the horizon of a surface at the terminator.
        assert found == pytest.approx(max(0.0, np.cos(np.deg2rad(degrees))), abs=0.024), degrees


def test_lobes_turn_as_their_tangents_say():
    directions, towards = even_directions(4096), even_directions(5)
    cosines = np.maximum(directions @ even_directions(5)[2], 0.0) * 4.0 / len(directions)
    for along in np.moveaxis(tangents(towards), 1, 0):
        np.testing.assert_allclose((along * towards).sum(axis=1), 0.0, atol=1e-12)
        turned = np.cos(1e-3) * towards + np.sin(1e-3) * along
        slope = (along @ directions.T).T / LOBE_WIDTH_RAD**2 * lobes(directions, towards)
        change = (cosines @ lobes(directions, turned) - cosines @ lobes(directions, towards)) / 1e-3
        np.testing.assert_allclose(cosines @ slope, change, atol=0.02)
