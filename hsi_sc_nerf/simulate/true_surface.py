"""The true surface of a simulated object as the reference of comparisons, and what the views see of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import CompareConfig, Reference, Track, surface_of, without_progress
from hsi_sc_nerf.geometry.camera import project, project_distorted, unit_vectors
from hsi_sc_nerf.geometry.mesh import ray_scene, unoccluded
from hsi_sc_nerf.simulate.truth import COVERED, Truth, load_truth

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

LIFT_M = 1e-5
"""Offset of the origin of a line of sight from the surface."""


def true_reference(session_dir: Path, config: CompareConfig, track: Track = without_progress) -> Reference:
    """The true surface of a simulated session as the reference of `hsi_sc_nerf.evaluation.comparison.compare`.

    Unless ``config.whole_reference`` is set, only points that are visible in at least one view count for recall.

    Args:
        session_dir: folder of the session.
        config: settings of the comparison.
        track: wrapper of the captures that shows a progress bar.

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
    """Whether each point of the object's surface is visible in at least one view.

    A point is visible in a view if it projects into an object pixel and the object does not occlude it. Pixels in
    which another part occludes the object are not object pixels.

    Args:
        truth: truth of the session.
        points_m: points on the surface, object frame, metres.
        vertices_m: vertices of the object's mesh, metres.
        triangles: triangles of the object's mesh.
        track: wrapper of the captures that shows a progress bar.

    Example:
        >>> mesh = truth.mesh()
        >>> seen_points(truth, mesh.vertices, mesh.vertices, mesh.triangles).mean()
    """
    scene = ray_scene(vertices_m, triangles)
    seen = np.zeros(len(points_m), bool)
    poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
    for capture in track(truth.captures):
        candidates = np.flatnonzero(~seen)
        candidates = candidates[_in_object_pixels(truth, capture, poses[capture], points_m[candidates])]
        if not len(candidates):
            continue
        seen[candidates] = visible_from(scene, points_m[candidates], poses[capture][:3, 3])
    return seen


def visible_from(
    scene: RaycastingScene,
    points_m: Float[np.ndarray, "n 3"],
    eye_m: Float[np.ndarray, "3"],
    lift_m: float = LIFT_M,
) -> Bool[np.ndarray, "n"]:
    """Whether each point of a surface is visible from ``eye_m``; occluders within ``lift_m`` of it do not count."""
    return unoccluded(scene, points_m, unit_vectors(eye_m - points_m), lift_m)


def _in_object_pixels(
    truth: Truth, capture: str, camera_to_world: Float[np.ndarray, "4 4"], points_m: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    coverage = truth.object_coverage(capture)
    if not len(points_m):
        return np.zeros(0, bool)
    depth = project(points_m, camera_to_world, truth.intrinsics)[1]
    pixels = project_distorted(points_m, camera_to_world, truth.intrinsics, np.array(truth.distortion))
    columns, lines = np.floor(pixels).astype(int).T
    inside = (depth > 0) & (lines >= 0) & (lines < coverage.shape[0])
    inside &= (columns >= 0) & (columns < coverage.shape[1])
    shown = np.zeros(len(points_m), bool)
    shown[inside] = coverage[lines[inside], columns[inside]] >= COVERED
    return shown
