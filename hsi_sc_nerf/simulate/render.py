"""Ray casting: which materials, in which shares, each pixel sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Float

from hsi_sc_nerf.poses.geometry import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.simulate.mesh import Mesh

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

    ``materials`` names the columns of the weights; the last one is the chamber.
    """

    def __init__(self, parts: Sequence[Part], chamber: str = "chamber") -> None:
        names = dict.fromkeys(name for part in parts for name in part.materials)
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
        self, intrinsics: PinholeIntrinsics, camera_to_world: Float[np.ndarray, "4 4"], supersampling: int
    ) -> tuple[Float[np.ndarray, "h w materials"], Float[np.ndarray, "h w"]]:
        """Material weights of each pixel (float32, summing to exactly 1) and the object's share of it.

        A pixel is the mean over ``supersampling`` x ``supersampling`` rays, evenly spaced (a box filter).
        """
        s, h, w = supersampling, intrinsics.h, intrinsics.w
        offsets = (np.arange(s) + 0.5) / s
        # Subsamples of a pixel follow each other, so that a pixel is a run of s * s rays.
        y, sub_y, x, sub_x = np.meshgrid(np.arange(h), offsets, np.arange(w), offsets, indexing="ij")
        pixels = np.stack([x + sub_x, y + sub_y], axis=-1).transpose(0, 2, 1, 3, 4).reshape(-1, 2)
        origin, directions = pixel_rays(intrinsics, camera_to_world, pixels)
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=1).astype(np.float32)
        hits = self._scene.cast_rays(o3d.core.Tensor(rays))

        triangle = hits["primitive_ids"].numpy()
        hit = np.flatnonzero(triangle != o3d.t.geometry.RaycastingScene.INVALID_ID)
        triangle = triangle[hit]
        uv = hits["primitive_uvs"].numpy()[hit]
        barycentric = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        of_hits = np.einsum("nk,nkm->nm", barycentric, self._weights[self._triangles[triangle]])

        pixel = hit // (s * s)
        starts = np.flatnonzero(np.diff(pixel, prepend=-1))
        weights = np.zeros((h * w, len(self.materials)), np.float32)
        coverage = np.zeros(h * w, np.float32)
        if len(starts):
            weights[pixel[starts]] = np.add.reduceat(of_hits, starts, axis=0)
            coverage[pixel[starts]] = np.add.reduceat(self._is_object[triangle].astype(np.float32), starts)
        weights /= s * s
        weights[:, -1] = 1.0 - weights[:, :-1].sum(axis=1)
        return exact_weights(weights).reshape(h, w, -1), (coverage / (s * s)).reshape(h, w)


def exact_weights(weights: Float[np.ndarray, "n materials"]) -> Float[np.ndarray, "n materials"]:
    """Round weights to multiples of 1 / `WEIGHT_STEPS` such that each row sums to exactly 1.

    What rounding leaves over goes to the row's largest weight.
    """
    steps = np.rint(np.clip(weights, 0.0, 1.0) * WEIGHT_STEPS)
    largest = steps.argmax(axis=1)
    steps[np.arange(len(steps)), largest] += WEIGHT_STEPS - steps.sum(axis=1)
    return (steps / WEIGHT_STEPS).astype(np.float32)
