"""Ray casting: which surface each pixel sees, and the fraction of each material in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TypeAlias

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene, rays_for_scene, unoccluded
from hsi_sc_nerf.simulate.mesh import subdivided

RAYS_AT_ONCE = 2**19
"""Of a camera, about; more take more memory."""
RAY_START_M = 2e-5
"""Offset of a ray's origin from the surface that it leaves, so that it does not hit that surface."""
WEIGHT_STEPS = 2048
"""Weights are multiples of 1 / 2048, which float16 represents exactly, so stored weights sum to exactly 1."""


Pixels = Float[np.ndarray, "*n 2"]
Lens: TypeAlias = Callable[[Pixels, PinholeIntrinsics], Pixels]
"""Where the pinhole image shows what the lens images at the given pixels; hashable, because rays are cached."""


@dataclass(frozen=True)
class Part:
    """A mesh in the object frame with the fraction of each material at its vertices."""

    mesh: Mesh
    materials: tuple[str, ...]
    weights: Float[np.ndarray, "v m"]
    is_object: bool = False
    """Whether this is the scanned object."""

    def refined(self, longest_edge_m: float) -> Part:
        """The same surface with no edge longer than ``longest_edge_m``."""
        columns, triangles = subdivided(
            np.concatenate([self.mesh.vertices, self.weights], axis=1), self.mesh.triangles, longest_edge_m
        )
        return replace(self, mesh=Mesh(columns[:, :3], triangles), weights=columns[:, 3:])


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of rays; each pixel has ``rays_per_pixel`` consecutive rays.

    Attributes:
        renderer: renderer whose parts the rays hit.
        origins, directions: of all rays; directions have unit length.
        ray: index of the ray of each hit.
        triangle: index of the renderer's triangle of each hit.
        barycentric: barycentric coordinates of each hit.
        distance_m: distance along the ray of each hit.
    """

    renderer: Renderer
    origins: Float[np.ndarray, "rays 3"]
    directions: Float[np.ndarray, "rays 3"]
    rays_per_pixel: int
    ray: Int[np.ndarray, "hits"]
    triangle: Int[np.ndarray, "hits"]
    barycentric: Float[np.ndarray, "3 hits"]
    distance_m: Float[np.ndarray, "hits"]

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return len(self.directions) // self.rays_per_pixel

    @property
    def pixel(self) -> Int[np.ndarray, "hits"]:
        """Pixel of each hit."""
        return self.ray // self.rays_per_pixel

    @cached_property
    def is_object(self) -> Bool[np.ndarray, "hits"]:
        """Whether the ray hits the scanned object."""
        return self.renderer.is_object[self.triangle]

    def positions(self) -> Float[np.ndarray, "hits 3"]:
        """Position of each hit, metres."""
        return self.origins[self.ray] + self.distance_m[:, None] * self.directions[self.ray]

    @cached_property
    def is_back_face(self) -> Bool[np.ndarray, "hits"]:
        """Whether the ray hits the back of the triangle."""
        normals = self.renderer.facet_normals[self.triangle]
        return np.einsum("nk,nk->n", normals, self.directions[self.ray]) > 0.0

    @cached_property
    def facing_normals(self) -> Float[np.ndarray, "hits 3"]:
        """Unit normals of the triangles on the visible side."""
        normals = self.renderer.facet_normals[self.triangle]
        return np.where(self.is_back_face[:, None], -normals, normals)

    def onwards(self, directions: Float[np.ndarray, "n 3"], some: Int[np.ndarray, "n"]) -> Hits:
        """First hits of rays that start at some of the hits, in the same pixels."""
        starts = self.positions()[some] + RAY_START_M * self.facing_normals[some]
        found = self.renderer.cast(starts, directions, self.rays_per_pixel)
        rays, origins, along = self.ray[some], self.origins.copy(), self.directions.copy()
        origins[rays], along[rays] = starts, directions
        return replace(found, origins=origins, directions=along, ray=rays[found.ray])

    def mix(
        self,
        triangles: Int[np.ndarray, "t 3"],
        columns: int,
        factor: Float[np.ndarray, "hits"] | float = 1.0,
    ) -> scipy.sparse.csr_array:
        """Weight of each point in each pixel: the mean over the pixel's rays, each multiplied by ``factor``.

        Args:
            triangles: the renderer's triangles as indices of points.
        """
        return scipy.sparse.csr_array(
            (
                np.concatenate(list(self.barycentric * factor)) / self.rays_per_pixel,
                (np.tile(self.pixel, 3), np.concatenate(list(triangles[self.triangle].T))),
            ),
            shape=(self.pixels, columns),
        )

    def mean(self, values: Float[np.ndarray, "hits"]) -> Float[np.ndarray, "pixels"]:
        """Mean of ``values`` over the rays of each pixel; rays that hit nothing count as 0."""
        return np.bincount(self.pixel, values, minlength=self.pixels) / self.rays_per_pixel


class Renderer:
    """Casts rays at a fixed set of parts; rays that hit nothing see the chamber.

    Attributes:
        materials: material of each column of the weights; extra materials and then the chamber come last.
        vertices, triangles, weights: of all parts, concatenated.
        is_object: which triangles belong to the scanned object.
    """

    def __init__(self, parts: Sequence[Part], extra_materials: Sequence[str] = ()) -> None:
        names = dict.fromkeys([name for part in parts for name in part.materials] + list(extra_materials))
        self.materials = (*names, "chamber")
        vertices, triangles, weights, is_object, offset = [], [], [], [], 0
        for part in parts:
            vertices.append(part.mesh.vertices)
            triangles.append(part.mesh.triangles + offset)
            offset += len(part.mesh.vertices)
            of_part = np.zeros((len(part.mesh.vertices), len(self.materials)), np.float32)
            of_part[:, [self.materials.index(name) for name in part.materials]] = part.weights
            weights.append(of_part)
            is_object.append(np.full(len(part.mesh.triangles), part.is_object))
        self.vertices = np.concatenate(vertices)
        self.triangles = np.concatenate(triangles)
        self.weights = np.concatenate(weights)
        self.is_object = np.concatenate(is_object)
        self._scene = ray_scene(self.vertices, self.triangles)

    @cached_property
    def facet_normals(self) -> Float[np.ndarray, "t 3"]:
        """Unit normal of each triangle, outwards."""
        return Mesh(self.vertices, self.triangles).facet_normals().astype(np.float32)

    def camera_hits(
        self,
        intrinsics: PinholeIntrinsics,
        camera_to_world: Float[np.ndarray, "4 4"],
        supersampling: int,
        lens: Lens | None = None,
    ) -> Iterator[tuple[slice, Hits]]:
        """Hits of the rays of a camera, a block of image lines at a time, which bounds the memory."""
        lines = max(1, RAYS_AT_ONCE // (intrinsics.w * supersampling**2))
        for first in range(0, intrinsics.h, lines):
            rows = slice(first, min(first + lines, intrinsics.h))
            directions = _camera_rays(intrinsics, rows.start, rows.stop, supersampling, lens)
            # For three columns einsum is faster than a multithreaded matrix product.
            directions = np.einsum("nk,jk->nj", directions, camera_to_world[:3, :3].astype(np.float32))
            origins = np.broadcast_to(camera_to_world[:3, 3].astype(np.float32), directions.shape)
            yield rows, self.cast(origins, directions, supersampling**2)

    def cast(
        self, origins: Float[np.ndarray, "rays 3"], directions: Float[np.ndarray, "rays 3"], rays_per_pixel: int
    ) -> Hits:
        """First hits of rays with unit directions."""
        hits = self._scene.cast_rays(rays_for_scene(origins, directions))
        distance_m = hits["t_hit"].numpy()
        ray = np.flatnonzero(np.isfinite(distance_m))
        u, v = hits["primitive_uvs"].numpy()[ray].T
        return Hits(
            renderer=self,
            origins=origins,
            directions=directions,
            rays_per_pixel=rays_per_pixel,
            ray=ray,
            triangle=hits["primitive_ids"].numpy()[ray],
            barycentric=np.stack([1.0 - u - v, u, v]),
            distance_m=distance_m[ray],
        )

    def is_free(
        self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"]
    ) -> Bool[np.ndarray, "n"]:
        """Whether rays in one direction from points of a surface, metres, hit nothing."""
        starts = points + RAY_START_M * normals
        return unoccluded(self._scene, starts, np.broadcast_to(direction, starts.shape))

    def material_weights(self, hits: Hits) -> Float[np.ndarray, "pixels materials"]:
        """Fraction of each material in each pixel, summing to exactly 1."""
        weights = hits.mix(self.triangles, len(self.weights)) @ self.weights
        weights[:, -1] = 1.0 - weights[:, :-1].sum(axis=1)
        return exact_weights(weights)


def exact_weights(weights: Float[np.ndarray, "n materials"]) -> Float[np.ndarray, "n materials"]:
    """Round weights to multiples of 1 / `WEIGHT_STEPS` such that each row sums to exactly 1.

    The rounding error is added to the row's largest weight.
    """
    steps = np.rint(np.clip(weights, 0.0, 1.0) * WEIGHT_STEPS)
    largest = steps.argmax(axis=1)
    steps[np.arange(len(steps)), largest] += WEIGHT_STEPS - steps.sum(axis=1)
    return (steps / WEIGHT_STEPS).astype(np.float32)


@lru_cache(maxsize=16)
def _camera_rays(
    intrinsics: PinholeIntrinsics, first_line: int, end_line: int, supersampling: int, lens: Lens | None
) -> Float[np.ndarray, "rays 3"]:
    """Ray directions of some image lines in the camera frame, with the rays of each pixel consecutive.

    They are cached because the camera is stationary.
    """
    offsets = (np.arange(supersampling) + 0.5) / supersampling
    lines, samples = np.arange(first_line, end_line), np.arange(intrinsics.w)
    y, x, sub_y, sub_x = np.meshgrid(lines, samples, offsets, offsets, indexing="ij")
    pixels = np.stack([x + sub_x, y + sub_y], axis=-1).reshape(-1, 2)
    if lens is not None:
        pixels = lens(pixels, intrinsics)
    return pixel_rays(intrinsics, np.eye(4), pixels)[1].astype(np.float32)
