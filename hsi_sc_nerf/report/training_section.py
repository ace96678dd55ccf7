"""Section on the training: curves of loss, PSNR, learning rates and pose corrections."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hsi_sc_nerf.report.blocks import Figure, Missing, Section
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.logs import Scalars, shortened

_LOSSES, _RATES = "Train Loss Dict/", "learning_rate/"
_CORRECTIONS = {
    "Train Metrics Dict/camera_opt_rotation_deg": "rotation of the camera",
    "Train Metrics Dict/camera_opt_angle_max_deg": "largest of the table's angles",
}
# Terms of the loss that never reach this share of its largest value say nothing.
_LEAST_SHARE = 1e-5
_PSNR = {
    "Train Metrics Dict/psnr": "training rays",
    "Eval Images Metrics Dict (all images)/psnr": "all held-out views",
    "Eval Images Metrics/psnr": "one held-out view",
}


def training_section(scalars: Scalars, stage_ends: Mapping[str, int]) -> Section:
    """Curves of whatever was logged, with the ends of the stages.

    Args:
        scalars: `read_scalars` of the run.
        stage_ends: steps done at the end of each stage, by name.
    """
    if not scalars:
        missing = Missing("The run has no TensorBoard events.", "ns-train hsi-sc-nerf --vis viewer+tensorboard")
        return Section("training", "Training", [missing])
    marks = {f"end of {name}": float(end) for name, end in stage_ends.items()}

    def named(prefix: str) -> dict[str, str]:
        return {tag: tag.removeprefix(prefix).replace("_", " ") for tag in scalars if tag.startswith(prefix)}

    charts, titles = [], []
    for title, y_label, tags, logarithmic in (
        ("Loss of training batches", "weighted loss", {"Train Loss": "sum"} | named(_LOSSES), True),
        ("Peak signal-to-noise ratio", "PSNR (dB)", _PSNR, False),
        ("Learning rates", "learning rate", named(_RATES), True),
        ("Corrections of the poses", "correction (degrees)", _CORRECTIONS, False),
    ):
        curves = _curves(scalars, tags)
        if curves:
            charts.append(
                line_chart(
                    curves,
                    x_label="step",
                    y_label=y_label,
                    alt=f"{title} over the training steps",
                    logarithmic=logarithmic,
                    marks=marks,
                )
            )
            titles.append(title)
    caption = (
        "Terms of the loss are weighted and have no unit; those that stay tiny are left out. In the masked stage "
        "most training rays are the object's: its loss and PSNR do not compare with those of whole frames."
    )
    return Section("training", "Training", [Figure(charts, caption, titles, columns=2)])


def _curves(scalars: Scalars, tags: Mapping[str, str]) -> list[Curve]:
    """Curves of the tags that were logged, but for those that stay tiny beside the largest."""
    found = {name: scalars[tag] for tag, name in tags.items() if tag in scalars}
    heights = {name: np.nanmax(np.abs(values), initial=0.0) for name, (_, values) in found.items()}
    least = _LEAST_SHARE * max(heights.values(), default=0.0)
    return [Curve(name, *shortened(*curve)) for name, curve in found.items() if heights[name] > least]
