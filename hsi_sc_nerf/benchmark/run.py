"""One configuration trained and timed, in a process of its own: ``python -m ... JOB.json RESULT.json``."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hsi_sc_nerf.benchmark.configurations import training_config
from hsi_sc_nerf.benchmark.steps import peak_memory_mib
from hsi_sc_nerf.evaluation.chosen_views import spread_of_views
from hsi_sc_nerf.files import write_json

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.data.utils.dataloaders import EvalDataloader

    from hsi_sc_nerf.models.schedule import Clock
    from hsi_sc_nerf.models.staged_trainer import StagedTrainer

_RENDERING_SPEEDS = ("num_rays_per_sec", "fps")


@dataclass(frozen=True)
class Job:
    """Work of one process.

    Attributes:
        method: nerfstudio method of this package.
        words: as after ``ns-train METHOD``.
        data: the packed dataset.
        output_dir: where the training run is kept.
        iterations: length of the run; None: it ends by the clock.
        train_seconds: length of the run by the clock; None if ``iterations`` is given.
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
        name: name of the configuration.
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


def build_trainer(job: Job) -> StagedTrainer:
    """The trainer that ``ns-train`` would make, without evaluations of its own on the way."""
    config: Any = training_config(job.method, job.words)  # imports nerfstudio in an order that it can bear
    import torch
    from nerfstudio.utils import writer

    writer.EVENT_WRITERS.clear()  # of an earlier trainer in this process
    config.pipeline.datamanager.data = Path(job.data)
    if job.iterations is None:
        config.max_train_seconds, config.train_clock = job.train_seconds, job.clock
    else:
        config.max_num_iterations = job.iterations
    config.output_dir, config.experiment_name, config.timestamp = Path(job.output_dir), "benchmark", "run"
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
        loader: loader of all held-out views.
        count: how many to take; None for all.
    """

    def __init__(self, loader: EvalDataloader, count: int | None) -> None:
        self.loader, self.indices = loader, spread_of_views(len(loader), count or len(loader))

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

    started = time.perf_counter()
    trainer = build_trainer(job)
    setup_seconds = time.perf_counter() - started

    manager: Any = trainer.pipeline.datamanager
    views = HeldOutViews(manager.fixed_indices_eval_dataloader, job.held_out_views)
    on_gpu = trainer.pipeline.device.type == "cuda"
    schedule = trainer.schedule
    stops = sorted({fraction * schedule.plan.length for fraction in job.checkpoints})
    early = 0.0 if job.iterations is None else 0.5  # of iterations, the nearest one
    found: list[Checkpoint] = []

    def evaluate_at_stops(step: int) -> None:
        due = [stop for stop in stops if stop - early <= schedule.position]
        del stops[: len(due)]
        if not due and not schedule.stage_complete:
            return
        with schedule.clock.paused() as (wall, cpu):
            peak = peak_memory_mib()
            before = time.perf_counter()
            metrics = trainer.pipeline.get_average_image_metrics(views, "eval", step, get_std=True)
            found.append(
                Checkpoint(
                    iteration=step + 1,
                    stage=schedule.stage.config.name,
                    ends_stage=schedule.stage_complete,
                    train_seconds=wall,
                    cpu_seconds=cpu,
                    evaluation_seconds=time.perf_counter() - before,
                    peak_memory_mib=peak,
                    gpu_memory_mib=torch.cuda.max_memory_allocated() / 2**20 if on_gpu else 0.0,
                    metrics={k: v for k, v in metrics.items() if k.removesuffix("_std") not in _RENDERING_SPEEDS},
                )
            )

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], evaluate_at_stops))
    trainer.train()
    return {"setup_seconds": setup_seconds, "checkpoints": [asdict(checkpoint) for checkpoint in found]}


def main(job_path: Path, result_path: Path) -> None:
    """Run the job in ``job_path`` and write its result."""
    import torch
    from threadpoolctl import threadpool_limits

    job = Job(**json.loads(job_path.read_text(encoding="utf-8")))
    torch.set_num_threads(job.threads)
    with threadpool_limits(job.threads):
        write_json(result_path, train(job))


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    except (Exception, SystemExit):
        # To the log, which stdout goes to.
        traceback.print_exc(file=sys.stdout)
        sys.exit(1)
