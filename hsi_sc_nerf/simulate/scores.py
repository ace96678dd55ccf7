"""Results of a simulated session against its truth: a processed dataset, and the surface of the object."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import CompareConfig, Reference, Track, surface_of, without_progress
from hsi_sc_nerf.geometry.camera import project, rotation_angle_deg, unit_vectors
from hsi_sc_nerf.geometry.mesh import ray_scene, unoccluded
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.simulate.truth import COVERED, Truth, load_truth
from hsi_sc_nerf.spectra import nearest_bands

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

LIFT_M = 1e-5
"""Offset of the origin of a line of sight from the surface."""


@dataclass(frozen=True)
class ProcessingScore:
    """Errors of a packed dataset over its frames.

    Attributes:
        rotation_deg: largest angle between an estimated and a true camera orientation.
        position_m: largest distance between an estimated and a true camera position.
        focal_length_percent: error of the focal length.
        reflectance_rmse: root mean squared error over all valid values, noise included; NaN without valid values.
        flagged_fraction: fraction of invalid values, in [0, 1].
        mask_iou: smallest intersection over union of a mask with the true object pixels.
    """

    rotation_deg: float
    position_m: float
    focal_length_percent: float
    reflectance_rmse: float
    flagged_fraction: float
    mask_iou: float


def score_processing(dataset: PackedDataset, truth: Truth) -> ProcessingScore:
    """Compare a packed dataset with the truth of its session, frame by frame and without alignment.

    Args:
        dataset: processed session.
        truth: truth of the session, in all bands of the dataset; it is clipped as reflectance is by default.

    Example:
        >>> score = score_processing(open_packed("data"), load_truth("pear-session"))
        >>> score.rotation_deg < 0.5
        True
    """
    poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
    bands = nearest_bands(truth.wavelengths_nm, dataset.wavelengths_nm)
    rotations, positions, ious = [], [], []
    squares, measurements, values = 0.0, 0, 0
    for frame in dataset.frames:
        pose = poses[frame.capture]
        rotations.append(float(rotation_angle_deg(frame.camera_to_world, pose)))
        positions.append(float(np.linalg.norm(frame.camera_to_world[:3, 3] - pose[:3, 3])))
        measured, valid = unpack(frame.cube())
        errors = np.clip(truth.reflectance(frame.capture)[..., bands], *paper.REFLECTANCE_BOUNDS) - measured
        squares += float(np.sum(errors**2, where=valid, dtype=float))
        measurements += int(valid.sum())
        values += valid.size
        mask, covered = frame.mask(), truth.object_coverage(frame.capture) > COVERED
        ious.append(float((mask & covered).sum() / (mask | covered).sum()))
    return ProcessingScore(
        rotation_deg=max(rotations),
        position_m=max(positions),
        focal_length_percent=100 * abs(dataset.intrinsics.fl_x / truth.intrinsics.fl_x - 1),
        reflectance_rmse=float(np.sqrt(squares / measurements)) if measurements else np.nan,
        flagged_fraction=1.0 - measurements / values,
        mask_iou=min(ious),
    )


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
    pixels, depth = project(points_m, camera_to_world, truth.intrinsics, truth.distortion)
    columns, lines = np.floor(pixels).astype(int).T
    inside = (depth > 0) & (lines >= 0) & (lines < coverage.shape[0])
    inside &= (columns >= 0) & (columns < coverage.shape[1])
    shown = np.zeros(len(points_m), bool)
    shown[inside] = coverage[lines[inside], columns[inside]] >= COVERED
    return shown
