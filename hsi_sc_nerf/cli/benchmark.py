"""``hsi-sc-nerf benchmark``: accuracy over training time of several configurations."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.benchmark.configurations import (
    CONFIGURATIONS,
    Configuration,
    named_configuration,
    own_configuration,
    split_words,
    training_config,
)
from hsi_sc_nerf.benchmark.run import BenchmarkRun, Checkpoint, Job
from hsi_sc_nerf.benchmark.steps import alone_in, available_cores, describe_machine, run_step
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import TEMPORARY_PREFIX, content_of, make_folder, read_json, write_json
from hsi_sc_nerf.models.schedule import Clock
from hsi_sc_nerf.packed.dataset import TRANSFORMS_NAME, open_packed
from hsi_sc_nerf.settings_file import between, check_options
from hsi_sc_nerf.terminal import screen_table


@dataclass(frozen=True)
class BenchmarkCommand:
    """Train several configurations on one session and compare their accuracy over training time.

    Each configuration trains in its own process. It is skipped if it was already trained on the same data with the
    same settings, machine and package versions. A stopped run starts again.
    """

    data: tyro.conf.Positional[Path]
    """A dataset made by `hsi-sc-nerf process`, or a capture session, which is processed first."""
    output_dir: Path
    """Folder for the runs and for benchmark.csv, .md, .json and .png."""
    configurations: tuple[str, ...] = tuple(CONFIGURATIONS)
    """Known configurations to train: paper is the published recipe, ours is this package's; each of the others
    changes one setting of ours."""
    sets: tuple[str, ...] = ()
    """Configurations of your own, each "NAME=BASE WORDS": the words change BASE (default: ours) as they would behind
    `ns-train METHOD`, for example "fine=paper --pipeline.model.max-res 1024"."""
    common: str = ""
    """Words for every configuration, joined to the option by an equals sign, for example
    --common="--pipeline.datamanager.train-num-rays-per-batch 1024"."""
    train_seconds: float = between(0.001, math.inf, default=600.0)
    """Training time of each configuration; stages and learning rates follow the clock."""
    clock: Clock = "wall"
    """Unit of --train-seconds and the picture: wall time, or processor time over all threads (cpu), which is fairer
    on a machine that also does other work."""
    iterations: int | None = between(1, math.inf, default=None)
    """The same number of iterations for each configuration instead of the same time."""
    checkpoints: tuple[float, ...] = (0.1, 0.25, 0.5, 0.75, 1.0)
    """Fractions of a run at which held-out views are evaluated; the end of each stage always is."""
    held_out_views: int | None = between(1, math.inf, default=None)
    """Evaluate this many of the held-out views, evenly spread, instead of all."""
    threads: int | None = between(1, math.inf, default=None)
    """CPU threads of each run. Default: all cores."""

    def main(self) -> None:
        """Train the missing configurations, write the results, print the table.

        Raises:
            InputError: a name, a word, a number or the data cannot be used, or a run failed.
        """
        chosen = [*map(named_configuration, self.configurations), *map(own_configuration, self.sets)]
        from hsi_sc_nerf.benchmark.results import TABLE_WIDTH, table

        header, rows = table(train_all(chosen, self))
        console = Console()
        console.width = max(console.width, TABLE_WIDTH)
        title = "Held-out views, masked to the object, at the end of each stage"
        console.print(screen_table(header, rows, title))
        console.print(f"Everything, and the picture: {escape(str(self.output_dir / 'benchmark.md'))}", soft_wrap=True)


def train_all(configurations: Sequence[Configuration], command: BenchmarkCommand) -> list[BenchmarkRun]:
    """Train the unfinished configurations and write all results after each.

    Raises:
        InputError: a setting cannot be used, another command works in the folder, or runs failed; the others' results
            are written all the same.
    """
    _check(configurations, command)
    data = _packed(command.data)
    make_folder(command.output_dir)
    with alone_in(command.output_dir):
        return _train_missing(configurations, command, data)


def _train_missing(
    configurations: Sequence[Configuration], command: BenchmarkCommand, data: Path
) -> list[BenchmarkRun]:
    console = Console(stderr=True)
    machine = describe_machine()
    identity = {"machine": machine, "data_sha256": _data_sha256(data)}
    jobs = {configuration.name: _job(configuration, command, data) for configuration in configurations}
    runs = {name: _finished(command.output_dir / name, job, identity) for name, job in jobs.items()}
    missing = [name for name, run in runs.items() if run is None]
    if len(missing) < len(jobs):
        console.print(f"Already trained: {', '.join(name for name in jobs if name not in missing)}")
    failures: list[str] = []
    started = time.perf_counter()
    for number, name in enumerate(missing):
        minutes = (len(missing) - number) * (time.perf_counter() - started) / max(1, number) / 60
        left = f", about {minutes:.0f} min left in all" if number else ""
        console.print(f"[bold]{number + 1}/{len(missing)} {name}[/bold] ({jobs[name].method}{left})")
        try:
            runs[name] = _train(command.output_dir / name, jobs[name], identity)
        except InputError as error:
            failures.append(str(error))
            console.print(f"[yellow]{escape(str(error))}")
        else:
            _write([run for run in runs.values() if run], command, machine)
    finished = [run for run in runs.values() if run]
    if finished and (failures or not missing):
        _write(finished, command, machine)
    if failures:
        raise InputError(f"{len(failures)} of {len(jobs)} configurations failed; the first: {failures[0]}")
    return finished


def _run_of(name: str, job: Job, content: dict[str, Any]) -> BenchmarkRun:
    checkpoints = tuple(Checkpoint(**one) for one in content["checkpoints"])
    return BenchmarkRun(name, job.method, job.words, float(content["setup_seconds"]), checkpoints)


def _check(configurations: Sequence[Configuration], command: BenchmarkCommand) -> None:
    """Refuse settings that would fail later."""
    check_options(command)
    names = [configuration.name for configuration in configurations]
    twice = {name for name in names if names.count(name) > 1}
    if not names or twice:
        raise InputError(
            f"--configurations and --sets name {' and '.join(sorted(twice))} twice; each needs a name of its own."
            if twice
            else "nothing to train: --configurations and --sets are both empty; name one configuration at least."
        )
    if not all(0 < fraction <= 1 for fraction in command.checkpoints):
        raise InputError(f"--checkpoints are fractions of a run, above 0 and at most 1, not {command.checkpoints}.")
    for configuration in configurations:
        training_config(configuration.method, (*split_words(command.common), *configuration.words))


def _packed(data: Path) -> Path:
    """The packed dataset that training will read; a session is processed as ``ns-train`` would."""
    from hsi_sc_nerf.data.dataparser import is_unprocessed, processed_dir
    from hsi_sc_nerf.processing.process import process_session

    if is_unprocessed(data):
        data = process_session(data, processed_dir(data.resolve()))
    return open_packed(data).root.resolve()


def _data_sha256(data: Path) -> str:
    """Hash of frames and poses, and of the masks, which the user can mend; cubes follow from the first."""
    digest = hashlib.sha256((data / TRANSFORMS_NAME).read_bytes())
    for path in sorted((data / "masks").glob("*.png")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _job(configuration: Configuration, command: BenchmarkCommand, data: Path) -> Job:
    return Job(
        method=configuration.method,
        words=(*split_words(command.common), *configuration.words),
        data=str(data),
        output_dir=str((command.output_dir / configuration.name).resolve()),
        iterations=command.iterations,
        train_seconds=None if command.iterations else command.train_seconds,
        clock=command.clock,
        checkpoints=command.checkpoints,
        threads=command.threads or available_cores(),
        held_out_views=command.held_out_views,
    )


def _train(folder: Path, job: Job, identity: dict[str, Any]) -> BenchmarkRun:
    """Train in a process of its own; the result is kept as ``result.json`` with its job."""
    log = folder.parent / "logs" / f"{folder.name}.log"
    for needed in (folder, log.parent):
        make_folder(needed)
    shutil.rmtree(folder / "benchmark", ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=TEMPORARY_PREFIX) as temporary:
        job_path, found_path = Path(temporary, "job.json"), Path(temporary, "found.json")
        write_json(job_path, asdict(job))
        module = "hsi_sc_nerf.benchmark.run"
        run_step(f"training of {folder.name}", [sys.executable, "-m", module, str(job_path), str(found_path)], log)
        found = json.loads(found_path.read_text(encoding="utf-8"))
    write_json(folder / "result.json", {"job": asdict(job), **identity, **found})
    return _run_of(folder.name, job, found)


def _finished(folder: Path, job: Job, identity: dict[str, Any]) -> BenchmarkRun | None:
    """Result of an earlier call for the same job, machine and data; None if there is none."""
    path = folder / "result.json"
    if not path.is_file():
        return None
    again = "delete it to measure again"
    content = read_json(path, again)
    expected = json.loads(json.dumps({"job": asdict(job), **identity}))
    if not expected.items() <= content.items():
        return None
    with content_of(path, "result", again):
        return _run_of(folder.name, job, content)


def _write(runs: Sequence[BenchmarkRun], command: BenchmarkCommand, machine: dict[str, str]) -> None:
    from hsi_sc_nerf.benchmark import results

    settings = {
        "data": command.data.name,
        "length": f"{command.iterations} iterations"
        if command.iterations
        else f"{command.train_seconds:g} s ({command.clock})",
        "checkpoints": ", ".join(f"{fraction:g}" for fraction in command.checkpoints),
        "held-out views": command.held_out_views or "all",
        "threads": command.threads or available_cores(),
    }
    out = command.output_dir / "benchmark"
    results.write_csv(out.with_suffix(".csv"), runs)
    write_json(
        out.with_suffix(".json"), {"machine": machine, "settings": settings, "runs": [asdict(run) for run in runs]}
    )
    results.write_results_page(out.with_suffix(".md"), runs, settings, machine)
    results.draw_accuracy_and_time(out.with_suffix(".png"), runs, command.clock)
