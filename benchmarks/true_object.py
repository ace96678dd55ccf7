"""Objects whose surface and materials are known: ideal clouds, true spectra, material fractions of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf import paper
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene
from hsi_sc_nerf.geometry.ply_file import read_ply
from hsi_sc_nerf.simulate.scores import visible_from
from hsi_sc_nerf.simulate.truth import Truth
from hsi_sc_nerf.spectra import composite, to_8_bit

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

FACET_LIFT_M = 0.0001
"""Offset by which the facets of a concave surface do not hide each other."""


@dataclass(frozen=True)
class TrueObject:
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
    def of(cls, truth: Truth) -> TrueObject:
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
        return np.any([visible_from(scene, points_m, eye_m, FACET_LIFT_M) for eye_m in eyes_m], axis=0)

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
