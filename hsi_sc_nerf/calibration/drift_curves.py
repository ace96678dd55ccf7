"""Curves of the lamps' drift over wavelength: smooth, and shared by all frames.

The drift of lamps is a sum of one or two courses over the session, each with one spectrum (a low rank over frames and
bands). The spectrum is a smoothing spline over 1 / wavelength with the most likely smoothness for the data: in noisy
bands the neighbouring bands determine it, and a drift of the blue alone stays in the blue. The course over the frames
is smooth as well, unless a frame contradicts it: lamps warm up slowly, but may be switched.

P. J. Green and B. W. Silverman, "Nonparametric Regression and Generalized Linear Models", 1994; G. Wahba, Annals of
Statistics 13, 1985; M. Gavish and D. Donoho, "Optimal Shrinkage of Singular Values", 2017.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import linalg

MAX_TERMS = 24
"""Largest number of terms of the spline: enough for a change of slope within 30 nm in the blue."""
FREE_TERMS = 2
"""The first terms, constant and linear over 1 / wavelength: a lamp's output and its temperature."""
SMOOTH_DIFFERENCES = 3
"""Order of the differences between frames that are small in a smooth course: the drift of a warm-up is fastest, and
bends most, in the first frame, which all others are relative to."""
UNLIKELINESS_MARGIN = 3.84
"""A course is made no smoother than the roughest one that a likelihood-ratio test (95 %) allows."""
LARGEST_RESIDUAL = 4.0
"""Standard deviations by which no frame may be off a smooth course; else the course is taken as it was measured."""
LOG_STRENGTHS = np.linspace(-12.0, 12.0, 97)
"""Tried logarithms of the penalised terms' variance, relative to the noise in the term of median roughness."""


def common_courses(
    coefficients: Float[np.ndarray, "frames terms"],
    covariance: Float[np.ndarray, "terms terms"],
    basis: Float[np.ndarray, "bands terms"],
    roughness: Float[np.ndarray, "terms"],
) -> tuple[Float[np.ndarray, "frames bands"], Float[np.ndarray, "frames bands"]]:
    """The curves of all frames less the first frame's, from few courses with one spectrum each; and their variance.

    The courses are the singular vectors of the coefficients, in units of their errors, that exceed noise, at least
    the first. Others count by how far they exceed it, so that a little more noise changes little. The variance is to
    first order that of a truncated singular value decomposition, with the posterior variance of the spectra, and with
    that of the courses before smoothing, whose gain the data do not determine well. It has the
    variance of each frame's output and temperature too, whose changes noise may hide.

    Args:
        covariance: covariance of one frame's coefficients; terms with a roughness have an error of their own.
        basis: terms over the bands.
        roughness: roughness of each term, 0 for those that are not penalised.
    """
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, (coefficients - coefficients.mean(axis=0)).T).T
    left, singular, right = np.linalg.svd(whitened, full_matrices=False)
    signal = _signal_fraction(singular, len(coefficients) - 1, len(root))
    signal[0] = 1.0
    rank = int((signal > 0.0).sum())
    spectra = (signal * singular)[:rank, None] * right[:rank]
    kept = np.stack([_kept_fraction(spectrum, roughness) for spectrum in spectra])
    courses = np.stack([_smoother(s * u) @ u for s, u in zip(singular[:rank], left.T, strict=False)], axis=1)
    courses -= courses[0]
    of_band = basis @ root
    curves = courses @ (kept * spectra) @ of_band.T
    of_spectra = np.square(courses) @ kept @ np.square(of_band).T
    # Of a value less the first one, without what the spectra's variance holds.
    of_courses = 2.0 - np.square(left[:, :rank] - left[0, :rank]).sum(axis=1)
    of_courses[0] = 0.0
    directions = np.linalg.qr(np.concatenate([kept * right[:rank], np.eye(len(root))[:FREE_TERMS]]).T)[0]
    return curves, of_spectra + np.outer(of_courses, np.square(of_band @ directions).sum(axis=1))


def smoothing_basis(
    positions: Float[np.ndarray, "bands"], precision: Float[np.ndarray, "bands"]
) -> tuple[Float[np.ndarray, "bands terms"], Float[np.ndarray, "terms"]]:
    """The smoothest functions that the data distinguish, orthonormal under ``precision`` (Demmler-Reinsch basis).

    Args:
        positions: positions of the bands, all different.
        precision: 1 / variance of each band, 0 in bands without a measurement, which are interpolated.

    Returns:
        At most `MAX_TERMS` functions, and the roughness of each, the integral of its squared second derivative.
        The first two, constant and linear, have none.
    """
    order = np.argsort(positions)
    scaled = (positions[order] - positions.min()) / np.ptp(positions)
    penalty = _roughness_of_splines(scaled)
    weight = np.diag(precision[order])
    penalty *= np.trace(weight) / max(float(np.trace(penalty)), 1e-300)
    eigenvalues, eigenvectors = linalg.eigh(weight, weight + penalty)
    terms = min(MAX_TERMS, int(np.count_nonzero(precision)))
    eigenvalues, eigenvectors = eigenvalues[::-1][:terms], eigenvectors[:, ::-1][:, :terms]
    roughness = np.maximum(1.0 / eigenvalues - 1.0, 0.0)
    roughness[:2] = 0.0
    basis = np.empty_like(eigenvectors)
    basis[order] = eigenvectors / np.sqrt(eigenvalues)
    return basis, roughness


def _roughness_of_splines(positions: Float[np.ndarray, "bands"]) -> Float[np.ndarray, "bands bands"]:
    """Matrix of the integral of the squared second derivative of the natural cubic spline through values."""
    step = np.diff(positions)
    inner = np.arange(len(positions) - 2)
    second = np.zeros((len(positions), len(inner)))
    second[inner, inner] = 1.0 / step[:-1]
    second[inner + 1, inner] = -1.0 / step[:-1] - 1.0 / step[1:]
    second[inner + 2, inner] = 1.0 / step[1:]
    gram = np.diag((step[:-1] + step[1:]) / 3.0) + np.diag(step[1:-1] / 6.0, 1) + np.diag(step[1:-1] / 6.0, -1)
    return second @ np.linalg.solve(gram, second.T)


def _smoother(course: Float[np.ndarray, "frames"]) -> Float[np.ndarray, "frames frames"]:
    """Matrix that makes a course with errors of variance 1 smooth; the identity where a frame contradicts that."""
    identity = np.eye(len(course))
    differences = np.diff(identity, SMOOTH_DIFFERENCES, axis=0)
    roughness, basis = np.linalg.eigh(differences.T @ differences)
    roughness[:SMOOTH_DIFFERENCES] = 0.0
    matrix = (basis * _kept_fraction(basis.T @ course, roughness, UNLIKELINESS_MARGIN)) @ basis.T
    residual = np.abs(course - matrix @ course)
    freedom = (1.0 - np.diagonal(matrix)).clip(min=1e-9)
    return matrix if (residual <= LARGEST_RESIDUAL * np.sqrt(freedom)).all() else identity


def _signal_fraction(singular: Float[np.ndarray, "k"], rows: int, columns: int) -> Float[np.ndarray, "k"]:
    """Fraction of each singular value of a matrix with noise of variance 1 that is signal (Gavish, Donoho)."""
    square = np.square(singular)
    above = np.maximum((square - rows - columns) ** 2 - 4.0 * rows * columns, 0.0)
    beyond_noise = singular > np.sqrt(rows) + np.sqrt(columns)
    return np.where(beyond_noise, np.sqrt(above) / np.maximum(square, 1e-300), 0.0)


def _kept_fraction(
    coefficients: Float[np.ndarray, "terms"], roughness: Float[np.ndarray, "terms"], margin: float = 0.0
) -> Float[np.ndarray, "terms"]:
    """Fraction of each coefficient that is signal and not noise of variance 1.

    The coefficients of penalised terms are taken to be normal with a variance that falls with their roughness. Its
    scale is the largest whose -2 log likelihood is by at most ``margin`` above that of the most likely one.
    """
    penalised = roughness > 0.0
    if not penalised.any():
        return np.ones_like(coefficients)
    relative = roughness[penalised] / np.median(roughness[penalised])
    total = 1.0 + np.exp(LOG_STRENGTHS)[:, None] / relative
    unlikeliness = (np.log(total) + coefficients[penalised] ** 2 / total).sum(axis=1)
    kept = np.ones_like(coefficients)
    likely = np.flatnonzero(unlikeliness <= unlikeliness.min() + margin)
    kept[penalised] = 1.0 - 1.0 / total[likely[-1]]
    return kept
