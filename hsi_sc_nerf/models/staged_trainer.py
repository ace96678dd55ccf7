"""Trainer that runs all stages in one run, resumes killed runs and skips non-finite steps."""

from __future__ import annotations

import copy
import math
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Literal, cast

import torch
import yaml
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.misc import step_check
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from hsi_sc_nerf import interruption
from hsi_sc_nerf.data.dataparser import require_data
from hsi_sc_nerf.errors import InputError, one_sentence
from hsi_sc_nerf.files import atomic_write, content_of, make_folder, write_json
from hsi_sc_nerf.models.captured_step import CapturedSteps
from hsi_sc_nerf.models.checkpoints import checkpoint_path, link_checkpoint, write_checkpoint
from hsi_sc_nerf.models.chosen_effects import effects_setting, resume_effects
from hsi_sc_nerf.models.occupancy_sampler import OccupancySampler
from hsi_sc_nerf.models.optimizers import GuardedOptimizers
from hsi_sc_nerf.models.pipeline import SpectralPipeline
from hsi_sc_nerf.models.presets import Preset, apply_preset
from hsi_sc_nerf.models.run_settings import discard_unbegun, read_config
from hsi_sc_nerf.models.schedule import Clock, Schedule
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.stages import (
    StageConfig,
    StagePlan,
    full_frame_stage,
    masked_stage,
    plan_stages,
    step_seed,
)
from hsi_sc_nerf.models.training_watch import (
    NonFiniteGuard,
    RisenLossGuard,
    TrainingDivergedError,
    end_diverged_run,
    files_of_run,
    flush_logs,
    non_finite_names,
    stage_summary,
    stopped_run,
    training_progress,
)
from hsi_sc_nerf.settings_file import between, check_options

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
    preset: Preset | None = None
    """fast, balanced or best: iterations and rays a step. Your own go before it."""
    max_train_seconds: float | None = between(0.001, math.inf, default=None)
    """End the run after so many seconds of training instead of --max-num-iterations; stages and learning rates follow
    the clock. Evaluations, saving and pauses do not count. Two such runs do not have the same weights bit by bit."""
    train_clock: Clock = "wall"
    """Clock of --max-train-seconds: wall time, or processor time over all threads (cpu)."""
    evaluate_stages: bool = True
    """Evaluate the held-out views at the end of each stage and write the result beside the stage's checkpoint."""
    capture_steps: bool = True
    """On a GPU, launch a step's forward and backward pass as one CUDA graph."""

    def __post_init__(self) -> None:
        apply_preset(self)
        if self.load_config is not None:  # nerfstudio reads it as soon as the options are read
            with one_sentence():
                read_config(self.load_config)

    def plan(self) -> StagePlan:
        """The stages of the run.

        Raises:
            InputError: a setting is impossible.
        """
        stages = (self.full_frame, self.masked)
        check_options(self)
        if self.machine.num_devices * self.machine.num_machines != 1:
            # Rays and random numbers follow from the step, so all processes would train on the same rays;
            # nerfstudio has not started them yet.
            raise InputError(
                "a run trains on one device; leave --machine.num-devices and --machine.num-machines at 1, and "
                "give each GPU a session of its own (hsi-sc-nerf batch)."
            )
        for stage in stages:
            stage.require_groups(self.optimizers)
        timed = self.max_train_seconds is not None
        return plan_stages(stages, self.max_train_seconds or self.max_num_iterations, timed)

    def save_config(self, checked: bool = False) -> None:
        """Check the settings unless that is done, and write ``config.yml``, the first file of a run, whole or not."""
        with one_sentence(), interruption.one_line():
            self.plan()
            path = self.get_base_dir() / "config.yml"
            CONSOLE.log(f"Saving config to: {path}")
            if not checked:
                require_data(self.pipeline.datamanager)
                resume_effects(self)
            make_folder(path.parent)
            (saved := copy.copy(self)).load_step = None  # nerfstudio's evaluation takes it for the step to evaluate
            with atomic_write(path) as (temporary,):
                temporary.write_text(yaml.dump(saved), encoding="utf-8")


class StagedTrainer(Trainer):
    """Trains one stage after the other.

    A step depends on its number, the configuration and the contents of a checkpoint only, so that a run that was
    killed and resumed ends with the same weights. In a timed run it depends on the clock as well.
    """

    config: StagedTrainerConfig
    optimizers: GuardedOptimizers
    pipeline: SpectralPipeline
    _loaded: Path | None

    @property
    def training_state(self) -> Literal["training", "paused", "completed"]:
        """nerfstudio's, which the viewer's button changes at any time; a pause does not count for the clock."""
        return self._training_state

    @training_state.setter
    def training_state(self, state: Literal["training", "paused", "completed"]) -> None:
        self._training_state, self._state_was_set = state, True

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Check the settings, plan the stages, and set up as nerfstudio does."""
        clock = self.config.train_clock if self.config.max_train_seconds else None
        wait = torch.cuda.synchronize if self.config.machine.device_type == "cuda" else None
        with one_sentence():
            self.schedule = Schedule(self.config.plan(), clock, wait)
        self._frozen: set[str] | None = None
        self._saved_step: int | None = None
        self._trained_step, self._steps_since_update = -1, 0
        self._guard, self._risen_loss = NonFiniteGuard(), RisenLossGuard()
        self._captured: CapturedSteps | None = None
        self.stop_training = False  # nerfstudio sets it when the training begins; single steps read it too
        try:
            with one_sentence(), interruption.one_line(self._stopped), files_of_run(self.base_dir):
                self._loaded, self._state = resume_effects(self.config) or (None, {})
                super().setup(test_mode)
        except SystemExit:
            discard_unbegun(self.base_dir)
            raise
        # Evaluation and export build what was trained, whatever becomes of the dataset.
        self._model.config.effects = effects_setting(self._model.effects)
        (config := self.config).save_config(checked=True)
        plain = not (config.mixed_precision or config.use_grad_scaler or config.log_gradients)
        plain = plain and config.capture_steps and not config.gradient_accumulation_steps
        if self.pipeline.device.type == "cuda" and plain:
            self._captured = CapturedSteps(self._model, [*chain(*self.optimizers.parameters.values())])

    def setup_optimizers(self) -> GuardedOptimizers:
        """Optimisers that skip non-finite steps."""
        return GuardedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    @property
    def _model(self) -> SpectralModel:
        return cast(SpectralModel, self.pipeline.model)

    def train(self) -> None:
        """Train the remaining steps of the plan; nerfstudio would add ``max_num_iterations`` to a resumed run."""
        try:
            with one_sentence(), interruption.one_line(self._stopped), files_of_run(self.base_dir):
                if self._loaded is None or not self._keep_stage_of(self._loaded) or not self.schedule.complete:
                    self.config = copy.copy(self.config)
                    self.config.max_num_iterations = self.schedule.require_steps_left(self._start_step)
                    with training_progress(self.schedule) as self._show_progress:
                        super().train()
                flush_logs()
            interruption.ignore_when_done()
        except TrainingDivergedError as error:
            # Skipped steps do not change the weights: unless the loss had risen before, they are still good.
            self.save_checkpoint(self.step)
            end_diverged_run(error, self.checkpoint_dir)
        finally:
            with suppress(OSError):  # what went wrong before is told
                flush_logs()

    def _stopped(self) -> str:
        return stopped_run(self.config.get_checkpoint_dir())

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """One step of its stage."""
        self.schedule.begin_step(step, after_pause=self._state_was_set)
        self._state_was_set = self.training_state == "paused"
        stage, position = self.schedule.stage, self.schedule.position
        manager, of_stage = self.pipeline.datamanager, stage.config
        manager.foreground_ray_fraction = of_stage.foreground_ray_fraction
        manager.boundary_ray_fraction = of_stage.boundary_ray_fraction
        if isinstance(self._model.proposal_sampler, OccupancySampler):
            self._model.proposal_sampler.samples_in_training = of_stage.samples_per_ray
            self._model.field.rise_length.fill_(stage.rise_length(position))
        self._freeze({group for group in self.optimizers.parameters if not stage.learns(group, position)})
        rates = self.optimizers.scale_learning_rates(lambda group: stage.lr_factor(position, group))
        if (sampler := self._model.proposals) is not None:
            # Evaluations and the viewer change these counters too, and nerfstudio's checkpoints lack them.
            sampler._step, sampler._steps_since_update = max(0, step - 1), self._steps_since_update

        torch.manual_seed(step_seed(self.config.machine.seed, step))
        self.pipeline.prepare_step(step, self.schedule.part_of_last_stage)
        captured = self._captured
        found = super().train_iteration(step) if captured is None else self._captured_iteration(captured, step)
        loss, loss_dict, metrics_dict = found
        if stage.learns("fields", position) and not self.optimizers.skipped_groups:
            self._model.field.shrink_grid(rates["fields"] * stage.config.grid_decay)

        if sampler is not None:
            self._steps_since_update = sampler._steps_since_update + 1
        total = float(loss.detach())  # of all terms: finite only if each is
        names = [] if math.isfinite(total) else non_finite_names(loss_dict)
        warning = self._guard.record(step, names, self.optimizers.skipped_groups)
        if warning is not None:
            CONSOLE.print(f"[yellow]{escape(warning)}")
        if step_check(step, self.config.logging.steps_per_log, run_at_zero=True):
            writer.put_dict(name="learning_rate", scalar_dict=rates, step=step)  # as nerfstudio's schedules are named
        if self._captured is None or step % _GPU_PROGRESS_STEPS == 0:
            self._show_progress(step, float(metrics_dict["psnr"]))
        self.schedule.end_step(step)
        self._trained_step = step
        self.stop_training |= self.schedule.complete
        self._risen_loss.record(step, self.schedule, total)
        return loss, loss_dict, metrics_dict

    def _captured_iteration(self, steps: CapturedSteps, step: int) -> TRAIN_INTERATION_OUTPUT:
        """What nerfstudio does in a step, its forward and backward pass as a graph."""
        rays, batch = self.pipeline.datamanager.next_train(step)
        seed = partial(torch.manual_seed, step_seed(self.config.machine.seed, step))
        try:
            found = steps((self.schedule.stage.config.name, frozenset(self._frozen or ())), rays, batch, seed)
        except RuntimeError as error:
            CONSOLE.print(f"[yellow]Training goes on, but more slowly; no graph of a step: {escape(str(error))}")
            self._captured = None
            seed()
            return super().train_iteration(step)
        self.optimizers.optimizer_scaler_step_some(self.grad_scaler, list(self.optimizers.parameters))
        return found

    def _freeze(self, frozen: set[str]) -> None:
        """Freeze these parameter groups, and no others."""
        if frozen == self._frozen:
            return
        for group, parameters in self.optimizers.parameters.items():
            for parameter in parameters:
                parameter.requires_grad_(group not in frozen)
                parameter.grad = None
        # Mode free-discarded resets the corrections when they are frozen.
        self._model.camera_optimizer.freeze("camera_opt" in frozen)
        self._frozen = frozen

    def eval_iteration(self, step: int) -> None:
        """nerfstudio's evaluations; after the last step of a stage, its checkpoint and held-out metrics."""
        with self.schedule.clock.paused():
            super().eval_iteration(step)
            if self.schedule.stage_complete:
                self._keep(step)

    def _keep_stage_of(self, loaded: Path) -> bool:
        """Keep the stage that a loaded checkpoint completed; False if its run has kept it, or none was completed."""
        kept = loaded.resolve().parents[1] / f"stage-{self.schedule.stage.config.name}" / loaded.name
        if not self.schedule.stage_complete or kept.exists():
            return False
        self._keep(self._start_step - 1)
        return True

    def _keep(self, step: int) -> None:
        """Keep the last checkpoint of a finished stage, and its metrics of the held-out views."""
        name = self.schedule.stage.config.name
        kept = checkpoint_path(self.base_dir / f"stage-{name}", step)
        self.save_checkpoint(step)
        if self.config.evaluate_stages:
            metrics = self.pipeline.get_average_eval_image_metrics(step=step, get_std=True)
            writer.put_dict(name="Eval Images Metrics Dict (all images)", scalar_dict=metrics, step=step)
            CONSOLE.print(stage_summary(name, metrics))
            results = {"stage": name, "step": step, "checkpoint": kept.name, "results": metrics}
            write_json(kept.with_suffix(".json"), results)
        link_checkpoint(checkpoint_path(self.checkpoint_dir, step), kept.parent)
        if self.config.save_only_latest_checkpoint:  # others are of an earlier run in this folder
            for older in {*kept.parent.glob("step-*")} - {kept, kept.with_suffix(".json")}:
                older.unlink()
        flush_logs()

    def _after_train(self) -> None:
        """Save, then finish as nerfstudio does."""
        # Where training is stopped, nerfstudio counts the step that it no longer takes.
        self.step = min(self.step, self._trained_step)
        self.save_checkpoint(self.step)
        super()._after_train()

    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint, then delete the older ones if the configuration says so.

        ``training`` holds what a resumed run needs beside nerfstudio's contents to give the same result.
        """
        if step == self._saved_step or self._risen_loss.risen_in_a_row:
            return  # the checkpoint before, which this one would replace, is better
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {},
            "scalers": self.grad_scaler.state_dict(),
            "training": {
                **self.schedule.state(),
                "steps_since_update": self._steps_since_update,
                "effects": effects_setting(self._model.effects),
            },
        }
        path = checkpoint_path(self.checkpoint_dir, step)
        with one_sentence(), self.schedule.clock.paused():
            write_checkpoint(path, state)
        self._saved_step = step
        if self.config.save_only_latest_checkpoint:
            for older in {*self.checkpoint_dir.glob("*.ckpt")} - {path}:
                older.unlink()

    def _load_checkpoint(self) -> None:
        """Load a checkpoint of `save_checkpoint`, with the contents of ``training``."""
        if (path := self._loaded) is None:
            return
        state, self._state = self._state, {}  # which is as large as the model
        with content_of(path, "state of a training", "take an earlier one"):
            self._start_step = state["step"] + 1
            self._trained_step = state["step"]
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.restore(state["optimizers"], path)
            if state["scalers"]:  # empty unless training was in mixed precision
                self.grad_scaler.load_state_dict(state["scalers"])
            self._steps_since_update = state["training"]["steps_since_update"]
            self.schedule.resume(state["training"], self._start_step)
        CONSOLE.print(f"Going on from {escape(str(path))}", soft_wrap=True)
