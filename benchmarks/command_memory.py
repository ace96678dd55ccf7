"""Peak memory and time of every command that reads a session, a dataset or a run, on a session of full size.

    uv run python benchmarks/command_memory.py --frames 6
    uv run python benchmarks/command_memory.py --frames 12

Each command runs in a process of its own, whose largest resident memory counts, and the largest part of it that is
anonymous: what the command itself holds. The rest are pages of files that the system takes back when it needs memory.
What a command needs for one more frame follows from sessions of different lengths. Needs 0.25 GB of disk a frame at
the default size, freed at the end.
"""

from __future__ import annotations

import contextlib
import tempfile
import threading
from pathlib import Path

import tyro
from psutil import NoSuchProcess, Process
from results_table import RESULTS, write_results

from hsi_sc_nerf.benchmark.steps import run_step, typed_command

COLUMNS = ["session", "command", "peak memory, MiB", "of it anonymous, MiB", "seconds"]
HELD_OUT = 2
SAMPLED_EVERY_S = 0.02


def commands(folder: Path, frames: int, size_px: int, bands: int, steps: int, points: int) -> dict[str, str]:
    """The commands in order, by their names."""
    session, data, runs, export, traits = (folder / n for n in ("session", "data", "runs", "export", "traits"))
    run, cloud = runs / "m" / "hsi-sc-nerf" / "run", export / "point_cloud.ply"
    config = run / "config.yml"
    training = f"ns-train hsi-sc-nerf --data {data} --output-dir {runs} --experiment-name m --timestamp run"
    training += f" --vis tensorboard --max-num-iterations {steps} --evaluate-stages False"
    training += " --steps-per-eval-batch 1000000 --steps-per-eval-image 1000000"
    training += f" --pipeline.datamanager.dataparser.train-split-fraction {(frames - HELD_OUT) / frames}"
    return {
        "simulate": f"hsi-sc-nerf simulate pear {session} --frames {frames} --size {size_px} --bands {bands}",
        "inspect": f"hsi-sc-nerf inspect {session}",
        "process": f"hsi-sc-nerf process {session} --output-dir {data}",
        f"ns-train, {steps} steps": training,
        f"ns-eval, {HELD_OUT} views": f"ns-eval --load-config {config} --output-path {folder / 'eval.json'}",
        f"ns-export pointcloud, {points} points": (
            f"ns-export pointcloud --load-config {config} --output-dir {export} --num-points {points}"
        ),
        "material": f"hsi-sc-nerf material {cloud} --load-config {config} --output {folder / 'material.ply'}",
        "traits": f"hsi-sc-nerf traits {cloud} --data {data} --output-dir {traits}",
        "report": (
            f"hsi-sc-nerf report {run} --output {folder / 'r.html'} --cloud {cloud} --traits {traits / 'traits.json'}"
        ),
        "render, 1 view": (
            f"hsi-sc-nerf render --load-config {config} --output-dir {folder / 'views'} --views orbit --orbit-views 1"
        ),
    }


class AnonymousMemory:
    """Context manager that samples the anonymous memory of all processes that this one starts; Linux alone."""

    def __init__(self) -> None:
        self.peak_mib = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> AnonymousMemory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(SAMPLED_EVERY_S):
            self.peak_mib = max(self.peak_mib, sum(map(_anonymous_mib, Process().children(recursive=True))))


def _anonymous_mib(process: Process) -> float:
    with contextlib.suppress(NoSuchProcess):
        memory = process.memory_info()
        return (memory.rss - memory.shared) / 2**20
    return 0.0


def main(
    frames: int = 60,
    size_px: int = 512,
    bands: int = 204,
    steps: int = 100,
    points: int = 200_000,
    only: str = "",
    keep: Path | None = None,
    results: Path = RESULTS,
) -> None:
    """Run every command on a simulated session, and write a row for each; rows of other sessions are kept.

    Args:
        frames, size_px, bands: of the session.
        steps: of the training.
        points: of the cloud.
        only: part of the names of the commands to run, whose inputs lie in --keep; the other rows are kept.
        keep: folder for the session and all results.
        results: folder of the table.
    """
    session = f"{frames} frames of {size_px} x {size_px} x {bands}"
    with tempfile.TemporaryDirectory() as temporary:
        folder = (keep or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        for name, line in commands(folder, frames, size_px, bands, steps, points).items():
            if only not in name:
                continue
            with AnonymousMemory() as anonymous:
                cost = run_step(name, typed_command(line.split()), folder / "log")
            row = [session, name, f"{cost.peak_memory_mib:.0f}", f"{anonymous.peak_mib:.0f}", f"{cost.seconds:.0f}"]
            write_results("command_memory", COLUMNS, [row], keys=2, folder=results)


if __name__ == "__main__":
    tyro.cli(main)
