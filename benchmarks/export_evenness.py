"""How evenly an exported cloud covers the true surface of a simulated session.

    uv run python benchmarks/export_evenness.py SESSION point_cloud.ply

The part of the true mesh that at least one frame sees at less than 80 degrees is cut into patches around evenly
spread centres. The coefficient of variation of points per area over the patches is compared with that of independent
random points, and of rays through random pixels, whose density is the sum of cos / distance^2 over the frames that
see a point. Points per area are also given by height: a stalk that the model makes too thick gets more points, and
parts that the dataset's masks leave out get fewer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float, Int
from results_table import RESULTS, write_results
from scipy.spatial import cKDTree

from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.ply import read_spectral_ply
from hsi_sc_nerf.simulate.scores.visible_surface import seen_points
from hsi_sc_nerf.simulate.truth import load_truth
from hsi_sc_nerf.surface.surface_depth import MIN_COSINE
from hsi_sc_nerf.surface.tsdf_fusion import SurfaceMesh

REFERENCE_POINTS = 100_000
HEIGHTS = 10


def coefficient_of_variation(
    weights: Float[np.ndarray, "n"], patches: np.ndarray, areas: Float[np.ndarray, "patches"]
) -> float:
    """Coefficient of variation of the weights' sum per area over patches, weighted by the patches' area."""
    density = np.bincount(patches, weights, minlength=len(areas)) / areas
    mean = np.average(density, weights=areas)
    return float(np.sqrt(np.average((density - mean) ** 2, weights=areas)) / mean)


@dataclass(frozen=True)
class ExportEvenness:
    """Measure how evenly a cloud covers what the frames see of the true surface."""

    session: tyro.conf.Positional[Path]
    """The simulated session."""
    cloud: tyro.conf.Positional[Path]
    """The exported cloud."""
    patches: int = 200
    """Patches of about equal area."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, print the table, write it."""
        truth, cloud = load_truth(self.session), read_spectral_ply(self.cloud)
        mesh = truth.mesh()
        surface, normals = _surface(mesh.vertices, mesh.triangles)
        density = np.zeros(len(surface))
        seen = np.zeros(len(surface), bool)
        for capture, pose in zip(truth.captures, truth.camera_to_world, strict=True):
            alone = replace(truth, captures=(capture,), camera_to_world=pose[None])
            visible = seen_points(alone, surface, mesh.vertices, mesh.triangles)
            to_camera = pose[:3, 3] - surface
            distance = np.linalg.norm(to_camera, axis=1)
            cosine = (to_camera * normals).sum(axis=1) / distance
            density += np.where(visible, cosine.clip(0.0) / distance**2, 0.0)
            seen |= visible & (cosine > MIN_COSINE)
        centres = cKDTree(_spread(surface[seen], self.patches))
        patch = centres.query(surface[seen])[1]
        areas = np.bincount(patch, minlength=self.patches).astype(float)
        points = centres.query(cloud.points)[1]
        print(f"{len(points):,} points, {self.patches} patches; coefficient of variation of points per area:")
        print(f"  this cloud           {coefficient_of_variation(np.ones(len(points)), points, areas):.3f}")
        print(f"  random points        {np.sqrt(self.patches / len(points)):.3f}")
        print(f"  rays through pixels  {coefficient_of_variation(density[seen], patch, areas):.3f} beside chance")
        edges = np.linspace(surface[seen, 2].min(), surface[seen, 2].max(), HEIGHTS + 1)
        area, of_rays, of_cloud = (
            np.histogram(heights, edges, weights=weights)[0]
            for heights, weights in (
                (surface[seen, 2], None),
                (surface[seen, 2], density[seen] / density[seen].mean()),
                (cloud.points[:, 2], np.full(len(points), seen.sum() / len(points))),
            )
        )
        columns = ("height above the disc", "fraction of the surface", "this cloud", "rays through random pixels")
        rows = [
            (f"{1e3 * low:.0f} to {1e3 * high:.0f} mm", f"{100 * part:.0f} %", f"{own:.2f}", f"{ray:.2f}")
            for low, high, part, own, ray in zip(
                edges[:-1], edges[1:], area / area.sum(), of_cloud / area, of_rays / area, strict=True
            )
        ]
        write_results("export_evenness", columns, rows, folder=self.results)


def _surface(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points spread evenly over a mesh, and the outward unit normals there."""
    points = sample_surface(vertices, triangles, REFERENCE_POINTS)
    return points, SurfaceMesh(np.asarray(vertices, float), triangles).normals_at(points)


def _spread(points: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "{count} 3"]:
    """Points far from one another: each the farthest from those before (Gonzalez 1985)."""
    chosen = [points[0]]
    distance = np.linalg.norm(points - chosen[0], axis=1)
    while len(chosen) < count:
        chosen.append(points[distance.argmax()])
        distance = np.minimum(distance, np.linalg.norm(points - chosen[-1], axis=1))
    return np.stack(chosen)


if __name__ == "__main__":
    tyro.cli(ExportEvenness).main()
