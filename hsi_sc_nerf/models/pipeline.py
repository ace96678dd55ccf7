"""nerfstudio's pipeline, whose evaluation uses averaged weights where there are any and holds for a single view."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from torch import Tensor

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.models.training_log import draw_spectra
from hsi_sc_nerf.models.weight_average import WeightAverage

# Buffers that place the scene in the model: weights mean nothing in another box.
_PLACES = ("aabb", "axis_origin")


@dataclass
class SpectralPipelineConfig(VanillaPipelineConfig):
    """Data and model of a run."""

    _target: type = field(default_factory=lambda: SpectralPipeline)


class SpectralPipeline(VanillaPipeline):
    """Data and model of a run, and how the model is evaluated.

    Attributes:
        weight_average: what is evaluated in place of the weights; the trainer sets it. None: the weights.
    """

    datamanager: SpectralDataManager
    weight_average: WeightAverage | None = None

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint's weights, if they belong to these settings and to the dataset as it is.

        nerfstudio would load what fits and leave the rest; a scene box that moved since training would fit.
        """
        own = self.state_dict()
        unlike = own.keys() ^ loaded_state.keys()
        if unlike:
            raise SystemExit(
                "hsi-sc-nerf: the checkpoint was made with other settings of the model "
                f"({', '.join(sorted(unlike)[:3])}); take those of the config.yml beside it."
            )
        if any(
            value.shape != loaded_state[name].shape
            or (name.rpartition(".")[2] in _PLACES and not torch.equal(value.cpu(), loaded_state[name].cpu()))
            for name, value in own.items()
        ):
            raise SystemExit(
                f"hsi-sc-nerf: {self.datamanager.get_datapath()} is not the dataset that the checkpoint was trained "
                "on, or was processed anew since; train again, or process it with the settings of that time."
            )
        super().load_pipeline(loaded_state, step)

    def averaged(self) -> AbstractContextManager[None]:
        """The model has its averaged weights within this context, where there are any."""
        return nullcontext() if self.weight_average is None else self.weight_average.in_use()

    def get_eval_loss_dict(self, step: int) -> tuple[dict, dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of random pixels of held-out views."""
        with self.averaged():
            return super().get_eval_loss_dict(step)

    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Metrics and pictures of one held-out view, and the spectra of some of its pixels."""
        with self.averaged():
            metrics, images = super().get_eval_image_metrics_and_images(step)
            images["spectra"] = self._spectra_picture()
        return metrics, images

    def _spectra_picture(self) -> Float[Tensor, "h w 3"]:
        rays, batch = self.datamanager.fixed_eval_pixels()
        self.eval()
        with torch.no_grad():
            rendered = self.model(rays)["spectral"].cpu()
        self.train()
        return draw_spectra(
            self.datamanager.eval_dataset.metadata["wavelengths_nm"],
            batch["spectral"],
            rendered,
            [f"line {line}, sample {sample}" for _, line, sample in batch["indices"].tolist()],
            batch.get("valid"),
        )

    def get_average_image_metrics(
        self,
        data_loader,
        image_prefix: str,
        step: int | None = None,
        output_path: Path | None = None,
        get_std: bool = False,
    ) -> dict[str, float]:
        """Mean and standard deviation of each metric over the views; the spread of one view is 0.

        nerfstudio's is NaN there, which no JSON reader takes.
        """
        with self.averaged():
            metrics = super().get_average_image_metrics(data_loader, image_prefix, step, output_path, get_std)
        # nerfstudio's loader counts all views of its dataset, whichever it is to give.
        if get_std and len(getattr(data_loader, "image_indices", data_loader)) == 1:
            metrics |= dict.fromkeys((name for name in metrics if name.endswith("_std")), 0.0)
        return metrics
