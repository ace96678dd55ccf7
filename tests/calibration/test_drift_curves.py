"""Curves of drift over wavelength, against drawn drifts and closed forms of splines."""

from __future__ import annotations

import numpy as np
import pytest

from hsi_sc_nerf.calibration.drift_curves import MAX_TERMS, common_courses, smoothing_basis
from hsi_sc_nerf.calibration.lamp_drift import fit_over_wavelength

BANDS, FRAMES = 24, 20
WAVELENGTHS_NM = np.linspace(400.0, 1000.0, BANDS)
MANY_NM = np.linspace(400.0, 1000.0, 120)

COURSES = {
    "ramp": np.linspace(-1.0, 1.0, FRAMES),
    "warm-up": 2.0 * np.exp(-np.arange(FRAMES) / 4.0),
    "flicker": np.random.default_rng(8).standard_normal(FRAMES),
    "switched": 2.0 * (np.arange(FRAMES) > 12),
}


@pytest.mark.parametrize(
    ("name", "of_one_frame"), [("ramp", 0.165), ("warm-up", 0.3), ("flicker", 0.2), ("switched", 0.15)]
)
def test_frames_tell_course_and_spectrum_of_the_drift_together(name, of_one_frame):
    """Errors are far smaller than that of each frame by itself, and not above what is stated."""
    rng = np.random.default_rng(6)
    # Orthogonal polynomials of root mean square 1.
    basis = np.linalg.qr(np.vander(700.0 / WAVELENGTHS_NM, 4, increasing=True))[0] * np.sqrt(BANDS)
    basis *= np.sign(basis[0])
    covariance = np.diag([1.0, 2.0, 4.0, 8.0]) * 1e-6
    true = np.outer(COURSES[name], [0.05, -0.02, 0.01, 0.005])
    relative = (true - true[0]) @ basis.T
    scores, squares = [], []
    for _ in range(200):
        noise = np.sqrt(np.diag(covariance)) * rng.standard_normal(true.shape)
        curves, variance = common_courses(true + noise, covariance, basis, np.zeros(len(covariance)))
        np.testing.assert_array_equal(curves[0], 0.0)
        np.testing.assert_array_equal(variance[0], 0.0)
        scores.append(np.square(curves - relative)[1:] / variance[1:])
        squares.append(np.square(curves - relative)[1:] / np.square((noise - noise[0])[1:] @ basis.T).mean())
    assert 0.25 < np.mean(scores) < 1.15
    assert np.mean(squares) < of_one_frame


def test_a_frame_that_contradicts_a_smooth_course_is_taken_as_measured():
    """A lamp that flashes in one frame: the flash is not spread over the frames beside it."""
    rng, flash = np.random.default_rng(1), 12
    course = np.linspace(-20.0, 20.0, FRAMES)
    course[flash] += 8.0
    true = np.outer(course, [1.0, 0.0, 0.0, 0.0])
    errors, stated = [], []
    for _ in range(200):
        curves, variance = common_courses(true + rng.standard_normal(true.shape), np.eye(4), np.eye(4), np.zeros(4))
        errors.append((curves - (true - true[0]))[flash, 0])
        stated.append(variance[flash, 0])
    # A third of it by chance is still smooth enough.
    assert np.mean(np.square(errors)) < 2.0 * np.mean(stated)


def test_a_second_course_comes_out_of_the_noise_little_by_little():
    """One that is taken or left as a whole would come with a jump of its full size."""
    terms, frames = 12, 40
    time = np.linspace(-1.0, 1.0, frames)
    second = time**3 - 0.6 * time
    second -= second.mean()
    courses = np.stack([np.exp(-time), second / np.linalg.norm(second)], axis=1)
    noise = np.random.default_rng(0).standard_normal((frames, terms))
    noise_edge = np.sqrt(frames - 1) + np.sqrt(terms)
    found = []
    for strength in np.arange(0.5, 1.6, 0.005) * noise_edge:
        drift = courses @ np.stack([20.0 * np.eye(terms)[0], strength * np.eye(terms)[1]])
        found.append(common_courses(drift + noise, np.eye(terms), np.eye(terms), np.zeros(terms))[0][:, 1])
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    assert steps.max() < 0.15 * noise_edge
    # It is nearly all there at the end.
    assert np.ptp(found[-1]) > 0.7 * strength * np.ptp(courses[:, 1])
    assert np.ptp(found[0]) < 0.3 * np.ptp(found[-1])


def fitted(log_light, variance, wavelengths_nm):
    basis, roughness = smoothing_basis(1.0 / wavelengths_nm, 1.0 / variance)
    return common_courses(*fit_over_wavelength(log_light, variance, basis, 0.0), basis, roughness)


def test_a_drift_of_the_blue_alone_stays_in_the_blue():
    """A kink that no polynomial follows, under noise that is largest in the blue."""
    rng = np.random.default_rng(3)
    spectrum = -0.05 - 0.05 * np.clip((530.0 - MANY_NM) / 130.0, 0.0, None)
    true = np.outer(np.linspace(-0.5, 0.5, FRAMES), spectrum)
    deviation = 1e-4 + 0.012 * np.exp((400.0 - MANY_NM) / 40.0)
    scores, errors = [], []
    for _ in range(60):
        noisy = true + deviation * rng.standard_normal(true.shape)
        curves, variance = fitted(noisy, deviation**2, MANY_NM)
        error = curves - (true - true[0])
        scores.append(error[1:] ** 2 / variance[1:])
        errors.append(np.abs(error - error.mean(axis=0)).max())
        assert np.abs(error[:, MANY_NM > 600.0]).max() < 5e-4
    assert np.median(errors) < 0.07 * deviation.max()
    # The spline is a little smoother than the kink.
    assert 0.3 < np.mean(scores) < 2.0


def test_a_drift_of_temperature_has_no_roughness():
    """By Wien's law it is linear in 1 / wavelength: noise is all that is lost."""
    rng = np.random.default_rng(5)
    true = np.outer(np.linspace(-1.0, 1.0, FRAMES), 0.02 * (700.0 / MANY_NM - 1.0) - 0.03)
    errors = {}
    for name, variance in (("spline", np.full(120, 1e-6)), ("quiet", np.full(120, 1e-14))):
        noisy = true + np.sqrt(variance) * rng.standard_normal(true.shape)
        errors[name] = np.abs(fitted(noisy, variance, MANY_NM)[0] - (true - true[0])).max()
    assert errors["quiet"] < 1e-6
    assert errors["spline"] < 1e-3


def test_basis_is_orthonormal_ordered_and_starts_with_straight_lines():
    rng = np.random.default_rng(1)
    positions, precision = rng.permutation(1.0 / MANY_NM), rng.uniform(1.0, 50.0, 120)
    precision[:10] = 0.0
    basis, roughness = smoothing_basis(positions, precision)
    assert basis.shape == (120, MAX_TERMS)
    np.testing.assert_allclose(basis.T * precision @ basis, np.eye(MAX_TERMS), atol=1e-6)
    assert (np.diff(roughness) >= 0.0).all()
    line = np.stack([np.ones(120), (positions - positions.mean()) / np.ptp(positions)], axis=1)
    inside = np.linalg.lstsq(basis[:, :2], line, rcond=None)[0]
    np.testing.assert_allclose(basis[:, :2] @ inside, line, atol=1e-6)


@pytest.mark.parametrize("bands", [3, 5])
def test_few_bands_have_as_many_terms(bands):
    wavelengths_nm = np.linspace(400.0, 1000.0, bands)
    true = np.outer(np.linspace(-1.0, 1.0, FRAMES), np.linspace(0.02, 0.05, bands))
    curves, variance = fitted(true, np.full(bands, 1e-10), wavelengths_nm)
    np.testing.assert_allclose(curves, true - true[0], atol=1e-4)
    assert np.isfinite(variance).all()
