"""Where the materials lie on the object: a share of each material at every vertex, summing to 1."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from hsi_sc_nerf.simulate.objects import Fruit, MaizeEar
from hsi_sc_nerf.simulate.shapes import Shape, smoothstep

FRUIT_MATERIALS = {
    "pear": ("pear_skin", "pear_blush", "lenticel", "bruise", "stem"),
    "apple": ("apple_skin", "apple_blush", "lenticel", "bruise", "stem"),
}
MAIZE_MATERIALS = ("kernel_yellow", "kernel_white", "kernel_purple", "cob", "husk")

LENTICELS_PER_CM2 = 3.0
PADDING_PX = 8
"""How far into the unpainted part of a weight texture its painted islands are grown."""
STREAK_STRETCH = np.array([1.0, 1.0, 0.15])


def fruit_weights(shape: Shape, fruit: Fruit, rng: np.random.Generator) -> Float[np.ndarray, "v 5"]:
    """Shares of skin, blush, lenticel, bruise and stem (in the order of `FRUIT_MATERIALS`)."""
    points = shape.mesh.vertices
    height = points[:, 2] / fruit.height_m
    skin, blush, lenticel, bruise, stem = np.eye(5)
    weights = np.tile(skin, (len(points), 1))

    # One sunny side that fades out, with mottles and with streaks that run from top to bottom.
    sun = rng.uniform(0.0, 2.0 * np.pi)
    facing = np.cos(np.arctan2(points[:, 1], points[:, 0]) - sun)
    streaks = smooth_noise(points * STREAK_STRETCH, 0.0045, rng)
    mottle = smooth_noise(points, 0.018, rng)
    sunny = smoothstep(0.48 + 0.50 * facing + 0.16 * mottle + 0.16 * streaks - 0.3 * np.abs(height - 0.45))
    weights = over(weights, blush, fruit.blush * sunny)
    # Skin is never one colour: a little blush pigment comes and goes everywhere.
    weights = over(weights, blush, fruit.blush * 0.25 * smoothstep(0.5 + smooth_noise(points, 0.010, rng)))

    if fruit.lenticel_diameter_m > 0.0:
        weights = over(weights, lenticel, 0.85 * speckle(shape, fruit.lenticel_diameter_m, rng))
    if fruit.bruise_diameter_m > 0.0:
        azimuth = sun + np.pi * rng.uniform(0.6, 0.9)
        side = np.argmin(
            np.abs(_wrapped(np.arctan2(points[:, 1], points[:, 0]) - azimuth)) + 8.0 * np.abs(height - 0.48)
        )
        distance = np.linalg.norm(points - points[side], axis=1)
        ragged = distance * (1.0 + 0.18 * smooth_noise(points, 0.012, rng))
        weights = over(weights, bruise, 0.9 * smoothstep((fruit.bruise_diameter_m / 2.0 - ragged) / 0.004 + 0.5))
    return over(weights, stem, shape.stem)


def maize_weights(shape: Shape, ear: MaizeEar, rng: np.random.Generator) -> Float[np.ndarray, "v 5"]:
    """Shares of yellow, white and purple kernel, cob and husk (in the order of `MAIZE_MATERIALS`)."""
    assert shape.kernel is not None
    assert shape.groove is not None
    yellow, white, purple, cob, husk = np.eye(5)
    kernels = int(shape.kernel.max()) + 1
    draw = rng.uniform(size=kernels)
    is_purple = draw < ear.coloured_kernels
    is_white = draw > 1.0 - ear.coloured_kernels
    of_kernel = np.tile(yellow, (kernels, 1))
    of_kernel = over(of_kernel, white, rng.uniform(0.0, 0.35, kernels) + 0.6 * is_white)
    of_kernel = over(of_kernel, purple, np.where(is_purple, rng.uniform(0.6, 0.95, kernels), 0.0))
    weights = over(of_kernel[shape.kernel], cob, 0.9 * shape.groove)
    return over(weights, husk, shape.stem)


def padded_shares(image: Float[np.ndarray, "h w m"]) -> Float[np.ndarray, "h w m"]:
    """An image whose channels are amounts of materials as shares that sum to 1 (0 where nothing is painted).

    Texels up to `PADDING_PX` beside a painted one take its shares: UV islands end between texels.
    """
    total = image.sum(axis=-1, keepdims=True)
    shares = np.divide(image, total, out=np.zeros_like(image), where=total > 0.0)
    distance_px, nearest = distance_transform_edt(total[..., 0] == 0.0, return_indices=True)
    return np.where((distance_px <= PADDING_PX)[..., None], shares[tuple(nearest)], 0.0)


def sampled(image: Float[np.ndarray, "h w m"], uv: Float[np.ndarray, "v 2"]) -> Float[np.ndarray, "v m"]:
    """Bilinear samples at UVs (origin at the image's lower left corner); the image repeats outside [0, 1]."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    across, down = (x - left)[:, None], (y - top)[:, None]
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    upper, lower = (image[row, columns[0]] * (1.0 - across) + image[row, columns[1]] * across for row in rows)
    return upper * (1.0 - down) + lower * down


def over(
    weights: Float[np.ndarray, "v m"], material: Float[np.ndarray, "m"], share: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v m"]:
    """Lay a material over others: it takes ``share`` of each point (clipped to [0, 1]), the rest keep theirs."""
    share = np.clip(share, 0.0, 1.0)[:, None]
    return weights * (1.0 - share) + material * share


def smooth_noise(points: Float[np.ndarray, "v 3"], scale_m: float, rng: np.random.Generator) -> np.ndarray:
    """A smooth random field of mean 0 and SD about 0.7 whose features are about ``scale_m`` wide."""
    waves = 24
    directions = rng.normal(size=(waves, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    wave_numbers = np.pi / scale_m * rng.uniform(0.6, 1.4, waves)
    phases = rng.uniform(0.0, 2.0 * np.pi, waves)
    field = np.cos(points @ (directions * wave_numbers[:, None]).T + phases).sum(axis=1)
    return field / np.sqrt(waves)


def speckle(shape: Shape, diameter_m: float, rng: np.random.Generator) -> Float[np.ndarray, "v"]:
    """Round dots scattered evenly by area, of diameters within 30 % of ``diameter_m``; 1 inside, 0 outside."""
    vertices, triangles = shape.mesh.vertices, shape.mesh.triangles
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    count = int(LENTICELS_PER_CM2 * shape.mesh.area_m2() * 1e4)
    centres = a[rng.choice(len(triangles), count, p=areas / areas.sum())]
    radii = diameter_m / 2.0 * rng.uniform(0.7, 1.3, count)
    distance, nearest = cKDTree(centres).query(vertices)
    return smoothstep((radii[nearest] - distance) / (0.4 * diameter_m) + 0.5)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """An angle in radians brought into (-pi, pi]."""
    return np.angle(np.exp(1j * angle))
