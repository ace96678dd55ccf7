"""Which stage a run is in, and when it ends: by its iterations, or by the seconds of a clock.

A run of so many iterations depends on the steps' numbers alone, so a processor repeats it bit by bit. A timed run
takes as many steps as fit: its stages and learning rates follow the elapsed fraction of its seconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.stages import Stage, StagePlan, resumed_plan

Clock = Literal["wall", "cpu"]
"""Wall time, or processor time over all threads, which other work on the machine hardly changes."""

_NO_LIMIT = 10**9
"""Iterations that nerfstudio may take in a timed run."""


class Schedule:
    """Where a run is in its plan.

    Args:
        plan: in iterations, or in seconds.
        clock: that the plan's seconds refer to; None for a plan in iterations.
        wait: finishes the work of a GPU before the clock is paused; None without one.

    Attributes:
        stage: stage of the present step, or of the last one.
        position: iterations or seconds before the present step; once it has ended, after it.
        stage_complete: whether the last step was its stage's last.
        clock: seconds of training so far.

    Example:
        >>> from hsi_sc_nerf.models.stages import full_frame_stage, masked_stage, plan_stages
        >>> schedule = Schedule(plan_stages((full_frame_stage(), masked_stage()), 4))
        >>> for step in range(2):
        ...     schedule.begin_step(step)
        ...     schedule.end_step(step)
        >>> schedule.stage.config.name, schedule.stage_complete, schedule.complete
        ('full-frame', True, False)
    """

    def __init__(self, plan: StagePlan, clock: Clock | None = None, wait: Callable[[], object] | None = None) -> None:
        self.plan, self._unit = plan, clock
        self.stage: Stage = plan.stages[0]
        self.position = 0.0
        self.stage_complete = False
        self.clock = TrainingClock(wait or (lambda: None))
        self._begun = False

    @property
    def complete(self) -> bool:
        """Whether the last step was the run's last."""
        return self.stage_complete and self.stage is self.plan.stages[-1]

    @property
    def part_of_last_stage(self) -> float | None:
        """The fraction of the last stage that is done; None before it."""
        last = self.plan.stages[-1]
        return (self.position - last.start) / (last.end - last.start) if self.stage is last else None

    def require_steps_left(self, steps_done: int) -> int:
        """How many steps may still be taken; a timed run ends by the clock.

        Raises:
            InputError: the run that is to go on is complete.
        """
        if self.complete:
            unit, option = (
                ("seconds", "--max-train-seconds") if self._unit else ("iterations", "--max-num-iterations")
            )
            raise InputError(
                f"the checkpoint's run has all its {self.plan.length:g} {unit}; raise {option} to train on."
            )
        return _NO_LIMIT if self._unit else int(self.plan.length) - steps_done

    def begin_step(self, step: int, after_pause: bool = False) -> None:
        """Take up the next stage if the last one is complete, and read the position before the step.

        The first step starts the clock; that of a resumed run goes on from where it was.

        Args:
            step: its number.
            after_pause: leave out the time since the last step.
        """
        if not self._begun or after_pause:
            self.clock, self._begun = TrainingClock(self.clock.wait, self.position if self._unit else 0.0), True
        if self.stage_complete and not self.complete:
            # A step longer than a whole stage does not skip that stage.
            self.stage = self.plan.stages[self.plan.stages.index(self.stage) + 1]
        self.stage_complete = False
        self.position = self._read(step)

    def end_step(self, step: int) -> None:
        """Read the position after the step."""
        self.position = self._read(step + 1)
        self.stage_complete = self.position >= self.stage.end

    def _read(self, steps_done: int) -> float:
        if self._unit is None:
            return steps_done
        wall, cpu = self.clock.read()
        return wall if self._unit == "wall" else cpu

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps of it."""
        name = self.stage.config.name
        return {
            "stage": {"name": name, "start": self.stage.start},
            "completed_stage": name if self.stage_complete else None,
            "position": self.position,
            "clock": self._unit,
        }

    def resume(self, state: Mapping[str, Any], steps_done: int) -> None:
        """Go on from the `state` of a checkpoint, perhaps of another run, whose stages had other lengths.

        Args:
            state: state of the checkpoint.
            steps_done: iterations that it has.

        Raises:
            InputError: one run counts iterations and the other seconds, or other seconds.
        """
        unit = state.get("clock")
        if unit != self._unit:
            was, now = (f"by seconds ({one})" if one else "by iterations" for one in (unit, self._unit))
            raise InputError(
                f"the checkpoint's run ends {was}, this one {now}; give --max-train-seconds, --train-clock or "
                "--max-num-iterations as it did."
            )
        self.position = state["position"] if unit else steps_done
        completed = state["completed_stage"]
        completed_at = None if completed is None else self.position
        self.plan = resumed_plan(self.plan, **state["stage"], completed_at=completed_at)
        by_name = {stage.config.name: stage for stage in self.plan.stages}
        self.stage = by_name.get(state["stage"]["name"], self.plan.at(self.position))
        if self.position >= self.plan.length:
            self.stage = self.plan.stages[-1]
        self.stage_complete = self.position >= self.stage.end


class TrainingClock:
    """Wall and processor seconds since its creation, without pauses.

    Args:
        wait: called before and after a pause, to finish the work of a GPU.
        spent: seconds that it begins with.
        wall: clock of wall time, seconds.
        cpu: clock of this process's processor time over all threads, seconds.
    """

    def __init__(
        self,
        wait: Callable[[], object] = lambda: None,
        spent: float = 0.0,
        wall: Callable[[], float] = time.perf_counter,
        cpu: Callable[[], float] = time.process_time,
    ) -> None:
        self.wait, self._wall, self._cpu = wait, wall, cpu
        self._wall_start, self._cpu_start = wall() - spent, cpu() - spent

    def read(self) -> tuple[float, float]:
        """Wall and processor seconds."""
        return self._wall() - self._wall_start, self._cpu() - self._cpu_start

    @contextmanager
    def paused(self) -> Iterator[tuple[float, float]]:
        """Pause both clocks; yields the readings before."""
        self.wait()
        wall, cpu = self.read()
        yield wall, cpu
        self.wait()
        self._wall_start, self._cpu_start = self._wall() - wall, self._cpu() - cpu
