"""A trainer of the tiny dataset, set up for a few steps; a pipeline as training would begin with."""

import copy
from pathlib import Path

import torch

from hsi_sc_nerf.config import hsi_sc_nerf

STEPS = 6


def shrink(model) -> None:
    """Settings of a model that is built and evaluated in tenths of a second."""
    model.match_resolution = False
    model.num_levels, model.log2_hashmap_size, model.max_res = 4, 10, 32
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (16, 8), 8


def trainer(
    tiny_dataset,
    folder,
    device="cpu",
    effects="view_dependence,still_chamber,pose_refinement",
    predict_normals=False,
    **changes,
):
    config = copy.deepcopy(hsi_sc_nerf.config)
    config.pipeline.datamanager.data = tiny_dataset[0]
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    model = config.pipeline.model
    shrink(model)
    config.output_dir, config.timestamp, config.vis = folder, "run", "tensorboard"
    config.machine.device_type = device
    config.max_num_iterations, config.evaluate_stages = STEPS, False
    model.effects, model.predict_normals = effects, predict_normals
    for key, value in changes.items():
        setattr(config, key, value)
    made = config.setup(local_rank=0, world_size=1)
    made.setup()
    return made


def untrained_pipeline(data: Path):
    """The pipeline of a dataset, in test mode."""
    config = copy.deepcopy(hsi_sc_nerf.config.pipeline)
    shrink(config.model)
    config.datamanager.data = config.datamanager.dataparser.data = data
    torch.manual_seed(0)
    return config.setup(device="cpu", test_mode="test")
