"""Peak memory and time of every command on a session of full size.

    uv run python benchmarks/command_memory.py --frames 6
    uv run python benchmarks/command_memory.py --frames 12

Each command runs in a process of its own, whose largest resident memory counts. What a command needs for one more
frame follows from sessions of different lengths. Needs 0.25 GB of disk a frame at the default size, freed at the end.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import tyro
from results_table import RESULTS, write_results

from hsi_sc_nerf.benchmark.steps import run_step, typed_command

COLUMNS = ["session", "command", "peak memory, MiB", "seconds"]
HELD_OUT = 2


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
        "traits": f"hsi-sc-nerf traits {cloud} --data {data} --output-dir {traits}",
        "report": (
            f"hsi-sc-nerf report {run} --output {folder / 'r.html'} --cloud {cloud} --traits {traits / 'traits.json'}"
        ),
        "render, 1 view": (
            f"hsi-sc-nerf render --load-config {config} --output-dir {folder / 'views'} --views orbit --orbit-views 1"
        ),
    }


def main(
    frames: int = 60,
    size_px: int = 512,
    bands: int = 204,
    steps: int = 100,
    points: int = 200_000,
    results: Path = RESULTS,
) -> None:
    """Run every command on a simulated session, and write a row for each; rows of other sessions are kept.

    Args:
        frames, size_px, bands: of the session.
        steps: of the training.
        points: of the cloud.
        results: folder of the table.
    """
    session = f"{frames} frames of {size_px} x {size_px} x {bands}"
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name, line in commands(folder, frames, size_px, bands, steps, points).items():
            cost = run_step(name, typed_command(line.split()), folder / "log")
            row = [session, name, f"{cost.peak_memory_mib:.0f}", f"{cost.seconds:.0f}"]
            write_results("command_memory", COLUMNS, [row], keys=2, folder=results)


if __name__ == "__main__":
    tyro.cli(main)
