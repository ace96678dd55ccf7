"""How often the truth lies within the stated uncertainty of sizes and of spots' brightness, over simulated sessions.

    uv run python benchmarks/trait_uncertainty.py OUTPUT_DIR
    uv run python benchmarks/trait_uncertainty.py OUTPUT_DIR --seeds 15 16 17 18

Each session is simulated, processed, trained and exported by the commands that a user would type; what is there is
not done again. Sessions have even light, photon and read noise. The object stands where the container ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from paper_tables import short_training
from results_table import Benchmark, write_results
from traits_accuracy import EVERY_KTH_CAMERA, SPOTS, spots_on
from true_object import TrueObject

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh
from hsi_sc_nerf.analysis.size import combined, pixel_on_object_m, size_of, size_uncertainty, systematic_errors
from hsi_sc_nerf.analysis.spectral_mesh import with_spectra
from hsi_sc_nerf.analysis.traits import analyse
from hsi_sc_nerf.benchmark.steps import run_step, typed_command
from hsi_sc_nerf.export.cloud import MAX_INCIDENCE_DEG, read_spectral_ply
from hsi_sc_nerf.files import read_json, write_json
from hsi_sc_nerf.models.presets import ITERATIONS, PRESETS
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.simulate.truth import load_truth

TRAITS = {"area_m2": "area", "volume_l": "volume", "height_m": "height", "largest_diameter_m": "largest diameter"}
SPOT = "brightness of spots of 10 mm"
COARSE = "maize"
"""Its kernels are finer than the pixels, so that its area is not measured: rows are also given without it."""
COLUMNS = (
    "trait",
    "seeds",
    "sessions",
    "within 1 std, %",
    "within 2 std, %",
    "median error, %",
    "median stated std, %",
)


@dataclass(frozen=True)
class TraitUncertainty(Benchmark):
    """Options of the benchmark."""

    output_dir: tyro.conf.Positional[Path]
    """Folder of the sessions and their results."""
    scenes: tuple[str, ...] = ("pear", "apple", "tomato", "maize", "pepper")
    """Scenes of `hsi-sc-nerf simulate`."""
    seeds: tuple[int, ...] = (11, 12, 13, 14)
    """Each gives another object of its kind, and other noise."""
    frames: int = 30
    """Frames of a session."""
    size: int = 128
    """Width and height of the images, pixels."""
    iterations: int = PRESETS["cpu"]["balanced"][ITERATIONS]
    """Training steps, of 1024 rays; those of `--preset balanced`, the default."""

    def main(self) -> None:
        """Measure all sessions, print the table, write it."""
        found: dict[str, list[tuple[str, float, float]]] = {}
        for seed in self.seeds:
            for scene in self.scenes:
                folder = self.output_dir / f"{scene}-{seed}"
                self._reconstruct(folder, scene, seed)
                for trait, error, std in self._measured(folder):
                    print(f"{folder.name}: {trait}: error {100 * error:+.2f} %, stated {100 * std:.2f} %")
                    found.setdefault(trait, []).append((scene, error, std))
        seeds = " ".join(map(str, self.seeds))
        rows = [_row(trait, seeds, values) for trait, values in found.items()]
        without = {trait: [value for value in values if value[0] != COARSE] for trait, values in found.items()}
        rows += [_row(f"{trait}, without {COARSE}", seeds, values) for trait, values in without.items()]
        write_results("trait_uncertainty", COLUMNS, rows, keys=2, seed=seeds, folder=self.results)

    def _measured(self, folder: Path) -> list[tuple[str, float, float]]:
        """`measured`, from the file that keeps it if it is there."""
        kept = folder / "measured.json"
        if not kept.is_file():
            write_json(kept, {"traits": list(measured(folder))})
        return [tuple(one) for one in read_json(kept, "delete it")["traits"]]

    def _reconstruct(self, folder: Path, scene: str, seed: int) -> None:
        session, data, run = folder / "session", folder / "data", folder / "run" / "hsi-sc-nerf" / "run"
        if (folder / "export" / "point_cloud.ply").is_file():
            return
        folder.mkdir(parents=True, exist_ok=True)
        simulating = ["hsi-sc-nerf", "simulate", scene, session, "--seed", seed, "--size", self.size]
        simulating += ["--frames", self.frames, "--effects", "photon_noise", "read_noise"]
        exporting = ["ns-export", "pointcloud", "--load-config", run / "config.yml", "--num-points", 60_000]
        steps: list[Sequence[object]] = [
            simulating,
            ["hsi-sc-nerf", "process", session, "--output-dir", data],
            short_training(data, folder, self.iterations),
            [*exporting, "--output-dir", folder / "export"],
        ]
        for words in steps:
            name = str(words[0] if words[0] != "hsi-sc-nerf" else words[1])
            run_step(name, typed_command(words), folder / f"{name}.log")


def measured(folder: Path) -> Iterator[tuple[str, float, float]]:
    """Trait, relative error and relative stated standard deviation of a session's sizes and spots."""
    truth, dataset = load_truth(folder / "session"), open_packed(folder / "data")
    true, cloud = TrueObject.of(truth), read_spectral_ply(folder / "export" / "point_cloud.ply")
    config = replace(MeshConfig(), base_height_m=float(true.mesh.vertices[:, 2].min()))
    mesh = closed_mesh(cloud.points, cloud.normals, config)
    systematic = systematic_errors(mesh, dataset, base_known=True)
    std = combined(size_uncertainty(cloud.points, cloud.normals, mesh, config, splits=3, systematic=systematic))
    size, exact = size_of(mesh), size_of(true.mesh)
    for name, trait in TRAITS.items():
        one = getattr(exact, name)
        yield trait, getattr(size, name) / one - 1.0, getattr(std, name) / one
    surface = with_spectra(mesh, cloud, config.smoothing_radius_m, MAX_INCIDENCE_DEG)
    ideal = true.spectral_mesh(truth.camera_to_world[::EVERY_KTH_CAMERA, :3, 3])
    spots = spots_on(ideal)
    regions = (analyse(one, spots, pixel_m=pixel_on_object_m(dataset)).regions[1:] for one in (surface, ideal))
    for region, real in zip(*regions, strict=True):
        brightness = real.spectrum.mean.mean()
        yield SPOT, region.spectrum.mean.mean() / brightness - 1.0, region.reflectance_std / brightness


def _row(trait: str, seeds: str, values: Sequence[tuple[str, float, float]]) -> list[str]:
    sessions = len(values) // (SPOTS if trait.startswith(SPOT) else 1)
    error, std = np.array([value[1:] for value in values]).T
    within = (f"{100 * np.mean(abs(error) <= count * std):.0f}" for count in (1, 2))
    return [trait, seeds, str(sessions), *within, f"{100 * np.median(abs(error)):.2f}", f"{100 * np.median(std):.2f}"]


if __name__ == "__main__":
    tyro.cli(TraitUncertainty, description=__doc__).main()
