"""The two stages of training, as plain data and pure functions of the step.

The paper (section "Training Protocol") trains on full frames with pose optimisation, then on the masked object with
the camera optimiser off. All that differs between the stages is a field of `StageConfig`. The stage of a step, its
learning rates and its random numbers follow from the step alone, so that a resumed run gives the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.settings_file import between

FIRST_RISE = 1 / 3
"""Part of a stage's rise length that holds from its start: hollows are opened by soft densities."""
GROWN_AFTER = 0.6
"""Part of a stage in which the surface becomes harder. In the rest, whose learning rates are small, it settles."""


@dataclass
class StageConfig:
    """One stage of training. The parameter groups are fields (the hash grid), field_networks (the weights of its
    networks), proposal_networks and camera_opt."""

    name: str
    """Shown in the progress bar, and the name of the stage's checkpoint folder."""
    fraction: float = between(0.0, math.inf)
    """Fraction of --max-num-iterations that this stage takes."""
    num_iterations: int | None = between(0, math.inf, default=None)
    """Length of this stage, in place of the fraction."""
    foreground_ray_fraction: float | None = between(0.0, 1.0, default=None)
    """Fraction of the rays that hit the foreground masks. The others keep empty space empty. 1: the object's pixels
    alone, as in the paper's second stage. None: rays anywhere in whole frames."""
    boundary_ray_fraction: float = between(0.0, 1.0, default=0.0)
    """Fraction of the other rays that pass within 3 pixels of the masks, where the object ends. It has no effect
    without a foreground ray fraction."""
    samples_per_ray: int | None = between(1, math.inf, default=None)
    """Samples a ray in this stage, if fewer than the model's and an occupancy grid places them. None: the model's."""
    rise_length: float = between(0.0, math.inf, default=0.0)
    """How opaque a rise of the density is where an occupancy grid places the samples: as much as this length of the
    density, scene units; a third of it at the stage's start. With it, the outlines and the texture agree on one
    surface (docs/concepts/model.md)."""
    frozen_groups: tuple[str, ...] = ()
    """Parameter groups that this stage does not change. What they learned so far stays in force, unless the pose
    refinement's mode is free-discarded."""
    learn_after: dict[str, float] = field(default_factory=lambda: {"camera_opt": 0.3})
    """Fraction of the stage's steps after which a parameter group begins to learn. Pose refinement starts after 30 %
    of the first stage, when the density has converged to a surface."""
    lr_start: float = between(1e-9, math.inf, default=1.0)
    """Factor on every learning rate at the start of the stage."""
    lr_end: float = between(1e-9, math.inf, default=0.5)
    """Factor on every learning rate at the end of the stage; it falls exponentially in between."""
    group_lr: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Both factors for single parameter groups, in place of those above."""
    grid_decay: float = between(0.0, math.inf, default=0.0)
    """Fraction by which the hash grid's features shrink in a step, over its learning rate. Features that few views
    reach fade, so that the surface is smooth between the views' outlines."""

    def require_groups(self, known: Collection[str]) -> None:
        """Refuse settings of a parameter group that is not among those known, or with a rate of 0.

        Raises:
            InputError: there is such a setting.
        """
        for group in (*self.frozen_groups, *self.learn_after, *self.group_lr):
            if group not in known:
                raise InputError(
                    f"the {self.name} stage names the parameter group {group!r}; there are {', '.join(known)}."
                )
        for group, factors in self.group_lr.items():
            if not min(factors) > 0.0:
                raise InputError(
                    f"the {self.name} stage's group-lr of {group} has a factor that is not above 0; "
                    "frozen-groups keeps a group as it is."
                )


def full_frame_stage() -> StageConfig:
    """The paper's first stage: whole frames, poses refined.

    A turntable's object covers less than a tenth of the pixels, and the occupancy grid bounds it from the start. Half
    of the rays are therefore drawn from the object. The others see its boundary, the container and the disc, without
    which the object's base would swell (docs/notes/dead_ends.md). Samples are few: they find the surface, those of
    the second stage its outline.
    """
    return StageConfig(
        name="full-frame",
        fraction=paper.STAGE_ITERATIONS[0] / sum(paper.STAGE_ITERATIONS),
        foreground_ray_fraction=0.5,
        boundary_ray_fraction=0.2,
        samples_per_ray=8,
        grid_decay=0.1,
    )


def masked_stage() -> StageConfig:
    """The paper's second stage: the object's pixels and some background rays, poses frozen."""
    return StageConfig(
        name="masked",
        fraction=paper.STAGE_ITERATIONS[1] / sum(paper.STAGE_ITERATIONS),
        foreground_ray_fraction=0.75,
        boundary_ray_fraction=0.8,
        rise_length=0.06,
        frozen_groups=("camera_opt",),
        lr_start=0.5,
        lr_end=0.02,
        grid_decay=1.0,
    )


def step_seed(seed: int, step: int) -> int:
    """Seed of the random numbers of one training step, different for every step and seed."""
    return int(np.random.SeedSequence((seed, step)).generate_state(1, np.uint64)[0])


@dataclass(frozen=True)
class Stage:
    """A stage of a run, which covers the positions ``start <= position < end``.

    Positions are iterations, or seconds if the run is timed.
    """

    config: StageConfig
    start: float
    end: float
    timed: bool = False

    def learns(self, group: str, position: float) -> bool:
        """Whether the parameters of ``group`` change at ``position``."""
        waiting = self.config.learn_after.get(group, 0.0) * (self.end - self.start)
        return group not in self.config.frozen_groups and position >= self.start + (
            waiting if self.timed else int(waiting)
        )

    def lr_factor(self, position: float, group: str) -> float:
        """Factor on the learning rate of ``group`` at ``position``, exponential from the stage's start to its end."""
        first, last = self.config.group_lr.get(group, (self.config.lr_start, self.config.lr_end))
        length = self.end - self.start if self.timed else max(1, self.end - self.start - 1)
        return first * (last / first) ** min(1.0, max(0.0, (position - self.start) / length))

    def rise_length(self, position: float) -> float:
        """Rise length at ``position``, scene units, which grows evenly until `GROWN_AFTER` of the stage."""
        grown = (position - self.start) / (GROWN_AFTER * (self.end - self.start))
        return self.config.rise_length * (FIRST_RISE + (1.0 - FIRST_RISE) * min(1.0, max(0.0, grown)))


@dataclass(frozen=True)
class StagePlan:
    """The stages of a run, in order."""

    stages: tuple[Stage, ...]

    @property
    def length(self) -> float:
        """Iterations or seconds of the whole run."""
        return self.stages[-1].end

    def at(self, position: float) -> Stage:
        """The stage of ``position``; after the end of the run, the last one."""
        for stage in self.stages:
            if position < stage.end:
                return stage
        return self.stages[-1]


def resumed_plan(plan: StagePlan, name: str, start: float, completed_at: float | None = None) -> StagePlan:
    """The plan of a run that goes on from a checkpoint, perhaps of another run, whose stages had other lengths.

    The checkpoint's stage and those after it keep the lengths that they have in ``plan``; the one before them ends
    where they begin. If ``plan`` has no such stage, it does not change.

    Args:
        plan: by the settings.
        name: stage of the checkpoint.
        start: position at which it began.
        completed_at: the position after the checkpoint, if it is the stage's last: the next stage of ``plan`` begins
            there.
    """
    names = [stage.config.name for stage in plan.stages]
    if name not in names:
        return plan
    position = names.index(name)
    if completed_at is not None and name != names[-1]:
        position, start = position + 1, completed_at
    shift = start - plan.stages[position].start
    if shift == 0:
        return plan
    before = (replace(stage, start=min(stage.start, start), end=start) for stage in plan.stages[:position][-1:])
    later = (replace(stage, start=stage.start + shift, end=stage.end + shift) for stage in plan.stages[position:])
    return StagePlan((*before, *later))


def plan_stages(configs: Sequence[StageConfig], length: float, timed: bool = False) -> StagePlan:
    """Divide a run into stages.

    A stage with ``num_iterations`` has that length; the others divide the remaining steps by their fractions. If all
    stages have a length, the run is as long as their sum. Stages of no steps are left out.

    Args:
        configs: the stages.
        length: of the run, iterations or seconds.
        timed: whether it is seconds.

    Raises:
        InputError: there is nothing to train, the stages' lengths leave nothing for the other stages, or a stage of a
            timed run has a number of iterations.

    Example:
        >>> plan = plan_stages((full_frame_stage(), masked_stage()), 500)
        >>> plan.at(300).config.name
        'masked'
    """
    divided = [config for config in configs if config.num_iterations is None]
    if timed and len(divided) < len(configs):
        name = next(config.name for config in configs if config.num_iterations is not None)
        raise InputError(
            f"the {name} stage has num-iterations, and --max-train-seconds ends the run by the clock; "
            "give the stage a fraction, or leave --max-train-seconds out."
        )
    fixed = sum(config.num_iterations or 0 for config in configs)
    left = length - fixed
    if divided and left < 0:
        raise InputError(
            f"the stages' num-iterations ({fixed}) exceed --max-num-iterations ({length}); raise the latter, or give "
            "every stage its own."
        )
    weight = sum(config.fraction for config in divided)
    if divided and left > 0 and not weight > 0.0:
        raise InputError("the stages' fractions add up to 0; give one of them a fraction above 0.")
    whole: Callable[[float], float] = float if timed else round
    stages: list[Stage] = []
    start, cumulated = 0.0, 0.0
    for config in configs:
        own: float | None = config.num_iterations
        if own is None:
            # Rounding the cumulated fractions, not each one, keeps the total exact.
            before, cumulated = cumulated, cumulated + config.fraction
            own = whole(left * cumulated / (weight or 1.0)) - whole(left * before / (weight or 1.0))
        if own > 0:
            stages.append(Stage(config, start, start + own, timed))
            start += own
    if not stages:
        raise InputError(f"--max-num-iterations is {length}, which leaves nothing to train; give a number above 0.")
    return StagePlan(tuple(stages))
