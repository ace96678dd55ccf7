"""How accurate all of `hsi-sc-nerf run` is on a session that shares no code with our simulator.

    uv run python benchmarks/path_traced_accuracy.py --output-dir OUT
    uv run python benchmarks/path_traced_accuracy.py --output-dir OUT --fruit long --size 128

The session is that of ``independent_session.py``: path-traced, glossy, with near lamps and a wooden wall. `run` works
on it as in a laboratory, with no word but the seed of the training. Its results are compared with what the path
tracer knows: held-out views with many rays, without drift and the sensor's noise; the mesh; the reflectance of the
skin below its gloss. What is finished is not done again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
import tyro
from independent_session import BANDS, NODES_NM, IndependentSession, mixing_matrix
from jaxtyping import Float
from material_reflectance import spot_errors
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from open3d.core import Tensor
from paper_tables import mean_and_deviation, rendered_views
from path_traced_scene import Fruit, PathTracedScene, camera_pose, material_reflectance, tarp_reflectance
from results_table import Benchmark, write_results
from session_mistakes import measured_errors

from hsi_sc_nerf.analysis.report import each_object
from hsi_sc_nerf.cli.workflows import RunCommand
from hsi_sc_nerf.evaluation.spatial import Surface, sample_surface, score_at
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_metrics
from hsi_sc_nerf.export.cloud import INCIDENCE, SpectralCloud, material_spectra, read_spectral_ply
from hsi_sc_nerf.files import read_json, write_json
from hsi_sc_nerf.geometry.mesh import ray_scene
from hsi_sc_nerf.models.presets import Preset
from hsi_sc_nerf.models.trained_run import TrainedRun, open_trained_run
from hsi_sc_nerf.simulate.scores import visible_from
from hsi_sc_nerf.spectra import nearest_bands

if TYPE_CHECKING:
    from open3d.t.geometry import RaycastingScene

COLUMNS: dict[str, dict[str, int]] = {
    "poses: largest error, deg, mm": {"rotation, deg": 3, "position, mm": 2},
    "focal length, %": {"focal length, %": 2},
    "masks: least IoU": {"mask, IoU": 3},
    "views: SAM, rad, RMSE": {"SAM, rad": 4, "RMSE": 4},
    "as measured: SAM, rad, RMSE": {"noise: SAM, rad": 4, "noise: RMSE": 4},
    "F at 2, 1, 0.5 mm, %": {"F at 2 mm, %": 1, "F at 1 mm, %": 1, "F at 0.5 mm, %": 1},
    "height above the surface, mm": {"height above the surface, mm": 2},
    "area, volume, %": {"area, %": 1, "volume, %": 1},
    "brightness as measured: 5, 50, 95 %": {"as measured: 5 %": 2, "50 %": 2, "95 %": 2},
    "of the material: 5, 50, 95 %": {"material: 5 %": 2, "median": 3, "95 % of material": 2},
    "spots: median, worst, %": {"spots, %": 1, "worst spot, %": 1},
}
"""Columns of the table, the figures in each, and their decimals."""
FIGURES = [name for figures in COLUMNS.values() for name in figures]
THRESHOLDS_M = {"F at 2 mm, %": 0.002, "F at 1 mm, %": 0.001, "F at 0.5 mm, %": 0.0005}
NOISE_FREE_RAYS = 2048
TARP_BRIGHTNESS = 0.5
"""The tarp is brighter than this part of the image's 99th percentile; a session's white is its mean."""
POINTS = 300_000
FRONTAL_DEG = 65.0


@dataclass(frozen=True)
class PathTracedAccuracy(Benchmark):
    """Render a session, run on it, judge the results."""

    output_dir: Path
    """Folder of the session and the results."""
    frames: int = 36
    """Frames of one turn."""
    size: int = 128
    """Width and height of the images, pixels."""
    rays: int = 256
    """Rays in each pixel of the session."""
    fruit: Fruit = "quince"
    """Shape of the fruit."""
    preset: Preset = "balanced"
    """Of `hsi-sc-nerf run`."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the training."""
    words: str = ""
    """More words for the training; they are part of the row's name."""
    picture: Path | None = None
    """Where to draw the first seed's cloud: its brightness relative to the skin's, its height above the surface."""

    def main(self) -> None:
        """Do what is missing, print the table, write it."""
        if not (self.session / "truth" / "mesh.ply").is_file():
            IndependentSession(self.session, self.frames, self.size, self.rays, self.fruit).main()
        found = [self._judged(seed) for seed in self.seeds]
        cells = [
            ", ".join(mean_and_deviation([one[name] for one in found], digits) for name, digits in figures.items())
            for figures in COLUMNS.values()
        ]
        name = f"{self.fruit}, {self.frames} views of {self.size} px"
        row = [name, f"{self.preset} {self.words}".strip(), *cells]
        seeds = f"scene, runs {' '.join(map(str, self.seeds))}"
        titles = ["fruit", "training", *COLUMNS]
        write_results("path_traced_accuracy", titles, [row], keys=2, seed=seeds, folder=self.results)
        if self.picture is not None:
            self._draw(self._out(self.seeds[0]), self.picture)

    @property
    def folder(self) -> Path:
        """Folder of this fruit."""
        return self.output_dir / f"{self.fruit}-{self.size}-{self.frames}-{self.rays}"

    @property
    def session(self) -> Path:
        """The path-traced session."""
        return self.folder / "session"

    def _out(self, seed: int) -> Path:
        """Folder of one run."""
        words = "".join(letter if letter.isalnum() else "_" for letter in self.words)
        return self.folder / f"{self.preset}{words}-{seed}"

    def _judged(self, seed: int) -> dict[str, float]:
        """Figures of one run."""
        out = self._out(seed)
        kept = out / "judged.json"
        if not kept.is_file():
            train = f"--machine.seed {seed} {self.words}".strip()
            RunCommand(self.session, out, preset=self.preset, train=train).main()
            write_json(kept, self._figures(out))
        return read_json(kept, "delete it to judge the run again")

    def _figures(self, out: Path) -> dict[str, float]:
        run = open_trained_run(out / "training" / "hsi-sc-nerf" / "run" / "config.yml")
        cloud, material = self._clouds(out)
        errors = dict(zip(FIGURES, map(float, measured_errors(out / "data", self.session)[:4]), strict=False))
        figures = errors | self._views(run) | self._surface(run, cloud) | self._sizes(out)
        return figures | self._brightness(cloud, material)

    def _clouds(self, out: Path) -> tuple[SpectralCloud, Float[np.ndarray, "n bands"]]:
        """The cloud of a run, and the material at its points; what was measured where no light was corrected."""
        cloud, corrected = read_spectral_ply(out / "point_cloud.ply"), out / "point_cloud-material.ply"
        material = material_spectra(read_spectral_ply(corrected)) if corrected.is_file() else None
        return cloud, cloud.spectra if material is None else material

    @cached_property
    def _scene(self) -> PathTracedScene:
        return PathTracedScene(NODES_NM, self.size, NOISE_FREE_RAYS, self.fruit, sampler="multijitter", seed=77)

    def _noise_free(self, capture: str) -> Float[np.ndarray, "h w 204"]:
        """Reflectance of a capture without the noise of paths and sensor, by the mean white of the whole tarp."""
        mixing = mixing_matrix()
        path, white_path = (self.folder / f"noise-free-{name}.npy" for name in (capture, "tarp"))
        if not white_path.is_file():
            image = self._scene.tarp(1000)
            brightness = image.mean(axis=-1)
            np.save(white_path, image[brightness > TARP_BRIGHTNESS * np.percentile(brightness, 99.0)].mean(axis=0))
        if not path.is_file():
            truth = read_json(self.session / "truth" / "truth.json", "render the session again")
            number, angle_deg = next(
                (number, frame["angle_deg"])
                for number, frame in enumerate(truth["frames"])
                if frame["capture"] == capture
            )
            np.save(path, self._scene.radiance(angle_deg, number))
        return (np.load(path) @ mixing) / (np.load(white_path) @ mixing)

    def _views(self, run: TrainedRun) -> dict[str, float]:
        """Held-out views and their measured cubes against noise-free ones.

        Pixels count where the dataset's mask and more than half of the true coverage show the fruit.
        """
        coverage = np.load(self.session / "truth" / "masks.npz")
        bands = nearest_bands(BANDS, run.dataset.wavelengths_nm)
        found: dict[str, list[float]] = {}
        for capture, rendered, batch in rendered_views(run):
            true = torch.from_numpy(self._noise_free(capture)[..., bands]).float()
            mask = batch["mask"][..., 0].bool() & torch.from_numpy(coverage[capture] > 0.5)
            for prefix, image in (("", rendered), ("noise: ", batch["spectral"])):
                metrics = spectral_metrics(image, true, mask)
                found.setdefault(f"{prefix}SAM, rad", []).append(metrics["sam"])
                found.setdefault(f"{prefix}RMSE", []).append(metrics["rmse"])
        return {name: float(np.mean(values)) for name, values in found.items()}

    @cached_property
    def _mesh(self) -> trimesh.Trimesh:
        mesh = trimesh.load(self.session / "truth" / "mesh.ply", process=False)
        assert isinstance(mesh, trimesh.Trimesh)
        return mesh

    @cached_property
    def _rays(self) -> RaycastingScene:
        return ray_scene(np.asarray(self._mesh.vertices), np.asarray(self._mesh.faces))

    def _surface(self, run: TrainedRun, cloud: SpectralCloud) -> dict[str, float]:
        """F-scores of what a camera sees, and the median signed distance from the true surface."""
        points_m = sample_surface(np.asarray(self._mesh.vertices), np.asarray(self._mesh.faces), POINTS)
        eyes_m = run.dataset.camera_to_worlds[:, :3, 3]
        seen = np.any([visible_from(self._rays, points_m, eye_m) for eye_m in eyes_m], axis=0)
        heights_m = self._heights_m(cloud.points)
        distances_m = np.abs(heights_m), Surface(cloud.points).distances_m(points_m[seen])
        scores = {name: score_at(*distances_m, limit_m).f_score for name, limit_m in THRESHOLDS_M.items()}
        return scores | {"height above the surface, mm": 1e3 * float(np.median(heights_m))}

    def _heights_m(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Signed distances from the true surface, outside of it positive."""
        return self._rays.compute_signed_distance(Tensor(points_m.astype(np.float32))).numpy().astype(float)

    def _sizes(self, out: Path) -> dict[str, float]:
        traits = json.loads((out / "traits" / "traits.json").read_text(encoding="utf-8"))
        size = next(iter(each_object(traits)))["size"]
        true: Mapping[str, float] = {"area": self._mesh.area, "volume": self._mesh.volume}
        return {
            "area, %": 100.0 * (size["area_m2"] / true["area"] - 1.0),
            "volume, %": 100.0 * (size["volume_l"] / 1e3 / true["volume"] - 1.0),
        }

    def _true_material(self, cloud: SpectralCloud) -> Float[np.ndarray, "n bands"]:
        """Reflectance of the skin below its gloss, relative to the tarp's, where the true surface is nearest."""
        nearest = self._rays.compute_closest_points(Tensor(cloud.points.astype(np.float32)))
        corner = self._mesh.faces[nearest["primitive_ids"].numpy().astype(int)][:, 0]
        skin = material_reflectance(self._mesh, self._scene.spots, cloud.wavelengths_nm)
        return (skin / tarp_reflectance(cloud.wavelengths_nm))[corner]

    def _brightness(self, cloud: SpectralCloud, material: Float[np.ndarray, "n bands"]) -> dict[str, float]:
        """Brightness of frontal points relative to the skin's, as measured and as the material's; spots of 10 mm."""
        frontal = np.flatnonzero(cloud.extra[INCIDENCE] < FRONTAL_DEG)
        cloud, corrected = cloud.select(frontal), material[frontal]
        true = self._true_material(cloud)
        apparent, bright = (spectra.mean(axis=1) / true.mean(axis=1) for spectra in (cloud.spectra, corrected))
        names = ("as measured: 5 %", "50 %", "95 %", "material: 5 %", "median", "95 % of material")
        values = [*np.quantile(apparent, [0.05, 0.5, 0.95]), *np.quantile(bright, [0.05, 0.5, 0.95])]
        spots = spot_errors(cloud.points, corrected, true)
        figures = dict(zip(names, map(float, values), strict=True))
        return figures | {
            "spots, %": 100.0 * float(np.median(spots)),
            "worst spot, %": 100.0 * float(spots.max()),
        }

    def _draw(self, out: Path, path: Path) -> None:
        """The points that face the first frame: their brightness relative to the skin's, their height."""
        cloud, material = self._clouds(out)
        camera = camera_pose(0.0)
        sight = camera[:3, 3] - cloud.points
        facing = np.flatnonzero((cloud.normals * sight).sum(axis=1) > 0.3 * np.linalg.norm(sight, axis=1))
        rows = facing[np.argsort(-np.linalg.norm(sight[facing], axis=1))]
        true = self._true_material(cloud.select(rows)).mean(axis=1)
        place_cm = 100.0 * (cloud.points[rows] - cloud.points.mean(axis=0)) @ camera[:3, :2]
        panels = (
            ("brightness as measured, relative to the skin's", cloud.spectra[rows].mean(axis=1) / true, (0.5, 1.5)),
            ("brightness of the material, relative to the skin's", material[rows].mean(axis=1) / true, (0.5, 1.5)),
            ("height above the true surface, mm", 1e3 * self._heights_m(cloud.points[rows]), (-1.0, 1.0)),
        )
        figure = Figure(figsize=(13.0, 3.8), layout="constrained")
        for axes, (title, values, limits) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            norm = Normalize(*limits)
            shown = axes.scatter(*place_cm.T, c=values, s=0.6, cmap="RdBu_r", norm=norm, rasterized=True)
            axes.set_title(title, fontsize=10)
            axes.set(aspect="equal", xlabel="cm")
            figure.colorbar(shown, ax=axes)
        figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(PathTracedAccuracy).main()
