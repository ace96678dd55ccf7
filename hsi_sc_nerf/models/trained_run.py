"""A trained run opened for export: its model, its data, and the transform between metres and scene units."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.engine.trainer import TrainerConfig

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.checkpoints import find_checkpoint, require_model
from hsi_sc_nerf.models.run_settings import read_config, relocated_run, require_method
from hsi_sc_nerf.models.spectral_model import SpectralModel, SpectralModelConfig
from hsi_sc_nerf.packed.dataset import PackedDataset


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A model in evaluation mode with the data that it was trained on.

    Attributes:
        model: model with the weights of the latest checkpoint.
        manager: data manager of its training and held-out frames.
    """

    model: SpectralModel
    manager: SpectralDataManager

    @property
    def dataset(self) -> PackedDataset:
        """The packed dataset."""
        return self.manager.train_dataparser_outputs.metadata["dataset"]

    @property
    def scale(self) -> float:
        """Scene units per metre."""
        return self.manager.train_dataparser_outputs.dataparser_scale

    @property
    def centre_m(self) -> Float[np.ndarray, "3"]:
        """Origin of the scene in the object frame."""
        return -self.manager.train_dataparser_outputs.dataparser_transform[:, 3].numpy().astype(float)

    def to_scene(self, points_m: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in the object frame (metres) in scene units."""
        return (points_m - self.centre_m) * self.scale

    def to_metres(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points in scene units in the object frame (metres)."""
        return points / self.scale + self.centre_m

    @torch.no_grad()
    def refined_poses_m(self) -> Float[np.ndarray, "frames 4 4"]:
        """Refined camera-to-world of every frame, held-out ones included (object frame, metres)."""
        poses = self.dataset.camera_to_worlds
        poses[:, :3, 3] = self.to_scene(poses[:, :3, 3])
        device = self.model.device
        measured = torch.from_numpy(poses).float().to(device)
        refined = self.model.camera_optimizer.corrected(torch.arange(len(poses), device=device), measured)
        result = refined.cpu().numpy().astype(float)
        result[:, :3, 3] = self.to_metres(result[:, :3, 3])
        return result


def open_trained_run(load_config: Path) -> TrainedRun:
    """Open a run of hsi-sc-nerf by its ``config.yml``, with its latest checkpoint.

    Raises:
        InputError: there is no such file, it is no run of this version of hsi-sc-nerf, or there is no checkpoint.

    Example:
        >>> run = open_trained_run(Path("outputs/pear/hsi-sc-nerf/2026-11-22_101500/config.yml"))
        >>> run.to_metres(np.zeros(3))  # the centre of the scene in the object frame
    """
    config = read_config(load_config)
    if not isinstance(config.pipeline.model, SpectralModelConfig):
        raise InputError(f"{load_config}: is not a run of hsi-sc-nerf; give the config.yml of one.")
    from nerfstudio.utils.eval_utils import eval_setup  # which imports the plugins, and so this file

    require_method(config, load_config)
    folder = relocated_run(config, load_config).get_checkpoint_dir()
    latest = find_checkpoint(folder, remedy="the run has saved none, so train it again")
    require_model(latest)

    def found(settings: TrainerConfig) -> TrainerConfig:
        settings.load_step = int(latest.stem.removeprefix("step-"))  # nerfstudio would look at all files
        return relocated_run(settings, load_config)

    _, pipeline, _, _ = eval_setup(load_config, update_config_callback=found)
    return TrainedRun(cast(SpectralModel, pipeline.model), cast(SpectralDataManager, pipeline.datamanager))
