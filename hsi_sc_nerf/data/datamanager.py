"""nerfstudio data manager and dataset: training rays with their spectra, and whole held-out views."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
import tyro
from jaxtyping import Int
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader

from hsi_sc_nerf.data.camera_rays import CameraRays
from hsi_sc_nerf.data.dataparser import SpectralDataParserConfig
from hsi_sc_nerf.data.device_pixels import DevicePixels, fits_on_gpu
from hsi_sc_nerf.errors import one_sentence
from hsi_sc_nerf.packed.cube import unpack, unpack_unflagged
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame
from hsi_sc_nerf.packed.pixels import PixelReader, PixelSampler
from hsi_sc_nerf.settings_file import between, check_options

FROM_CHECKPOINT = "from_checkpoint"
"""Metadata of the training frames: whether a checkpoint replaces what a model finds in them before training."""

OUTLINE_DENSITY = 0.5
"""How often pixels on the outline are drawn compared with others, if four rays show each: half as often, training is
as good (docs/notes/dead_ends.md)."""


@dataclass
class SpectralDataManagerConfig(VanillaDataManagerConfig):
    """Configuration of the data manager."""

    _target: type = field(default_factory=lambda: SpectralDataManager)
    dataparser: SpectralDataParserConfig = field(default_factory=SpectralDataParserConfig)
    train_num_rays_per_batch: int = between(1, math.inf, default=2048)
    """Rays of a training step."""
    eval_num_rays_per_batch: int = between(1, math.inf, default=2048)
    """Rays of an evaluation step during training."""
    seed: int = 0
    """Seed of the random pixels."""
    hold_on_gpu: bool = True
    """Keep the training cubes in GPU memory if they fill at most half of what is free there. Otherwise, and without a
    GPU, every batch is read from the files."""
    # Pixels are read from the cubes on disk one by one, so these options of nerfstudio have no effect.
    camera_res_scale_factor: tyro.conf.Suppress[float] = 1.0
    images_on_gpu: tyro.conf.Suppress[bool] = False
    masks_on_gpu: tyro.conf.Suppress[bool] = False
    patch_size: tyro.conf.Suppress[int] = 1
    pixel_sampler: tyro.conf.Suppress[PixelSamplerConfig] = field(default_factory=PixelSamplerConfig)
    train_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    train_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    eval_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_image_indices: tyro.conf.Suppress[tuple[int, ...] | None] = (0,)

    def __post_init__(self) -> None:
        with one_sentence():
            check_options(self)


class SpectralDataset(InputDataset):
    """Frames of a packed dataset.

    An item holds ``spectral`` (lines, samples, bands) beside ``image`` and ``mask`` and, where the dataset has
    flagged values, ``valid`` (likewise, bool): which of them are measurements.
    """

    @property
    def frames(self) -> list[PackedFrame]:
        """The frames, in the cameras' order."""
        return self._dataparser_outputs.metadata["frames"]

    @property
    def has_flagged(self) -> bool:
        """Whether some of the dataset's values are not measurements."""
        return self._dataparser_outputs.metadata["dataset"].flagged_values > 0

    def get_metadata(self, data: dict) -> dict:
        """The reflectance cube of the item."""
        counts = self.frames[data["image_idx"]].cube()
        if not self.has_flagged:
            return {"spectral": torch.from_numpy(unpack_unflagged(counts))}
        reflectance, valid = unpack(counts)
        return {"spectral": torch.from_numpy(reflectance), "valid": torch.from_numpy(valid)}


class SpectralDataManager(VanillaDataManager[SpectralDataset]):
    """Random pixels of the cubes on disk; only the masks are kept in memory, and the cubes if they fit on a GPU.

    Attributes:
        foreground_ray_fraction: fraction of the training rays that hit the foreground; None for whole frames. The
            trainer sets it by stage.
        boundary_ray_fraction: fraction of the others that pass just beside the foreground; likewise.
        supersample_outline: give `QUARTERS` rays for each training pixel on the outline of the foreground; these are
            the last of a batch. The pipeline sets it for training.
    """

    config: SpectralDataManagerConfig
    train_pixel_sampler: PixelSampler  # type: ignore[assignment]
    eval_pixel_sampler: PixelSampler  # type: ignore[assignment]
    foreground_ray_fraction: float | None = None
    boundary_ray_fraction: float = 0.0
    supersample_outline: bool = False

    def create_train_dataset(self) -> SpectralDataset:
        """The training frames; their metadata tell whether the model's weights will be those of a checkpoint."""
        dataset = super().create_train_dataset()
        dataset.metadata[FROM_CHECKPOINT] = self.test_mode != "val"  # nerfstudio's name for training
        return dataset

    def setup_train(self) -> None:
        """Open the training cubes."""
        self.train_pixel_sampler = self._pixel_sampler(self.train_dataset, self.config.train_num_rays_per_batch)
        self._train_rays = CameraRays(self.train_dataset.cameras.to(self.device))
        self._held: DevicePixels | None = None
        if self.config.hold_on_gpu and fits_on_gpu(self.train_dataset.frames, torch.device(self.device)):
            masks, flagged = self.train_pixel_sampler.masks, self.train_dataset.has_flagged
            self._held = DevicePixels(self.train_dataset.frames, masks, self.device, has_flagged=flagged)

    def setup_eval(self) -> None:
        """Open the held-out cubes."""
        self.eval_pixel_sampler = self._pixel_sampler(self.eval_dataset, self.config.eval_num_rays_per_batch)
        self._eval_rays = CameraRays(self.eval_dataset.cameras.to(self.device))
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(
            input_dataset=self.eval_dataset, device=self.device
        )
        # Pictures in the logs show the same view every time, so that they can be compared.
        self.eval_dataloader = FixedIndicesEvalDataloader(  # type: ignore[assignment]
            input_dataset=self.eval_dataset, image_indices=(0,), device=self.device
        )

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """The rays and pixels of ``step``: the same for the same step, stage and seed.

        nerfstudio's exporters ask for step 0 again and again: they get other pixels of the object each time.
        """
        self.train_count += 1
        if self.test_mode != "val":  # nerfstudio's name for training
            step, self.foreground_ray_fraction = self.train_count, 1.0
        sampler = self.train_pixel_sampler
        density = OUTLINE_DENSITY if self.supersample_outline else 1.0
        fractions = (self.foreground_ray_fraction, self.boundary_ray_fraction, density)
        pixels, on_outline = sampler.draw(step, *fractions)
        quartered = on_outline if self.supersample_outline else 0
        if self._held is not None:
            indices = torch.from_numpy(pixels).pin_memory().to(self.device, non_blocking=True)
            return self._train_rays(indices, quartered), self._held(indices)
        return self.training_pixels(pixels, quartered)

    def training_pixels(self, pixels: Int[np.ndarray, "count 3"], quartered: int = 0) -> tuple[RayBundle, dict]:
        """The rays and contents of pixels (frame, line, sample) of training frames, as read from disk."""
        return self._train_rays(torch.from_numpy(pixels), quartered), _tensors(self.train_pixel_sampler.at(pixels))

    def next_eval(self, step: int) -> tuple[RayBundle, dict]:
        """Random pixels of held-out views."""
        self.eval_count += 1
        batch = _tensors(self.eval_pixel_sampler.sample(step))
        return self._eval_rays(batch["indices"]), batch

    def _pixel_sampler(self, dataset: SpectralDataset, num_rays: int) -> PixelSampler:
        packed: PackedDataset = dataset.metadata["dataset"]
        return PixelSampler(
            PixelReader(packed.cube_of(frame) for frame in dataset.frames),
            np.stack([packed.mask_of(frame) for frame in dataset.frames]),
            num_rays_per_batch=num_rays,
            seed=self.config.seed,
            has_flagged=dataset.has_flagged,
        )


def _tensors(pixels: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {key: torch.from_numpy(value) for key, value in pixels.items()}
