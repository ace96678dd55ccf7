"""Pear, apple, maize ear and tomato: meshes that stand on z = 0, and the distribution of their materials."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.materials import over, smooth_noise, smoothstep
from hsi_sc_nerf.simulate.mesh import SEGMENTS, revolve, steps
from hsi_sc_nerf.simulate.scene import Fruit, MaizeEar, Tomato

# Profiles of (radius, height) in units of the object's height; the body is a smooth curve, the stem a polyline.
PEAR_BODY = np.array(
    [
        (0.0, 0.035), (0.06, 0.02), (0.15, 0.001), (0.25, 0.05), (0.315, 0.17), (0.325, 0.30), (0.28, 0.43),
        (0.21, 0.55), (0.168, 0.65), (0.146, 0.73), (0.118, 0.79), (0.070, 0.828), (0.030, 0.835),
    ]
)  # fmt: skip
PEAR_STEM = np.array([(0.022, 0.842), (0.018, 0.88), (0.017, 0.94), (0.021, 0.985), (0.019, 1.0), (0.0, 1.0)])
APPLE_BODY = np.array(
    [
        (0.0, 0.085), (0.07, 0.06), (0.19, 0.0), (0.35, 0.045), (0.47, 0.21), (0.51, 0.42), (0.475, 0.62),
        (0.37, 0.775), (0.25, 0.82), (0.13, 0.785), (0.05, 0.715),
    ]
)  # fmt: skip
APPLE_STEM = np.array([(0.020, 0.725), (0.017, 0.80), (0.017, 0.92), (0.022, 0.985), (0.019, 1.0), (0.0, 1.0)])
MAIZE_EAR = np.array(
    [
        (0.0, 0.0), (0.075, 0.0), (0.078, 0.03), (0.10, 0.06), (0.132, 0.10), (0.146, 0.17), (0.150, 0.30),
        (0.146, 0.45), (0.138, 0.60), (0.124, 0.74), (0.103, 0.86), (0.070, 0.95), (0.035, 0.99), (0.0, 1.0),
    ]
)  # fmt: skip
MAIZE_ROWS = 14
MAIZE_KERNEL_PITCH_M = 0.0052
MAIZE_KERNEL_RELIEF_M = 0.0022
MAIZE_KERNEL_SPAN = (0.085, 0.975)
"""Range with kernels as fractions of the ear's height; shank and husk are below it."""
# Over the shoulder and down to the floor of the hollow.
TOMATO_BODY = np.array(
    [
        (0.0, 0.04), (0.16, 0.02), (0.34, 0.0), (0.56, 0.10), (0.71, 0.28), (0.77, 0.50), (0.73, 0.73), (0.60, 0.91),
        (0.45, 0.985), (0.33, 0.97), (0.24, 0.88), (0.17, 0.76), (0.09, 0.70), (0.0, 0.69),
    ]
)  # fmt: skip
TOMATO_RIBS = 7
TOMATO_RIB_RELIEF = (0.04, 0.16)
"""Depth of the grooves between ribs at the base and on the shoulder, as a fraction of the radius."""
TOMATO_SCAR_RADIUS = 0.10
"""Radius of the scar of the stem on the floor of the hollow, as a fraction of the height."""
FRUIT_MATERIALS = {
    "pear": ("pear_skin", "pear_blush", "lenticel", "bruise", "stem"),
    "apple": ("apple_skin", "apple_blush", "lenticel", "bruise", "stem"),
}
TOMATO_MATERIALS = ("tomato_red", "tomato_green", "stem")
MAIZE_MATERIALS = ("kernel_yellow", "kernel_white", "kernel_purple", "cob", "husk")
LENTICELS_PER_CM2 = 3.0
STREAK_STRETCH = np.array([1.0, 1.0, 0.15])


@dataclass(frozen=True)
class PlantMesh:
    """A closed mesh and the organ of each vertex."""

    mesh: Mesh
    stem: Float[np.ndarray, "v"]
    """Fraction of stem (fruit), of its scar (tomato) or of husk (maize), in [0, 1]."""
    kernel: Int[np.ndarray, "v"] | None = None
    """Number of the kernel of each vertex (maize)."""
    groove: Float[np.ndarray, "v"] | None = None
    """Fraction of cob between kernels, in [0, 1] (maize)."""


def pear(height_m: float, rng: np.random.Generator) -> PlantMesh:
    """A pear with a bent neck, stem included in ``height_m``."""
    return _fruit(PEAR_BODY, PEAR_STEM, height_m, rng, lobes=3, lobe_depth=0.012, bend=0.055)


def apple(height_m: float, rng: np.random.Generator) -> PlantMesh:
    """An apple with five faint lobes, stem included in ``height_m``."""
    return _fruit(APPLE_BODY, APPLE_STEM, height_m, rng, lobes=5, lobe_depth=0.014, bend=0.03)


def maize(height_m: float, rng: np.random.Generator) -> PlantMesh:
    """A husked maize ear on its shank; staggered rows of kernels are part of the relief."""
    profile = _resample(_smooth(MAIZE_EAR, closed_top=True) * height_m)
    mesh = revolve(profile, SEGMENTS)
    x, y, z = mesh.vertices.T
    radius, azimuth = np.hypot(x, y), np.arctan2(y, x) % (2.0 * np.pi)

    row_position = azimuth / (2.0 * np.pi) * MAIZE_ROWS + 0.25 * np.sin(2.0 * np.pi * z / height_m)
    row = np.floor(row_position).astype(int) % MAIZE_ROWS
    # Neighbouring rows are shifted by about half a kernel.
    start = 0.5 * (np.arange(MAIZE_ROWS) % 2) + rng.uniform(-0.12, 0.12, MAIZE_ROWS)
    along = z / MAIZE_KERNEL_PITCH_M + start[row]
    across_offset = 2.0 * (row_position - np.floor(row_position)) - 1.0
    along_offset = 2.0 * (along - np.floor(along)) - 1.0
    dome = np.sqrt((1.0 - across_offset**4) * (1.0 - along_offset**4))

    low, high = (fraction * height_m for fraction in MAIZE_KERNEL_SPAN)
    fade = smoothstep((z - low) / 0.004) * smoothstep((high - z) / 0.012)
    # Kernels shrink with the ear towards its tip.
    relief = MAIZE_KERNEL_RELIEF_M * fade * np.minimum(1.0, radius / (0.12 * height_m))
    wobble = rng.uniform(0.75, 1.15, (MAIZE_ROWS, int(along.max()) + 2))[row, np.floor(along).astype(int)]
    factor = np.divide(radius + relief * (dome * wobble - 0.6), radius, out=np.ones_like(radius), where=radius > 0)
    return PlantMesh(
        mesh=_grown(mesh, factor, height_m, 0.03, rng),
        stem=1.0 - smoothstep((z - low + 0.002) / 0.003),
        kernel=row * (int(along.max()) + 2) + np.floor(along).astype(int),
        groove=1.0 - smoothstep((dome - 0.25) / 0.3),
    )


def tomato(height_m: float, rng: np.random.Generator) -> PlantMesh:
    """A flat tomato with uneven ribs that are deepest on the shoulder, and a hollow where the stem was."""
    profile = _resample(_smooth(TOMATO_BODY, closed_top=True) * height_m)
    mesh = revolve(profile, SEGMENTS)
    x, y, z = mesh.vertices.T
    azimuth, phase = np.arctan2(y, x), rng.uniform(0.0, 2.0 * np.pi, 4)
    uneven = azimuth + 0.16 * np.sin(azimuth + phase[0]) + 0.10 * np.sin(2.0 * azimuth + phase[1])
    # Round ribs with narrow grooves between them; 0 in a groove, 1 on a rib.
    rib = np.sqrt(0.015 + 0.985 * np.sin(0.5 * TOMATO_RIBS * uneven + phase[2]) ** 2)
    low, high = TOMATO_RIB_RELIEF
    depth = low + (high - low) * smoothstep((z / height_m - 0.15) / 0.7)
    swell = 1.0 + 0.03 * np.cos(2.0 * azimuth + phase[3]) - depth * (1.0 - rib)
    on_floor = 1.0 - smoothstep((np.hypot(x, y) / height_m - 0.75 * TOMATO_SCAR_RADIUS) / (0.5 * TOMATO_SCAR_RADIUS))
    scar = np.where(z > 0.5 * height_m, on_floor, 0.0)
    return PlantMesh(mesh=_grown(mesh, swell, height_m, 0.04, rng), stem=scar)


def _fruit(
    body: Float[np.ndarray, "b 2"],
    stem: Float[np.ndarray, "s 2"],
    height_m: float,
    rng: np.random.Generator,
    *,
    lobes: int,
    lobe_depth: float,
    bend: float,
) -> PlantMesh:
    """Body and stem as one closed surface, out of round by a few percent, with a flat base."""
    body_profile = _resample(_smooth(body, closed_top=False) * height_m)
    profile = np.concatenate([body_profile, _resample(stem * height_m)])
    mesh = revolve(profile, SEGMENTS)
    first_stem_vertex = 1 + (len(body_profile) - 1) * SEGMENTS
    on_stem = np.arange(len(mesh.vertices)) >= first_stem_vertex

    azimuth = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]) % (2.0 * np.pi)
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    swell = 1.0 + 0.02 * np.cos(2.0 * azimuth + phase[0]) + lobe_depth * np.cos(lobes * azimuth + phase[1])
    return PlantMesh(mesh=_grown(mesh, swell, height_m, bend, rng), stem=on_stem.astype(float))


def _grown(mesh: Mesh, swell: Float[np.ndarray, "v"], height_m: float, bend: float, rng: np.random.Generator) -> Mesh:
    """A surface of revolution with its radii times ``swell``, bent, on a flat base and as tall as before.

    The top is sheared sideways by ``bend`` of the height, quadratic in height, which keeps the volume. The lowest 1 %
    of the height is flattened, so that the object stands on an area.
    """
    x, y, z = mesh.vertices.T
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    shift = bend * height_m * (z / height_m) ** 2
    standing = np.maximum(z - z.min() - 0.01 * height_m, 0.0)
    bent = x * swell + shift * np.cos(azimuth), y * swell + shift * np.sin(azimuth)
    return Mesh(np.stack([*bent, standing * height_m / standing.max()], axis=-1), mesh.triangles)


def _smooth(nodes: Float[np.ndarray, "n 2"], *, closed_top: bool) -> Float[np.ndarray, "m 2"]:
    """Dense smooth curve through the nodes of a profile, horizontal at the axis."""
    position = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    level_outwards = (1, np.array([1.0, 0.0]))
    top = (1, np.array([-1.0, 0.0])) if closed_top else (2, np.zeros(2))
    curve = CubicSpline(position, nodes, bc_type=(level_outwards, top))(np.linspace(0.0, position[-1], 2000))
    curve[0] = nodes[0]
    curve[-1] = nodes[-1]
    return np.stack([np.maximum(curve[:, 0], 0.0), curve[:, 1]], axis=-1)


def _resample(profile: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Points along a profile at most `VERTEX_SPACING_M` apart, both ends included."""
    position = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    sampled = np.linspace(0.0, position[-1], steps(position[-1]) + 1)
    return np.stack([np.interp(sampled, position, profile[:, i]) for i in range(2)], axis=-1)


def fruit_weights(shape: PlantMesh, fruit: Fruit, rng: np.random.Generator) -> Float[np.ndarray, "v 5"]:
    """Fractions of skin, blush, lenticel, bruise and stem (in the order of `FRUIT_MATERIALS`)."""
    points = shape.mesh.vertices
    height = points[:, 2] / fruit.height_m
    skin, blush, lenticel, bruise, stem = np.eye(5)
    weights = np.tile(skin, (len(points), 1))

    # Blush on the sunny side, with mottles and vertical streaks.
    sun = rng.uniform(0.0, 2.0 * np.pi)
    facing = np.cos(np.arctan2(points[:, 1], points[:, 0]) - sun)
    streaks = smooth_noise(points * STREAK_STRETCH, 0.0045, rng)
    mottle = smooth_noise(points, 0.018, rng)
    sunny = smoothstep(0.48 + 0.50 * facing + 0.16 * mottle + 0.16 * streaks - 0.3 * np.abs(height - 0.45))
    weights = over(weights, blush, fruit.blush * sunny)
    # A little blush pigment varies everywhere on the skin.
    weights = over(weights, blush, fruit.blush * 0.25 * smoothstep(0.5 + smooth_noise(points, 0.010, rng)))

    if fruit.lenticel_diameter_m > 0.0:
        weights = over(weights, lenticel, 0.85 * speckle(shape, fruit.lenticel_diameter_m, rng))
    if fruit.bruise_diameter_m > 0.0:
        azimuth = sun + np.pi * rng.uniform(0.6, 0.9)
        # Wrapped to (-pi, pi].
        off_side = np.angle(np.exp(1j * (np.arctan2(points[:, 1], points[:, 0]) - azimuth)))
        side = np.argmin(np.abs(off_side) + 8.0 * np.abs(height - 0.48))
        distance = np.linalg.norm(points - points[side], axis=1)
        ragged = distance * (1.0 + 0.18 * smooth_noise(points, 0.012, rng))
        weights = over(weights, bruise, 0.9 * smoothstep((fruit.bruise_diameter_m / 2.0 - ragged) / 0.004 + 0.5))
    return over(weights, stem, shape.stem)


def maize_weights(shape: PlantMesh, ear: MaizeEar, rng: np.random.Generator) -> Float[np.ndarray, "v 5"]:
    """Fractions of yellow, white and purple kernel, cob and husk (in the order of `MAIZE_MATERIALS`)."""
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


def tomato_weights(shape: PlantMesh, fruit: Tomato, rng: np.random.Generator) -> Float[np.ndarray, "v 3"]:
    """Fractions of red and green skin and of the scar (in the order of `TOMATO_MATERIALS`)."""
    points = shape.mesh.vertices
    red, green, scar = np.eye(3)
    mottle, patches = smooth_noise(points, 0.006, rng), smooth_noise(points, 0.020, rng)
    on_shoulder = smoothstep((points[:, 2] / fruit.height_m - 0.55) / 0.45 + 0.15 * mottle + 0.15 * patches)
    weights = np.tile(red, (len(points), 1))
    weights = over(weights, green, fruit.green_shoulder * on_shoulder)
    # A little chlorophyll is left everywhere.
    weights = over(weights, green, 0.3 * fruit.green_shoulder * smoothstep(0.4 + 0.6 * mottle))
    return over(weights, scar, shape.stem)


def speckle(shape: PlantMesh, diameter_m: float, rng: np.random.Generator) -> Float[np.ndarray, "v"]:
    """Round dots, uniform by area, with diameters within 30 % of ``diameter_m``; 1 inside, 0 outside."""
    vertices, triangles = shape.mesh.vertices, shape.mesh.triangles
    areas = shape.mesh.triangle_areas_m2()
    count = int(LENTICELS_PER_CM2 * shape.mesh.area_m2() * 1e4)
    centres = vertices[triangles[rng.choice(len(triangles), count, p=areas / areas.sum()), 0]]
    radii = diameter_m / 2.0 * rng.uniform(0.7, 1.3, count)
    distance, nearest = cKDTree(centres).query(vertices)
    return smoothstep((radii[nearest] - distance) / (0.4 * diameter_m) + 0.5)
