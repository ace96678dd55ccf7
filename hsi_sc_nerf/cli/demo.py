"""``hsi-sc-nerf demo``: the whole workflow on a simulated session, compared with its truth."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from hsi_sc_nerf.cli.steps import StepCost, nerfstudio_command, own_command, own_cost, run_step
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write, make_folder

MARK = ".hsi-sc-nerf-demo"
"""File that marks the folder of a demo, whose contents may be replaced."""

# Fewer rays a step than the default, for two cores.
DEMO_TRAINING = {
    "pipeline.datamanager.train-num-rays-per-batch": "1024",
    "evaluate-stages": "False",
    "steps-per-eval-batch": "1000000",
    "steps-per-eval-image": "1000000",
    "vis": "tensorboard",
}


@dataclass(frozen=True)
class DemoCommand:
    """Simulate a session of a fruit, reconstruct it, and compare the result with the truth.

    Takes two to five minutes on two cores.
    """

    output_dir: Path = Path("hsi-sc-nerf-demo")
    """Folder for all results; an earlier demo there is replaced."""
    scene: str = "pear"
    """pear, apple, maize, pepper, sphere, cylinder, or the path of a scene file."""
    iterations: int = 500
    """Training steps of both stages together."""
    points: int = 60_000
    """Number of points of the cloud."""

    def main(self) -> None:
        """Run the demo.

        Raises:
            InputError: a step failed, or the folder cannot be used.
        """
        # Deferred because Open3D takes seconds to import.
        from hsi_sc_nerf.cli.demo_report import draw_pictures, score, show_table, write_summary

        console, out = Console(), self.output_dir
        logs = out / "logs"
        make_folder(out)
        if any(out.iterdir()) and not (out / MARK).is_file():
            raise InputError(f"{out}: holds something other than a demo; choose another --output-dir.")
        make_folder(logs)
        with atomic_write(out / MARK) as (mark,):
            mark.write_text(
                "This folder belongs to `hsi-sc-nerf demo`, which replaces its contents.\n", encoding="utf-8"
            )
        session, data, runs = out / "session", out / "data", out / "runs"
        for earlier in (runs, out / "renders"):
            shutil.rmtree(earlier, ignore_errors=True)
        config = runs / "demo" / "hsi-sc-nerf" / "demo" / "config.yml"
        training = [word for key, value in DEMO_TRAINING.items() for word in (f"--{key}", *value.split())]
        commands = {
            "simulate": [*own_command(), "simulate", self.scene, str(session)],
            "process": [*own_command(), "process", str(session), "--output-dir", str(data)],
            "train": [
                *nerfstudio_command("train"),
                "hsi-sc-nerf",
                *("--data", str(data), "--output-dir", str(runs)),
                *("--experiment-name", "demo", "--timestamp", "demo"),
                *("--max-num-iterations", str(self.iterations)),
                *training,
            ],
            "evaluate": [
                *nerfstudio_command("eval"),
                *("--load-config", str(config), "--output-path", str(out / "eval.json")),
                *("--render-output-path", str(out / "renders")),
            ],
            "export": [
                *nerfstudio_command("exporter"),
                *("pointcloud", "--load-config", str(config), "--output-dir", str(out)),
                *("--num-points", str(self.points)),
            ],
        }
        costs: list[StepCost] = []
        for number, (name, argv) in enumerate(commands.items(), start=1):
            console.print(f"[bold]{number}/{len(commands) + 1} {name}")
            costs.append(run_step(name, argv, logs / f"{name}.log"))
        console.print(f"[bold]{len(costs) + 1}/{len(commands) + 1} compare")
        started = time.perf_counter()
        metrics, processing = score(out)
        draw_pictures(out)
        costs.append(own_cost("compare", started))
        write_summary(out, metrics, processing, costs)
        show_table(console, out, metrics, processing, costs)
