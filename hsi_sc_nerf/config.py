"""What nerfstudio discovers: the method `hsi-sc-nerf`. (Its data parser is found in `data.dataparser`.)"""

from __future__ import annotations

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from hsi_sc_nerf import paper
from hsi_sc_nerf.data.datamanager import SpectralDataManagerConfig
from hsi_sc_nerf.export.nerfstudio_adapter import extend_export_point_cloud
from hsi_sc_nerf.models.checkpoints import allow_nerfstudio_checkpoints
from hsi_sc_nerf.models.pipeline import SpectralPipelineConfig
from hsi_sc_nerf.models.spectral_model import SpectralModelConfig
from hsi_sc_nerf.models.staged_trainer import StagedTrainerConfig

allow_nerfstudio_checkpoints()
extend_export_point_cloud()


def _adam(lr: float) -> dict:
    """An optimiser whose learning rate the stages scale; nerfstudio's own schedules stay off."""
    return {"optimizer": AdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": None}


hsi_sc_nerf = MethodSpecification(
    config=StagedTrainerConfig(
        method_name="hsi-sc-nerf",
        max_num_iterations=sum(paper.STAGE_ITERATIONS),
        steps_per_save=2000,
        steps_per_eval_batch=500,
        steps_per_eval_image=5000,
        steps_per_eval_all_images=20_000,
        pipeline=SpectralPipelineConfig(datamanager=SpectralDataManagerConfig(), model=SpectralModelConfig()),
        optimizers={"fields": _adam(1e-2), "proposal_networks": _adam(1e-2), "camera_opt": _adam(3e-4)},
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        # The progress bar of the stages takes the place of nerfstudio's table of lines.
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False)),
        viewer=ViewerConfig(quit_on_train_completion=True),
        vis="viewer+tensorboard",
    ),
    description="HSI-SC-NeRF: hyperspectral 3D reconstruction of turntable captures from a stationary camera.",
)
