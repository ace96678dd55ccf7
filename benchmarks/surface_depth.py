"""Opacity that rays of a trained model have collected by depth below the true surface of a simulated session.

    uv run python benchmarks/surface_depth.py SESSION RUN/config.yml

The rays are those of training frames that hit the true surface at less than 60 degrees from its normal. They are
followed from 6 mm before the surface to 8 mm behind it. Opacity is that of a ray along the normal. The figures give
`surface.surface_depth.SURFACE_OPACITY`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Float
from open3d.core import Tensor as Open3DTensor
from results_table import RESULTS, write_results

from hsi_sc_nerf.meshes.mesh import ray_scene
from hsi_sc_nerf.models.trained_run import TrainedRun, open_run
from hsi_sc_nerf.simulate.truth import load_truth
from hsi_sc_nerf.surface.surface_depth import camera_rays, opacity_crossing_depth

LEVELS = (0.05, 0.07, 0.1, 0.25, 0.5, 0.9)
BEFORE_M, BEHIND_M, STEP_M = 0.006, 0.008, 0.0001
MIN_COSINE = 0.5


@dataclass(frozen=True)
class SurfaceDepth:
    """Measure where a trained model's opacity begins."""

    session: tyro.conf.Positional[Path]
    """The simulated session."""
    load_config: tyro.conf.Positional[Path]
    """The run's config.yml."""
    rays: int = 4000
    """Number of rays."""
    seed: int = 0
    """Seed of the random rays."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure, print the table, write the object's row."""
        run, truth = open_run(self.load_config), load_truth(self.session)
        mesh = truth.mesh()
        origins_m, directions = self._rays(run)
        scene = ray_scene(mesh.vertices, mesh.triangles)
        met = scene.cast_rays(Open3DTensor(np.concatenate([origins_m, directions], axis=1).astype(np.float32)))
        cosines = -(met["primitive_normals"].numpy() * directions).sum(axis=1)
        depths_m = met["t_hit"].numpy()
        frontal = np.isfinite(depths_m) & (cosines > MIN_COSINE)
        below_m = depths_below_surface(
            run, origins_m[frontal], directions[frontal], depths_m[frontal], cosines[frontal]
        )
        cells = [f"{1e3 * np.nanmean(below):.2f} ± {1e3 * np.nanstd(below):.2f}" for below in below_m]
        columns = ["object", *(f"opacity {level:g}" for level in LEVELS)]
        seed = f"scene, rays {self.seed}"
        write_results("surface_depth", columns, [[truth.object, *cells]], keys=1, seed=seed, folder=self.results)

    def _rays(self, run: TrainedRun) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Refined rays through the centres of pixels of the object: origins in metres, and directions."""
        dataset = run.manager.train_dataset
        masks = np.stack([frame.mask() for frame in dataset.frames])
        pixels = np.random.default_rng(self.seed).choice(np.argwhere(masks), self.rays, replace=False)
        rays = camera_rays(dataset.cameras, pixels[:, 0], pixels[:, :0:-1] + 0.5, run.model.device)
        with torch.no_grad():
            run.model.camera_optimizer.apply_to_raybundle(rays)
        return run.to_metres(rays.origins.cpu().numpy().astype(float)), rays.directions.cpu().numpy().astype(float)


@torch.no_grad()
def depths_below_surface(
    run: TrainedRun,
    origins_m: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    depths_m: Float[np.ndarray, "n"],
    cosines: Float[np.ndarray, "n"],
) -> list[Float[np.ndarray, "n"]]:
    """Depth below the surface (m) at which rays reach each of `LEVELS`; NaN for those that do not."""
    below = np.arange(-BEFORE_M, BEHIND_M, STEP_M)
    along_m = depths_m[:, None] + below / cosines[:, None]
    middles_m = (along_m[:, 1:] + along_m[:, :-1]) / 2.0
    points = run.to_scene(origins_m[:, None] + directions[:, None] * middles_m[..., None])
    densities = run.model.field.density_fn(torch.from_numpy(points).float().to(run.model.device))[..., 0].cpu()
    densities = densities * torch.from_numpy(cosines[:, None]).float()
    edges = torch.from_numpy(along_m * run.scale).float()
    results = []
    for level in LEVELS:
        reached_m = opacity_crossing_depth(edges, densities, level).numpy() / run.scale
        missing = reached_m >= along_m[:, -1] - STEP_M / 2.0
        results.append(np.where(missing, np.nan, (reached_m - depths_m) * cosines))
    return results


if __name__ == "__main__":
    tyro.cli(SurfaceDepth).main()
