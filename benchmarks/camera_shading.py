"""What shading by the normal in the camera's frame brings, beside a head that sees the viewing direction.

    uv run python benchmarks/independent_session.py /tmp/quince --rays 200
    uv run python benchmarks/camera_shading.py --output-dir /tmp/shading --path-traced /tmp/quince \\
        --picture docs/images/highlights.png

Simulated objects before a lamp, with and without gloss, are judged against the noise-free light on the sensor, and
their clouds against the true surface. The path-traced fruit is judged against its held-out views as measured, whose
noise is in both models' errors alike. The head that sees the viewing direction is that of commit 0455bcd: the command
runs on a checkout of it as well (``PYTHONPATH`` of that checkout, ``--model "viewing direction"``).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from accuracy_and_time import surface_figures
from effects import held_out_views
from matplotlib import rc_context
from paper_tables import PaperTable, mean_and_deviation
from results_table import current_commit, write_results

import hsi_sc_nerf
from hsi_sc_nerf.benchmark.configurations import own_configuration
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_metrics
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.plotting import STYLE, new_figure, save_figure, show_image
from hsi_sc_nerf.processing.process import process_session

NOISE = ("photon_noise", "read_noise")
SCENES = {
    "pear, lamp without gloss": ("pear", ("lamp",)),
    "pear, lamp and gloss": ("pear", ("lamp", "gloss")),
    "pear, lamp and shade": ("pear", ("lamp", "chamber_shading", "inter_reflection")),
    "tomato, lamp and its own gloss": ("tomato", ("lamp",)),
}
USUAL_STEPS = 700
PATH_TRACED = "path-traced quince, two lamps"
RIM_PX = 2
VIEW, SHOWN_ERROR = "view.npz", 0.15
DIGITS = {
    "sam": 4,
    "rmse": 4,
    "rim": 4,
    "f_half_mm": 1,
    "area_percent": 2,
    "volume_percent": 2,
    "spots_percent": 1,
    "seconds": 0,
}
COLUMNS = (
    *("session", "view dependence by", "SAM, rad", "RMSE", f"RMSE of the outermost {RIM_PX} px", "F at 0.5 mm, %"),
    *("area, %", "volume, %", "spots, %", "processor seconds"),
)


@dataclass(frozen=True)
class CameraShadingTable(PaperTable):
    """Simulate, process and train each session, and write a row of the table for it."""

    common: str = "--pipeline.datamanager.train-num-rays-per-batch 1024"
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    iterations: int | None = USUAL_STEPS
    """Steps of each run; rows of another number state it."""
    threads: int | None = 1
    """CPU threads."""
    frames: int = 30
    """Frames of a session."""
    size: int = 96
    """Width and height of the images, pixels."""
    bands: int = 24
    """Spectral bands."""
    seeds: tuple[int, ...] = (1, 2, 3)
    """Seeds of the networks and of the drawn pixels, a run each."""
    path_traced: Path | None = None
    """Session of independent_session.py; without it, that row is left out."""
    model: str = "normal in the camera's frame"
    """Name of the model in the table."""
    only: str = ""
    """Sessions whose names contain this."""
    picture: Path | None = None
    """PNG file to draw a held-out view of each session to, by all models of the table. None: none is drawn."""

    def main(self) -> None:
        """Make the table, and the picture."""
        for name, (scene, effects) in SCENES.items():
            if self.only in name:
                session = self.output_dir / name.replace(",", "").replace(" ", "-")
                self.measured(f"{name}{self._steps}", session, self.simulated(scene, session, (*NOISE, *effects)))
        if self.path_traced is not None and self.only in PATH_TRACED:
            data = process_session(self.path_traced, self.output_dir / "path-traced-data")
            self.measured(f"{PATH_TRACED}{self._steps}", None, data)
        if self.picture is not None:
            draw_views(self.picture, self.output_dir)

    @property
    def _steps(self) -> str:
        return "" if self.iterations == USUAL_STEPS else f", {self.iterations} steps"

    def measured(self, name: str, session: Path | None, data: Path) -> None:
        """Train with each seed, judge, and write the row."""
        found = [self.judged(session, data, seed) for seed in self.seeds]
        cells = [
            mean_and_deviation([one[figure] for one in found], digits) if figure in found[0] else ""
            for figure, digits in DIGITS.items()
        ]
        seeds, commit = " ".join(map(str, self.seeds)), current_commit(Path(hsi_sc_nerf.__file__).parent)
        rows = [[name, self.model, *cells]]
        write_results("camera_shading", COLUMNS, rows, keys=2, seed=seeds, commit=commit, folder=self.results)

    def judged(self, session: Path | None, data: Path, seed: int) -> dict[str, float]:
        """Figures of one run; a run that was judged before is not judged again."""
        folder = f"{self.model.replace(' ', '-').replace(chr(39), '')}-{seed}"
        runs = data.with_name(f"{data.name}-{folder}{self._steps.replace(', ', '-').replace(' ', '-')}")
        configuration = own_configuration("shading=--pipeline.model.effects view_dependence")
        (run,) = self.trained([configuration], data, runs, seed)
        kept = runs / "judged.json"
        if not kept.is_file():
            config = runs / "shading" / "benchmark" / run.method / "run" / "config.yml"
            figures = held_out_errors(config, session, runs / VIEW)
            figures |= {} if session is None else surface_figures(config, session)
            write_json(kept, figures | {"seconds": run.checkpoints[-1].cpu_seconds})
        scores: dict[str, float] = json.loads(kept.read_text(encoding="utf-8"))
        return scores


def held_out_errors(config: Path, session: Path | None, kept_view: Path) -> dict[str, float]:
    """SAM and RMSE on the object, and RMSE of its outermost pixels: means over views, against light without noise.

    Args:
        config: of the run.
        session: simulated; None for views as measured.
        kept_view: file that keeps the first view in three bands, for the picture.
    """
    found = []
    for rendered, expected, mask, bands in held_out_views(config, session):
        if not found:
            shown = {"rendered": rendered[..., bands], "expected": expected[..., bands], "mask": mask}
            np.savez(kept_view, **{key: value.numpy() for key, value in shown.items()})
        rim = mask & torch.from_numpy(dilate(~mask.numpy(), 2 * RIM_PX + 1))
        metrics = spectral_metrics(rendered, expected, mask)
        outermost = (rendered - expected)[rim].square().mean().sqrt()
        found.append({"sam": metrics["sam"], "rmse": metrics["rmse"], "rim": float(outermost)})
    return {name: float(np.mean([view[name] for view in found])) for name in found[0]}


@rc_context(STYLE)
def draw_views(path: Path, folder: Path) -> None:
    """A row for each session that all models have: the first held-out view as it is, and by each, with its error."""
    found: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    for file in sorted(folder.glob(f"*-data-*-1/{VIEW}")):
        session, model = file.parent.name.removesuffix("-1").split("-data-")
        found.setdefault(session, {})[model.replace("-", " ")] = dict(np.load(file))
    models = sorted({model for views in found.values() for model in views}, reverse=True)
    found = {session: views for session, views in found.items() if len(views) == len(models)}
    figure = new_figure(2.0 * (1 + 2 * len(models)), 2.1 * len(found))
    rows = figure.subplots(len(found), 1 + 2 * len(models), squeeze=False)
    for axes, views in zip(rows, found.values(), strict=True):
        lines, samples = np.nonzero(next(iter(views.values()))["mask"])
        crop = slice(lines.min(), lines.max() + 1), slice(samples.min(), samples.max() + 1)
        for i, model in enumerate(models):
            truth, rendered = views[model]["expected"][crop], views[model]["rendered"][crop]
            brightest = np.percentile(truth, 99.5)
            show_image(axes[0], (truth / brightest).clip(0.0, 1.0))
            show_image(axes[1 + 2 * i], (rendered / brightest).clip(0.0, 1.0))
            error = (rendered - truth).mean(axis=-1)
            show_image(axes[2 + 2 * i], error, cmap="RdBu_r", vmin=-SHOWN_ERROR, vmax=SHOWN_ERROR)
    rows[0, 0].set_title("held-out view")
    for i, model in enumerate(models):
        rows[0, 1 + 2 * i].set_title("by the " + model.split(" in ")[0])
        rows[0, 2 + 2 * i].set_title(f"error, -{SHOWN_ERROR:g} to {SHOWN_ERROR:g}")
    save_figure(figure, path)


if __name__ == "__main__":
    tyro.cli(CameraShadingTable).main()
