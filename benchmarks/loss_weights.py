"""The paper's loss-weight ablation (table "Pre-trained vs. fine-tuned") on the simulated maize, beside its figures.

    uv run python benchmarks/loss_weights.py --output-dir /tmp/loss-weights --page docs/accuracy_and_time.md

Every weighting is trained in a process of its own by `hsi-sc-nerf benchmark`; what is finished is not trained again.
Pre-trained is the end of the first stage, fine-tuned the end of the second.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from page import write_table
from rich.console import Console
from rich.table import Table

from hsi_sc_nerf.benchmark.configurations import Configuration, named_configuration
from hsi_sc_nerf.benchmark.machine import describe_machine
from hsi_sc_nerf.benchmark.results import describe_in_words
from hsi_sc_nerf.benchmark.run import BenchmarkRun, Clock
from hsi_sc_nerf.cli.benchmark import BenchmarkCommand, train_all
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.processing.process import process_session
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

METRICS = {"sam": ("SAM, rad", 4), "rmse": ("RMSE", 4), "ssim": ("SSIM", 3), "psnr": ("PSNR, dB", 2)}

# (angular, hsi): the paper's mean and SD for each metric, pre-trained and fine-tuned (its table of the ablation).
PAPER: dict[tuple[float, float], dict[str, tuple[tuple[float, float], tuple[float, float]]]] = {
    (0.0, 1.0): {
        "sam": ((0.0622, 0.0113), (0.0422, 0.0192)),
        "rmse": ((0.0731, 0.0134), (0.0360, 0.0141)),
        "ssim": ((0.3905, 0.1377), (0.8564, 0.0718)),
        "psnr": ((22.11, 1.63), (27.27, 4.43)),
    },
    (0.25, 0.75): {
        "sam": ((0.0588, 0.0091), (0.0292, 0.0046)),
        "rmse": ((0.0715, 0.0098), (0.0305, 0.0114)),
        "ssim": ((0.4356, 0.1161), (0.8882, 0.0562)),
        "psnr": ((22.17, 1.34), (29.14, 2.55)),
    },
    (0.5, 0.5): {
        "sam": ((0.0808, 0.0130), (0.0523, 0.0204)),
        "rmse": ((0.0922, 0.0085), (0.0468, 0.0162)),
        "ssim": ((0.1758, 0.0972), (0.7896, 0.0978)),
        "psnr": ((19.81, 1.11), (24.45, 3.59)),
    },
    (0.75, 0.25): {
        "sam": ((0.0498, 0.0087), (0.0428, 0.0169)),
        "rmse": ((0.0616, 0.0141), (0.0421, 0.0138)),
        "ssim": ((0.5212, 0.1676), (0.8534, 0.0802)),
        "psnr": ((23.78, 1.91), (25.89, 3.94)),
    },
    (1.0, 0.0): {
        "sam": ((0.0707, 0.0249), (0.0381, 0.0162)),
        "rmse": ((0.0893, 0.0120), (0.0732, 0.0096)),
        "ssim": ((0.2811, 0.1276), (0.5984, 0.0342)),
        "psnr": ((19.97, 1.51), (21.65, 1.69)),
    },
}
# The paper restricts supervision to the mask in its second stage alone; its first is judged over whole frames.
REGIONS = ("full_", "")


@dataclass(frozen=True)
class LossWeights:
    """Train with each of the paper's loss weightings and print the results beside the paper's."""

    output_dir: Path
    """Folder for the session, the dataset and the runs."""
    page: Path | None = None
    """Markdown page whose table is replaced."""
    base: str = "paper"
    """Configuration of `hsi-sc-nerf benchmark` whose weights are changed."""
    common: str = ""
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    train_seconds: float = 600.0
    """Time for training each weighting."""
    clock: Clock = "wall"
    """What the seconds are of, as in `hsi-sc-nerf benchmark`."""
    iterations: int | None = None
    """The same number of iterations for each weighting instead of the same time; the paper's is 40000."""
    threads: int | None = None
    """CPU threads; all cores where it is not given."""
    frames: int = 60
    """Frames of the session."""
    size: int = 128
    """Width and height of the images, pixels."""
    bands: int = 204
    """Spectral bands."""

    def main(self) -> None:
        """Simulate and train what is missing, print the table, write it into the page."""
        session, data = self.output_dir / "session", self.output_dir / "data"
        if not session.exists():
            scene = override(load_scene("maize"), frames=self.frames, size_px=self.size, bands=self.bands)
            simulate_session(scene, session)
        process_session(session, data)
        command = BenchmarkCommand(
            data=data,
            output_dir=self.output_dir / "runs",
            common=self.common,
            train_seconds=self.train_seconds,
            clock=self.clock,
            iterations=self.iterations,
            checkpoints=(1.0,),
            threads=self.threads,
        )
        runs = train_all([weighted(self.base, *weights) for weights in PAPER], command)
        titles, rows = comparison(runs)
        shown = Table(*titles)
        for row in rows:
            shown.add_row(*row)
        Console(width=200).print(shown)
        if self.page is not None:
            write_table(self.page, "loss weights", titles, rows, self._caption(runs))

    def _caption(self, runs: list[BenchmarkRun]) -> str:
        ends = [run.checkpoints[-1] for run in runs]
        iterations = sorted(end.iteration for end in ends)
        seconds = sorted(end.train_seconds for end in ends)
        method = named_configuration(self.base).method
        return (
            f"{self.frames} frames of {self.size} x {self.size} x {self.bands}; {method} {self.common}, "
            f"{iterations[0]} to {iterations[-1]} iterations in {seconds[0]:.0f} to {seconds[-1]:.0f} s of training; "
            f"{describe_in_words(describe_machine())}."
        )


def weighted(base: str, angular: float, hsi: float) -> Configuration:
    """A known configuration with these loss weights."""
    known = named_configuration(base)
    weights = ("--pipeline.model.angular-loss-mult", str(angular), "--pipeline.model.hsi-loss-mult", str(hsi))
    words = ("--pipeline.model.angular-loss", "cosine", *weights)
    return Configuration(f"{base}-angular-{angular:g}-hsi-{hsi:g}", known.method, known.words + words)


def comparison(runs: list[BenchmarkRun]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows: each weighting as the paper printed it, and as it came out here."""
    stages = ("pre-trained", "fine-tuned")
    titles = ["(angular, hsi)", "", *(f"{title}, {stage}" for title, _ in METRICS.values() for stage in stages)]
    rows = []
    for (weights, printed), run in zip(PAPER.items(), runs, strict=True):
        name = f"({weights[0]:g}, {weights[1]:g})"
        ends = [end.metrics for end in run.stage_ends]
        if len(ends) != len(stages):
            raise InputError(f"{run.name} trained {len(ends)} stages instead of two; give it more iterations.")
        paper_cells: list[str] = []
        own_cells: list[str] = []
        for metric, (_, digits) in METRICS.items():
            for stage, region in enumerate(REGIONS):
                found = (ends[stage][region + metric], ends[stage][f"{region}{metric}_std"])
                for cells, (mean, spread) in ((paper_cells, printed[metric][stage]), (own_cells, found)):
                    cells.append(f"{mean:.{digits}f} ± {spread:.{digits}f}")
        rows += [[name, "paper", *paper_cells], [name, "here", *own_cells]]
    return titles, rows


if __name__ == "__main__":
    tyro.cli(LossWeights).main()
