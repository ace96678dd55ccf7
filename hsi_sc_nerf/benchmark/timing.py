"""When to evaluate, what the clock counts, and how many iterations fit into a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Literal

Clock = Literal["wall", "cpu"]
"""Wall time, or the processor's time over all threads of a process, which other work on a machine hardly changes."""

# The first steps of a stage build caches and tables.
_WARM_UP_STEPS = 2


def checkpoint_iterations(shares: Sequence[float], stage_ends: Sequence[int]) -> tuple[int, ...]:
    """Numbers of done iterations at which a run is evaluated: these shares of it, and the end of every stage.

    Args:
        shares: of the whole run, in (0, 1].
        stage_ends: iterations done at the end of each stage; the last is the run's length.
    """
    total = stage_ends[-1]
    return tuple(sorted({*stage_ends, *(max(1, round(share * total)) for share in shares)}))


def mean_iteration_seconds(times: Sequence[float], stage_ends: Sequence[int]) -> float:
    """Mean time of an iteration without the first two of each stage, each stage counting by its length.

    Args:
        times: the clock before the first iteration and after each, so one more than iterations, seconds.
        stage_ends: iterations done at the end of each stage.
    """
    steps = [after - before for before, after in pairwise(times)]
    spent = 0.0
    for start, end in pairwise((0, *stage_ends)):
        counted = steps[min(start + _WARM_UP_STEPS, end - 1) : end]
        spent += (end - start) * sum(counted) / len(counted)
    return spent / stage_ends[-1]


class TrainingClock:
    """Seconds of wall and of processor time since it was made, pauses left out.

    Args:
        wait: called before each reading, so that what a GPU has still to do is counted where it belongs.
        wall: clock of wall time, seconds.
        cpu: clock of this process's processor time over all threads, seconds.
    """

    def __init__(
        self,
        wait: Callable[[], object] = lambda: None,
        wall: Callable[[], float] = time.perf_counter,
        cpu: Callable[[], float] = time.process_time,
    ) -> None:
        self._wait, self._wall, self._cpu = wait, wall, cpu
        self._wall_start, self._cpu_start = wall(), cpu()

    def read(self) -> tuple[float, float]:
        """Wall and processor seconds."""
        self._wait()
        return self._wall() - self._wall_start, self._cpu() - self._cpu_start

    @contextmanager
    def paused(self) -> Iterator[tuple[float, float]]:
        """What is done within counts on neither clock; gives the readings before it."""
        wall, cpu = self.read()
        yield wall, cpu
        self._wait()
        self._wall_start, self._cpu_start = self._wall() - wall, self._cpu() - cpu
