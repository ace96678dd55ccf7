"""The methods that nerfstudio discovers: `hsi-sc-nerf` and `hsi-sc-nerf-paper`.

nerfstudio discovers the data parser in `data.dataparser`.
"""

from __future__ import annotations

from typing import Any

from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, OptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from hsi_sc_nerf import paper
from hsi_sc_nerf.data.datamanager import SpectralDataManagerConfig
from hsi_sc_nerf.data.dataparser import SpectralDataParserConfig
from hsi_sc_nerf.models.checkpoints import allow_nerfstudio_checkpoints
from hsi_sc_nerf.models.optimizers import MuonOptimizerConfig
from hsi_sc_nerf.models.pipeline import SpectralPipeline, SpectralPipelineConfig
from hsi_sc_nerf.models.pose_refinement import PoseRefinementConfig
from hsi_sc_nerf.models.presets import ITERATIONS, PRESETS, RAYS, default_device
from hsi_sc_nerf.models.spectral_model import SpectralModelConfig
from hsi_sc_nerf.models.staged_trainer import StagedTrainerConfig
from hsi_sc_nerf.models.stages import StageConfig, full_frame_stage, masked_stage
from hsi_sc_nerf.nerfstudio_commands import extend_nerfstudio_commands
from hsi_sc_nerf.viewer.panel import attach_spectral_panel

allow_nerfstudio_checkpoints()
extend_nerfstudio_commands()


def pipeline_with_panel(config: SpectralPipelineConfig, **options) -> SpectralPipeline:
    """The pipeline of a run, with the viewer's spectral panel. Saved ``config.yml`` files name this function."""
    pipeline = SpectralPipeline(config, **options)
    attach_spectral_panel(pipeline)
    return pipeline


_BALANCED = PRESETS[default_device()]["balanced"]


def _adam(lr: float) -> OptimizerConfig:
    return AdamOptimizerConfig(lr=lr, eps=1e-15)


def _published_lr(step: int) -> float:
    """Factor on the learning rates in the paper's released schedule, which is longer than the run."""
    return paper.LEARNING_RATE_DECAY ** (step / paper.LEARNING_RATE_DECAY_STEPS)


def _method(
    method_name: str,
    datamanager: SpectralDataManagerConfig,
    model: SpectralModelConfig,
    optimizers: dict[str, OptimizerConfig],
    full_frame: StageConfig,
    masked: StageConfig,
    **options: Any,
) -> StagedTrainerConfig:
    """Configuration of a method's trainer, with all that the two methods have in common."""
    return StagedTrainerConfig(
        method_name=method_name,
        steps_per_save=2000,
        steps_per_eval_batch=500,
        steps_per_eval_image=5000,
        steps_per_eval_all_images=20_000,
        pipeline=SpectralPipelineConfig(_target=pipeline_with_panel, datamanager=datamanager, model=model),  # type: ignore[arg-type]
        # Without schedules: the stages scale the learning rates.
        optimizers={name: {"optimizer": optimizer, "scheduler": None} for name, optimizer in optimizers.items()},
        machine=MachineConfig(device_type=default_device()),
        # The progress bar of the stages replaces nerfstudio's table.
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False)),
        viewer=ViewerConfig(quit_on_train_completion=True),
        vis="viewer+tensorboard",
        full_frame=full_frame,
        masked=masked,
        **options,
    )


hsi_sc_nerf = MethodSpecification(
    config=_method(
        "hsi-sc-nerf",
        SpectralDataManagerConfig(train_num_rays_per_batch=_BALANCED[RAYS]),
        SpectralModelConfig(),
        {
            "fields": _adam(1.5e-2),
            "field_networks": MuonOptimizerConfig(),
            "proposal_networks": _adam(1e-2),
            "camera_opt": _adam(3e-4),
        },
        full_frame=full_frame_stage(),
        masked=masked_stage(),
        preset="balanced",
        max_num_iterations=_BALANCED[ITERATIONS],
    ),
    description="HSI-SC-NeRF: hyperspectral 3D reconstruction of turntable captures from a stationary camera.",
)

# The recipe of the paper's text and released settings; settings that neither names are nerfacto's defaults. It keeps
# an unbounded scene around a bounded object, no background, pose corrections that are discarded after the first
# stage, no background rays in the second stage, and learning rates that hardly fall.
hsi_sc_nerf_paper = MethodSpecification(
    config=_method(
        "hsi-sc-nerf-paper",
        SpectralDataManagerConfig(
            dataparser=SpectralDataParserConfig(scene="cameras"),
            train_num_rays_per_batch=paper.RAYS_PER_BATCH,
            eval_num_rays_per_batch=paper.RAYS_PER_BATCH,
        ),
        SpectralModelConfig(
            head="direct",
            effects="view_dependence",
            background="last-sample",
            supersample_outline=False,
            angular_loss="cosine",
            angular_loss_mult=paper.ANGULAR_LOSS_WEIGHT,
            distortion_loss_mult=paper.DISTORTION_LOSS_WEIGHT,
            near_plane=paper.NEAR_FAR[0],
            far_plane=paper.NEAR_FAR[1],
            disable_scene_contraction=False,
            proposal_initial_sampler="piecewise",
            num_proposal_iterations=2,
            num_proposal_samples_per_ray=(256, 96),
            num_nerf_samples_per_ray=48,
            proposal_net_args_list=[
                {"hidden_dim": 16, "log2_hashmap_size": 17, "num_levels": 5, "max_res": size, "use_linear": False}
                for size in (128, 256)
            ],
            predict_normals=True,
            match_resolution=False,
            num_levels=paper.HASH_LEVELS,
            max_res=paper.FINEST_GRID,
            log2_hashmap_size=paper.LOG2_HASH_TABLE,
            average_init_density=paper.INITIAL_DENSITY,
            use_appearance_embedding=True,
            camera_optimizer=PoseRefinementConfig(mode="free-discarded"),
        ),
        {
            **{name: _adam(paper.LEARNING_RATE) for name in ("fields", "field_networks", "proposal_networks")},
            "camera_opt": _adam(1e-3),
        },
        full_frame=StageConfig(
            name="full-frame",
            fraction=0.5,
            learn_after={},
            lr_end=_published_lr(paper.STAGE_ITERATIONS[0]),
            group_lr={"camera_opt": (1.0, 0.1)},
        ),
        masked=StageConfig(
            name="masked",
            fraction=0.5,
            foreground_ray_fraction=1.0,
            frozen_groups=("camera_opt",),
            learn_after={},
            lr_start=_published_lr(paper.STAGE_ITERATIONS[0]),
            lr_end=_published_lr(sum(paper.STAGE_ITERATIONS)),
        ),
        max_num_iterations=sum(paper.STAGE_ITERATIONS),
    ),
    description="HSI-SC-NeRF as published: the baseline that hsi-sc-nerf is measured against.",
)
