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
from hsi_sc_nerf.packed.pixels import PixelReader, PixelSampler, spread_over


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
    """Random pixels of the cubes on disk; nothing is cached but the masks.

    Attributes:
        foreground_ray_fraction: fraction of the training rays that hit the foreground; None for whole frames. The
            trainer sets it by stage.
        boundary_ray_fraction: fraction of the others that pass just beside the foreground; likewise.
    """

    config: SpectralDataManagerConfig
    train_pixel_sampler: PixelSampler  # type: ignore[assignment]
    eval_pixel_sampler: PixelSampler  # type: ignore[assignment]
    foreground_ray_fraction: float | None = None
    boundary_ray_fraction: float = 0.0

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
        self.train_ray_generator = RayGenerator(self.train_dataset.cameras.to(self.device))

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
        batch = self.train_pixel_sampler.sample(step, self.foreground_ray_fraction, self.boundary_ray_fraction)
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
