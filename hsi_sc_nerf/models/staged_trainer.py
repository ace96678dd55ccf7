"""Both stages of training in one run, guarded against steps that turn non-finite."""

from __future__ import annotations

import dataclasses
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.models.nonfinite import GuardedOptimizers, NonFiniteGuard, TrainingDivergedError, non_finite_names
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.stages import Stage, StageConfig, full_frame_stage, masked_stage, plan_stages
from hsi_sc_nerf.models.training_progress import TrainingProgress


@dataclass
class StagedTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with the paper's two stages."""

    _target: type = field(default_factory=lambda: StagedTrainer)
    full_frame: StageConfig = field(default_factory=full_frame_stage)
    """First stage: whole frames."""
    masked: StageConfig = field(default_factory=masked_stage)
    """Second stage: the masked object."""
    max_nonfinite_steps: int = 20
    """Stop the run after this many skipped steps in a row."""


class StagedTrainer(Trainer):
    """Trains stage after stage; stage, learning rate and batches of a step depend on the step alone."""

    config: StagedTrainerConfig
    optimizers: GuardedOptimizers

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Set up as nerfstudio does, then place the stages."""
        try:
            self.plan = plan_stages((self.config.full_frame, self.config.masked), self.config.max_num_iterations)
        except ValueError as error:
            raise SystemExit(f"hsi-sc-nerf: {error}") from error
        self._stage: Stage | None = None
        self._guard = NonFiniteGuard(self.config.max_nonfinite_steps)
        super().setup(test_mode)

    def setup_optimizers(self) -> GuardedOptimizers:
        """Optimisers that skip non-finite steps."""
        return GuardedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train what is left of the plan: nerfstudio would add ``max_num_iterations`` to a resumed run."""
        left = self.plan.num_iterations - self._start_step
        if left <= 0:
            raise SystemExit(
                f"hsi-sc-nerf: the checkpoint in {self.config.load_dir or self.config.load_checkpoint} has all "
                f"{self.plan.num_iterations} iterations; raise --max-num-iterations to train on"
            )
        self.config = dataclasses.replace(self.config, max_num_iterations=left)
        try:
            with TrainingProgress(self.plan.num_iterations, self._start_step) as self._progress:
                super().train()
        except TrainingDivergedError as error:
            # Skipped steps leave the weights as they were: these are the last good ones.
            self.save_checkpoint(self.step)
            raise SystemExit(f"hsi-sc-nerf: {error}. The last good checkpoint is in {self.checkpoint_dir}") from error

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One guarded step of the stage that it belongs to."""
        stage = self.plan.at(step)
        if stage is not self._stage:
            self._enter(stage, step)
        cast(SpectralModel, self.pipeline.model).camera_optimizer.freeze(not stage.refines_poses(step))
        factor = stage.lr_factor(step)
        for name, optimizer in self.optimizers.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = self.config.optimizers[name]["optimizer"].lr * factor

        loss, loss_dict, metrics_dict = super().train_iteration(step)

        complaint = self._guard.record(step, non_finite_names(loss_dict), self.optimizers.skipped_groups)
        if complaint is not None:
            CONSOLE.print(f"[yellow]{complaint}")
        metrics_dict["lr_factor"] = factor  # type: ignore[assignment]
        self._progress.update(step, stage, float(metrics_dict["psnr"]))
        return loss, loss_dict, metrics_dict

    def _enter(self, stage: Stage, step: int) -> None:
        """Begin ``stage``; the stage before it, if it ran here, leaves its last checkpoint behind."""
        if self._stage is not None:
            self.save_checkpoint(step - 1)
            kept = self.base_dir / f"stage-{self._stage.config.name}"
            kept.mkdir(exist_ok=True)
            shutil.copy2(self._checkpoint_path(step - 1), kept)
        cast(SpectralDataManager, self.pipeline.datamanager).foreground_share = stage.config.foreground_share
        self._stage = stage

    def _checkpoint_path(self, step: int) -> Path:
        return self.checkpoint_dir / f"step-{step:09d}.ckpt"

    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint whole or not at all, then delete the older ones where the configuration says so."""
        final_dir = self.checkpoint_dir
        self.checkpoint_dir = final_dir.with_name(f".{final_dir.name}-writing")
        try:
            super().save_checkpoint(step)
            final_dir.mkdir(parents=True, exist_ok=True)
            os.replace(self._checkpoint_path(step), final_dir / self._checkpoint_path(step).name)
        except (OSError, RuntimeError) as error:
            raise SystemExit(
                f"hsi-sc-nerf: the checkpoint of step {step} could not be written to {final_dir} ({error}); free "
                "some space and resume with --load-dir from the checkpoint before it"
            ) from error
        finally:
            shutil.rmtree(self.checkpoint_dir, ignore_errors=True)
            self.checkpoint_dir = final_dir
        if self.config.save_only_latest_checkpoint:
            for older in final_dir.glob("*.ckpt"):
                if older != self._checkpoint_path(step):
                    older.unlink()
