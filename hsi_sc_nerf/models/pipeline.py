"""nerfstudio's pipeline, which refuses weights of another dataset and judges views that show something."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import UInt8
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.models.floating_matter import CLEAR_EVERY, clear_floating_matter
from hsi_sc_nerf.models.hull_caps import clear_cap
from hsi_sc_nerf.models.occupancy_sampler import pixels_with_matter
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.stages import GROWN_AFTER

SCENE_BUFFERS = ("aabb", "axis_origin")
"""Buffers that place the scene; weights are meaningless in another scene box."""
_FRAMES = "frames"
"""Buffer of the frames' names: with other ones, training views could be held out and judged as unseen."""


@dataclass
class SpectralPipelineConfig(VanillaPipelineConfig):
    """Data and model of a run."""

    _target: type = field(default_factory=lambda: SpectralPipeline)


class SpectralPipeline(VanillaPipeline):
    """Data and model of a run."""

    datamanager: SpectralDataManager

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.register_buffer(_FRAMES, digest_of_frames(self.datamanager))
        if self.test_mode != "val":  # nerfstudio's name for training
            return
        model = cast(SpectralModel, self.model)
        self.datamanager.supersample_outline = model.config.supersample_outline
        if (grid := model.occupancy) is not None:
            metadata = self.datamanager.train_dataparser_outputs.metadata
            pixels = pixels_with_matter(grid, metadata["dataset"], metadata["frames"])
            self.datamanager.train_pixel_sampler.restrict_background(pixels)

    def prepare_step(self, step: int, part_of_last_stage: float | None) -> None:
        """Bring the model up to date before a step of training.

        In the last stage, when the surface has formed, what floats in the air is cleared now and then, and caps over
        hollows once opacity rises as far as it will.

        Args:
            step: of training.
            part_of_last_stage: fraction of the last stage that is done; None before it.
        """
        model = cast(SpectralModel, self.model)
        model.prepare_step(step)
        if part_of_last_stage is None or step == 0 or step % CLEAR_EVERY != 0 or model.occupancy is None:
            return
        if part_of_last_stage > GROWN_AFTER:
            clear_cap(model, self.datamanager, step)
        clear_floating_matter(model, self.datamanager, step)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load the weights of a checkpoint that was made with the same model settings and dataset.

        nerfstudio would load the weights that fit, into a scene box that may have moved since.
        """
        own = self.state_dict()
        loaded_state = {_FRAMES: own[_FRAMES]} | loaded_state  # earlier versions do not tell their frames
        different = own.keys() ^ loaded_state.keys()
        if different:
            raise SystemExit(
                "hsi-sc-nerf: the checkpoint was made with other settings of the model or by another version "
                f"({', '.join(sorted(different)[:3])}); take the settings of the config.yml beside it, or train anew."
            )
        if not torch.equal(own[_FRAMES].cpu(), loaded_state[_FRAMES].cpu()):
            raise SystemExit(
                f"hsi-sc-nerf: {self.datamanager.get_datapath()} has other frames than when the checkpoint was "
                "trained, or holds out other ones; put back what was removed or renamed, or train again."
            )
        if any(
            value.shape != loaded_state[name].shape
            or (name.rpartition(".")[2] in SCENE_BUFFERS and not torch.equal(value.cpu(), loaded_state[name].cpu()))
            for name, value in own.items()
        ):
            raise SystemExit(
                f"hsi-sc-nerf: {self.datamanager.get_datapath()} is not the dataset that the checkpoint was trained "
                "on, or was processed anew since, or another version made the checkpoint; train again, or process "
                "the session with the settings of that time."
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
        """Mean and standard deviation of each metric over the views that show something of the object.

        The standard deviation over one view is 0; nerfstudio's is NaN, which JSON does not allow. A training goes on
        where no view can be judged, and gets no metrics.

        Raises:
            SystemExit: no view can be judged, and this is no training.
        """
        views = _JudgedViews(data_loader)
        metrics: dict[str, float] = {}
        if views:
            metrics = super().get_average_image_metrics(views, image_prefix, step, output_path, get_std)
        if told := views.left_out():
            if not metrics and self.test_mode != "val":  # nerfstudio's name for training
                raise SystemExit(f"hsi-sc-nerf: {told}")
            CONSOLE.print(f"[yellow]{told}", soft_wrap=True)
        if get_std and views.judged == 1:
            metrics |= dict.fromkeys((name for name in metrics if name.endswith("_std")), 0.0)
        return {name: value for name, value in metrics.items() if not math.isnan(value)}


def digest_of_frames(manager: SpectralDataManager) -> UInt8[torch.Tensor, "32"]:
    """SHA-256 of the names of a dataset's frames, in their order, and of those that are trained on."""
    metadata = manager.train_dataparser_outputs.metadata
    names = [[frame.capture for frame in frames] for frames in (metadata["dataset"].frames, metadata["frames"])]
    return torch.tensor(list(hashlib.sha256(json.dumps(names).encode()).digest()), dtype=torch.uint8)


class _JudgedViews:
    """Those of a loader's held-out views that show something of the object that was measured, one at a time."""

    def __init__(self, loader: Any) -> None:
        self._loader = loader
        self.judged, self._seen = 0, 0
        self._views = self._each()
        self._first = next(self._views, None)

    def __bool__(self) -> bool:
        return self._first is not None

    def __len__(self) -> int:
        return len(self._loader)

    def __iter__(self) -> Iterator[tuple[Cameras, dict]]:
        first, self._first = self._first, None
        return chain(() if first is None else (first,), self._views)

    def _each(self) -> Iterator[tuple[Cameras, dict]]:
        for camera, batch in self._loader:
            self._seen += 1
            shown = batch["mask"][..., 0].bool()
            if (batch["valid"][shown] if "valid" in batch else shown).any():
                self.judged += 1
                yield camera, batch

    def left_out(self) -> str:
        """What to say of the views that were left out, once all were to be rendered."""
        if self.judged == self._seen:
            return ""
        which = "none" if self.judged == 0 else f"{self.judged}"
        return (
            f"{which} of {self._seen} held-out views show anything of the object that was measured, and the others "
            "have no score; look at their masks in the dataset's report/."
        )
