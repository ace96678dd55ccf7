"""Spectral angle and mean square of float32 spectra, with gradients, as compiled loops for training without a GPU.

Arithmetic is float64, as in `numerics`, but no spectrum is written to memory in that type.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32

from hsi_sc_nerf.compiled import compiled

_LARGEST = float(np.finfo(np.float32).max)

# Sums in any order, which the processor computes several elements at a time.
_compiled = compiled(fastmath={"reassoc", "contract"})


@_compiled
def angles(a: Float32[np.ndarray, "n bands"], b: Float32[np.ndarray, "n bands"]) -> Float32[np.ndarray, "n"]:
    """`numerics.spectral_angle` of each pair of spectra."""
    found = np.empty(len(a), np.float32)
    for i in range(len(a)):
        norm_a, norm_b = _norm(a[i]), _norm(b[i])
        if norm_a == 0.0 or norm_b == 0.0:
            # A NaN of the other spectrum is not hidden.
            found[i] = math.pi / 2.0 + 0.0 * (norm_a + norm_b)
        else:
            difference, total = _chords(a[i], b[i], norm_a, norm_b)
            found[i] = 2.0 * math.atan2(difference, total)
    return found


@_compiled
def angle_gradient(
    a: Float32[np.ndarray, "n bands"], b: Float32[np.ndarray, "n bands"], upstream: Float32[np.ndarray, "n"]
) -> Float32[np.ndarray, "n bands"]:
    """Gradient of a sum of the angles, each times its ``upstream``, with respect to ``a``."""
    gradient = np.zeros_like(a)
    for i in range(len(a)):
        norm_a, norm_b = _norm(a[i]), _norm(b[i])
        if norm_a == 0.0 or norm_b == 0.0:
            continue
        difference, total = _chords(a[i], b[i], norm_a, norm_b)
        if difference == 0.0 or total == 0.0:
            continue
        # d angle / d u = -(v - cos u) / sin, with 1 - cos = difference^2 / 2 and sin = difference total / 2.
        factor = -upstream[i] / (norm_a * 0.5 * difference * total)
        past = 0.5 * difference * difference
        of_a, of_b = 1.0 / norm_a, 1.0 / norm_b
        for k in range(a.shape[1]):
            u, v = a[i, k] * of_a, b[i, k] * of_b
            value = factor * ((v - u) + past * u)
            gradient[i, k] = min(max(value, -_LARGEST), _LARGEST)
    return gradient


@_compiled
def mean_square(a: Float32[np.ndarray, "n"], b: Float32[np.ndarray, "n"]) -> float:
    """Mean of the squared differences; 0 of none."""
    total = 0.0
    for i in range(len(a)):
        difference = np.float64(a[i]) - np.float64(b[i])
        total += difference * difference
    return total / max(len(a), 1)


@_compiled
def mean_square_gradient(
    a: Float32[np.ndarray, "n"], b: Float32[np.ndarray, "n"], upstream: float
) -> Float32[np.ndarray, "n"]:
    """Gradient of ``upstream`` times their mean square with respect to ``a``."""
    gradient, factor = np.empty_like(a), 2.0 * upstream / max(len(a), 1)
    for i in range(len(a)):
        value = factor * (np.float64(a[i]) - np.float64(b[i]))
        # Written so that NaN is not hidden.
        gradient[i] = -_LARGEST if value < -_LARGEST else _LARGEST if value > _LARGEST else value
    return gradient


@_compiled
def _norm(spectrum):
    total = 0.0
    for value in spectrum:
        total += np.float64(value) * np.float64(value)
    return math.sqrt(total)


@_compiled
def _chords(a, b, norm_a, norm_b):
    """Lengths of the difference and of the sum of the unit vectors."""
    difference, total = 0.0, 0.0
    of_a, of_b = 1.0 / norm_a, 1.0 / norm_b
    for k in range(len(a)):
        u, v = a[k] * of_a, b[k] * of_b
        difference += (u - v) * (u - v)
        total += (u + v) * (u + v)
    return math.sqrt(difference), math.sqrt(total)
