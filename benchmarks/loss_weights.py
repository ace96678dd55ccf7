"""The paper's loss-weight ablation (table "Pre-trained vs. fine-tuned") on the simulated maize, beside its figures.

    uv run python benchmarks/loss_weights.py --output-dir /tmp/loss-weights --base ours

Pre-trained is the end of the first stage, fine-tuned the end of the second.
"""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from paper_tables import METRICS, PaperTable, mean_and_deviation
from results_table import write_results

from hsi_sc_nerf.benchmark.configurations import Configuration, named_configuration
from hsi_sc_nerf.benchmark.run import BenchmarkRun
from hsi_sc_nerf.errors import InputError

DIGITS = {name: 2 if name == "psnr" else digits for name, (_, digits) in METRICS.items()}

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
class LossWeights(PaperTable):
    """Train with each of the paper's loss weightings and write the results beside the paper's."""

    base: str = "paper"
    """Configuration of `hsi-sc-nerf benchmark` whose weights are changed."""

    def main(self) -> None:
        """Do what is missing, print the table, write it."""
        data = self.simulated("maize", self.output_dir / "session")
        runs = self.trained([weighted(self.base, *weights) for weights in PAPER], data, self.output_dir / "runs")
        for run in runs:
            end = run.checkpoints[-1]
            print(f"{run.name}: {end.iteration} iterations in {end.train_seconds:.0f} s of training")
        write_results("loss_weights", *comparison(runs), folder=self.results)


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
        for metric, digits in DIGITS.items():
            for stage, region in enumerate(REGIONS):
                mean, deviation = printed[metric][stage]
                paper_cells.append(f"{mean:.{digits}f} ± {deviation:.{digits}f}")
                own_cells.append(mean_and_deviation(ends[stage], region + metric, digits))
        rows += [[name, "paper", *paper_cells], [name, "here", *own_cells]]
    return titles, rows


if __name__ == "__main__":
    tyro.cli(LossWeights).main()
