"""Triangle meshes: surfaces of revolution, quadrilaterals, merging of vertices and subdivision."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels

from hsi_sc_nerf.geometry.mesh import Mesh

SEGMENTS = 336
"""Vertices around the axis of an object."""
VERTEX_SPACING_M = 0.0005
"""Largest distance between the rings of vertices of an object."""


def revolve(profile: Float[np.ndarray, "n 2"], segments: int) -> Mesh:
    """Closed surface of revolution about z.

    Args:
        profile: (radius, height) points from the lower to the upper pole; the first and last radius are 0, the others
            positive.

    Returns:
        A mesh whose first vertex is the lower pole and whose last vertex is the upper pole; vertex
        ``1 + ring * segments + k`` has the azimuth ``360 k / segments`` degrees.
    """
    profile = np.asarray(profile, float)
    azimuth = 2.0 * np.pi * np.arange(segments) / segments
    radius, height = profile[1:-1].T
    on_rings = radius[:, None] * np.cos(azimuth), radius[:, None] * np.sin(azimuth), height[:, None]
    rings = np.stack(np.broadcast_arrays(*on_rings), axis=-1).reshape(-1, 3)
    vertices = np.concatenate([[[0.0, 0.0, profile[0, 1]]], rings, [[0.0, 0.0, profile[-1, 1]]]])

    ring = 1 + np.arange(len(rings)).reshape(-1, segments)
    following = np.roll(ring, -1, axis=1)
    below, below_next, above, above_next = ring[:-1], following[:-1], ring[1:], following[1:]
    parts = (
        (np.zeros_like(ring[0]), following[0], ring[0]),
        (below, below_next, above_next),
        (below, above_next, above),
        (np.full_like(ring[0], len(vertices) - 1), ring[-1], following[-1]),
    )
    return Mesh(vertices, np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in parts]))


def sphere(diameter_m: float) -> Mesh:
    """A sphere that stands on z = 0; its vertices lie on it, so area and volume are at most 0.02 % too small."""
    radius_m = diameter_m / 2.0
    rings = max(SEGMENTS // 2, steps(np.pi * radius_m))
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, rings + 1)
    profile = np.stack([radius_m * np.cos(latitude), radius_m * (1.0 + np.sin(latitude))], axis=-1)
    profile[[0, -1], 0] = 0.0
    return revolve(profile, SEGMENTS)


def cylinder(diameter_m: float, height_m: float, segments: int = 128, spacing_m: float | None = None) -> Mesh:
    """A closed upright cylinder that stands on z = 0.

    Args:
        diameter_m: diameter of the circle through its vertices, metres.
        height_m: metres.
        spacing_m: largest distance between rings of vertices, metres; None gives rings at the two rims only.
    """
    r = diameter_m / 2.0
    corners = np.array([[0.0, 0.0], [r, 0.0], [r, height_m], [0.0, height_m]])
    sides = [
        np.linspace(a, b, 2 if spacing_m is None else steps(float(np.linalg.norm(b - a)), spacing_m) + 1)
        for a, b in pairwise(corners)
    ]
    return revolve(np.concatenate([sides[0], sides[1][1:], sides[2][1:]]), segments)


def steps(length_m: float, longest_m: float = VERTEX_SPACING_M) -> int:
    """The smallest number of equal steps, none longer than ``longest_m``, that make up a length."""
    return max(1, int(np.ceil(length_m / longest_m)))


def quads(corners: Float[np.ndarray, "q 4 3"]) -> Mesh:
    """Separate flat quadrilaterals with counter-clockwise corners; no vertices are shared."""
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return Mesh(np.asarray(corners, float).reshape(-1, 3), triangles)


def snapped(vertices: Float[np.ndarray, "v 3"], tolerance_m: float) -> Float[np.ndarray, "v 3"]:
    """Vertices within ``tolerance_m`` of each other get the position of the first of them."""
    near = cKDTree(vertices).query_pairs(tolerance_m, output_type="ndarray")
    group = connected_component_labels(near, node_count=len(vertices))
    _, first = np.unique(group, return_index=True)
    return vertices[first[group]]


def welded(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], columns: Float[np.ndarray, "v c"]
) -> tuple[Mesh, Float[np.ndarray, "w c"]]:
    """Merge vertices of equal position, average their columns, and remove degenerate triangles."""
    # Adding 0 turns -0 into 0.
    positions, position = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    position = position.ravel()
    count = np.bincount(position, minlength=len(positions))
    mean = np.stack([np.bincount(position, column, minlength=len(positions)) for column in columns.T], axis=-1)
    a, b, c = position[triangles].T
    return Mesh(positions, np.stack([a, b, c], axis=-1)[(a != b) & (b != c) & (c != a)]), mean / count[:, None]


def subdivided(
    vertices: Float[np.ndarray, "v 3+c"], triangles: Int[np.ndarray, "t 3"], longest_m: float
) -> tuple[Float[np.ndarray, "w 3+c"], Int[np.ndarray, "s 3"]]:
    """Subdivide triangles until no edge is longer than ``longest_m``.

    Long edges are halved repeatedly. Whether an edge is halved depends on the positions of its ends only, so a closed
    mesh stays closed, also along seams of repeated vertices. Columns after the first three are interpolated.
    """
    while True:
        start, end = triangles, np.roll(triangles, -1, axis=1)
        is_long = np.linalg.norm(vertices[start, :3] - vertices[end, :3], axis=-1) > longest_m
        if not is_long.any():
            return vertices, triangles
        n = len(vertices)
        edges = np.minimum(start, end).astype(np.int64) * n + np.maximum(start, end)
        halved, which = np.unique(edges[is_long], return_inverse=True)
        middle = np.full(triangles.shape, -1)
        middle[is_long] = n + which
        vertices = np.concatenate([vertices, (vertices[halved // n] + vertices[halved % n]) / 2.0])
        triangles = np.concatenate([_cut(triangles, middle, long_edges, vertices) for long_edges in range(4)])


def _cut(
    triangles: Int[np.ndarray, "t 3"], middle: Int[np.ndarray, "t 3"], long_edges: int, vertices: np.ndarray
) -> Int[np.ndarray, "s 3"]:
    """Subdivide the triangles that have ``long_edges`` of them; ``middle`` is the midpoint after each corner, or
    -1."""
    chosen = (middle >= 0).sum(axis=1) == long_edges
    corners, middle = triangles[chosen], middle[chosen]
    # Rotate the corners so that the long edges come first.
    turn = {1: middle.argmax(axis=1), 2: middle.argmin(axis=1) + 1}.get(long_edges, np.zeros(len(corners), int))
    order = (turn[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(corners, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, order, axis=1).T
    if long_edges == 0:
        return corners
    if long_edges == 1:
        pieces = [(a, ab, c), (ab, b, c)]
    elif long_edges == 2:
        # The remaining quadrilateral is split along its shorter diagonal.
        across, back = (np.linalg.norm(vertices[p, :3] - vertices[q, :3], axis=-1) for p, q in ((a, bc), (ab, c)))
        from_a = across < back
        pieces = [(ab, b, bc), (a, ab, np.where(from_a, bc, c)), (np.where(from_a, a, ab), bc, c)]
    else:
        pieces = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(piece, axis=-1) for piece in pieces])
