"""Ray casting: which materials, in which shares, each pixel sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import open3d as o3d
import scipy.sparse
from jaxtyping import Float

from hsi_sc_nerf.poses.geometry import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.simulate.effects.stages import LensEffect
from hsi_sc_nerf.simulate.mesh import Mesh

RAYS_AT_ONCE = 2**19
WEIGHT_STEPS = 2048
"""Weights are multiples of 1 / 2048, which float16 holds exactly, so that stored weights sum to exactly 1."""


@dataclass(frozen=True)
class Part:
    """A mesh with shares of materials at its vertices, in the object frame."""

    mesh: Mesh
    materials: tuple[str, ...]
    weights: Float[np.ndarray, "v m"]
    is_object: bool = False
    """Whether this is the thing that is scanned, not its surroundings."""


class Renderer:
    """Casts rays at a fixed set of parts; whatever a ray misses is the chamber.

    ``materials`` names the columns of the weights; the last one is the chamber, before it come the extra ones.
    """

    def __init__(self, parts: Sequence[Part], chamber: str = "chamber", extra_materials: Sequence[str] = ()) -> None:
        names = dict.fromkeys([name for part in parts for name in part.materials] + list(extra_materials))
        self.materials = (*names, chamber)
        vertices, triangles, weights, is_object, offset = [], [], [], [], 0
        for part in parts:
            vertices.append(part.mesh.vertices)
            triangles.append(part.mesh.triangles + offset)
            offset += len(part.mesh.vertices)
            of_part = np.zeros((len(part.mesh.vertices), len(self.materials)), np.float32)
            of_part[:, [self.materials.index(name) for name in part.materials]] = part.weights
            weights.append(of_part)
            is_object.append(np.full(len(part.mesh.triangles), part.is_object))
        self._triangles = np.concatenate(triangles)
        self._weights = np.concatenate(weights)
        self._is_object = np.concatenate(is_object)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(np.concatenate(vertices).astype(np.float32), self._triangles.astype(np.uint32))

    def render(
        self,
        intrinsics: PinholeIntrinsics,
        camera_to_world: Float[np.ndarray, "4 4"],
        supersampling: int,
        lens: LensEffect | None = None,
    ) -> tuple[Float[np.ndarray, "h w materials"], Float[np.ndarray, "h w"]]:
        """Material weights of each pixel (float32, summing to exactly 1) and the object's share of it.

        A pixel is the mean over ``supersampling`` x ``supersampling`` rays, evenly spaced (a box filter), which a
        ``lens`` bends.
        """
        weights = np.empty((intrinsics.h, intrinsics.w, len(self.materials)), np.float32)
        coverage = np.empty((intrinsics.h, intrinsics.w), np.float32)
        # As many lines at once as keep the memory small.
        lines = max(1, RAYS_AT_ONCE // (intrinsics.w * supersampling**2))
        for first in range(0, intrinsics.h, lines):
            rows = slice(first, min(first + lines, intrinsics.h))
            directions = _camera_rays(intrinsics, rows.start, rows.stop, supersampling, lens)
            # Three columns are too few for a matrix product to pay for its threads.
            directions = np.einsum("nk,jk->nj", directions, camera_to_world[:3, :3].astype(np.float32))
            of_rows, coverage_of_rows = self._mean_along_rays(camera_to_world[:3, 3], directions, supersampling**2)
            weights[rows] = of_rows.reshape(-1, intrinsics.w, len(self.materials))
            coverage[rows] = coverage_of_rows.reshape(-1, intrinsics.w)
        return weights, coverage

    def _mean_along_rays(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "rays 3"], rays_per_pixel: int
    ) -> tuple[Float[np.ndarray, "pixels materials"], Float[np.ndarray, "pixels"]]:
        """Weights and object share of pixels that are runs of ``rays_per_pixel`` rays."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin, directions
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        triangle = hits["primitive_ids"].numpy()
        hit = np.flatnonzero(triangle != o3d.t.geometry.RaycastingScene.INVALID_ID)
        triangle = triangle[hit]
        u, v = hits["primitive_uvs"].numpy()[hit].T
        a, b, c = self._triangles[triangle].T

        # Each ray adds its hit's barycentric mix of three vertices to its pixel: one sparse matrix product.
        pixel = hit // rays_per_pixel
        pixels = len(directions) // rays_per_pixel
        mix = scipy.sparse.csr_array(
            (
                np.concatenate([1.0 - u - v, u, v]) / rays_per_pixel,
                (np.tile(pixel, 3), np.concatenate([a, b, c])),
            ),
            shape=(pixels, len(self._weights)),
        )
        weights = mix @ self._weights
        weights[:, -1] = 1.0 - weights[:, :-1].sum(axis=1)
        coverage = np.bincount(pixel, self._is_object[triangle], minlength=pixels) / rays_per_pixel
        return exact_weights(weights), coverage


def exact_weights(weights: Float[np.ndarray, "n materials"]) -> Float[np.ndarray, "n materials"]:
    """Round weights to multiples of 1 / `WEIGHT_STEPS` such that each row sums to exactly 1.

    What rounding leaves over goes to the row's largest weight.
    """
    steps = np.rint(np.clip(weights, 0.0, 1.0) * WEIGHT_STEPS)
    largest = steps.argmax(axis=1)
    steps[np.arange(len(steps)), largest] += WEIGHT_STEPS - steps.sum(axis=1)
    return (steps / WEIGHT_STEPS).astype(np.float32)


@lru_cache(maxsize=16)
def _camera_rays(
    intrinsics: PinholeIntrinsics, first_line: int, end_line: int, supersampling: int, lens: LensEffect | None
) -> Float[np.ndarray, "rays 3"]:
    """Directions, in the camera's axes, of the rays through some lines; a pixel's rays follow one another.

    Kept from frame to frame, since the camera stands still.
    """
    offsets = (np.arange(supersampling) + 0.5) / supersampling
    lines, samples = np.arange(first_line, end_line), np.arange(intrinsics.w)
    y, x, sub_y, sub_x = np.meshgrid(lines, samples, offsets, offsets, indexing="ij")
    pixels = np.stack([x + sub_x, y + sub_y], axis=-1).reshape(-1, 2)
    if lens is not None:
        pixels = lens.straighten(pixels, intrinsics)
    return pixel_rays(intrinsics, np.eye(4), pixels)[1].astype(np.float32)
