"""Trainer that runs all stages in one run, resumes killed runs to the same weights and skips non-finite steps."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, NoReturn, cast

import torch
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import make_folder, write_json
from hsi_sc_nerf.models.captured_step import CapturedSteps
from hsi_sc_nerf.models.checkpoints import (
    checkpoint_path,
    find_checkpoint,
    link_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from hsi_sc_nerf.models.chosen_effects import effects_setting
from hsi_sc_nerf.models.optimizers import GuardedOptimizers
from hsi_sc_nerf.models.pipeline import SpectralPipeline
from hsi_sc_nerf.models.spectral_model import SpectralModel, SpectralModelConfig
from hsi_sc_nerf.models.stages import (
    Stage,
    StageConfig,
    StagePlan,
    full_frame_stage,
    masked_stage,
    plan_stages,
    resumed_plan,
    step_seed,
)
from hsi_sc_nerf.models.training_watch import (
    NonFiniteGuard,
    RisenLossGuard,
    TrainingDivergedError,
    flush_logs,
    non_finite_names,
    stage_summary,
    training_progress,
)
from hsi_sc_nerf.settings_file import check_options

_GPU_PROGRESS_STEPS = 16
"""On a GPU the progress bar is brought up to date once in so many steps: each time, the GPU is waited for."""


@dataclass
class StagedTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with the paper's two stages."""

    _target: type = field(default_factory=lambda: StagedTrainer)
    full_frame: StageConfig = field(default_factory=full_frame_stage)
    """First stage: whole frames, with the object and its boundary sampled more often than the rest."""
    masked: StageConfig = field(default_factory=masked_stage)
    """Second stage: the masked object, and some background rays."""
    evaluate_stages: bool = True
    """Evaluate the held-out views at the end of each stage and write the result beside the stage's checkpoint."""
    capture_steps: bool = True
    """On a GPU, launch a step's forward and backward pass as one CUDA graph."""

    def plan(self) -> StagePlan:
        """The stages of the run.

        Raises:
            SystemExit: a setting is impossible, in one sentence.
        """
        stages = (self.full_frame, self.masked)
        try:
            check_options(self)
            for stage in stages:
                for group in (*stage.frozen_groups, *stage.learn_after, *stage.group_lr):
                    if group not in self.optimizers:
                        raise InputError(
                            f"the {stage.name} stage names the parameter group {group!r}; there are "
                            f"{', '.join(self.optimizers)}."
                        )
            return plan_stages(stages, self.max_num_iterations)
        except InputError as error:
            raise SystemExit(f"hsi-sc-nerf: {error}") from error

    def save_config(self) -> None:
        """Check the settings, then write ``config.yml``, the first file of a run."""
        self.plan()
        try:
            make_folder(self.get_base_dir())
        except InputError as error:
            raise SystemExit(f"hsi-sc-nerf: {error}") from error
        super().save_config()


class StagedTrainer(Trainer):
    """Trains one stage after the other.

    A step depends on its number, the configuration and the contents of a checkpoint only, so that a run that was
    killed and resumed ends with the same weights.
    """

    config: StagedTrainerConfig
    optimizers: GuardedOptimizers
    pipeline: SpectralPipeline

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Check the settings, plan the stages, and set up as nerfstudio does."""
        if self.world_size > 1:
            # Rays and random numbers follow from the step, so all processes would train on the same rays.
            raise SystemExit("hsi-sc-nerf: trains on one device; leave --machine.num-devices at 1.")
        self.plan = self.config.plan()
        self._stage: Stage | None = None
        self._frozen: set[str] | None = None
        self._steps_since_update = 0
        self._saved_step: int | None = None
        self._loaded: Path | None = None
        self._completed: str | None = None
        self._guard = NonFiniteGuard()
        self._risen_loss = RisenLossGuard()
        self._captured: CapturedSteps | None = None
        try:
            self._keep_effects()
            super().setup(test_mode)
        except InputError as error:
            raise SystemExit(f"hsi-sc-nerf: {error}") from error
        except KeyboardInterrupt:
            self._tell_that_it_stopped()
        # Evaluation and export build what was trained, whatever becomes of the dataset.
        self._model_config.effects = effects_setting(self._model.effects)
        self.config.save_config()
        on_gpu = self.pipeline.device.type == "cuda"
        plain = not (self.config.mixed_precision or self.config.use_grad_scaler or self.config.log_gradients)
        if on_gpu and plain and self.config.capture_steps and not self.config.gradient_accumulation_steps:
            self._captured = CapturedSteps(self._model, [p for group in self._trainable.values() for p in group])

    def _keep_effects(self) -> None:
        """Go on with the effects of the checkpoint that is to be loaded.

        Raises:
            InputError: the settings ask for others, or the checkpoint cannot be read.
        """
        model, path = self._model_config, self._checkpoint_to_load()
        trained = None if path is None else read_checkpoint(path)["training"].get("effects")
        if trained is None or model.effects == trained:
            return
        if model.effects != "auto":
            raise InputError(
                f"{path}: was trained with --pipeline.model.effects {trained}; leave the option out to go on with it."
            )
        model.effects = trained

    def setup_optimizers(self) -> GuardedOptimizers:
        """Optimisers that skip non-finite steps."""
        optimizers = GuardedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())
        self._trainable = {
            group: [parameter for parameter in parameters if parameter.requires_grad]
            for group, parameters in optimizers.parameters.items()
        }
        if self.pipeline.device.type == "cuda":
            optimizers.fuse()
        return optimizers

    @property
    def _model(self) -> SpectralModel:
        return cast(SpectralModel, self.pipeline.model)

    @property
    def _model_config(self) -> SpectralModelConfig:
        return cast(SpectralModelConfig, self.config.pipeline.model)

    def train(self) -> None:
        """Train the remaining steps of the plan; nerfstudio would add ``max_num_iterations`` to a resumed run."""
        try:
            was_to_be_kept = self._loaded is not None and self._keep_stage_of(self._loaded)
            left = self.plan.num_iterations - self._start_step
            if left <= 0 and was_to_be_kept:
                return
            if left <= 0:
                raise InputError(
                    f"{self._loaded}: has all {self.plan.num_iterations} iterations; raise --max-num-iterations to "
                    "train on."
                )
            self.config = dataclasses.replace(self.config, max_num_iterations=left)
            with training_progress(self.plan.num_iterations, self._start_step) as self._show_progress:
                super().train()
        except TrainingDivergedError as error:
            # Skipped steps do not change the weights: unless the loss had risen before, they are still good.
            if not self._risen_loss.risen_in_a_row:
                self.save_checkpoint(self.step)
            good = any(self.checkpoint_dir.glob("step-*.ckpt"))
            kept = f"The last good checkpoint is in {self.checkpoint_dir}" if good else "No checkpoint was good"
            raise SystemExit(f"hsi-sc-nerf: {error}. {kept}.") from error
        except InputError as error:
            raise SystemExit(f"hsi-sc-nerf: {error}") from error
        except KeyboardInterrupt:
            self._tell_that_it_stopped()
        finally:
            flush_logs()

    def _tell_that_it_stopped(self) -> NoReturn:
        """End after Ctrl-C with one line; nerfstudio would print the stack and exit with 0.

        Nothing is saved: a step may be half done, and the weights would not be those of an uninterrupted run.
        """
        folder = self.config.get_checkpoint_dir()
        saved = any(folder.glob("step-*.ckpt"))
        hint = f"; --load-dir {folder} goes on from the last checkpoint" if saved else ""
        print(f"hsi-sc-nerf: stopped{hint}.", file=sys.stderr)
        raise SystemExit(130) from None

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One step of its stage."""
        stage = self.plan.at(step)
        if stage is not self._stage:
            manager, self._stage = self.pipeline.datamanager, stage
            manager.foreground_ray_fraction = stage.config.foreground_ray_fraction
            manager.boundary_ray_fraction = stage.config.boundary_ray_fraction
        self._freeze({group for group in self.optimizers.parameters if not stage.learns(group, step)})
        rates = self._set_learning_rates(stage, step)
        sampler = self._model.proposals
        if sampler is not None:
            # Evaluations and the viewer change these counters too, and nerfstudio's checkpoints lack them.
            sampler._step, sampler._steps_since_update = max(0, step - 1), self._steps_since_update

        torch.manual_seed(step_seed(self.config.machine.seed, step))
        self._model.prepare_step(step)
        captured = self._captured
        found = super().train_iteration(step) if captured is None else self._captured_iteration(captured, step)
        loss, loss_dict, metrics_dict = found
        if stage.learns("fields", step) and not self.optimizers.skipped_groups:
            self._model.field.shrink_grid(rates["fields"] * stage.config.grid_decay)

        if sampler is not None:
            self._steps_since_update = sampler._steps_since_update + 1
        warning = self._guard.record(step, non_finite_names(loss_dict), self.optimizers.skipped_groups)
        if warning is not None:
            CONSOLE.print(f"[yellow]{escape(warning)}")
        self._risen_loss.record(step, stage, float(loss))
        if step_check(step, self.config.logging.steps_per_log, run_at_zero=True):
            for group, rate in rates.items():  # under the names of nerfstudio's own schedules
                writer.put_scalar(name=f"learning_rate/{group}", scalar=rate, step=step)
        if self._captured is None or step % _GPU_PROGRESS_STEPS == 0 or step == stage.end - 1:
            self._show_progress(step, stage, float(metrics_dict["psnr"]))
        return loss, loss_dict, metrics_dict

    def _captured_iteration(self, steps: CapturedSteps, step: int) -> TRAIN_INTERATION_OUTPUT:
        """What nerfstudio does in a step, its forward and backward pass as a graph."""
        sampler = self._model.proposals
        # As the sampler will say itself, in the steps that are not captured.
        proposals_learn = sampler is not None and (
            sampler._steps_since_update > sampler.update_sched(sampler._step) or sampler._step < 10
        )
        rays, batch = self.pipeline.datamanager.next_train(step)
        kind = (id(self._stage), frozenset(self._frozen or ()), proposals_learn)
        seed = partial(torch.manual_seed, step_seed(self.config.machine.seed, step))
        try:
            found = steps(kind, rays, batch, seed)
        except RuntimeError as error:
            CONSOLE.print(f"[yellow]Steps are launched one operation at a time: {escape(str(error))}")
            self._captured = None
            seed()
            return super().train_iteration(step)
        self.optimizers.optimizer_scaler_step_some(self.grad_scaler, list(self.optimizers.parameters))
        if sampler is not None and proposals_learn:
            sampler._steps_since_update = 0
        return found

    def _freeze(self, frozen: set[str]) -> None:
        """Freeze these parameter groups, and no others."""
        if frozen == self._frozen:
            return
        for group, parameters in self._trainable.items():
            for parameter in parameters:
                parameter.requires_grad_(group not in frozen)
                parameter.grad = None
        # Mode free-discarded resets the corrections when they are frozen.
        self._model.camera_optimizer.freeze("camera_opt" in frozen)
        self._frozen = frozen

    def _set_learning_rates(self, stage: Stage, step: int) -> dict[str, float]:
        rates = {
            name: self.config.optimizers[name]["optimizer"].lr * stage.lr_factor(step, name)
            for name in self.optimizers.optimizers
        }
        for name, optimizer in self.optimizers.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = rates[name]
        return rates

    def eval_iteration(self, step: int) -> None:
        """nerfstudio's evaluations; after the last step of a stage, its checkpoint and held-out metrics."""
        super().eval_iteration(step)
        stage = self.plan.at(step)
        if step == stage.end - 1:
            self._keep(stage)

    def _keep_stage_of(self, loaded: Path) -> bool:
        """Keep the stage that a loaded checkpoint completed; False if its run has kept it, or none was completed."""
        stage = self.plan.at(self._start_step - 1)
        kept = loaded.resolve().parents[1] / f"stage-{stage.config.name}" / loaded.name
        if self._completed != stage.config.name or self._start_step != stage.end or kept.exists():
            return False
        self._keep(stage)
        return True

    def _keep(self, stage: Stage) -> None:
        """Keep the last checkpoint of a finished stage, and its metrics of the held-out views."""
        step = stage.end - 1
        kept = checkpoint_path(self.base_dir / f"stage-{stage.config.name}", step)
        self.save_checkpoint(step)
        if self.config.evaluate_stages:
            metrics = self.pipeline.get_average_eval_image_metrics(step=step, get_std=True)
            writer.put_dict(name="Eval Images Metrics Dict (all images)", scalar_dict=metrics, step=step)
            CONSOLE.print(stage_summary(stage.config.name, metrics))
            results = {"stage": stage.config.name, "step": step, "checkpoint": kept.name, "results": metrics}
            write_json(kept.with_suffix(".json"), results)
        link_checkpoint(checkpoint_path(self.checkpoint_dir, step), kept.parent)
        flush_logs()

    def _after_train(self) -> None:
        """Save, then finish as nerfstudio does."""
        self.save_checkpoint(self.step)
        super()._after_train()

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint, then delete the older ones if the configuration says so.

        ``training`` holds what a resumed run needs beside nerfstudio's contents to give the same result.
        """
        if step == self._saved_step or self._risen_loss.risen_in_a_row:
            return  # the checkpoint before, which this one would replace, is better
        stage = self.plan.at(step)
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {},
            "scalers": self.grad_scaler.state_dict(),
            "training": {
                "stage": {"name": stage.config.name, "start": stage.start},
                "completed_stage": stage.config.name if step == stage.end - 1 else None,
                "steps_since_update": self._steps_since_update,
                "effects": self._model_config.effects,
            },
        }
        path = checkpoint_path(self.checkpoint_dir, step)
        try:
            write_checkpoint(path, state)
        except InputError as error:
            raise SystemExit(f"hsi-sc-nerf: {error}") from error
        self._saved_step = step
        if self.config.save_only_latest_checkpoint:
            for older in self.checkpoint_dir.glob("*.ckpt"):
                if older != path:
                    older.unlink()

    def _checkpoint_to_load(self) -> Path | None:
        if self.config.load_dir is not None:
            return find_checkpoint(self.config.load_dir, self.config.load_step)
        return self.config.load_checkpoint

    def _load_checkpoint(self) -> None:
        """Load a checkpoint of `save_checkpoint`, with the contents of ``training``."""
        path = self._checkpoint_to_load()
        if path is None:
            return
        state = read_checkpoint(path)
        self._start_step = state["step"] + 1
        self.pipeline.load_pipeline(state["pipeline"], state["step"])
        different = set(state["optimizers"]) ^ set(self.optimizers.optimizers)
        if different:
            raise InputError(
                f"{path}: was made with other parameter groups ({', '.join(sorted(different))}); take the settings "
                "of the config.yml beside it."
            )
        self.optimizers.load_optimizers(state["optimizers"])
        if state["scalers"]:  # empty unless training was in mixed precision
            self.grad_scaler.load_state_dict(state["scalers"])
        training = state["training"]
        self._steps_since_update = training["steps_since_update"]
        self._completed = training["completed_stage"]
        completed_at = None if self._completed is None else self._start_step
        self.plan = resumed_plan(self.plan, **training["stage"], completed_at=completed_at)
        self._loaded = path
        CONSOLE.print(f"Going on from {escape(str(path))}", soft_wrap=True)
