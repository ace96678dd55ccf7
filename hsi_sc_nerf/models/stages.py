"""The two stages of training, as plain data and pure functions of the step.

The paper (section "Training Protocol") trains on full frames with pose optimisation, then on the masked object with
the camera optimiser off. Everything that differs between the stages is a field of `StageConfig`; which stage a step
belongs to, and its learning rate, follow from the step alone, so a resumed run continues as if never interrupted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hsi_sc_nerf import paper


@dataclass
class StageConfig:
    """One stage of training."""

    name: str
    """Shown in the progress bar, and the name of the stage's checkpoint folder."""
    share: float
    """Share of --max-num-iterations that this stage gets."""
    num_iterations: int | None = None
    """Length of this stage on its own; where it is given it goes before the share."""
    foreground_share: float | None = None
    """Share of the rays that hit the foreground masks; the others keep empty space empty. None: whole frames."""
    optimize_poses: bool = True
    """Refine the camera poses during this stage; otherwise what was learned so far is frozen, and kept unless the
    refinement's mode says otherwise."""
    poses_after: float = 0.3
    """Share of the stage's steps that pass before the poses move: fog tells nothing of where the camera is."""
    lr_start: float = 1.0
    """Factor on every learning rate at the start of the stage."""
    lr_end: float = 0.5
    """Factor on every learning rate at the end of the stage; it falls exponentially in between."""
    warmup_iterations: int = 0
    """Steps over which the learning rate rises linearly from nothing at the start of the stage."""


def full_frame_stage() -> StageConfig:
    """The paper's first stage: every pixel, poses refined."""
    return StageConfig(name="full-frame", share=paper.STAGE_ITERATIONS[0] / sum(paper.STAGE_ITERATIONS))


def masked_stage() -> StageConfig:
    """The paper's second stage: the object's pixels and some background rays, poses frozen."""
    return StageConfig(
        name="masked",
        share=paper.STAGE_ITERATIONS[1] / sum(paper.STAGE_ITERATIONS),
        foreground_share=0.75,
        optimize_poses=False,
        lr_start=0.5,
        lr_end=0.02,
    )


@dataclass(frozen=True)
class Stage:
    """A stage placed in a run: it covers the steps ``start <= step < end``."""

    config: StageConfig
    start: int
    end: int

    def refines_poses(self, step: int) -> bool:
        """Whether the poses may move at ``step``."""
        waiting = int(self.config.poses_after * (self.end - self.start))
        return self.config.optimize_poses and step >= self.start + waiting

    def lr_factor(self, step: int) -> float:
        """Factor on the learning rates at ``step``: exponential from ``lr_start`` to ``lr_end``, after a warm-up."""
        done = step - self.start
        progress = done / max(1, self.end - self.start - 1)
        decayed = self.config.lr_start * (self.config.lr_end / self.config.lr_start) ** min(1.0, progress)
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
