"""Which parts of a simulated object some view sees: the rest of the truth nobody can reconstruct."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import CompareConfig, Reference, Track, surface_of, without_progress
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL
from hsi_sc_nerf.meshes.mesh import ray_scene
from hsi_sc_nerf.simulate.truth import Truth, load_truth

COVERED = 0.5
"""Share of a pixel that the object must cover for the pixel to show it."""
LIFT_M = 1e-5
"""How far above its own surface a point's line of sight starts."""


def true_reference(session_dir: Path, config: CompareConfig, track: Track = without_progress) -> Reference:
    """The true surface of a simulated session, for `hsi_sc_nerf.evaluation.comparison.compare`.

    Args:
        session_dir: folder of the session.
        config: settings of the comparison.
        track: shows progress.

    Raises:
        InputError: the session has no truth, no view shows its object, or the unit is not metres.
    """
    if config.reference_unit != "m":
        raise InputError(f"{session_dir}: a simulated session's truth is in metres; leave out --reference-unit.")
    truth = load_truth(session_dir)
    surface, seen = surface_of(truth.mesh_path, config), None
    if not config.whole_reference:
        assert surface.vertices_m is not None
        assert surface.triangles is not None
        mesh = surface.vertices_m, surface.triangles
        seen = seen_points(
            truth, surface.points_m, *mesh, lambda captures: track(captures, "Finding what the views see")
        )
        if not seen.any():
            raise InputError(f"{session_dir}: no view shows the object; simulate the session again.")
    return Reference(str(session_dir), surface, seen, align="none")


def seen_points(
    truth: Truth,
    points_m: Float[np.ndarray, "n 3"],
    vertices_m: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    track: Callable[[tuple[str, ...]], Iterable[str]] = iter,
) -> Bool[np.ndarray, "n"]:
    """Whether some view sees each point of the object's surface.

    A view sees a point that projects into a pixel which shows the object, and whose line of sight the object itself
    does not block. What stands before the object (the container's wall) leaves the pixel without the object.

    Args:
        truth: Of the session.
        points_m: On the surface, object frame.
        vertices_m: Of the object's mesh.
        triangles: Of the object's mesh.
        track: Wrapped around the captures, for a progress bar.
    """
    scene = ray_scene(vertices_m, triangles)
    seen = np.zeros(len(points_m), bool)
    poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
    for capture in track(truth.captures):
        candidates = np.flatnonzero(~seen)
        candidates = candidates[_in_object_pixels(truth, capture, poses[capture], points_m[candidates])]
        if not len(candidates):
            continue
        sight = poses[capture][:3, 3] - points_m[candidates]
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        rays = np.concatenate([points_m[candidates], sight], axis=1, dtype=np.float32)
        blocked = scene.test_occlusions(rays, tnear=LIFT_M).numpy()
        seen[candidates[~blocked]] = True
    return seen


def _in_object_pixels(
    truth: Truth, capture: str, camera_to_world: Float[np.ndarray, "4 4"], points_m: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    coverage = truth.object_coverage(capture)
    if not len(points_m):
        return np.zeros(0, bool)
    world_to_camera = np.linalg.inv(camera_to_world @ OPENCV_TO_OPENGL)
    in_camera = points_m @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    pixels, _ = cv2.projectPoints(
        in_camera, np.zeros(3), np.zeros(3), truth.intrinsics.matrix(), np.array(truth.distortion)
    )
    columns, lines = np.floor(pixels[:, 0]).astype(int).T
    inside = (in_camera[:, 2] > 0) & (lines >= 0) & (lines < coverage.shape[0])
    inside &= (columns >= 0) & (columns < coverage.shape[1])
    shown = np.zeros(len(points_m), bool)
    shown[inside] = coverage[lines[inside], columns[inside]] >= COVERED
    return shown
