"""How uncertain the place of a surface is: by the angle at which cameras see it, and where no outline shows it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixels_of
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.processing.visual_hull import MAX_MISSED_FRACTION, silhouette_counts

SURFACE_PX = 0.07
"""Standard deviation of where training puts a surface seen from the front, in pixels on the object
(docs/validation/surface.md). A pixel covers more of a surface seen obliquely, which is found less well."""
MOST_OBLIQUE = 0.34
"""Cosine of the angle, 70 degrees, from which on cameras look along a surface rather than at it."""
HOLLOW_FRACTION = 0.2
"""Standard deviation of the depth of a hollow, as a fraction of how deep it lies below the visual hull
(docs/validation/surface.md)."""
_DEEPEST_PX = 12
"""Depths below the visual hull are followed this far."""


def surface_std_m(cosine: Float[np.ndarray, "v"], pixel_m: float) -> Float[np.ndarray, "v"]:
    """Standard deviation of the place of each vertex along its normal, but for hollows (`hollow_std_m`).

    Args:
        cosine: `most_frontal_cosine` of the vertices.
        pixel_m: side of a pixel on the object.
    """
    return SURFACE_PX * pixel_m / np.maximum(cosine, MOST_OBLIQUE)


def hollow_std_m(
    mesh: Mesh,
    cosine: Float[np.ndarray, "v"],
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    pixel_m: float,
) -> Float[np.ndarray, "v"]:
    """Standard deviation of the depth of each vertex in a hollow, 0 on the visual hull and where no camera looks.

    Outlines show where the visual hull ends. A surface below it rests on how alike its spectra look in all views,
    which tells less. Hollows mostly come out too shallow.

    Args:
        mesh: with outward normals, object frame.
        cosine: `most_frontal_cosine` of its vertices.
        masks: true on the object.
        camera_to_worlds: poses, OpenGL axes.
        intrinsics: of the one camera; lens distortion is neglected.
        pixel_m: side of a pixel on the object.
    """
    normals = mesh.vertex_normals()
    depth_px = np.zeros(len(normals))
    below = np.flatnonzero(cosine > MOST_OBLIQUE)
    for step_px in range(1, _DEEPEST_PX + 1):
        moved = mesh.vertices[below] + step_px * pixel_m * normals[below]
        in_image, in_mask = silhouette_counts(
            moved, masks, lambda frame, points: pixels_of(points, camera_to_worlds[frame], intrinsics)
        )
        below = below[in_image - in_mask <= MAX_MISSED_FRACTION * len(masks)]
        # Masks may reach a pixel beyond the surface, so depths count from one pixel below the hull.
        depth_px[below] = step_px - 1
    return HOLLOW_FRACTION * pixel_m * depth_px


def most_frontal_cosine(mesh: Mesh, eyes_m: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "v"]:
    """Largest cosine, over the cameras, of the angle between a vertex' normal and the direction to the camera.

    What hides the vertex from a camera is neglected.
    """
    normals, cosine = mesh.vertex_normals(), np.full(len(mesh.vertices), -1.0)
    for eye_m in eyes_m:
        towards = eye_m - mesh.vertices
        np.maximum(cosine, np.einsum("vi,vi->v", normals, towards) / np.linalg.norm(towards, axis=1), out=cosine)
    return cosine
