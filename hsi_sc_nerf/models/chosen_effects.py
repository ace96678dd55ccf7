"""Which effects a model simulates: as the dataset's evidence has it, or as the user says."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from nerfstudio.engine.trainer import TrainerConfig

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import content_of
from hsi_sc_nerf.models.checkpoints import find_checkpoint, read_checkpoint
from hsi_sc_nerf.packed.dataset import PackedDataset

MODEL_EFFECTS = ("view_dependence", "still_chamber", "pose_refinement")
"""Effects that change what is built; all others are matters of `process` and `material`."""


def require_effects(setting: str) -> None:
    """Refuse a setting that is neither auto nor none nor a list of the model's effects.

    Raises:
        InputError: it is not.
    """
    unknown = set(_named(setting)) - set(MODEL_EFFECTS)
    if unknown:
        raise InputError(
            f"--pipeline.model.effects {setting}: the model has no effect {min(unknown)!r}; take auto, none, or some "
            f"of {','.join(MODEL_EFFECTS)}, joined by commas."
        )


def chosen_effects(setting: str, dataset: PackedDataset) -> tuple[str, ...]:
    """The effects of a setting, in the order of `MODEL_EFFECTS`.

    Args:
        setting: auto, none, or names joined by commas.
        dataset: its evidence decides "auto"; a dataset of an older version, without any, has all effects, but poses
            from markers are not refined.
    """
    if setting != "auto":
        return tuple(name for name in MODEL_EFFECTS if name in _named(setting))
    if not dataset.effects:
        return MODEL_EFFECTS[:2] if dataset.pose_method == "markers" else MODEL_EFFECTS
    present = {effect.name for effect in dataset.effects if effect.present}
    return tuple(name for name in MODEL_EFFECTS if name in present)


def resume_effects(config: TrainerConfig) -> tuple[Path, dict[str, Any]] | None:
    """Take the effects of the checkpoint that a run goes on from into its settings.

    Returns:
        Its path, and what it holds (`read_checkpoint`); None for a new run.

    Raises:
        InputError: the settings ask for others, or there is no such checkpoint, or it cannot be read.
    """
    path = config.load_checkpoint if config.load_dir is None else find_checkpoint(config.load_dir, config.load_step)
    if path is None:
        return None
    state, model = read_checkpoint(path), cast(Any, config.pipeline.model)
    with content_of(path, "state of a training", "take an earlier one"):
        trained = state["training"].get("effects") or model.effects
        same = model.effects == "auto" or set(_named(model.effects)) == set(_named(trained))
    if not same:
        raise InputError(
            f"{path}: was trained with --pipeline.model.effects {trained}; leave the option out to go on with it."
        )
    model.effects = trained
    return path, state


def effects_setting(effects: tuple[str, ...]) -> str:
    """The setting that gives these effects whatever the dataset says."""
    return ",".join(effects) or "none"


def _named(setting: str) -> list[str]:
    return [] if setting in ("auto", "none") else setting.split(",")
