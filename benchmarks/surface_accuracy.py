"""How well the cloud of a trained run lies on the true surface of a simulated session, down to half a millimetre.

    uv run python benchmarks/surface_accuracy.py SESSION RUN/config.yml "apple, 1 mm a pixel"
    uv run python benchmarks/surface_accuracy.py SESSION RUN/config.yml "apple, exact depths" --exact-depths

F-scores are of what at least one camera sees. Precision is measured from the cloud to the true mesh, recall from true
points to the nearest of many points of the cloud. Heights are signed distances of the cloud's points from the true
surface, outside of it positive. Normals are compared with those of the nearest triangles. The lowest centimetre is
that of the true mesh.

With exact depths, the run's depth maps are those of the true mesh. What is missed then, pixels and fusion miss.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import tyro
from jaxtyping import Float
from open3d.core import Tensor
from results_table import Benchmark, current_commit, write_results

import hsi_sc_nerf
from hsi_sc_nerf.evaluation.comparison import CompareConfig
from hsi_sc_nerf.evaluation.spatial import Surface, sample_surface, score_at
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.geometry.mesh import Mesh, ray_scene
from hsi_sc_nerf.models.trained_run import TrainedRun, open_trained_run
from hsi_sc_nerf.simulate.scores import true_reference
from hsi_sc_nerf.simulate.truth import load_truth
from hsi_sc_nerf.surface.depth_renders import DepthRenders, render_depth_maps
from hsi_sc_nerf.surface.surface_depth import camera_rays
from hsi_sc_nerf.surface.surface_points import tsdf_fusion

THRESHOLDS_M = (0.002, 0.001, 0.0005)
POINTS = 300_000
"""Points of the cloud, a quarter of a millimetre apart on a fruit: far less than the smallest threshold."""
BANDS = ("650",)
LOWEST_M = 0.01
COLUMNS = (
    "",
    *(f"F at {1e3 * threshold_m:g} mm, %" for threshold_m in THRESHOLDS_M),
    "precision at 0.5 mm, %",
    "recall at 0.5 mm, %",
    "height above the true surface, mm",
    "16 to 84 % of points, mm",
    "lowest centimetre: recall at 0.5 mm, %",
    "its height, mm",
    "error of normals, median, deg",
    "90 %",
)


@dataclass(frozen=True)
class SurfaceAccuracy(Benchmark):
    """Measure the surface of a run's cloud against the truth."""

    session: tyro.conf.Positional[Path]
    """The simulated session."""
    load_config: tyro.conf.Positional[Path]
    """The run's config.yml."""
    label: tyro.conf.Positional[str]
    """Name of the row."""
    exact_depths: bool = False
    """Take the depths of the true mesh instead of the model's."""

    def main(self) -> None:
        """Export, measure, print the table, write the row."""
        mesh = load_truth(self.session).mesh()
        run = open_trained_run(self.load_config)
        cloud_m, normals = fused_exact_depths(run, mesh) if self.exact_depths else exported(run)
        reference = true_reference(self.session, CompareConfig(whole_reference=False))
        assert reference.seen is not None
        seen_m = reference.surface.points_m[reference.seen]
        # Open3D's signed distance is positive outside.
        scene = ray_scene(mesh.vertices, mesh.triangles)
        heights_m = scene.compute_signed_distance(Tensor(cloud_m.astype(np.float32))).numpy().astype(float)
        nearest = scene.compute_closest_points(Tensor(cloud_m.astype(np.float32)))["primitive_normals"].numpy()
        off_deg = np.rad2deg(np.arccos(np.clip((nearest * normals).sum(axis=1), -1.0, 1.0)))
        to_cloud_m = Surface(cloud_m).distances_m(seen_m)
        scores = [score_at(np.abs(heights_m), to_cloud_m, threshold_m) for threshold_m in THRESHOLDS_M]
        low, middle, high = 1e3 * np.percentile(heights_m, [16, 50, 84])
        end_m = mesh.vertices[:, 2].min() + LOWEST_M
        lowest = to_cloud_m[seen_m[:, 2] < end_m] < THRESHOLDS_M[-1]
        cells = [self.label, *(f"{score.f_score:.1f}" for score in scores)]
        cells += [f"{scores[-1].precision:.1f}", f"{scores[-1].recall:.1f}"]
        cells += [f"{middle:+.2f}", f"{low:+.2f} to {high:+.2f}"]
        cells += [f"{100.0 * lowest.mean():.1f}", f"{1e3 * np.median(heights_m[cloud_m[:, 2] < end_m]):+.2f}"]
        cells += [f"{degrees:.1f}" for degrees in np.percentile(off_deg, [50, 90])]
        commit = current_commit(Path(hsi_sc_nerf.__file__).parent)
        write_results("surface_accuracy", COLUMNS, [cells], keys=1, commit=commit, folder=self.results)


def exported(run: TrainedRun) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points of the run's cloud, metres, and their normals."""
    with TemporaryDirectory() as folder:
        cloud = read_spectral_ply(export_cloud(run, Path(folder), CloudOptions(num_points=POINTS, bands=BANDS)))
    return cloud.points.astype(float), cloud.normals


@torch.no_grad()
def fused_exact_depths(run: TrainedRun, mesh: Mesh) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points, in metres, and normals of the fusion of the true mesh's depths in the middles of the run's cells."""
    dataset = run.manager.train_dataset
    renders = render_depth_maps(run.model, dataset.cameras, run.manager.train_pixel_sampler.masks, 4096)
    renders = with_exact_depths(run, renders, mesh)
    box = run.to_scene(run.dataset.object_box_m)
    fused = tsdf_fusion(renders, box)
    assert fused is not None
    points = sample_surface(fused.vertices, fused.triangles, POINTS, seed=0)
    normals = fused.normals_at(points)
    seen = renders.most_frontal(*(torch.from_numpy(array).float() for array in (points, normals)))[0].numpy() >= 0
    kept = seen & ((points >= box[0]) & (points <= box[1])).all(axis=1)
    return run.to_metres(points[kept]), normals[kept]


def with_exact_depths(run: TrainedRun, renders: DepthRenders, mesh: Mesh) -> DepthRenders:
    """Depth maps of the true mesh where the model's were rendered."""
    depths = renders.depths.clone()
    scene = ray_scene(run.to_scene(mesh.vertices), mesh.triangles)
    frame, line, sample = np.nonzero(~np.isnan(depths.numpy()))
    xy_px = (np.stack([sample, line], axis=1) + 0.5) * renders.cell_px
    rays = camera_rays(run.manager.train_dataset.cameras, frame, xy_px, "cpu")
    origins, directions = rays.origins.numpy(), rays.directions.numpy()
    hits = scene.cast_rays(Tensor(np.concatenate([origins, directions], axis=1)))["t_hit"].numpy()
    depths[frame, line, sample] = torch.from_numpy(hits)
    met = np.isfinite(hits)
    return replace(renders, depths=depths, points=(origins + directions * hits[:, None])[met])


if __name__ == "__main__":
    tyro.cli(SurfaceAccuracy).main()
