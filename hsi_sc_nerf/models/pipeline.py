"""nerfstudio's pipeline, which refuses weights of another dataset."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.models.occupancy_sampler import pixels_with_matter
from hsi_sc_nerf.models.spectral_model import SpectralModel

SCENE_BUFFERS = ("aabb", "axis_origin")
"""Buffers that place the scene; weights are meaningless in another scene box."""


@dataclass
class SpectralPipelineConfig(VanillaPipelineConfig):
    """Data and model of a run."""

    _target: type = field(default_factory=lambda: SpectralPipeline)


class SpectralPipeline(VanillaPipeline):
    """Data and model of a run."""

    datamanager: SpectralDataManager

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        grid = cast(SpectralModel, self.model).occupancy
        if grid is not None and self.test_mode == "val":  # nerfstudio's name for training
            metadata = self.datamanager.train_dataparser_outputs.metadata
            pixels = pixels_with_matter(grid, metadata["dataset"], metadata["frames"])
            self.datamanager.train_pixel_sampler.restrict_background(pixels)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load the weights of a checkpoint that was made with the same model settings and dataset.

        nerfstudio would load the weights that fit, into a scene box that may have moved since.
        """
        own = self.state_dict()
        different = own.keys() ^ loaded_state.keys()
        if different:
            raise SystemExit(
                "hsi-sc-nerf: the checkpoint was made with other settings of the model "
                f"({', '.join(sorted(different)[:3])}); take those of the config.yml beside it."
            )
        if any(
            value.shape != loaded_state[name].shape
            or (name.rpartition(".")[2] in SCENE_BUFFERS and not torch.equal(value.cpu(), loaded_state[name].cpu()))
            for name, value in own.items()
        ):
            raise SystemExit(
                f"hsi-sc-nerf: {self.datamanager.get_datapath()} is not the dataset that the checkpoint was trained "
                "on, or was processed anew since; train again, or process it with the settings of that time."
            )
        super().load_pipeline(loaded_state, step)

    def get_average_image_metrics(
        self,
        data_loader,
        image_prefix: str,
        step: int | None = None,
        output_path: Path | None = None,
        get_std: bool = False,
    ) -> dict[str, float]:
        """Mean and standard deviation of each metric over the views.

        The standard deviation over one view is 0; nerfstudio's is NaN, which JSON does not allow.
        """
        metrics = super().get_average_image_metrics(data_loader, image_prefix, step, output_path, get_std)
        # The length of nerfstudio's loader is that of its dataset, not of the views that it yields.
        if get_std and len(getattr(data_loader, "image_indices", data_loader)) == 1:
            metrics |= dict.fromkeys((name for name in metrics if name.endswith("_std")), 0.0)
        return metrics
