"""Processor time of evaluating six views of 512 x 512 x 204 and of a cloud of a million points, before and now.

    git worktree add /tmp/before before-bounds
    uv run python benchmarks/export_and_evaluation.py --output-dir /tmp/cost --before /tmp/before

Both versions train on the same simulated session, each for so many steps, and then evaluate and export their own
run with `ns-eval` and `ns-export pointcloud`, one after the other on one core. Starting Python counts. What is
finished is not done again, except for evaluating and exporting.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from paper_tables import short_training
from results_table import RESULTS, write_results

from hsi_sc_nerf.benchmark.steps import peak_memory_mib, typed_command
from hsi_sc_nerf.processing.process import process_session
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

HELD_OUT_FRACTION = 0.5
"""Six of twelve frames."""
TITLES = ["version", "step", "processor, s", "before / now", "memory, MiB"]


@dataclass(frozen=True)
class ExportAndEvaluation:
    """Options of the benchmark."""

    output_dir: Path
    """Folder for the session, the dataset, the runs and their results."""
    before: Path
    """Work tree of the version to compare with."""
    scene: str = "pear"
    """Scene of `hsi-sc-nerf simulate`."""
    frames: int = 12
    """Frames of the session; half of them are held out."""
    size: int = 512
    """Width and height of the images, pixels."""
    points: int = 1_000_000
    """Points of the cloud."""
    iterations: int = 500
    """Training steps of either version, of 1024 rays."""
    results: Path = RESULTS
    """Folder of the CSV file."""

    def main(self) -> None:
        """Measure what is asked for, print the table, write it."""
        output_dir = self.output_dir.resolve()
        session, data = output_dir / "session", output_dir / "data"
        if not session.exists():
            scene = override(load_scene(self.scene), frames=self.frames, size_px=self.size)
            simulate_session(scene, session)
        process_session(session, data)
        trees = {"before": self.before.resolve(), "now": Path(__file__).resolve().parents[1]}
        costs = {version: self._costs(version, tree, data) for version, tree in trees.items()}
        rows = [
            [
                version,
                step,
                f"{seconds:.1f}",
                f"{costs['before'][step][0] / seconds:.2f}",
                f"{memory_mib:.0f}",
            ]
            for version in trees
            for step, (seconds, memory_mib) in costs[version].items()
        ]
        write_results("export_and_evaluation", TITLES, rows, keys=2, folder=self.results)

    def _costs(self, version: str, tree: Path, data: Path) -> dict[str, tuple[float, float]]:
        """Processor seconds and memory of the steps of one version, by the step's name."""
        folder = self.output_dir.resolve() / version
        run = folder / "run" / "hsi-sc-nerf" / "run"
        training = short_training(data, folder, self.iterations)
        training += ["--pipeline.datamanager.dataparser.train-split-fraction", 1.0 - HELD_OUT_FRACTION]
        if not list(run.glob("stage-masked/*.ckpt")):
            _run(tree, training, folder / "train.log")
        evaluating = ["ns-eval", "--load-config", run / "config.yml", "--output-path", folder / "eval.json"]
        exporting = ["ns-export", "pointcloud", "--load-config", run / "config.yml", "--output-dir", folder]
        return {
            "evaluate": _run(tree, evaluating, folder / "evaluate.log"),
            "export": _run(tree, [*exporting, "--num-points", self.points], folder / "export.log"),
        }


def _run(tree: Path, words: Sequence[object], log: Path) -> tuple[float, float]:
    """Processor seconds and peak memory (MiB) of a command with the code of a work tree, on one core."""
    one_core = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "PYTHONPATH": str(tree), "PYTHONWARNINGS": "ignore"}
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as output:
        # Python looks for the package in the current folder first.
        process = subprocess.Popen(
            typed_command(words), stdout=output, stderr=subprocess.STDOUT, env=os.environ | one_core, cwd=tree
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{log}: the step failed with status {process.returncode}.")
    return usage.ru_utime + usage.ru_stime, peak_memory_mib(usage)


if __name__ == "__main__":
    tyro.cli(ExportAndEvaluation).main()
