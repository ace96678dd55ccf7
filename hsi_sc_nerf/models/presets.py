"""Named settings of a training run: what they cost and give stands in docs/validation/accuracy_and_time.md."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any, Literal

Preset = Literal["fast", "balanced", "best"]

Device = Literal["cpu", "cuda"]

ITERATIONS = "max_num_iterations"
RAYS = "pipeline.datamanager.train_num_rays_per_batch"

PRESETS: Mapping[Device, Mapping[Preset, Mapping[str, int]]] = {
    "cpu": {
        "fast": {ITERATIONS: 800, RAYS: 1024},
        "balanced": {ITERATIONS: 2400, RAYS: 1024},
        "best": {ITERATIONS: 4000, RAYS: 1024},
    },
    "cuda": {
        "fast": {ITERATIONS: 1000, RAYS: 2048},
        "balanced": {ITERATIONS: 5000, RAYS: 2048},
        "best": {ITERATIONS: 40_000, RAYS: 2048},
    },
}
"""Settings by device and preset, as attributes of the trainer's configuration."""


def apply_preset(config: Any) -> None:
    """Set what the configuration's preset sets for its device, but for settings that the user has changed.

    Args:
        config: of the trainer; changed in place, unless its preset is None. A setting is the user's where it is not
            that of balanced, the default.

    Example:
        >>> config.preset, config.max_num_iterations = "fast", PRESETS["cpu"]["balanced"][ITERATIONS]
        >>> apply_preset(config)
        >>> config.max_num_iterations
        800
    """
    if config.preset is None:
        return
    device: Device = "cuda" if config.machine.device_type == "cuda" else "cpu"
    untouched = PRESETS[default_device()]["balanced"]
    for path, value in PRESETS[device][config.preset].items():
        parent, _, name = path.rpartition(".")
        part = attrgetter(parent)(config) if parent else config
        if getattr(part, name) == untouched[path]:
            setattr(part, name, value)


def default_device() -> Device:
    """The device that a run trains on if none is named."""
    import torch  # takes seconds; the names of the presets do without

    return "cuda" if torch.cuda.is_available() else "cpu"
