"""Named settings of a training run: what they cost and give stands in docs/validation/accuracy_and_time.md."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any, Literal

import yaml

Preset = Literal["fast", "balanced", "best"]

Device = Literal["cpu", "cuda"]

ITERATIONS = "max_num_iterations"
RAYS = "pipeline.datamanager.train_num_rays_per_batch"


class PresetValue(int):
    """A number of a preset, which another preset may replace. A number that the user gives is a plain ``int``."""


yaml.Dumper.add_representer(PresetValue, lambda dumper, value: dumper.represent_int(int(value)))

_P = PresetValue
PRESETS: Mapping[Device, Mapping[Preset, Mapping[str, PresetValue]]] = {
    "cpu": {
        "fast": {ITERATIONS: _P(800), RAYS: _P(1024)},
        "balanced": {ITERATIONS: _P(2400), RAYS: _P(1024)},
        "best": {ITERATIONS: _P(4000), RAYS: _P(1024)},
    },
    "cuda": {
        "fast": {ITERATIONS: _P(1000), RAYS: _P(2048)},
        "balanced": {ITERATIONS: _P(5000), RAYS: _P(2048)},
        "best": {ITERATIONS: _P(40_000), RAYS: _P(2048)},
    },
}
"""Settings by device and preset, as attributes of the trainer's configuration."""


def apply_preset(config: Any) -> None:
    """Set what the configuration's preset sets for its device, but for settings that the user has given.

    Args:
        config: of the trainer; changed in place, unless its preset is None. Settings that are no `PresetValue` stay.

    Raises:
        SystemExit: the configuration is that of the published method.

    Example:
        >>> config.preset = "fast"
        >>> apply_preset(config)
        >>> config.max_num_iterations
        800
    """
    if config.preset is None:
        return
    if config.method_name == "hsi-sc-nerf-paper":
        raise SystemExit(
            "hsi-sc-nerf: --preset is for ns-train hsi-sc-nerf; the published method has its own length, which "
            "--max-num-iterations changes."
        )
    device: Device = "cuda" if config.machine.device_type == "cuda" else "cpu"
    for path, value in PRESETS[device][config.preset].items():
        parent, _, name = path.rpartition(".")
        part = attrgetter(parent)(config) if parent else config
        if isinstance(getattr(part, name), PresetValue):
            setattr(part, name, value)


def default_device() -> Device:
    """The device that a run trains on if none is named."""
    import torch  # takes seconds; the names of the presets do without

    return "cuda" if torch.cuda.is_available() else "cpu"
