"""Where a training step's time goes on a GPU: ``python benchmarks/gpu_profile.py DATA FOLDER METHOD``.

Prints rows for benchmarks/gpu.py, the places where the host waits for the device, and the profiler's table.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import torch

from hsi_sc_nerf.benchmark.configurations import training_config
from hsi_sc_nerf.benchmark.run import Job, build_trainer

ON_GPU = torch.cuda.is_available()
WARM_UP, STEPS, FETCHES = (30, 150, 100) if ON_GPU else (2, 3, 5)


def main(data: str, folder: str, method: str) -> None:
    """Profile."""
    job = Job(method, (), data, folder, STEPS, None, "wall", (), 8, None)
    device = "cuda" if ON_GPU else "cpu"
    for name, words in (
        ("eager, pixels from files", ("--capture-steps", "False", *HELD, "False")),
        ("eager, pixels held", ("--capture-steps", "False", *HELD, "True")),
        ("graph, pixels held", ("--capture-steps", "True", *HELD, "True")),
        ("graph of compiled functions", ("--capture-steps", "True", *HELD, "True")),
    ):
        if name == "graph of compiled functions":
            if not ON_GPU:
                continue
            _compile_functions()
        trainer = build_trainer(training_config(method, words), job, 4000, Path(folder))
        trainer._show_progress = lambda *_: None
        trainer.pipeline.train()
        _steps(trainer, 0, WARM_UP)
        _wait(device)
        started = time.perf_counter()
        for step in range(FETCHES):
            trainer.pipeline.datamanager.next_train(step)
        _wait(device)
        fetch_ms = 1000.0 / FETCHES * (time.perf_counter() - started)
        started = time.perf_counter()
        _steps(trainer, 1000, STEPS)
        _wait(device)
        step_ms = 1000.0 / STEPS * (time.perf_counter() - started)
        memory = torch.cuda.max_memory_allocated() / 2**20 if device == "cuda" else 0.0
        row = {"step": name, "ms per iteration": step_ms, "GPU, MiB": memory}
        print("ROW " + json.dumps(row | {"note": f"fetch {fetch_ms:.2f} ms of it"}), flush=True)
        if name != "eager, pixels from files":
            _profile(trainer, device)
        if name == "eager, pixels held" and device == "cuda":
            _synchronisations(trainer)
        print("captured:", trainer._captured is not None, flush=True)
        trainer._captured = None
        del trainer
        if device == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()


HELD = ("--pipeline.datamanager.hold-on-gpu",)


def _compile_functions() -> None:
    """Let torch.compile fuse what the hash grid is made of."""
    from hsi_sc_nerf.fields import hash_grid

    for name in ("_corner_rows", "_corner_weights", "_slopes", "_scatter_to_table"):
        setattr(hash_grid, name, torch.compile(getattr(hash_grid, name)))


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _steps(trainer, first: int, count: int) -> None:
    for step in range(first, first + count):
        trainer.train_iteration(step)


def _profile(trainer, device: str) -> None:
    from torch.profiler import ProfilerActivity, profile

    activities = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if device == "cuda" else [])
    with profile(activities=activities) as found:
        _steps(trainer, 2000, 10)
        _wait(device)
    averages = found.key_averages()
    for key in ("self_cuda_time_total", "self_cpu_time_total") if device == "cuda" else ("self_cpu_time_total",):
        lines = averages.table(sort_by=key, row_limit=14, max_name_column_width=48).splitlines()
        for line in lines[:20]:
            print(line[:50] + line[-92:])
        print(lines[-2] if lines[-1] == "" else "", lines[-1])


def _synchronisations(trainer) -> None:
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _steps(trainer, 3000, 1)
    torch.cuda.set_sync_debug_mode("default")
    places = Counter(f"{Path(w.filename).name}:{w.lineno}" for w in caught)
    print("the host waits at", dict(places), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:4])
