"""One configuration trained and timed, in a process of its own: ``python -m ... JOB.json RESULT.json``."""

from __future__ import annotations

import gc
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hsi_sc_nerf.benchmark.configurations import training_config
from hsi_sc_nerf.benchmark.steps import peak_memory_mib
from hsi_sc_nerf.files import TEMPORARY_PREFIX, write_json

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.data.utils.dataloaders import EvalDataloader

    from hsi_sc_nerf.models.staged_trainer import StagedTrainer

Clock = Literal["wall", "cpu"]
"""Wall time, or processor time over all threads, which other work on the machine hardly changes."""

# Iterations at the start of a stage that are not timed, because they build caches.
_WARM_UP_STEPS = 2
_REHEARSAL_ITERATIONS = 20
_REHEARSAL_FRACTION = 0.05
_RENDERING_SPEEDS = ("num_rays_per_sec", "fps")


@dataclass(frozen=True)
class Job:
    """Work of one process.

    Attributes:
        method: nerfstudio method of this package.
        words: as after ``ns-train METHOD``.
        data: the packed dataset.
        output_dir: where the training run is kept.
        iterations: length of the run; None: as many as fit into ``train_seconds``, by a rehearsal.
        train_seconds: time to fill; None if ``iterations`` is given.
        clock: that ``train_seconds`` refer to.
        checkpoints: fractions of the run at which it is evaluated, beside the stages' ends.
        threads: CPU threads.
        held_out_views: how many held-out views are evaluated, evenly spread; None for all.
    """

    method: str
    words: tuple[str, ...]
    data: str
    output_dir: str
    iterations: int | None
    train_seconds: float | None
    clock: Clock
    checkpoints: tuple[float, ...]
    threads: int
    held_out_views: int | None


@dataclass(frozen=True)
class Checkpoint:
    """Measurements of a run at one of its steps.

    Attributes:
        iteration: iterations done.
        stage: name of the stage that the last of them belongs to.
        ends_stage: whether it was that stage's last.
        train_seconds: wall time of training so far, without evaluations and without setting up.
        cpu_seconds: the processor's, likewise, over all threads.
        evaluation_seconds: wall time of this evaluation.
        peak_memory_mib: most memory that the process has held so far, earlier evaluations included.
        gpu_memory_mib: most memory that tensors have held on the GPU so far; 0 without one.
        metrics: mean over the held-out views of the model's own metrics, and ``_std``, their spread.
    """

    iteration: int
    stage: str
    ends_stage: bool
    train_seconds: float
    cpu_seconds: float
    evaluation_seconds: float
    peak_memory_mib: float
    gpu_memory_mib: float
    metrics: dict[str, float]


@dataclass(frozen=True)
class BenchmarkRun:
    """A configuration's finished run.

    Attributes:
        name: of the configuration.
        method: nerfstudio method.
        words: as after ``ns-train METHOD``, those that all configurations share included.
        setup_seconds: wall time before the first step: reading the dataset, building the model.
        checkpoints: in the order of iterations.
    """

    name: str
    method: str
    words: tuple[str, ...]
    setup_seconds: float
    checkpoints: tuple[Checkpoint, ...]

    @property
    def stage_ends(self) -> tuple[Checkpoint, ...]:
        """The last checkpoint of each stage."""
        return tuple(checkpoint for checkpoint in self.checkpoints if checkpoint.ends_stage)


def build_trainer(config: Any, job: Job, iterations: int, output_dir: Path) -> StagedTrainer:
    """The trainer that ``ns-train`` would make of ``config``, without evaluations of its own on the way."""
    import torch
    from nerfstudio.utils import writer

    writer.EVENT_WRITERS.clear()  # of an earlier trainer in this process
    config.pipeline.datamanager.data = Path(job.data)
    config.max_num_iterations = iterations
    config.output_dir, config.experiment_name, config.timestamp = output_dir, "benchmark", "run"
    config.vis = "tensorboard"
    config.steps_per_save = config.steps_per_eval_batch = 0
    config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.evaluate_stages = False
    torch.manual_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    config.save_config()
    return trainer


class HeldOutViews:
    """Some of the held-out views, evenly spread, read one at a time.

    nerfstudio's own loader of selected views has the length of the whole dataset.

    Args:
        loader: of all held-out views.
        count: how many to take; None for all.
    """

    def __init__(self, loader: EvalDataloader, count: int | None) -> None:
        total = len(loader)
        count = min(count or total, total)
        self.loader, self.indices = loader, [i * total // count for i in range(count)]

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[tuple[Cameras, dict]]:
        return map(self.loader.get_camera, self.indices)


def train(job: Job) -> dict[str, Any]:
    """Train and evaluate; gives ``setup_seconds`` and ``checkpoints``.

    The trainer draws each step's random numbers anew, so that evaluations do not change the training.
    """
    import torch
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    assert job.iterations is not None
    config = training_config(job.method, job.words)
    started = time.perf_counter()
    trainer = build_trainer(config, job, job.iterations, Path(job.output_dir))
    setup_seconds = time.perf_counter() - started

    manager: Any = trainer.pipeline.datamanager
    views = HeldOutViews(manager.fixed_indices_eval_dataloader, job.held_out_views)
    on_gpu = trainer.pipeline.device.type == "cuda"
    ends = {stage.end for stage in trainer.plan.stages}
    found: list[Checkpoint] = []

    def evaluate(step: int) -> None:
        with clock.paused() as (wall, cpu):
            peak = peak_memory_mib()
            before = time.perf_counter()
            metrics = trainer.pipeline.get_average_image_metrics(views, "eval", step, get_std=True)
            found.append(
                Checkpoint(
                    iteration=step + 1,
                    stage=trainer.plan.at(step).config.name,
                    ends_stage=step + 1 in ends,
                    train_seconds=wall,
                    cpu_seconds=cpu,
                    evaluation_seconds=time.perf_counter() - before,
                    peak_memory_mib=peak,
                    gpu_memory_mib=torch.cuda.max_memory_allocated() / 2**20 if on_gpu else 0.0,
                    metrics={k: v for k, v in metrics.items() if k.removesuffix("_std") not in _RENDERING_SPEEDS},
                )
            )

    stops = checkpoint_iterations(job.checkpoints, sorted(ends))
    trainer.callbacks.append(
        TrainingCallback(
            [TrainingCallbackLocation.AFTER_TRAIN_ITERATION], evaluate, iters=tuple(stop - 1 for stop in stops)
        )
    )
    clock = TrainingClock(torch.cuda.synchronize) if on_gpu else TrainingClock()
    trainer.train()
    return {"setup_seconds": setup_seconds, "checkpoints": [asdict(checkpoint) for checkpoint in found]}


def rehearse(job: Job) -> int:
    """How many iterations fill ``train_seconds``.

    A run of 20 iterations estimates how many fit into a twentieth of the time; a run of that length, with all stages,
    gives the mean time of an iteration.
    """
    assert job.train_seconds is not None
    with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as folder:
        seconds = _rehearsed_seconds(job, _REHEARSAL_ITERATIONS, Path(folder))
        longer = int(_REHEARSAL_FRACTION * job.train_seconds / seconds)
        if longer > _REHEARSAL_ITERATIONS:
            seconds = _rehearsed_seconds(job, longer, Path(folder))
    return max(1, round(job.train_seconds / seconds))


def _rehearsed_seconds(job: Job, iterations: int, folder: Path) -> float:
    import torch
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    trainer = build_trainer(training_config(job.method, job.words), job, iterations, folder)

    def record(step: int) -> None:
        if trainer.pipeline.device.type == "cuda":
            torch.cuda.synchronize()
        times.append(clock())

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], record))
    clock = time.perf_counter if job.clock == "wall" else time.process_time
    times = [clock()]
    trainer.train()
    return mean_iteration_seconds(times, [stage.end for stage in trainer.plan.stages])


def checkpoint_iterations(fractions: Sequence[float], stage_ends: Sequence[int]) -> tuple[int, ...]:
    """Numbers of done iterations at which a run is evaluated: these fractions of it, and the end of every stage.

    Args:
        fractions: of the whole run, in (0, 1].
        stage_ends: iterations done at the end of each stage; the last is the run's length.
    """
    total = stage_ends[-1]
    return tuple(sorted({*stage_ends, *(max(1, round(fraction * total)) for fraction in fractions)}))


def mean_iteration_seconds(times: Sequence[float], stage_ends: Sequence[int]) -> float:
    """Mean time of an iteration without the first two of each stage, each stage counting by its length.

    Args:
        times: the clock before the first iteration and after each, so one more than iterations, seconds.
        stage_ends: iterations done at the end of each stage.
    """
    steps = [after - before for before, after in pairwise(times)]
    spent = 0.0
    for start, end in pairwise((0, *stage_ends)):
        counted = steps[min(start + _WARM_UP_STEPS, end - 1) : end]
        spent += (end - start) * sum(counted) / len(counted)
    return spent / stage_ends[-1]


class TrainingClock:
    """Wall and processor seconds since its creation, without pauses.

    Args:
        wait: called before each reading, to finish the work of a GPU.
        wall: clock of wall time, seconds.
        cpu: clock of this process's processor time over all threads, seconds.
    """

    def __init__(
        self,
        wait: Callable[[], object] = lambda: None,
        wall: Callable[[], float] = time.perf_counter,
        cpu: Callable[[], float] = time.process_time,
    ) -> None:
        self._wait, self._wall, self._cpu = wait, wall, cpu
        self._wall_start, self._cpu_start = wall(), cpu()

    def read(self) -> tuple[float, float]:
        """Wall and processor seconds."""
        self._wait()
        return self._wall() - self._wall_start, self._cpu() - self._cpu_start

    @contextmanager
    def paused(self) -> Iterator[tuple[float, float]]:
        """Pause both clocks; yields the readings before."""
        wall, cpu = self.read()
        yield wall, cpu
        self._wait()
        self._wall_start, self._cpu_start = self._wall() - wall, self._cpu() - cpu


def main(job_path: Path, result_path: Path) -> None:
    """Run the job in ``job_path`` and write its result."""
    import torch
    from threadpoolctl import threadpool_limits

    job = Job(**json.loads(job_path.read_text(encoding="utf-8")))
    torch.set_num_threads(job.threads)
    with threadpool_limits(job.threads):
        if job.iterations is None:
            job = replace(job, iterations=rehearse(job))
            gc.collect()
            if torch.cuda.is_available():
                torch.cuda.reset_peak_memory_stats()
        write_json(result_path, train(job))


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    except (Exception, SystemExit):
        # To the log, which stdout goes to.
        traceback.print_exc(file=sys.stdout)
        sys.exit(1)
