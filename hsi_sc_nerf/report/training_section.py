"""Section on the training: curves of loss, PSNR, learning rates and pose corrections."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hsi_sc_nerf.report.blocks import Block, Figure, Missing, Section
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.logs import Scalars, shortened

_LOSSES, _RATES = "Train Loss Dict/", "learning_rate/"
_TRAIN_PSNR = "Train Metrics Dict/psnr"
_CORRECTIONS = ("Train Metrics Dict/camera_opt_rotation_deg", "Train Metrics Dict/camera_opt_angle_max_deg")
_HELD_OUT_PSNR = ("Eval Images Metrics Dict (all images)/psnr", "Eval Images Metrics/psnr")


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

    charts = (
        (
            {"Train Loss": "sum"} | named(_LOSSES),
            "loss",
            True,
            "Loss of the training batches: the weighted terms and their sum; no unit.",
        ),
        (
            {_TRAIN_PSNR: "training rays", **dict.fromkeys(_HELD_OUT_PSNR, "held-out views")},
            "PSNR (dB)",
            False,
            "Peak signal-to-noise ratio over all bands, dB. In the masked stage most rays are the object's, which is "
            "harder than the chamber: the curve drops there.",
        ),
        (named(_RATES), "learning rate", True, "Learning rates of the groups of parameters."),
        (
            {tag: tag.rpartition("/")[2].removeprefix("camera_opt_").replace("_", " ") for tag in _CORRECTIONS},
            "correction (degrees)",
            False,
            "Corrections of the poses: of the camera's rotation, and the largest of the turntable's angles.",
        ),
    )
    blocks: list[Block] = []
    for tags, y_label, logarithmic, caption in charts:
        curves = [
            Curve(name, *shortened(*scalars[tag])) for tag, name in tags.items() if np.any(_values(scalars, tag) != 0)
        ]
        if curves:
            alt = f"{y_label} over the training steps"
            chart = line_chart(curves, x_label="step", y_label=y_label, alt=alt, logarithmic=logarithmic, marks=marks)
            blocks.append(Figure([chart], caption))
    return Section("training", "Training", blocks)


def _values(scalars: Scalars, tag: str) -> np.ndarray:
    """Values of a tag, none where it was not logged."""
    return scalars[tag][1] if tag in scalars else np.zeros(0)
