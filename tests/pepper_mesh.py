"""Makes the mesh of the shipped scene ``pepper``: ``python tests/pepper_mesh.py FILE.ply``.

A bell pepper of four uneven lobes that is turning red, with the shares of its three materials as vertex properties.
"""

import sys
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.interpolate import CubicSpline

from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.materials import over, smooth_noise, smoothstep
from hsi_sc_nerf.simulate.mesh import revolve

MATERIALS = ("pepper_red", "pepper_green", "pepper_stem")
HEIGHT_M = 0.105
SEGMENTS = 112
BODY_RINGS = 50
BODY = np.array(
    [
        (0.0, 0.075), (0.10, 0.045), (0.20, 0.0), (0.30, 0.045), (0.35, 0.16), (0.38, 0.32), (0.41, 0.50),
        (0.415, 0.62), (0.36, 0.74), (0.26, 0.775), (0.16, 0.735), (0.085, 0.71),
    ]
)  # fmt: skip
STEM = np.array(
    [
        (0.078, 0.722), (0.062, 0.745), (0.050, 0.775), (0.045, 0.82), (0.043, 0.88), (0.046, 0.94), (0.054, 0.985),
        (0.050, 1.0), (0.025, 1.0), (0.0, 1.0),
    ]
)  # fmt: skip


def pepper() -> tuple[Mesh, np.ndarray]:
    """The mesh, in metres, and shares of `MATERIALS` at its vertices."""
    rng = np.random.default_rng(11)
    body = CubicSpline(np.linspace(0.0, 1.0, len(BODY)), BODY)(np.linspace(0.0, 1.0, BODY_RINGS))
    body[0] = BODY[0]
    mesh = revolve(np.concatenate([body, STEM]) * HEIGHT_M, SEGMENTS)
    on_stem = np.arange(len(mesh.vertices)) >= 1 + (BODY_RINGS - 1) * SEGMENTS
    x, y, z = mesh.vertices.T
    azimuth, height, radius = np.arctan2(y, x), z / HEIGHT_M, np.hypot(x, y) / HEIGHT_M

    # Furrows between lobes of unequal width, deeper at both ends than around the belly.
    furrow = np.exp(-((np.sin(2.0 * (azimuth + 0.14 * np.sin(azimuth + 1.0))) / 0.42) ** 2))
    outwards = smoothstep(radius / 0.2) * ~on_stem
    depth = (0.055 + 0.16 * smoothstep((0.28 - height) / 0.28) + 0.10 * smoothstep((height - 0.55) / 0.2)) * outwards
    width = 1.0 - depth * furrow + 0.03 * outwards * np.cos(azimuth - 0.6)
    sunk = HEIGHT_M * (0.05 * smoothstep((0.2 - height) / 0.2) - 0.05 * smoothstep((height - 0.6) / 0.15)) * furrow
    lean = 0.05 * HEIGHT_M * np.where(on_stem, (height - 0.72) / 0.28, 0.0) ** 2
    vertices = np.stack([x * width + 2.0 * lean, y * width - lean, z + sunk * outwards], axis=-1)

    red, green, stem = np.eye(3)
    ripeness = 0.55 + 0.55 * np.cos(azimuth - 0.9) + 0.35 * smooth_noise(vertices, 0.03, rng) + 0.5 * (0.45 - height)
    weights = over(np.tile(red, (len(vertices), 1)), green, 0.95 * smoothstep(0.5 - 1.1 * (ripeness - 0.1)))
    # The calyx: a lobed green collar around the foot of the stem.
    collar = 0.155 + 0.03 * np.cos(5.0 * azimuth)
    weights = over(weights, stem, smoothstep((collar - radius) / 0.02 + 0.5) * (height > 0.5))
    return Mesh(vertices, mesh.triangles), weights


def write(path: Path) -> None:
    """Write the pepper as binary PLY with shares in 1 / 255."""
    mesh, weights = pepper()
    vertex = np.empty(
        len(mesh.vertices), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((f"weight_{m}", "u1") for m in MATERIALS)]
    )
    vertex["x"], vertex["y"], vertex["z"] = mesh.vertices.T
    for name, column in zip(MATERIALS, weights.T, strict=True):
        vertex[f"weight_{name}"] = np.rint(255.0 * column)
    face = np.empty(len(mesh.triangles), [("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = mesh.triangles
    elements = [PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]
    PlyData(elements, byte_order="<", comments=["a bell pepper, metres, z up"]).write(path)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
