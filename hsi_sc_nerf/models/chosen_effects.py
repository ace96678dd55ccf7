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


def resume_effects(config: TrainerConfig) -> Path | None:
    """Take the effects of the checkpoint that a run goes on from into its settings; gives it, None for a new run.

    Raises:
        InputError: the settings ask for others, or there is no such checkpoint, or it cannot be read.
    """
    path = config.load_checkpoint if config.load_dir is None else find_checkpoint(config.load_dir, config.load_step)
    if path is not None:
        model = cast(Any, config.pipeline.model)
        model.effects = _trained_effects(model.effects, path)
    return path


def _trained_effects(setting: str, checkpoint: Path) -> str:
    with content_of(checkpoint, "state of a training", "take an earlier one"):
        trained = read_checkpoint(checkpoint)["training"].get("effects")
    if trained is None or setting == "auto" or set(_named(setting)) == set(_named(trained)):
        return trained or setting
    raise InputError(
        f"{checkpoint}: was trained with --pipeline.model.effects {trained}; leave the option out to go on with it."
    )


def effects_setting(effects: tuple[str, ...]) -> str:
    """The setting that gives these effects whatever the dataset says."""
    return ",".join(effects) or "none"


def _named(setting: str) -> list[str]:
    return [] if setting in ("auto", "none") else setting.split(",")
