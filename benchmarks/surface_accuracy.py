"""How well the cloud of a trained run lies on the true surface of a simulated session, down to half a millimetre.

    uv run python benchmarks/surface_accuracy.py SESSION RUN/config.yml "apple, 1 mm a pixel"

F-scores are of what at least one camera sees. Precision is measured from the cloud to the true mesh, recall from true
points to the nearest of many points of the cloud. Heights are signed distances of the cloud's points from the true
surface, outside of it positive.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro
from open3d.core import Tensor
from results_table import RESULTS, write_results

from hsi_sc_nerf.evaluation.comparison import CompareConfig, read_surface
from hsi_sc_nerf.evaluation.spatial import Surface, score_at
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.geometry.mesh import ray_scene
from hsi_sc_nerf.models.trained_run import open_run
from hsi_sc_nerf.simulate.scores import true_reference
from hsi_sc_nerf.simulate.truth import load_truth

THRESHOLDS_M = (0.002, 0.001, 0.0005)
POINTS = 300_000
"""Points of the cloud, a quarter of a millimetre apart on a fruit: far less than the smallest threshold."""
BANDS = ("650",)


@dataclass(frozen=True)
class SurfaceAccuracy:
    """Measure the surface of a run's cloud against the truth."""

    session: tyro.conf.Positional[Path]
    """The simulated session."""
    load_config: tyro.conf.Positional[Path]
    """The run's config.yml."""
    label: tyro.conf.Positional[str]
    """Name of the row."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Export, measure, print the table, write the row."""
        with TemporaryDirectory() as folder:
            options = CloudOptions(num_points=POINTS, bands=BANDS)
            cloud_m = read_surface(export_cloud(open_run(self.load_config), Path(folder), options))[0]
        reference = true_reference(self.session, CompareConfig(whole_reference=False))
        assert reference.seen is not None
        mesh = load_truth(self.session).mesh()
        scene = ray_scene(mesh.vertices, mesh.triangles)
        # Open3D's signed distance is positive outside.
        heights_m = scene.compute_signed_distance(Tensor(cloud_m.astype(np.float32))).numpy().astype(float)
        to_cloud_m = Surface(cloud_m).distances_m(reference.surface.points_m[reference.seen])
        scores = [score_at(np.abs(heights_m), to_cloud_m, threshold_m) for threshold_m in THRESHOLDS_M]
        low, middle, high = 1e3 * np.percentile(heights_m, [16, 50, 84])
        columns = [
            "",
            *(f"F at {1e3 * threshold_m:g} mm, %" for threshold_m in THRESHOLDS_M),
            "precision at 0.5 mm, %",
            "recall at 0.5 mm, %",
            "height above the true surface, mm",
            "16 to 84 % of points, mm",
        ]
        cells = [self.label, *(f"{score.f_score:.1f}" for score in scores)]
        cells += [f"{scores[-1].precision:.1f}", f"{scores[-1].recall:.1f}"]
        cells += [f"{middle:+.2f}", f"{low:+.2f} to {high:+.2f}"]
        write_results("surface_accuracy", columns, [cells], keys=1, folder=self.results)


if __name__ == "__main__":
    tyro.cli(SurfaceAccuracy).main()
