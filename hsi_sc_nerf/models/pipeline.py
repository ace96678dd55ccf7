"""nerfstudio's pipeline, with an evaluation that also holds for a single held-out view."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig


@dataclass
class SpectralPipelineConfig(VanillaPipelineConfig):
    """Data and model of a run."""

    _target: type = field(default_factory=lambda: SpectralPipeline)


class SpectralPipeline(VanillaPipeline):
    """Differs from nerfstudio's only in the spread over one view."""

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
        metrics = super().get_average_image_metrics(data_loader, image_prefix, step, output_path, get_std)
        if get_std and len(data_loader) == 1:
            metrics |= dict.fromkeys((name for name in metrics if name.endswith("_std")), 0.0)
        return metrics
