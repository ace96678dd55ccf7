"""Procedural textures: mixing of materials and smooth noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


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
