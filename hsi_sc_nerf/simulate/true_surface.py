"""The true surface of a simulated object: what views see of it, ideal clouds, true spectra, material fractions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import CompareConfig, Reference, Track, surface_of, without_progress
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL
from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene
from hsi_sc_nerf.geometry.ply_file import read_ply
from hsi_sc_nerf.simulate.truth import COVERED, Truth, load_truth
from hsi_sc_nerf.spectra import composite, to_8_bit

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

LIFT_M = 1e-5
"""Offset of the origin of a line of sight from the surface."""
FACET_LIFT_M = 0.0001
"""Offset by which the facets of a concave surface do not hide each other."""


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
        seen[candidates] = unoccluded(scene, points_m[candidates], poses[capture][:3, 3])
    return seen


def unoccluded(
    scene: RaycastingScene,
    points_m: Float[np.ndarray, "n 3"],
    eye_m: Float[np.ndarray, "3"],
    lift_m: float = LIFT_M,
) -> Bool[np.ndarray, "n"]:
    """Whether each point of a surface is visible from ``eye_m``; occluders within ``lift_m`` of it do not count."""
    sight = eye_m - points_m
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    rays = np.concatenate([points_m, sight], axis=1, dtype=np.float32)
    return ~scene.test_occlusions(rays, tnear=lift_m).numpy()


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


@dataclass(frozen=True)
class TrueSurface:
    """A closed mesh with known materials.

    Attributes:
        materials: names.
        mesh: metres, object frame.
        weights: fraction of each material at each vertex.
        endmembers: reflectance of each material.
        wavelengths_nm: band centres.
    """

    materials: tuple[str, ...]
    mesh: Mesh
    weights: Float[np.ndarray, "v materials"]
    endmembers: Float[np.ndarray, "materials bands"]
    wavelengths_nm: Float[np.ndarray, "bands"]

    @classmethod
    def of(cls, truth: Truth) -> TrueSurface:
        """The true surface of a simulated session."""
        vertex = read_ply(truth.mesh_path)["vertex"]
        columns = {p.name.removeprefix("weight_"): vertex[p.name] for p in vertex.properties if "weight_" in p.name}
        endmembers = truth.endmembers[[truth.materials.index(name) for name in columns]]
        return cls(
            tuple(columns), truth.mesh(), np.stack(list(columns.values()), axis=-1), endmembers, truth.wavelengths_nm
        )

    def spectral_mesh(self, eyes_m: Float[np.ndarray, "cameras 3"]) -> SpectralMesh:
        """The surface with its true spectra; what no camera at these positions sees is unseen."""
        spectra = (self.weights @ self.endmembers).astype(np.float32)
        return SpectralMesh(self.mesh, spectra, self.wavelengths_nm, self.seen(self.mesh.vertices, eyes_m))

    def nearest(self, points_m: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit normal, material fractions and distance (m) of the nearest surface point of each point."""
        found = self._scene().compute_closest_points(np.asarray(points_m, np.float32))
        triangle, uv = found["primitive_ids"].numpy().astype(np.int64), found["primitive_uvs"].numpy()
        barycentric = np.concatenate([1.0 - uv.sum(axis=1, keepdims=True), uv], axis=1)
        weights = np.einsum("nc,ncm->nm", barycentric, self.weights[self.mesh.triangles[triangle]])
        normals = found["primitive_normals"].numpy().astype(float)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return normals, weights, np.linalg.norm(found["points"].numpy() - points_m, axis=1)

    def seen(
        self, points_m: Float[np.ndarray, "n 3"], eyes_m: Float[np.ndarray, "cameras 3"]
    ) -> Bool[np.ndarray, "n"]:
        """Which points of the surface are visible from at least one camera position, occluded by the object only."""
        scene = self._scene()
        return np.any([unoccluded(scene, points_m, eye_m, FACET_LIFT_M) for eye_m in eyes_m], axis=0)

    def cloud(self, count: int, eyes_m: Float[np.ndarray, "cameras 3"], noise_m: float) -> SpectralCloud:
        """The cloud of an ideal reconstruction: uniform, visible points with true spectra.

        Args:
            count: number of points on the whole surface, invisible ones included.
            eyes_m: positions of the cameras.
            noise_m: standard deviation of the position in each direction; if positive, normals scatter by 0.3 rad.
        """
        rng = np.random.default_rng(0)
        points = sample_surface(self.mesh.vertices, self.mesh.triangles, count)
        points = points[self.seen(points, eyes_m)]
        normals, weights, _ = self.nearest(points)
        spectra = (weights @ self.endmembers).astype(np.float32)
        colours = to_8_bit(composite(spectra, self.wavelengths_nm, paper.PSEUDO_RGB_NM))
        if noise_m > 0.0:
            points = points + noise_m * rng.standard_normal(points.shape)
            normals = normals + 0.3 * rng.standard_normal(points.shape)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return SpectralCloud(
            points.astype(np.float32), normals.astype(np.float32), colours, spectra, self.wavelengths_nm
        )

    def _scene(self) -> RaycastingScene:
        return ray_scene(self.mesh.vertices, self.mesh.triangles)


def relative_rms(measured: Float[np.ndarray, "bands"], true: Float[np.ndarray, "bands"]) -> float:
    """Root mean square error of a spectrum relative to the root mean square of the true spectrum."""
    return float(np.sqrt(np.mean(np.square(measured - true)) / np.mean(np.square(true))))
