"""Points on the surface of all parts: occlusion and form factors."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse
import trimesh
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.geometry.camera import GOLDEN_ANGLE, unit_vectors
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate.render import RAY_START_M, Renderer

CREASE_DEG = 40.0
"""Angle between facets above which they have separate points along their edge, where light is discontinuous."""
POINTS_AT_ONCE = 4096
COVER_DISTANCE_M, COVER_FRACTION = 0.001, 0.6
"""A point is covered if this fraction of its rays hits a back face or, on the support, hits within the distance."""


Surroundings = tuple[Float[np.ndarray, "p"], scipy.sparse.csr_array]
"""What is visible from the points of a surface, weighted by the cosine to the normal: the fraction of directions in
which nothing occludes the chamber, in [0, 1]; and the form factors, the fraction of each point of the surface
(column) in the view of each point (row), without back faces."""


class SceneSurface:
    """Points on all parts, one for each vertex, and several where facets meet at a crease.

    Attributes:
        renderer: whose parts these are.
        vertex: the renderer's vertex of each point.
        triangles: the renderer's triangles as indices of points.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.triangles, self.vertex = split_at_creases(renderer.vertices, renderer.triangles, CREASE_DEG)
        self._surroundings: dict[int, Surroundings] = {}

    @cached_property
    def mesh(self) -> Mesh:
        """The points as a mesh, metres."""
        return Mesh(self.renderer.vertices[self.vertex], self.triangles)

    @cached_property
    def is_object(self) -> Bool[np.ndarray, "p"]:
        """Which points belong to the scanned object."""
        is_object = np.zeros(len(self.vertex), bool)
        is_object[self.triangles[self.renderer.is_object]] = True
        return is_object

    def surroundings(self, directions: int) -> Surroundings:
        """What is visible from each point, sampled in a number of directions; cached."""
        if directions not in self._surroundings:
            self._surroundings[directions] = self._sample_surroundings(directions)
        return self._surroundings[directions]

    def _sample_surroundings(self, directions: int) -> Surroundings:
        points, positions, normals = len(self.vertex), self.mesh.vertices, self.mesh.vertex_normals()
        visibility, covered, factors = np.empty(points), np.empty(points, bool), []
        # Rotated from point to point, so that errors of neighbours are independent.
        turn = GOLDEN_ANGLE * np.arange(points)
        for first in range(0, points, POINTS_AT_ONCE):
            some = slice(first, min(first + POINTS_AT_ONCE, points))
            above = cosine_directions(directions, turn[some]).astype(np.float32)
            along = np.einsum("pdk,pkj->pdj", above, _frames(normals[some]).astype(np.float32)).reshape(-1, 3)
            start = np.repeat((positions[some] + RAY_START_M * normals[some]).astype(np.float32), directions, axis=0)
            hits = self.renderer.cast(start, along, directions)
            count = some.stop - some.start
            visibility[some] = 1.0 - np.bincount(hits.pixel, minlength=count) / directions
            near = (hits.distance_m < COVER_DISTANCE_M) & ~self.is_object[some][hits.pixel]
            covered[some] = (
                np.bincount(hits.pixel, hits.is_back_face | near, minlength=count) >= COVER_FRACTION * directions
            )
            factors.append(hits.mix(self.triangles, points, (~hits.is_back_face).astype(np.float32)))
        uncover = self._from_uncovered_neighbours(covered)
        return uncover @ visibility, scipy.sparse.csr_array(uncover @ scipy.sparse.vstack(factors, format="csr"))

    def _from_uncovered_neighbours(self, covered: Bool[np.ndarray, "p"]) -> scipy.sparse.csr_array:
        """Matrix that replaces the value of a covered point by the mean of its uncovered neighbours.

        Otherwise the darkness between two parts in contact would be interpolated into the light beside the contact.
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
    """Split vertices into several points where facets meet at more than ``crease_deg``.

    Returns:
        The triangles as indices of points, and the vertex of each point.
    """
    normals = Mesh(vertices, triangles).facet_normals()
    faces, edges = trimesh.graph.face_adjacency(triangles, return_edges=True)
    smooth = np.einsum("nk,nk->n", *normals[faces.T]) >= np.cos(np.deg2rad(crease_deg))
    # Corner 3 t + k is vertex k of triangle t. At both ends of a smooth edge its triangles' corners are one point.
    one, other = (
        (3 * face + (triangles[face] == edges[smooth].T[..., None]).argmax(axis=-1)).ravel()
        for face in faces[smooth].T
    )
    point = trimesh.graph.connected_component_labels(np.stack([one, other], axis=1), node_count=triangles.size)
    vertex = np.empty(point.max() + 1, np.int64)
    vertex[point] = triangles.ravel()
    return point.reshape(-1, 3), vertex


def cosine_directions(directions: int, turn: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p directions 3"]:
    """Cosine-distributed directions about +z (Malley's method on a Fibonacci spiral, rotated by ``turn`` radians)."""
    index = np.arange(directions) + 0.5
    radius = np.sqrt(index / directions)
    azimuth = GOLDEN_ANGLE * index + turn[:, None]
    height = np.broadcast_to(np.sqrt(1.0 - radius**2), azimuth.shape)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1)


def _frames(normals: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3 3"]:
    """Tangent frames: rows are two tangents and the normal."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = unit_vectors(np.cross(helper, normals))
    return np.stack([tangent, np.cross(normals, tangent), normals], axis=1)
