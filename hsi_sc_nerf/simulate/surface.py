"""Points on the surface of all parts: what each point sees around it, and diffusion of light between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from hsi_sc_nerf.simulate.render import RAY_START_M, Renderer

CREASE_DEG = 40.0
"""Facets that meet at more than this have points of their own along the edge: light changes at once there."""
POINTS_AT_ONCE = 4096
COVER_DISTANCE_M, COVER_FRACTION = 0.001, 0.6
"""A point is covered if this fraction of what it sees is seen from behind or, on the object's support, is so near."""
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
COLUMNS_AT_ONCE = 8


@dataclass(frozen=True)
class Surroundings:
    """What the points of a surface see in the half space above them, weighted by the cosine to the normal.

    Attributes:
        free: fraction of directions in which nothing but the chamber is seen, in [0, 1].
        seen: fraction of each point of the surface in what each point sees; what is seen from behind is left out.
    """

    free: Float[np.ndarray, "p"]
    seen: scipy.sparse.csr_array


class Surface:
    """Points on all parts, one for each vertex, and several where facets meet at a crease.

    Attributes:
        renderer: whose parts these are.
        vertex: vertex of the renderer at which each point lies.
        triangles: the renderer's triangles, by points.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.triangles, self.vertex = split_at_creases(renderer.vertices, renderer.triangles, CREASE_DEG)
        self._surroundings: dict[int, Surroundings] = {}

    @cached_property
    def positions(self) -> Float[np.ndarray, "p 3"]:
        """Place of each point, metres."""
        return self.renderer.vertices[self.vertex]

    @cached_property
    def normals(self) -> Float[np.ndarray, "p 3"]:
        """Unit normal of each point, outwards: the mean of its facets, weighted by area."""
        doubled = self._doubled_normals()
        total = self._over_corners(np.repeat(doubled, 3, axis=0))
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)

    @cached_property
    def areas_m2(self) -> Float[np.ndarray, "p"]:
        """Each point's fraction of the surface: a third of each of its triangles."""
        thirds = np.linalg.norm(self._doubled_normals(), axis=1) / 6.0
        return self._over_corners(np.repeat(thirds, 3)[:, None])[:, 0]

    @cached_property
    def is_object(self) -> Bool[np.ndarray, "p"]:
        """Which points lie on the thing that is scanned."""
        is_object = np.zeros(len(self.vertex), bool)
        is_object[self.triangles[self.renderer.is_object]] = True
        return is_object

    def spread_over_object(self, values: Float[np.ndarray, "p c"], width_m: float) -> Float[np.ndarray, "p c"]:
        """Values of the object's points (of all others 0), spread over its surface (`diffusion.diffused`).

        Points of one vertex get the same value; each column's total over the object is kept.
        """
        points = np.flatnonzero(self.is_object)
        vertices, vertex = np.unique(self.vertex[points], return_inverse=True)
        local = np.zeros(len(self.renderer.vertices), np.int64)
        local[vertices] = np.arange(len(vertices))
        areas_m2 = self.areas_m2[points]
        to_vertices = scipy.sparse.csr_array((areas_m2, (vertex, np.arange(len(points)))))
        at_vertices = (to_vertices @ values[points]) / np.maximum(np.bincount(vertex, areas_m2), 1e-30)[:, None]
        triangles = local[self.renderer.triangles[self.renderer.is_object]]
        spread = np.zeros_like(values)
        spread[points] = diffused(self.renderer.vertices[vertices], triangles, at_vertices, width_m)[vertex]
        return spread

    def surroundings(self, directions: int) -> Surroundings:
        """What each point sees along so many directions; computed once."""
        if directions not in self._surroundings:
            self._surroundings[directions] = self._look_around(directions)
        return self._surroundings[directions]

    def _doubled_normals(self) -> Float[np.ndarray, "t 3"]:
        a, b, c = (self.renderer.vertices[corner] for corner in self.renderer.triangles.T)
        return np.cross(b - a, c - a)

    def _over_corners(self, of_corner: Float[np.ndarray, "3t n"]) -> Float[np.ndarray, "p n"]:
        point, points = self.triangles.ravel(), len(self.vertex)
        return np.stack([np.bincount(point, column, minlength=points) for column in of_corner.T], axis=-1)

    def _look_around(self, directions: int) -> Surroundings:
        points = len(self.vertex)
        free, covered, seen = np.empty(points), np.empty(points, bool), []
        # Turned from point to point, so that neighbours do not share their errors.
        turn = GOLDEN_ANGLE * np.arange(points)
        for first in range(0, points, POINTS_AT_ONCE):
            some = slice(first, min(first + POINTS_AT_ONCE, points))
            above = cosine_directions(directions, turn[some]).astype(np.float32)
            along = np.einsum("pdk,pkj->pdj", above, _frames(self.normals[some]).astype(np.float32)).reshape(-1, 3)
            start = np.repeat(
                (self.positions[some] + RAY_START_M * self.normals[some]).astype(np.float32), directions, axis=0
            )
            hits = self.renderer.cast(start, along, directions)
            count = some.stop - some.start
            free[some] = 1.0 - np.bincount(hits.pixel, minlength=count) / directions
            near = (hits.distance_m < COVER_DISTANCE_M) & ~self.is_object[some][hits.pixel]
            covered[some] = (
                np.bincount(hits.pixel, hits.is_behind | near, minlength=count) >= COVER_FRACTION * directions
            )
            seen.append(hits.mix(self.triangles, points, (~hits.is_behind).astype(np.float32)))
        uncover = self._from_uncovered_neighbours(covered)
        return Surroundings(uncover @ free, scipy.sparse.csr_array(uncover @ scipy.sparse.vstack(seen, format="csr")))

    def _from_uncovered_neighbours(self, covered: Bool[np.ndarray, "p"]) -> scipy.sparse.csr_array:
        """Gives a covered point the mean of its uncovered neighbours.

        Else the light next to where one part stands on another would be mixed with the dark between the two.
        """
        start, end = self.triangles.ravel(), np.roll(self.triangles, -1, axis=1).ravel()
        row, column = np.concatenate([start, end]), np.concatenate([end, start])
        needed = covered[row] & ~covered[column]
        points = np.arange(len(covered))
        has_neighbour = np.zeros(len(covered), bool)
        has_neighbour[row[needed]] = True
        row = np.concatenate([row[needed], points[~has_neighbour]])
        column = np.concatenate([column[needed], points[~has_neighbour]])
        means = scipy.sparse.csr_array((np.ones(len(row)), (row, column)), shape=(len(covered),) * 2)
        return scipy.sparse.csr_array(scipy.sparse.diags_array(1.0 / means.sum(axis=1)) @ means)


def split_at_creases(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], crease_deg: float
) -> tuple[Int[np.ndarray, "t 3"], Int[np.ndarray, "p"]]:
    """Points for the vertices, several where facets meet at more than ``crease_deg``.

    Returns the triangles by points, and the vertex of each point.
    """
    a, b, c = (vertices[corner] for corner in triangles.T)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    # Corner 3 t + k is where edge k of triangle t starts. The two triangles of an edge come together by sorting.
    corner = np.arange(triangles.size)
    following = corner - corner % 3 + (corner + 1) % 3
    start, end = triangles.ravel(), triangles.ravel()[following]
    edge = np.minimum(start, end).astype(np.int64) * len(vertices) + np.maximum(start, end)
    order = np.argsort(edge, kind="stable")
    shared = edge[order[1:]] == edge[order[:-1]]
    one, other = order[:-1][shared], order[1:][shared]
    smooth = np.einsum("nk,nk->n", normals[one // 3], normals[other // 3]) >= np.cos(np.deg2rad(crease_deg))
    one, other = one[smooth], other[smooth]
    runs_back = start[one] != start[other]
    same_as_start = np.where(runs_back, following[other], other)
    same_as_end = np.where(runs_back, other, following[other])
    rows, columns = np.concatenate([one, following[one]]), np.concatenate([same_as_start, same_as_end])
    joined = scipy.sparse.coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(corner),) * 2)
    points, point = connected_components(joined, directed=False)
    vertex = np.empty(points, np.int64)
    vertex[point] = triangles.ravel()
    return point.reshape(-1, 3), vertex


def cosine_directions(directions: int, turn: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p directions 3"]:
    """Directions about +z, each standing for the same fraction of the cosine-weighted half space (Malley's method).

    They lie above the points of a Fibonacci spiral on the unit disc, turned by ``turn`` (radians).
    """
    index = np.arange(directions) + 0.5
    radius = np.sqrt(index / directions)
    azimuth = GOLDEN_ANGLE * index + turn[:, None]
    height = np.broadcast_to(np.sqrt(1.0 - radius**2), azimuth.shape)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)


def _frames(normals: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """Rows: two tangents and the normal."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-30)
    return np.stack([tangent, np.cross(normals, tangent), normals], axis=1)


def diffused(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    values: Float[np.ndarray, "v c"],
    width_m: float,
) -> Float[np.ndarray, "v c"]:
    """Values at the vertices, each spread over the surface around it.

    Solves (1 - w² / 2 Laplacian) u = values with linear finite elements, so that a point becomes a spot whose
    standard deviation along each direction of a flat surface is ``width_m``: the steady state of light that wanders
    and is lost on its way (the diffusion approximation, in two dimensions). Each column's total over the surface is
    kept, and none exceeds its largest value or falls below its smallest.
    """
    laplacian, areas_m2 = cotangent_laplacian(vertices, triangles)
    # A vertex of no triangle keeps its value.
    areas_m2 = np.where(areas_m2 > 0.0, areas_m2, areas_m2.mean())
    matrix = scipy.sparse.diags_array(areas_m2) + 0.5 * width_m**2 * laplacian
    factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    spread = np.zeros_like(values)
    used = np.flatnonzero(values.any(axis=0))
    for first in range(0, len(used), COLUMNS_AT_ONCE):
        columns = used[first : first + COLUMNS_AT_ONCE]
        spread[:, columns] = factors.solve(areas_m2[:, None] * values[:, columns].astype(float))
    return spread


def cotangent_laplacian(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[scipy.sparse.csr_array, Float[np.ndarray, "v"]]:
    """Stiffness matrix of linear finite elements (positive semidefinite), and each vertex's fraction of the area.

    Negative cotangents, of triangles with an obtuse angle, count as 0: values then stay within their range.
    """
    size = len(vertices)
    matrix = scipy.sparse.csr_array((size, size))
    areas_m2 = np.zeros(size)
    for k in range(3):
        apex, start, end = (triangles[:, (k + i) % 3] for i in range(3))
        u, v = vertices[start] - vertices[apex], vertices[end] - vertices[apex]
        doubled = np.linalg.norm(np.cross(u, v), axis=1)
        half_cotangent = 0.5 * np.maximum(np.einsum("nk,nk->n", u, v), 0.0) / np.maximum(doubled, 1e-30)
        matrix += scipy.sparse.csr_array((half_cotangent, (start, end)), shape=(size, size))
        areas_m2 += np.bincount(apex, doubled / 6.0, minlength=size)
    matrix = matrix + matrix.T
    return scipy.sparse.csr_array(scipy.sparse.diags_array(matrix.sum(axis=1)) - matrix), areas_m2
