"""What is watched while a run trains: steps that are not finite, the progress, the results of its stages.

Steps with non-finite losses or gradients are skipped; too many in a row stop the run. So does a loss that rises far
above what it was and stays there.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import NoReturn

import torch
from nerfstudio.utils import writer
from nerfstudio.utils.profiler import PROFILER
from rich.progress import TextColumn
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.schedule import Schedule
from hsi_sc_nerf.models.stages import Stage
from hsi_sc_nerf.terminal import timed_progress

# Metrics of the paper's table.
_SUMMARY = {"sam": "SAM {:.4f} rad", "rmse": "RMSE {:.4f}", "ssim": "SSIM {:.3f}", "psnr": "PSNR {:.1f} dB"}

MAX_SKIPPED_IN_A_ROW = 20
"""Skipped steps that end a run: single ones come from damaged values, so many from weights that are lost."""


LOSS_STEPS = 10
"""Steps whose median loss is compared: single batches spike, also in runs that end well."""
RISEN_FACTOR = 10.0
"""A loss of so many times the least one of the stage has risen: batches differ by factors of two to three."""
MAX_RISEN_IN_A_ROW = 100
"""Steps with a risen loss that end a run: one that is too fast at first comes back within some tens."""


class TrainingDivergedError(RuntimeError):
    """Too many steps in a row were not finite, or had a risen loss."""


def non_finite_names(values: Mapping[str, Tensor]) -> list[str]:
    """Names of the tensors that contain an infinity or a NaN."""
    if not values:
        return []
    # A norm is finite only if all elements are, and is one of steps to be skipped above 1e19. That of order 2 is the
    # fastest on a processor. One transfer from the GPU for all.
    norms = torch.stack(torch._foreach_norm([value.detach().float() for value in values.values()], 2))
    return [name for name, finite in zip(values, torch.isfinite(norms).tolist(), strict=True) if not finite]


class NonFiniteGuard:
    """Counter of consecutive skipped steps."""

    in_a_row = 0

    def record(self, step: int, losses: Iterable[str], groups: Iterable[str]) -> str | None:
        """Record a step; returns a sentence to print if it was skipped, else None.

        Args:
            losses: names of the loss terms that were not finite.
            groups: names of the parameter groups whose gradient was not finite.

        Raises:
            TrainingDivergedError: this was the last of `MAX_SKIPPED_IN_A_ROW`.
        """
        causes = [f"loss {name}" for name in losses] or [f"gradient of {name}" for name in groups]
        if not causes:
            self.in_a_row = 0
            return None
        self.in_a_row += 1
        sentence = f"step {step} skipped: {', '.join(causes)} not finite"
        if self.in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingDivergedError(
                f"{sentence}, the last of {self.in_a_row} in a row; lower the learning rate "
                "(--optimizers.fields.optimizer.lr), or look for "
                "damaged frames"
            )
        return sentence


class RisenLossGuard:
    """Tells when a loss is far above what it was in the same stage, and stays there."""

    risen_in_a_row = 0

    def __init__(self) -> None:
        self._stage: Stage | None = None
        self._last: deque[float] = deque(maxlen=LOSS_STEPS)
        self._least = math.inf

    def record(self, step: int, schedule: Schedule, loss: float) -> None:
        """Record a step that has ended.

        Args:
            schedule: of the run; a stage's first loss is the one to compare with until there is a smaller median.
            loss: loss of all terms; one that is not finite does not count.

        Raises:
            TrainingDivergedError: this was the last of `MAX_RISEN_IN_A_ROW`, or the stage ends with a risen loss.
        """
        if schedule.stage is not self._stage:
            self._stage, self._least, self.risen_in_a_row = schedule.stage, math.inf, 0
            self._last.clear()
        if math.isfinite(loss):
            self._last.append(loss)
            self._least = min(self._least, loss) if len(self._last) == 1 else self._least
        if len(self._last) < LOSS_STEPS:
            return
        now = median(self._last)
        self._least = min(self._least, now)
        self.risen_in_a_row = self.risen_in_a_row + 1 if now > RISEN_FACTOR * self._least else 0
        if self.risen_in_a_row == MAX_RISEN_IN_A_ROW or (self.risen_in_a_row and schedule.stage_complete):
            raise TrainingDivergedError(
                f"step {step}: the loss is {now / self._least:.3g} times the least one of its stage, and has been "
                f"more than {RISEN_FACTOR:g} times for {self.risen_in_a_row} steps; lower the learning rate "
                "(--optimizers.fields.optimizer.lr)"
            )


def stage_summary(name: str, metrics: Mapping[str, float]) -> str:
    """One line with a stage's metrics of the held-out views, inside the masks and (``full_``) of whole frames."""
    masked, full = (
        ", ".join(text.format(metrics.get(prefix + key, math.nan)) for key, text in _SUMMARY.items())
        for prefix in ("", "full_")
    )
    return f"{name} stage, held-out views: object {masked}; whole frame {full}"


@contextmanager
def training_progress(schedule: Schedule) -> Iterator[Callable[[int, float], None]]:
    """Progress bar with stage, steps, smoothed PSNR of the batches and time left.

    The context gives a function that shows that a step is done, and the PSNR of its batch (dB).
    """
    smoothed_db = math.nan
    total = schedule.plan.length

    def update(step: int, psnr_db: float) -> None:
        nonlocal smoothed_db
        if math.isfinite(psnr_db):  # not so in a skipped step
            smoothed_db = psnr_db if math.isnan(smoothed_db) else 0.95 * smoothed_db + 0.05 * psnr_db
        quality = "" if math.isnan(smoothed_db) else f"PSNR {smoothed_db:.1f} dB"
        stage = schedule.stage
        steps = f"{step + 1} steps" if stage.timed else f"{step + 1}/{total:.0f}"
        completed = schedule.position if stage.timed else step + 1
        description = f"training, {stage.config.name} stage"
        bar.update(task, completed=completed, description=description, steps=steps, quality=quality)

    with timed_progress(TextColumn("{task.fields[steps]}"), TextColumn("{task.fields[quality]}")) as bar:
        task = bar.add_task("training", total=total, completed=round(schedule.position), steps="", quality="")
        yield update


def flush_logs() -> None:
    """Write the logs to disk; TensorBoard's writer would lose its buffer if the process ended."""
    writer.write_out_storage()
    for event_writer in writer.EVENT_WRITERS:
        if isinstance(event_writer, writer.TensorboardWriter):
            event_writer.tb_writer.flush()


@contextmanager
def files_of_run(folder: Path) -> Iterator[None]:
    """In the block, a file that the system refuses, such as the logs on a full disk, is one sentence.

    Raises:
        InputError: there was one.
    """
    hook = threading.excepthook

    def tell(raised: threading.ExceptHookArgs) -> None:
        if not isinstance(raised.exc_value, OSError):  # the thread that writes the logs raises in this one as well
            hook(raised)

    threading.excepthook = tell
    try:
        yield
        threading.excepthook = hook
    except OSError as error:  # that thread may be about to tell of it
        raise InputError(
            f"{error.filename or folder}: cannot be read or written ({error.strerror or error}); mend that, or free "
            "some space, and resume with --load-dir."
        ) from error


def stopped_run(checkpoints: Path) -> str:
    """The line that a run ends with after Ctrl-C; nerfstudio would print the stack and exit with 0.

    Nothing is saved: a step may be half done, and the weights would not be those of an uninterrupted run.
    """
    saved = any(checkpoints.glob("step-*.ckpt"))
    hint = f"; --load-dir {checkpoints} goes on from the last checkpoint" if saved else ""
    PROFILER.clear()  # or nerfstudio prints its times after this line
    return f"hsi-sc-nerf: stopped{hint}."


def end_diverged_run(error: TrainingDivergedError, checkpoints: Path) -> NoReturn:
    """End with one line that says what diverged and where the last good checkpoint is."""
    good = any(checkpoints.glob("step-*.ckpt"))
    kept = f"The last good checkpoint is in {checkpoints}" if good else "No checkpoint was good"
    PROFILER.clear()
    raise SystemExit(f"hsi-sc-nerf: {error}. {kept}.") from error
