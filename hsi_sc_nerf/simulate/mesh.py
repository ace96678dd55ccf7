"""Triangle meshes as plain arrays: area, volume, and the few ways in which the simulator makes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in metres; triangles run counter-clockwise seen from outside."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]

    def moved(self, offset: Float[np.ndarray, "3"]) -> Mesh:
        """The mesh shifted by ``offset`` (metres)."""
        return Mesh(self.vertices + offset, self.triangles)

    def area_m2(self) -> float:
        """Surface area."""
        return float(np.linalg.norm(self._doubled_normals(), axis=1).sum() / 2.0)

    def volume_m3(self) -> float:
        """Enclosed volume of a closed mesh (divergence theorem)."""
        first = self.vertices[self.triangles[:, 0]]
        return float(np.einsum("ij,ij->", first, self._doubled_normals()) / 6.0)

    def is_watertight(self) -> bool:
        """Whether each edge belongs to exactly two triangles that run along it in opposite directions."""
        t = self.triangles.astype(np.int64)
        start, end = t.ravel(), np.roll(t, -1, axis=1).ravel()
        n = len(self.vertices)
        forward, backward = np.sort(start * n + end), np.sort(end * n + start)
        return bool((np.diff(forward) > 0).all() and np.array_equal(forward, backward))

    def _doubled_normals(self) -> Float[np.ndarray, "t 3"]:
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return np.cross(b - a, c - a)


def revolve(profile: Float[np.ndarray, "n 2"], segments: int) -> Mesh:
    """Turn a profile of (radius, height) points about z into a closed mesh.

    The profile runs from the lower to the upper pole; its first and last radius must be 0 and the others above
    0. Vertex 0 is the lower pole and the last vertex the upper pole; between them vertex ``1 + ring * segments
    + k`` is at azimuth ``360 k / segments`` degrees.

    Raises:
        ValueError: the profile does not start and end on the axis, or touches it in between.
    """
    profile = np.asarray(profile, float)
    if len(profile) < 3 or profile[0, 0] != 0.0 or profile[-1, 0] != 0.0 or (profile[1:-1, 0] <= 0.0).any():
        raise ValueError("revolve: the profile must start and end on the axis and stay off it in between")
    azimuth = 2.0 * np.pi * np.arange(segments) / segments
    radius, height = profile[1:-1].T
    rings = np.stack(
        [
            radius[:, None] * np.cos(azimuth),
            radius[:, None] * np.sin(azimuth),
            np.broadcast_to(height[:, None], (len(radius), segments)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0.0, 0.0, profile[0, 1]]], rings, [[0.0, 0.0, profile[-1, 1]]]])

    k = np.arange(segments)
    following = (k + 1) % segments
    first, last = 1, 1 + (len(radius) - 1) * segments
    lower_cap = np.stack([np.zeros_like(k), first + following, first + k], axis=-1)
    upper_cap = np.stack([np.full_like(k, len(vertices) - 1), last + k, last + following], axis=-1)
    ring = 1 + segments * np.arange(len(radius) - 1)[:, None]
    below, below_next = ring + k, ring + following
    above, above_next = below + segments, below_next + segments
    walls = np.concatenate(
        [
            np.stack([below, below_next, above_next], axis=-1).reshape(-1, 3),
            np.stack([below, above_next, above], axis=-1).reshape(-1, 3),
        ]
    )
    return Mesh(vertices, np.concatenate([lower_cap, walls, upper_cap]))


def cylinder(diameter_m: float, height_m: float, segments: int = 128) -> Mesh:
    """A closed upright cylinder that stands on z = 0."""
    r = diameter_m / 2.0
    return revolve(np.array([[0.0, 0.0], [r, 0.0], [r, height_m], [0.0, height_m]]), segments)


def quads(corners: Float[np.ndarray, "q 4 3"]) -> Mesh:
    """Separate flat quadrilaterals, each with four vertices of its own, corners in counter-clockwise order."""
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Mesh(np.asarray(corners, float).reshape(-1, 3), triangles)
