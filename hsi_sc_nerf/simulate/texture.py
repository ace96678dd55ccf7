"""Procedural and image textures: mixing of materials, smooth noise, and sampling of images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt

PADDING_PX = 8
"""Distance by which painted islands of a weight texture are dilated."""


def padded_fractions(image: Float[np.ndarray, "h w m"]) -> Float[np.ndarray, "h w m"]:
    """Normalise the channels of an image to fractions that sum to 1; unpainted texels stay 0.

    Texels within `PADDING_PX` of a painted one get its fractions, because UV islands end between texels.
    """
    total = image.sum(axis=-1, keepdims=True)
    fractions = np.divide(image, total, out=np.zeros_like(image), where=total > 0.0)
    distance_px, nearest = distance_transform_edt(total[..., 0] == 0.0, return_indices=True)
    return np.where((distance_px <= PADDING_PX)[..., None], fractions[tuple(nearest)], 0.0)


def sampled(image: Float[np.ndarray, "h w m"], uv: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "v m"]:
    """Bilinear samples at UVs with the origin in the lower left corner; the image repeats outside [0, 1]."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, below = (x - left)[:, None], (y - top)[:, None]
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    upper, lower = (image[row, columns[0]] * (1.0 - right) + image[row, columns[1]] * right for row in rows)
    return upper * (1.0 - below) + lower * below


def over(
    weights: Float[np.ndarray, "v m"], material: Float[np.ndarray, "m"], fraction: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v m"]:
    """Cover ``fraction`` (clipped to [0, 1]) of each point with a material."""
    fraction = np.clip(fraction, 0.0, 1.0)[:, None]
    return weights * (1.0 - fraction) + material * fraction


def smooth_noise(points: Float[np.ndarray, "v 3"], scale_m: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth random field with mean 0, standard deviation of about 0.7 and features of about ``scale_m``."""
    waves = 24
    directions = rng.normal(size=(waves, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    wave_numbers = np.pi / scale_m * rng.uniform(0.6, 1.4, waves)
    phases = rng.uniform(0.0, 2.0 * np.pi, waves)
    field = np.cos(points @ (directions * wave_numbers[:, None]).T + phases).sum(axis=1)
    return field / np.sqrt(waves)


def smoothstep(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Cubic step from 0 at x <= 0 to 1 at x >= 1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
