"""What accuracy costs in time: budgets, presets, one setting at a time, views and pictures, with three seeds.

    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front
    uv run python benchmarks/accuracy_and_time.py --output-dir /tmp/front --parts views

A simulated noisy session is trained for the same time with every setting, and judged against what is known:
held-out views without the noise, the true surface, its area and volume. A row is the mean over the seeds and their
range. Ranges that overlap are no difference. What is finished is not done again.

Other work on the machine changes seconds by a third from hour to hour, and steps not at all. So the seconds of a step
are measured once for all settings, in turns in one process, and each setting is trained for the steps that its time
buys. ``--measure-again`` measures the seconds of a step anew, for the table alone.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
import tyro
from beyond_the_paper import NOISE, SHADING, noise_free_metrics
from matplotlib import rc_context
from paper_tables import PaperTable
from results_table import read_results, write_results

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig, closed_mesh
from hsi_sc_nerf.analysis.size import size_of
from hsi_sc_nerf.benchmark.configurations import own_configuration, split_words
from hsi_sc_nerf.benchmark.run import Job, build_trainer
from hsi_sc_nerf.evaluation.comparison import CompareConfig
from hsi_sc_nerf.evaluation.spatial import Surface, score_at
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.files import read_json, write_json
from hsi_sc_nerf.models.presets import ITERATIONS, PRESETS
from hsi_sc_nerf.models.trained_run import open_run
from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure
from hsi_sc_nerf.simulate.true_surface import true_reference
from hsi_sc_nerf.simulate.truth import load_truth

Part = Literal["budgets", "settings", "presets", "views", "pictures"]
CLOUD_POINTS = 150_000
STEPS_A_TURN = 10
SETTLING_TURNS = 12
"""Turns that are not timed: by then the occupancy grid has emptied most of the hull."""
TIMED_TURNS = 8
CAPTURE_SECONDS = 120
"""Of a view at the instrument: a SPECIM IQ takes about two minutes."""
DEFAULT = "default"
_RAYS = "--pipeline.datamanager.train-num-rays-per-batch"
_MODEL = "--pipeline.model"

# Name of a row: what it changes of the default.
SETTINGS: dict[str, str] = {
    DEFAULT: "",
    "2048 rays a step": f"{_RAYS} 2048",
    "8 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 8",
    "32 samples a ray": f"{_MODEL}.num-nerf-samples-per-ray 32",
    "every band a channel": f"{_MODEL}.head direct",
    "first stage a quarter": "--full-frame.fraction 0.25 --masked.fraction 0.75",
    "no angular loss": f"{_MODEL}.angular-loss-mult 0",
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
    """Training of a setting."""
    threads: int | None = 1
    """CPU threads."""
    scene: str = "pear"
    """Of `hsi-sc-nerf simulate`."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the networks and the drawn pixels."""
    held_out_views: int | None = 3
    """Evaluate this many of the held-out views."""
    parts: tuple[Part, ...] = ("budgets", "settings", "presets", "views", "pictures")
    """What is measured; none: only draw."""
    measure_again: bool = False
    """Measure the seconds of a step anew."""
    picture: Path | None = None
    """PNG file to draw the table to."""

    def main(self) -> None:
        """Do what is missing, write the table, draw it."""
        data, _ = self._sessions()
        kept = self.output_dir / "step_seconds.json"
        if not kept.is_file():
            write_json(kept, dict.fromkeys(("first", "last"), step_seconds(data, self.common, SETTINGS)))
        elif self.measure_again:
            write_json(kept, read_json(kept, "delete it") | {"last": step_seconds(data, self.common, SETTINGS)})
        seconds = read_json(kept, "delete it to measure again")
        for part in self.parts:
            rows = self._rows(part, seconds["first"])
            found: dict[str, list[dict[str, float]]] = {name: [] for name, *_ in rows}
            for seed in self.seeds:
                for name, command, words in rows:
                    judged = command.judged(name, words, seed)
                    cost = seconds["last"][name if part == "settings" else DEFAULT]
                    found[name].append(judged | {"seconds": judged["steps"] * cost})
            write_results(
                *("accuracy_and_time", TITLES, table_rows(part, found)),
                keys=2,
                seed=f"scene, runs {' '.join(map(str, self.seeds))}",
                folder=self.results,
            )
        if self.picture is not None:
            draw_front(self.picture, read_results(self.results / "accuracy_and_time.csv")[1:])

    def _rows(self, part: Part, seconds: Mapping[str, float]) -> list[tuple[str, AccuracyAndTime, str]]:
        """Name, options and words of each row."""
        if part == "settings":
            return [
                (name, replace(self, iterations=round(self.train_seconds / seconds[name])), words)
                for name, words in SETTINGS.items()
            ]
        usual = round(self.train_seconds / seconds[DEFAULT])
        changes: Mapping[str, Mapping[str, int]] = {
            "budgets": {f"{budget} s": {"iterations": round(budget / seconds[DEFAULT])} for budget in BUDGETS_S},
            "presets": {name: {"iterations": preset[ITERATIONS]} for name, preset in PRESETS["cpu"].items()},
            "views": {f"{frames} views": {"frames": frames, "iterations": usual} for frames in VIEWS},
            "pictures": {name: {**change, "iterations": usual} for name, change in PICTURES.items()},
        }[part]
        return [(name, replace(self, **change), "") for name, change in changes.items()]  # type: ignore[arg-type]

    def _sessions(self) -> tuple[Path, Path]:
        """Dataset of the noisy session; folder of all that belongs to it."""
        folder = self.output_dir / f"{self.size}-{self.bands}-{self.frames}"
        self.simulated(self.scene, folder / "noise-free", SHADING)
        return self.simulated(self.scene, folder / "session", (*NOISE, *SHADING)), folder

    def judged(self, name: str, words: str, seed: int) -> dict[str, float]:
        """Figures of one run."""
        data, folder = self._sessions()
        folder_name = re.sub("[^a-z0-9]+", "-", name) if words else DEFAULT
        runs = folder / f"runs-{self.iterations}-{seed}"
        (run,) = self.trained([own_configuration(f"{folder_name}={words}")], data, runs, seed)
        kept = runs / run.name / "judged.json"
        if not kept.is_file() or kept.stat().st_mtime < (runs / run.name / "result.json").stat().st_mtime:
            config = runs / run.name / "benchmark" / run.method / "run" / "config.yml"
            last = run.checkpoints[-1]
            found = {"steps": float(last.iteration), "memory_mib": last.peak_memory_mib}
            found |= {metric: last.metrics[metric] for metric in ("sam", "rmse")}
            found |= noise_free_metrics(config, folder / "noise-free-data", self.held_out_views)
            write_json(kept, found | surface_figures(config, folder / "session"))
        return read_json(kept, "delete it to judge the run again")


def step_seconds(data: Path, common: str, settings: Mapping[str, str]) -> dict[str, float]:
    """Processor seconds of a step with each setting: in turns, so that other work on the machine meets all alike."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as temporary:
        trainers = {}
        for name, words in settings.items():
            all_words = tuple(split_words(f"{common} {words}"))
            folder = str(Path(temporary, str(len(trainers))))
            job = Job("hsi-sc-nerf", all_words, str(data), folder, 10_000, None, "cpu", (), 1, None)
            trainers[name] = build_trainer(job)
            trainers[name]._show_progress = lambda step, psnr_db: None
        seconds = dict.fromkeys(trainers, 0.0)
        for turn in range(SETTLING_TURNS + TIMED_TURNS):
            for name, trainer in trainers.items():
                trainer.pipeline.train()
                before = time.process_time()
                for step in range(turn * STEPS_A_TURN, (turn + 1) * STEPS_A_TURN):
                    trainer.train_iteration(step)
                if turn >= SETTLING_TURNS:
                    seconds[name] += (time.process_time() - before) / (TIMED_TURNS * STEPS_A_TURN)
    return seconds


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


@rc_context(STYLE)
def draw_front(path: Path, rows: Sequence[Sequence[str]]) -> None:
    """Error over seconds of training, and surface and spectra over minutes at the instrument.

    Args:
        path: of the PNG file.
        rows: of the CSV file.
    """
    figure = new_figure(11.0, 4.2)
    by_time, by_views = figure.subplots(1, 2)
    column = {title: TITLES.index(title) for title in TITLES}

    def ranges(part: str, title: str) -> np.ndarray:
        """Mean, least and largest, a row of the part."""
        return np.array([parse_range(row[column[title]]) for row in rows if row[0] == part])

    def curve(axes: Any, at: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
        spread = np.abs(values[:, 1:] - values[:, :1]).T
        axes.errorbar(at, values[:, 0], spread, color=colour, marker="o", markersize=4, capsize=2, label=label)

    seconds = ranges("budgets", "training, s")[:, 0]
    curve(by_time, seconds, ranges("budgets", "without the noise: SAM"), COLOURS[0], "SAM (rad), default")
    curve(by_time, seconds, ranges("budgets", " RMSE"), COLOURS[1], "RMSE, default")
    for title, colour in (("without the noise: SAM", COLOURS[0]), (" RMSE", COLOURS[1])):
        others = ranges("settings", title)[1:, 0]
        at = ranges("settings", "training, s")[1:, 0]
        by_time.plot(at, others, "x", color=colour, markersize=4, label=f"{title.split()[-1]}, one setting changed")
    by_time.set(xscale="log", yscale="log", xlabel="training (s of one core)", ylabel="error without the noise")
    by_time.set_xticks(seconds, [f"{second:.0f}" for second in seconds])
    errors_drawn = (0.01, 0.02, 0.03, 0.04)
    by_time.set_yticks(errors_drawn, [f"{error:g}" for error in errors_drawn])
    by_time.minorticks_off()
    by_time.legend(fontsize=7)

    minutes = np.array([int(row[1].split()[0]) for row in rows if row[0] == "views"]) * CAPTURE_SECONDS / 60.0
    curve(by_views, minutes, ranges("views", "F at 0.5 mm, %"), COLOURS[2], "F-score at 0.5 mm (%)")
    by_views.set(xscale="log", xlabel="capture (min, two minutes a view)", ylabel="F-score (%)", xticks=minutes)
    by_views.set_xticks(minutes, [f"{minute:.0f}" for minute in minutes])
    by_views.minorticks_off()
    errors = by_views.twinx()
    errors.grid(visible=False)
    curve(errors, minutes, np.abs(ranges("views", "volume, %")), COLOURS[3], "error of the volume (%)")
    curve(errors, minutes, 100.0 * ranges("views", " RMSE"), COLOURS[1], "RMSE without the noise (% reflectance)")
    errors.set(ylabel="error (%)", ylim=(0.0, None))
    by_views.legend(*map(list.__add__, by_views.get_legend_handles_labels(), errors.get_legend_handles_labels()))
    save_figure(figure, path)


def parse_range(cell: str) -> tuple[float, float, float]:
    """Mean, least and largest of `mean_and_range`.

    Example:
        >>> parse_range("1.5 (1.0 to 2.0)"), parse_range("3")
        ((1.5, 1.0, 2.0), (3.0, 3.0, 3.0))
    """
    numbers = [float(number) for number in re.findall(r"[-+]?[0-9.]+", cell)]
    return (numbers[0], numbers[0], numbers[0]) if len(numbers) == 1 else (numbers[0], numbers[1], numbers[2])


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
