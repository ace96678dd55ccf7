"""The progress bar of a training run."""

from __future__ import annotations

import math
from types import TracebackType

from rich.progress import MofNCompleteColumn, TextColumn

from hsi_sc_nerf.models.stages import Stage
from hsi_sc_nerf.progress import timed_progress


class TrainingProgress:
    """Stage, steps, PSNR of the batches and time left; use it as a context."""

    def __init__(self, total_steps: int, first_step: int) -> None:
        self._progress = timed_progress(MofNCompleteColumn(), TextColumn("{task.fields[quality]}"))
        self._task = self._progress.add_task("training", total=total_steps, completed=first_step, quality="")
        self._smoothed_psnr: float | None = None

    def __enter__(self) -> TrainingProgress:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.stop()

    def update(self, step: int, stage: Stage, psnr: float) -> None:
        """Show that ``step`` of ``stage`` is done."""
        if math.isfinite(psnr):  # a skipped step has none
            before = self._smoothed_psnr
            self._smoothed_psnr = psnr if before is None else 0.95 * before + 0.05 * psnr
        self._progress.update(
            self._task,
            completed=step + 1,
            description=f"training, {stage.config.name} stage",
            quality="" if self._smoothed_psnr is None else f"PSNR {self._smoothed_psnr:.1f} dB",
        )
