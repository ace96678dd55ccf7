"""The two stages of training, as plain data and pure functions of the step.

The paper (section "Training Protocol") trains on full frames with pose optimisation, then on the masked object with
the camera optimiser off. Everything that differs between the stages is a field of `StageConfig`; which stage a step
belongs to, its learning rates and its random numbers follow from the step alone, so a resumed run continues as if
never interrupted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hsi_sc_nerf import paper


@dataclass
class StageConfig:
    """One stage of training. Parameter groups are those of --optimizers: fields, proposal_networks, camera_opt,
    basis, background."""

    name: str
    """Shown in the progress bar, and the name of the stage's checkpoint folder."""
    share: float
    """Share of --max-num-iterations that this stage gets."""
    num_iterations: int | None = None
    """Length of this stage on its own; where it is given it goes before the share."""
    foreground_share: float | None = None
    """Share of the rays that hit the foreground masks; the others, anywhere else in the frames, keep empty space
    empty. 1: the object's pixels alone, as in the paper. None: anywhere in whole frames."""
    rim_share: float = 0.0
    """Share of the other rays, where there is a foreground share, that pass just beside the masks: these say most
    sharply where the object ends."""
    angular_loss_mult: float | None = None
    """Weight of the spectral angle's loss in this stage. None: the model's."""
    hsi_loss_mult: float | None = None
    """Weight of the squared error in this stage. None: the model's."""
    frozen_groups: tuple[str, ...] = ()
    """Parameter groups that this stage does not change: what they learned so far stays in force (camera_opt: unless
    the pose refinement's mode says otherwise)."""
    learn_after: dict[str, float] = field(default_factory=lambda: {"camera_opt": 0.3})
    """Share of the stage's steps that pass before a parameter group begins to learn. Poses wait by default: fog tells
    nothing of where the camera is."""
    lr_start: float = 1.0
    """Factor on every learning rate at the start of the stage."""
    lr_end: float = 0.5
    """Factor on every learning rate at the end of the stage; it falls exponentially in between."""
    group_lr: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Both factors for single parameter groups, in place of those above."""
    warmup_iterations: int = 0
    """Steps over which the learning rate rises linearly from nothing at the start of the stage."""

    def loss_weights(self) -> dict[str, float]:
        """Loss weights of the model that this stage sets, by their names in the model's configuration."""
        weights = {"angular_loss_mult": self.angular_loss_mult, "hsi_loss_mult": self.hsi_loss_mult}
        return {name: weight for name, weight in weights.items() if weight is not None}

    def check(self, groups: Collection[str]) -> None:
        """Refuse what cannot be trained with.

        Args:
            groups: names of all parameter groups that have an optimiser.

        Raises:
            ValueError: one sentence that names the stage and its field.
        """
        shares = {"foreground-share": self.foreground_share, "rim-share": self.rim_share}
        for option, share in shares.items():
            if share is not None and not 0.0 <= share <= 1.0:
                raise ValueError(f"{self.name}: {option} {share} is not between 0 and 1")
        if self.share < 0.0:
            raise ValueError(f"{self.name}: share {self.share} is below 0")
        factors = {"lr-start": self.lr_start, "lr-end": self.lr_end}
        factors |= {f"group-lr of {group}": min(pair) for group, pair in self.group_lr.items()}
        for option, factor in factors.items():
            if factor <= 0.0:
                raise ValueError(f"{self.name}: {option} {factor} is not above 0; frozen-groups stops a group")
        for group in (*self.frozen_groups, *self.learn_after, *self.group_lr):
            if group not in groups:
                raise ValueError(f"{self.name}: no parameter group is named {group!r}; there are {', '.join(groups)}")


def full_frame_stage() -> StageConfig:
    """The paper's first stage: whole frames, poses refined.

    A share of the rays is sure to hit the object, and one to pass just beside it: its surface comes into being here,
    and on a turntable it is seen in less than a tenth of the pixels.
    """
    return StageConfig(
        name="full-frame",
        share=paper.STAGE_ITERATIONS[0] / sum(paper.STAGE_ITERATIONS),
        foreground_share=0.2,
        rim_share=0.2,
    )


def masked_stage() -> StageConfig:
    """The paper's second stage: the object's pixels and some background rays, poses frozen."""
    return StageConfig(
        name="masked",
        share=paper.STAGE_ITERATIONS[1] / sum(paper.STAGE_ITERATIONS),
        foreground_share=0.75,
        rim_share=0.8,
        frozen_groups=("camera_opt", "background"),
        lr_start=0.5,
        lr_end=0.02,
    )


def exponential_decay(final_factor: float, schedule_steps: int, step: int) -> float:
    """Factor on a learning rate at ``step`` of a schedule that falls to ``final_factor`` over ``schedule_steps``.

    A schedule that is longer than the run, as the paper's released settings have it (to 0.01 over 200,000 steps, of
    which 20,000 are run), is expressed by its values at the ends of the stages.
    """
    return final_factor ** min(1.0, step / schedule_steps)


def step_seed(seed: int, step: int) -> int:
    """Seed of the random numbers of one training step, unlike those of all other steps and seeds."""
    return int(np.random.SeedSequence((seed, step)).generate_state(1, np.uint64)[0])


@dataclass(frozen=True)
class Stage:
    """A stage placed in a run: it covers the steps ``start <= step < end``."""

    config: StageConfig
    start: int
    end: int

    def learns(self, group: str, step: int) -> bool:
        """Whether the parameters of ``group`` change at ``step``."""
        waiting = int(self.config.learn_after.get(group, 0.0) * (self.end - self.start))
        return group not in self.config.frozen_groups and step >= self.start + waiting

    def lr_factor(self, step: int, group: str) -> float:
        """Factor on the learning rate of ``group`` at ``step``: exponential between its two, after a warm-up."""
        first, last = self.config.group_lr.get(group, (self.config.lr_start, self.config.lr_end))
        done = step - self.start
        progress = done / max(1, self.end - self.start - 1)
        decayed = first * (last / first) ** min(1.0, progress)
        return decayed * min(1.0, (done + 1) / (self.config.warmup_iterations + 1))


@dataclass(frozen=True)
class StagePlan:
    """The stages of a run, in order."""

    stages: tuple[Stage, ...]

    @property
    def num_iterations(self) -> int:
        """Steps of the whole run."""
        return self.stages[-1].end

    def at(self, step: int) -> Stage:
        """The stage that ``step`` belongs to; past the end of the run, the last one."""
        for stage in self.stages:
            if step < stage.end:
                return stage
        return self.stages[-1]


def plan_after(plan: StagePlan, completed: str, next_step: int) -> StagePlan:
    """The plan of a run that goes on at ``next_step`` from the end of the stage named ``completed``.

    The stages after it follow at once, with the lengths that ``plan`` gives them, however long the completed one was.
    Where it is the last stage, or none of the plan's, the plan stays as it is.
    """
    names = [stage.config.name for stage in plan.stages]
    if completed not in names[:-1]:
        return plan
    return plan_within(plan, names[names.index(completed) + 1], next_step)


def plan_within(plan: StagePlan, name: str, start: int) -> StagePlan:
    """The plan of a run whose stage ``name`` began at the step ``start``, as after another run's first stage.

    That stage and those after it keep the lengths that ``plan`` gives them; the one before it ends where it begins.
    Where ``plan`` has no such stage, it stays as it is.
    """
    names = [stage.config.name for stage in plan.stages]
    if name not in names or start == plan.stages[names.index(name)].start:
        return plan
    position = names.index(name)
    shift = start - plan.stages[position].start
    before = (replace(stage, start=min(stage.start, start - 1), end=start) for stage in plan.stages[:position][-1:])
    later = (replace(stage, start=stage.start + shift, end=stage.end + shift) for stage in plan.stages[position:])
    return StagePlan((*before, *later))


def plan_stages(configs: Sequence[StageConfig], max_num_iterations: int) -> StagePlan:
    """Place stages in a run of ``max_num_iterations`` steps.

    Stages with a ``num_iterations`` of their own get it; the others divide what is left by their shares. Where all
    have their own, the run is as long as they are together. Stages of no steps are left out.

    Raises:
        ValueError: nothing is left to train, or the stages' own lengths exceed the run while others wait.
    """
    own = sum(config.num_iterations or 0 for config in configs)
    sharing = [config for config in configs if config.num_iterations is None]
    left = max_num_iterations - own
    if sharing and left < 0:
        raise ValueError(
            f"the stages' own num-iterations ({own}) exceed --max-num-iterations ({max_num_iterations}); raise the "
            "latter, or give every stage its own"
        )
    weight = sum(config.share for config in sharing)
    if sharing and left > 0 and not weight > 0.0:
        raise ValueError("the stages' shares add up to 0: one of them has to be more")
    stages: list[Stage] = []
    start, shared = 0, 0.0
    for config in configs:
        if config.num_iterations is not None:
            length = config.num_iterations
        else:
            # Rounding the running sum, not each part, keeps the total exact.
            before = round(left * shared / weight)
            shared += config.share
            length = round(left * shared / weight) - before
        if length > 0:
            stages.append(Stage(config, start, start + length))
            start += length
    if not stages:
        raise ValueError("no iterations to train: --max-num-iterations and the stages' num-iterations are all zero")
    return StagePlan(tuple(stages))
