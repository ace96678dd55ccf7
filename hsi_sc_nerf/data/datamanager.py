"""nerfstudio data manager: training rays with their spectra, read from the cubes on disk pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
import tyro
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from nerfstudio.model_components.ray_generators import RayGenerator

from hsi_sc_nerf.data.dataparser import SpectralDataParserConfig
from hsi_sc_nerf.data.dataset import SpectralDataset
from hsi_sc_nerf.data.device_pixels import CameraRays, DevicePixels, fits_on_gpu
from hsi_sc_nerf.data.pixels import PixelReader, PixelSampler, spread_over


@dataclass
class SpectralDataManagerConfig(VanillaDataManagerConfig):
    """Configuration of the data manager."""

    _target: type = field(default_factory=lambda: SpectralDataManager)
    dataparser: SpectralDataParserConfig = field(default_factory=SpectralDataParserConfig)
    train_num_rays_per_batch: int = 2048
    """Rays of a training step."""
    eval_num_rays_per_batch: int = 2048
    """Rays of an evaluation step during training."""
    seed: int = 0
    """Seed of the random pixels."""
    hold_on_gpu: bool = True
    """Hold the training cubes in a GPU's memory where they fill no more than half of what is free there. False, and
    without a GPU: every batch is read from the files."""
    # Pixels are read from the cubes on disk one by one: these options of nerfstudio's have nothing to act on.
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


class SpectralDataManager(VanillaDataManager[SpectralDataset]):
    """Random pixels of the cubes on disk; nothing is cached but the masks, unless the cubes fit on a GPU.

    Attributes:
        foreground_share: share of the training rays that hit the foreground; ``None`` for whole frames. The
            trainer sets it by stage.
        rim_share: share of the others that pass just beside it; likewise.
    """

    config: SpectralDataManagerConfig
    train_pixel_sampler: PixelSampler  # type: ignore[assignment]
    eval_pixel_sampler: PixelSampler  # type: ignore[assignment]
    foreground_share: float | None = None
    rim_share: float = 0.0

    def _pixels(self, dataset: SpectralDataset, num_rays: int) -> PixelSampler:
        return PixelSampler(
            PixelReader(frame.cube() for frame in dataset.frames),
            np.stack([frame.mask() for frame in dataset.frames]),
            num_rays_per_batch=num_rays,
            seed=self.config.seed,
            has_flagged=dataset.has_flagged,
        )

    def setup_train(self) -> None:
        """Open the training cubes."""
        self.train_pixel_sampler = self._pixels(self.train_dataset, self.config.train_num_rays_per_batch)
        cameras = self.train_dataset.cameras.to(self.device)
        self.train_ray_generator = RayGenerator(cameras)
        self._held: DevicePixels | None = None
        if self.config.hold_on_gpu and fits_on_gpu(self.train_dataset.frames, torch.device(self.device)):
            masks, flagged = self.train_pixel_sampler.masks, self.train_dataset.has_flagged
            self._held = DevicePixels(self.train_dataset.frames, masks, self.device, has_flagged=flagged)
            self._rays = CameraRays(cameras)

    def setup_eval(self) -> None:
        """Open the held-out cubes."""
        self.eval_pixel_sampler = self._pixels(self.eval_dataset, self.config.eval_num_rays_per_batch)
        self.eval_ray_generator = RayGenerator(self.eval_dataset.cameras.to(self.device))
        # A view in which the object was not found has nothing to be judged by: it would score as perfect.
        judged = np.flatnonzero(self.eval_pixel_sampler.masks.any(axis=(1, 2))).tolist()
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(
            input_dataset=self.eval_dataset,
            image_indices=tuple(judged or range(len(self.eval_dataset))),  # type: ignore[arg-type]
            device=self.device,
        )
        # Pictures in the logs show the same view every time, so that they can be compared.
        self.eval_dataloader = FixedIndicesEvalDataloader(  # type: ignore[assignment]
            input_dataset=self.eval_dataset, image_indices=(0,), device=self.device
        )

    def next_train(self, step: int) -> tuple[RayBundle, dict]:
        """The training batch of ``step``: always the same for the same step, stage and seed."""
        self.train_count += 1
        if self._held is not None:
            places = self.train_pixel_sampler.draw(step, self.foreground_share, self.rim_share)
            indices = torch.from_numpy(places).pin_memory().to(self.device, non_blocking=True)
            return self._rays(indices), self._held(indices)
        batch = self.train_pixel_sampler.sample(step, self.foreground_share, self.rim_share)
        return self._with_rays(batch, self.train_ray_generator)

    def next_eval(self, step: int) -> tuple[RayBundle, dict]:
        """Random pixels of held-out views."""
        self.eval_count += 1
        return self._with_rays(self.eval_pixel_sampler.sample(step), self.eval_ray_generator)

    def fixed_eval_pixels(self, count: int = 4) -> tuple[RayBundle, dict]:
        """Some pixels of the object in the first held-out view (of all of it, where it has none), always the same."""
        mask = self.eval_pixel_sampler.masks[:1]
        indices = spread_over(mask if mask.any() else ~mask, count)
        return self._with_rays(self.eval_pixel_sampler.at(indices), self.eval_ray_generator)

    def _with_rays(self, pixels: dict[str, np.ndarray], generator: RayGenerator) -> tuple[RayBundle, dict]:
        batch = {key: torch.from_numpy(value) for key, value in pixels.items()}
        return generator(batch["indices"]), batch
