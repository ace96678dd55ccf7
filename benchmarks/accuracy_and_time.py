"""What accuracy costs in time: budgets, one setting at a time, views and pictures, each with three seeds.

    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front --clock cpu --threads 1
    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front --clock cpu --threads 1 --parts views

A simulated noisy session is trained for the same seconds with every setting, and judged against what is known:
held-out views without the noise, the true surface, its area and volume. A row is the mean over the seeds and their
range. Ranges that overlap are no difference. What is finished is not done again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import tyro
from beyond_the_paper import NOISE, SHADING, noise_free_metrics
from paper_tables import PaperTable
from results_table import write_results

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh, size_of
from hsi_sc_nerf.benchmark.configurations import Configuration, own_configuration
from hsi_sc_nerf.benchmark.run import BenchmarkRun
from hsi_sc_nerf.evaluation.comparison import CompareConfig
from hsi_sc_nerf.evaluation.spatial import Surface, score_at
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.ply import read_spectral_ply
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.models.trained_run import open_run
from hsi_sc_nerf.simulate.true_surface import true_reference
from hsi_sc_nerf.simulate.truth import load_truth

Part = Literal["budgets", "settings", "views", "pictures"]
CLOUD_POINTS = 150_000
CAPTURE_SECONDS = 120
"""Of a view at the instrument: a SPECIM IQ takes about two minutes."""
DEFAULT = "default"
_RAYS = "--pipeline.datamanager.train-num-rays-per-batch"
_MODEL = "--pipeline.model"

# Name of a row: what it changes of the default.
SETTINGS: dict[str, str] = {
    DEFAULT: "",
    "2048 rays a step": f"{_RAYS} 2048",
    "4096 rays a step": f"{_RAYS} 4096",
    "8 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 8",
    "32 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 32",
    "every band a channel": f"{_MODEL}.head direct",
    "first stage a quarter": "--full-frame.fraction 0.25 --masked.fraction 0.75",
    "first stage three quarters": "--full-frame.fraction 0.75 --masked.fraction 0.25",
    "no angular loss": f"{_MODEL}.angular-loss-mult 0",
    "angular loss times three": f"{_MODEL}.angular-loss-mult 0.09",
    "predicted normals": f"{_MODEL}.predict-normals True",
    "all three effects": f"{_MODEL}.effects view_dependence,still_chamber,pose_refinement",
    "no effects": f"{_MODEL}.effects none",
}
BUDGETS_S = (10, 20, 40, 80, 160)
VIEWS = (8, 12, 20, 30, 60)
PICTURES: dict[str, dict[str, int]] = {
    "64 x 64 pixels": {"size": 64},
    "256 x 256 pixels": {"size": 256},
    "25 bands": {"bands": 25},
    "51 bands": {"bands": 51},
    "102 bands": {"bands": 102},
}

TITLES = (
    *("part", "", "training, s", "steps", "memory, MiB", "SAM, rad", "RMSE", "without the noise: SAM"),
    *(" RMSE", "F at 2 mm, %", "F at 0.5 mm, %", "area, %", "volume, %", "beside the default", "front"),
)
_SHOWN = {  # figure: digits after the point; the last six are against the truth
    "sam": 4,
    "rmse": 4,
    "clean_sam": 4,
    "clean_rmse": 4,
    "f_2_mm": 1,
    "f_half_mm": 1,
    "area_percent": 2,
    "volume_percent": 2,
}


@dataclass(frozen=True)
class AccuracyAndTime(PaperTable):
    """Train, judge, write the table and the picture."""

    common: str = f"{_RAYS} 1024"
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    train_seconds: float = 40.0
    """Training of all but the budgets."""
    scene: str = "pear"
    """Of `hsi-sc-nerf simulate`."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the networks and the drawn pixels."""
    held_out_views: int | None = 3
    """Evaluate this many of the held-out views."""
    parts: tuple[Part, ...] = ("budgets", "settings", "views", "pictures")
    """What is measured."""

    def main(self) -> None:
        """Do what is missing; the table has what is finished."""
        for part in self.parts:
            found: dict[str, list[dict[str, float]]] = {}
            for seed in self.seeds:
                for name, command, configuration in self._rows(part):
                    folder = self.output_dir / f"{command.size}-{command.bands}-{command.frames}"
                    judged = command.judged(configuration, folder, seed)
                    found.setdefault(name, []).append(judged)
            rows = table_rows(part, found)
            write_results(
                *("accuracy_and_time", TITLES, rows),
                keys=2,
                seed=f"scene, runs {' '.join(map(str, self.seeds))}",
                folder=self.results,
            )

    def _rows(self, part: Part) -> list[tuple[str, AccuracyAndTime, Configuration]]:
        """Name, options and configuration of each row."""
        if part == "settings":
            return [
                (name, self, own_configuration(f"{name.replace(' ', '-')}={words}"))
                for name, words in SETTINGS.items()
            ]
        changes: Mapping[str, Mapping[str, float]] = {
            "budgets": {f"{seconds} s": {"train_seconds": float(seconds)} for seconds in BUDGETS_S},
            "views": {f"{frames} views": {"frames": frames} for frames in VIEWS},
            "pictures": PICTURES,
        }[part]
        return [
            (name, replace(self, **change), own_configuration(f"{DEFAULT}="))  # type: ignore[arg-type]
            for name, change in changes.items()
        ]

    def judged(self, configuration: Configuration, folder: Path, seed: int) -> dict[str, float]:
        """Figures of one run."""
        data = self.simulated(self.scene, folder / "session", (*NOISE, *SHADING))
        self.simulated(self.scene, folder / "noise-free", SHADING)
        runs = folder / f"runs-{self.train_seconds:g}-{seed}"
        (run,) = self.trained([configuration], data, runs, seed)
        kept = runs / run.name / "judged.json"
        if not kept.is_file() or kept.stat().st_mtime < (runs / run.name / "result.json").stat().st_mtime:
            config = runs / run.name / "benchmark" / run.method / "run" / "config.yml"
            found = _training_figures(run)
            found |= noise_free_metrics(config, folder / "noise-free-data", self.held_out_views)
            write_json(kept, found | surface_figures(config, folder / "session"))
        return json.loads(kept.read_text(encoding="utf-8"))


def _training_figures(run: BenchmarkRun) -> dict[str, float]:
    last = run.checkpoints[-1]
    metrics = {name: last.metrics[name] for name in ("sam", "rmse")}
    return {"seconds": last.cpu_seconds, "steps": last.iteration, "memory_mib": last.peak_memory_mib, **metrics}


def surface_figures(config: Path, session: Path) -> dict[str, float]:
    """F-scores of what a camera sees, percent, and errors of area and volume of the closed cloud, percent."""
    truth = load_truth(session)
    true_mesh = truth.mesh()
    with TemporaryDirectory() as temporary:
        options = CloudOptions(num_points=CLOUD_POINTS, bands=("650",))
        cloud = read_spectral_ply(export_cloud(open_run(config), Path(temporary), options))
    reference = true_reference(session, CompareConfig(whole_reference=False))
    assert reference.seen is not None
    surface = Surface(cloud.points)
    distances_m = (
        reference.surface.distances_m(cloud.points),
        surface.distances_m(reference.surface.points_m[reference.seen]),
    )
    f_scores = [score_at(*distances_m, threshold_m).f_score for threshold_m in (0.002, 0.0005)]
    mesh = closed_mesh(cloud.points, cloud.normals, MeshConfig(base_height_m=float(true_mesh.vertices[:, 2].min())))
    found, true = size_of(mesh), size_of(true_mesh)
    return {
        "f_2_mm": f_scores[0],
        "f_half_mm": f_scores[1],
        "area_percent": 100.0 * (found.area_m2 / true.area_m2 - 1.0),
        "volume_percent": 100.0 * (found.volume_l / true.volume_l - 1.0),
    }


def table_rows(part: str, found: Mapping[str, Sequence[Mapping[str, float]]]) -> list[list[str]]:
    """A row of the table for each name: means and ranges over the seeds."""
    front = pareto_front(
        {
            name: (_mean(runs, "seconds"), _mean(runs, "memory_mib"), _mean(runs, "clean_sam"))
            for name, runs in found.items()
        }
    )
    rows = []
    for name, runs in found.items():
        cells = [f"{_mean(runs, figure):.0f}" for figure in ("seconds", "steps", "memory_mib")]
        cells += [mean_and_range([run[figure] for run in runs], digits) for figure, digits in _SHOWN.items()]
        beside = "" if DEFAULT not in found else difference(runs, found[DEFAULT])
        rows.append([part, name, *cells, beside, "yes" if name in front else ""])
    return rows


def _mean(runs: Sequence[Mapping[str, float]], figure: str) -> float:
    return float(np.mean([run[figure] for run in runs]))


def mean_and_range(values: Sequence[float], digits: int) -> str:
    """The mean, and the least and the largest of more than one."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def difference(runs: Sequence[Mapping[str, float]], default: Sequence[Mapping[str, float]]) -> str:
    """Change of the error against noise-free views, where the ranges of the seeds do not overlap.

    Example:
        >>> difference([{"clean_sam": 0.02, "clean_rmse": 0.01}], [{"clean_sam": 0.01, "clean_rmse": 0.01}])
        'SAM +100 %'
    """
    told = []
    for figure, title in (("clean_sam", "SAM"), ("clean_rmse", "RMSE")):
        mine, others = ([run[figure] for run in one] for one in (runs, default))
        if min(mine) > max(others) or max(mine) < min(others):
            told.append(f"{title} {100.0 * (np.mean(mine) / np.mean(others) - 1.0):+.0f} %")
    return ", ".join(told) or "none"


def pareto_front(costs: Mapping[str, tuple[float, ...]]) -> set[str]:
    """Names whose costs no other name has all at most, and one less.

    Example:
        >>> sorted(pareto_front({"a": (1.0, 3.0), "b": (2.0, 2.0), "c": (2.0, 3.0)}))
        ['a', 'b']
    """

    def dominates(other: tuple[float, ...], mine: tuple[float, ...]) -> bool:
        return all(o <= m for o, m in zip(other, mine, strict=True)) and other != mine

    return {name for name, mine in costs.items() if not any(dominates(other, mine) for other in costs.values())}


if __name__ == "__main__":
    tyro.cli(AccuracyAndTime).main()
