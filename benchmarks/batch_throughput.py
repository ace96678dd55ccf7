"""Sessions per hour that `hsi-sc-nerf batch` does on this machine, against cores, with the memory that it takes.

    uv run python benchmarks/batch_throughput.py

Each row is a batch of its own on the same simulated sessions, all steps with the table and the page. Processor
seconds count all processes of the batch, and say what wall-clock time does not where other work shares the machine.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path

import tyro
from results_table import RESULTS, write_results
from rich.progress import track
from six_sessions import TRAIN

from hsi_sc_nerf.batch.plan import STEPS, read_plan
from hsi_sc_nerf.benchmark.steps import typed_command
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

COLUMNS = ("cores", "sessions", "with a report", "seconds", "processor seconds a session", "sessions per hour")
COLUMNS += ("peak memory of a step, MiB", "step")


def measure(sessions: Path, out: Path, cores: int, steps: int) -> list[str]:
    """One batch on so many cores, as a row of the table."""
    words = ["hsi-sc-nerf", "batch", sessions, "--output-dir", out, "--max-num-iterations", steps]
    words += ["--num-points", 1000, f"--train={TRAIN}", "--no-gpu", "--cores", cores]
    started = time.monotonic()
    with out.with_suffix(".log").open("wb") as log:
        process = subprocess.Popen(typed_command(words), stdout=log, stderr=subprocess.STDOUT)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.monotonic() - started
    if process.returncode != 0:
        raise SystemExit(out.with_suffix(".log").read_text()[-3000:])
    plan = read_plan(out)
    memory = {
        (float(read_json(one.record(step), "")["peak_memory_mib"]), step) for one in plan.values() for step in STEPS
    }
    peak_mib, largest = max(memory)
    reports = sum((one.folder / "report.html").is_file() for one in plan.values())
    processor_s = (usage.ru_utime + usage.ru_stime) / len(plan)
    row = [cores, len(plan), reports, f"{seconds:.0f}", f"{processor_s:.0f}", f"{3600 * len(plan) / seconds:.0f}"]
    return [*map(str, row), f"{peak_mib:.0f}", largest]


def main(sessions: int = 2, steps: int = 60, cores: tuple[int, ...] = (1, 2), results: Path = RESULTS) -> None:
    """Simulate the sessions, run the batches, and write the table.

    Args:
        sessions: of 8 frames of 64 x 64 x 8.
        steps: of each training.
        cores: of each batch.
        results: folder of the table.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for number in range(sessions):
            scene = override(load_scene("pear"), frames=8, size_px=64, bands=8, seed=number)
            simulate_session(scene, folder / "sessions" / f"pear_{number}", progress=False)
        rows = [
            measure(folder / "sessions", folder / f"out_{count}", count, steps) for count in track(cores, "Batches")
        ]
    write_results("batch_throughput", COLUMNS, rows, folder=results, seed=f"0 to {sessions - 1}")


if __name__ == "__main__":
    tyro.cli(main)
