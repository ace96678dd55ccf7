"""The paper's 40,000 iterations at 128 x 128, killed and resumed: loss, memory and time of a step along the run.

    uv run python benchmarks/long_run.py --output-dir /tmp/long

`ns-train` is killed (SIGKILL) at random moments of every second part of the run and goes on from its last checkpoint.
The last row is a run of its own of a quarter of the length, about ten minutes. What is finished is not done again.
"""

from __future__ import annotations

import random
import signal
import subprocess
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import tyro
from beyond_the_paper import NOISE, SHADING, noise_free_metrics
from paper_tables import PaperTable, short_training
from psutil import Process
from results_table import write_results
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hsi_sc_nerf.benchmark.steps import typed_command
from hsi_sc_nerf.files import make_folder, read_json, write_json

TITLES = (
    "run",
    "steps",
    "loss",
    "processor, ms a step",
    "memory, MiB",
    "kills",
    "without the noise: SAM, rad",
    " RMSE",
)
CHECKPOINT_EVERY = 500
PARTS = 10
_POLL_S = 0.5
_KILL_WITHIN_S = 30.0
"""A kill comes so soon after a checkpoint, so that a run of hours loses minutes."""


@dataclass(frozen=True)
class LongRun(PaperTable):
    """Train, kill, resume, and write the table."""

    steps: int = 40_000
    """Of the long run; the other has a quarter."""
    scene: str = "pear"
    """Of `hsi-sc-nerf simulate`."""

    def main(self) -> None:
        """Do what is missing, and write the table."""
        self.simulated(self.scene, self.output_dir / "noise-free", SHADING)
        data = self.simulated(self.scene, self.output_dir / "session", (*NOISE, *SHADING))
        rows = []
        for name, steps, parts in (("long", self.steps, PARTS), ("a quarter", self.steps // 4, 1)):
            folder = self.output_dir / f"{name.replace(' ', '-')}-{steps}"
            marks = train_with_kills(data, folder, steps, parts)
            run = folder / "run" / "hsi-sc-nerf" / "run"
            rows += [[name, *cells] for cells in part_rows(marks, logged_losses(run), steps, parts)]
            errors = noise_free_metrics(run / "config.yml", self.output_dir / "noise-free-data", self.held_out_views)
            rows[-1][-2:] = [f"{errors['clean_sam']:.4f}", f"{errors['clean_rmse']:.4f}"]
        write_results("long_run", TITLES, rows, keys=2, seed="scene, run 0, kills 0", folder=self.results)


def train_with_kills(data: Path, folder: Path, steps: int, parts: int) -> list[dict[str, float]]:
    """Train to the end, whatever is killed; returns what a process had used at each of its checkpoints.

    Args:
        data: dataset.
        folder: of the run.
        steps: of the whole run.
        parts: of the run; there is a kill in every second one.
    """
    make_folder(folder)
    kept = folder / "marks.json"
    marks: list[dict[str, float]] = read_json(kept, "delete the folder") if kept.is_file() else []
    moments = random.Random(0)
    kill_steps = [steps * (part + moments.random()) / parts for part in range(1, parts, 2)]
    checkpoints = folder / "run" / "hsi-sc-nerf" / "run" / "nerfstudio_models"
    while not marks or marks[-1]["step"] < steps - 1:
        words = [*short_training(data, folder, steps), "--steps-per-save", CHECKPOINT_EVERY]
        if any(checkpoints.glob("*.ckpt")):
            words += ["--load-dir", checkpoints]
        with (folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(typed_command(words), stdout=log, stderr=log)
        watched, kill_at_s = Process(process.pid), None
        while process.poll() is None and (kill_at_s is None or time.monotonic() < kill_at_s):
            time.sleep(_POLL_S)
            step = max((int(path.stem.split("-")[1]) for path in checkpoints.glob("*.ckpt")), default=0)
            if step <= max((mark["step"] for mark in marks), default=0) or process.poll() is not None:
                continue
            used, kills = watched.cpu_times(), len({mark["process"] for mark in marks} - {process.pid})
            marks.append({"step": step, "process": process.pid, "seconds": used.user + used.system})
            marks[-1]["memory_mib"] = watched.memory_info().rss / 2**20
            write_json(kept, marks)
            if kills < len(kill_steps) and step >= kill_steps[kills]:
                kill_at_s = time.monotonic() + moments.uniform(0.0, _KILL_WITHIN_S)
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
        elif process.returncode == 0:
            break
        if process.wait() != -signal.SIGKILL:
            raise SystemExit(f"the training ended with status {process.returncode}; see {folder / 'log.txt'}")
    return marks


def logged_losses(run: Path) -> dict[int, float]:
    """The loss at each logged step, from TensorBoard's files."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0}).Reload()
    return {event.step: event.value for event in events.Scalars("Train Loss")}


def part_rows(marks: list[dict[str, float]], losses: dict[int, float], steps: int, parts: int) -> list[list[str]]:
    """Steps, loss, processor ms a step, memory and kills of each part; two cells stay empty.

    A step's time is that between two checkpoints of one process, so that no start of Python is in it.
    """
    rows = []
    for part in range(parts):
        first, last = (round(steps * (part + more) / parts) for more in (0, 1))
        spans = [(a, b) for a, b in pairwise(marks) if first <= a["step"] and b["step"] <= last]
        whole = [(a, b) for a, b in spans if a["process"] == b["process"]]
        seconds = sum(b["seconds"] - a["seconds"] for a, b in whole) / sum(b["step"] - a["step"] for a, b in whole)
        loss = np.mean([value for step, value in losses.items() if first <= step < last])
        memory_mib = max(mark["memory_mib"] for mark in marks if first <= mark["step"] <= last)
        rows.append([f"{first} to {last}", f"{loss:.4f}", f"{1000.0 * seconds:.0f}", f"{memory_mib:.0f}"])
        rows[-1] += [str(len(spans) - len(whole)), "", ""]
    return rows


if __name__ == "__main__":
    tyro.cli(LongRun).main()
