"""Shapes that stand on z = 0: sphere, cylinder; pear, apple, maize ear (surfaces of revolution, bent and dented)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline

from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.simulate.mesh import revolve

SEGMENTS = 336
VERTEX_SPACING_M = 0.0005

# (radius, height) in units of the whole object's height; the body is smooth, the stem is a tube on top of it.
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
"""Share of the ear's height that carries kernels; below is the shank with the rest of the husk."""


@dataclass(frozen=True)
class Shape:
    """A closed mesh and, for each vertex, what part of the object it belongs to."""

    mesh: Mesh
    stem: Float[np.ndarray, "v"]
    """Share of stem (fruit) or of husk (maize), in [0, 1]."""
    kernel: Int[np.ndarray, "v"] | None = None
    """Number of the kernel that the vertex belongs to (maize)."""
    groove: Float[np.ndarray, "v"] | None = None
    """Share of the cob seen between kernels, in [0, 1] (maize)."""


def sphere(diameter_m: float) -> Mesh:
    """A sphere; every vertex lies on it, so that area and volume come out at most 0.02 % too small."""
    radius_m = diameter_m / 2.0
    rings = max(SEGMENTS // 2, _steps(np.pi * radius_m))
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, rings + 1)
    profile = np.stack([radius_m * np.cos(latitude), radius_m * (1.0 + np.sin(latitude))], axis=-1)
    profile[[0, -1], 0] = 0.0
    return revolve(profile, SEGMENTS)


def cylinder(diameter_m: float, height_m: float) -> Mesh:
    """An upright cylinder; area and volume come out less than 0.01 % too small."""
    r = diameter_m / 2.0
    corners = np.array([[0.0, 0.0], [r, 0.0], [r, height_m], [0.0, height_m]])
    sides = [np.linspace(a, b, _steps(float(np.linalg.norm(b - a))) + 1) for a, b in pairwise(corners)]
    return revolve(np.concatenate([sides[0], sides[1][1:], sides[2][1:]]), SEGMENTS)


def pear(height_m: float, rng: np.random.Generator) -> Shape:
    """A pear with a bent neck, stem included in ``height_m``."""
    return _fruit(PEAR_BODY, PEAR_STEM, height_m, rng, lobes=3, lobe_depth=0.012, bend=0.055)


def apple(height_m: float, rng: np.random.Generator) -> Shape:
    """An apple with five faint lobes, stem included in ``height_m``."""
    return _fruit(APPLE_BODY, APPLE_STEM, height_m, rng, lobes=5, lobe_depth=0.014, bend=0.03)


def maize(height_m: float, rng: np.random.Generator) -> Shape:
    """A husked maize ear that stands on its shank, its kernels in staggered rows as real relief."""
    profile = _resample(_smooth(MAIZE_EAR, closed_top=True) * height_m)
    mesh = revolve(profile, SEGMENTS)
    radius, azimuth, z = _cylindrical(mesh.vertices)

    row_position = azimuth / (2.0 * np.pi) * MAIZE_ROWS + 0.25 * np.sin(2.0 * np.pi * z / height_m)
    row = np.floor(row_position).astype(int) % MAIZE_ROWS
    # Rows start at heights of their own, neighbours about half a kernel apart.
    start = 0.5 * (np.arange(MAIZE_ROWS) % 2) + rng.uniform(-0.12, 0.12, MAIZE_ROWS)
    along = z / MAIZE_KERNEL_PITCH_M + start[row]
    across_offset = 2.0 * (row_position - np.floor(row_position)) - 1.0
    along_offset = 2.0 * (along - np.floor(along)) - 1.0
    dome = np.sqrt((1.0 - across_offset**4) * (1.0 - along_offset**4))

    low, high = (share * height_m for share in MAIZE_KERNEL_SPAN)
    fade = smoothstep((z - low) / 0.004) * smoothstep((high - z) / 0.012)
    # Kernels shrink with the ear towards its tip.
    relief = MAIZE_KERNEL_RELIEF_M * fade * np.minimum(1.0, radius / (0.12 * height_m))
    wobble = rng.uniform(0.75, 1.15, (MAIZE_ROWS, int(along.max()) + 2))[row, np.floor(along).astype(int)]
    factor = np.divide(radius + relief * (dome * wobble - 0.6), radius, out=np.ones_like(radius), where=radius > 0)
    vertices = mesh.vertices * np.stack([factor, factor, np.ones_like(factor)], axis=-1)
    bent = _bend(vertices, height_m, 0.03, rng)
    return Shape(
        mesh=Mesh(_stand(bent, height_m), mesh.triangles),
        stem=1.0 - smoothstep((z - low + 0.002) / 0.003),
        kernel=row * (int(along.max()) + 2) + np.floor(along).astype(int),
        groove=1.0 - smoothstep((dome - 0.25) / 0.3),
    )


def _fruit(
    body: Float[np.ndarray, "b 2"],
    stem: Float[np.ndarray, "s 2"],
    height_m: float,
    rng: np.random.Generator,
    *,
    lobes: int,
    lobe_depth: float,
    bend: float,
) -> Shape:
    """Body and stem as one closed surface, out of round by a few percent, its base flattened to stand."""
    body_profile = _resample(_smooth(body, closed_top=False) * height_m)
    profile = np.concatenate([body_profile, _resample(stem * height_m)])
    mesh = revolve(profile, SEGMENTS)
    first_stem_vertex = 1 + (len(body_profile) - 1) * SEGMENTS
    on_stem = np.arange(len(mesh.vertices)) >= first_stem_vertex

    _, azimuth, _ = _cylindrical(mesh.vertices)
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    swell = 1.0 + 0.02 * np.cos(2.0 * azimuth + phase[0]) + lobe_depth * np.cos(lobes * azimuth + phase[1])
    vertices = mesh.vertices * np.stack([swell, swell, np.ones_like(swell)], axis=-1)
    vertices = _bend(vertices, height_m, bend, rng)
    return Shape(mesh=Mesh(_stand(vertices, height_m), mesh.triangles), stem=on_stem.astype(float))


def _stand(vertices: Float[np.ndarray, "v 3"], height_m: float) -> Float[np.ndarray, "v 3"]:
    """Sink the lowest 1 % of the height flat into z = 0, to rest on an area and not on a line; keep the height."""
    x, y, z = vertices.T
    z = np.maximum(z - z.min() - 0.01 * height_m, 0.0)
    return np.stack([x, y, z * height_m / z.max()], axis=-1)


def _bend(
    vertices: Float[np.ndarray, "v 3"], height_m: float, amount: float, rng: np.random.Generator
) -> Float[np.ndarray, "v 3"]:
    """Shift the top sideways by ``amount`` of the height, growing with the square of height (volume is kept)."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    shift = amount * height_m * (vertices[:, 2] / height_m) ** 2
    return vertices + np.stack([shift * np.cos(azimuth), shift * np.sin(azimuth), np.zeros_like(shift)], axis=-1)


def _smooth(nodes: Float[np.ndarray, "n 2"], *, closed_top: bool) -> Float[np.ndarray, "m 2"]:
    """A dense smooth curve through profile nodes, level where it meets the axis."""
    position = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
    level_outwards = (1, np.array([1.0, 0.0]))
    top = (1, np.array([-1.0, 0.0])) if closed_top else (2, np.zeros(2))
    curve = CubicSpline(position, nodes, bc_type=(level_outwards, top))(np.linspace(0.0, position[-1], 2000))
    curve[0] = nodes[0]
    curve[-1] = nodes[-1]
    return np.stack([np.maximum(curve[:, 0], 0.0), curve[:, 1]], axis=-1)


def _resample(profile: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Points along a profile every `VERTEX_SPACING_M`, its ends kept."""
    position = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    wanted = np.linspace(0.0, position[-1], _steps(position[-1]) + 1)
    return np.stack([np.interp(wanted, position, profile[:, i]) for i in range(2)], axis=-1)


def _steps(length_m: float) -> int:
    """Into how many steps of at most `VERTEX_SPACING_M` a length is cut."""
    return max(1, int(np.ceil(length_m / VERTEX_SPACING_M)))


def _cylindrical(points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radius, azimuth in [0, 2 pi) and height."""
    x, y, z = points.T
    return np.hypot(x, y), np.arctan2(y, x) % (2.0 * np.pi), z


def smoothstep(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """0 below 0, 1 above 1, smooth between."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
