"""Training curves, as the run's TensorBoard events tell them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

Scalars = dict[str, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]
"""Steps and values by TensorBoard's tag."""

_CHECKPOINT = re.compile(r"step-(\d+)\.ckpt")
MOST_POINTS = 400
"""Longer curves are drawn as means over as many pieces: more would not be seen, and would make the page large."""


def read_scalars(run: Path) -> Scalars:
    """All scalars that the run logged, by tag; empty where it has no events. Of a resumed run, one value a step."""
    if not any(run.glob("events.out.tfevents.*")):
        return {}
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    events = EventAccumulator(str(run), size_guidance={SCALARS: 0})
    events.Reload()
    scalars = {}
    for tag in events.Tags()[SCALARS]:
        last = {event.step: event.value for event in events.Scalars(tag)}
        steps = np.array(sorted(last), dtype=float)
        scalars[tag] = steps, np.array([last[int(step)] for step in steps], dtype=float)
    return scalars


def shortened(
    steps: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], most: int = MOST_POINTS
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Means of at most ``most`` pieces of equal length, the curve itself where it is no longer."""
    if len(steps) <= most:
        return steps, values
    starts = np.arange(most) * len(steps) // most
    lengths = np.diff(np.append(starts, len(steps)))
    return np.add.reduceat(steps, starts) / lengths, np.add.reduceat(values, starts) / lengths


def stage_ends(run: Path) -> dict[str, int]:
    """How many steps were done when each finished stage ended, by the stage's name, the first one first."""
    ends = {}
    for folder in run.glob("stage-*"):
        steps = [int(match[1]) for path in folder.iterdir() if (match := _CHECKPOINT.fullmatch(path.name))]
        if steps:
            ends[folder.name.removeprefix("stage-")] = max(steps) + 1
    return dict(sorted(ends.items(), key=lambda item: item[1]))
