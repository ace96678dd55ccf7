"""Random pixels of memory-mapped cubes: a training batch reads those pixels and nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int


def gather_spectra(
    cubes: Sequence[np.ndarray], indices: Int[np.ndarray, "count 3"], scale: float
) -> Float[np.ndarray, "count bands"]:
    """Read the spectra at (frame, line, sample) ``indices`` from integer ``cubes`` and divide them by ``scale``."""
    spectra = np.empty((len(indices), cubes[0].shape[2]), np.float32)
    order = np.argsort(indices[:, 0], kind="stable")
    frames, starts = np.unique(indices[order, 0], return_index=True)
    for frame, rows in zip(frames, np.split(order, starts[1:]), strict=True):
        spectra[rows] = cubes[frame][indices[rows, 1], indices[rows, 2]]
    spectra /= scale
    return spectra


class PixelSampler:
    """Batches of random pixels of a set of frames; the same seed and step give the same batch.

    A resumed run therefore sees the batches that an uninterrupted one would have seen.

    Args:
        cubes: memory-mapped integer cubes (lines, samples, bands), one a frame.
        masks: foreground of each frame.
        scale: integer value of reflectance 1.
        num_rays_per_batch: pixels a batch.
        seed: part of every batch's seed.
    """

    def __init__(
        self,
        cubes: Sequence[np.ndarray],
        masks: Bool[np.ndarray, "frames lines samples"],
        scale: float,
        num_rays_per_batch: int,
        seed: int,
    ) -> None:
        self.cubes = cubes
        self.masks = masks
        self.scale = scale
        self.num_rays_per_batch = num_rays_per_batch
        self.seed = seed
        self._foreground = np.flatnonzero(masks)
        self._rest = np.flatnonzero(~masks)

    def sample(self, step: int, foreground_share: float | None = None) -> dict[str, np.ndarray]:
        """One batch.

        Args:
            step: training step.
            foreground_share: share of the pixels drawn from the foreground, the others from the rest of the
                frames; ``None`` draws evenly from whole frames.

        Returns:
            ``indices`` (count, 3) int64: frame, line, sample; ``spectral`` (count, bands) float32 reflectance;
            ``mask`` (count, 1) bool: foreground.
        """
        rng = np.random.default_rng((self.seed, step))
        count = self.num_rays_per_batch
        if foreground_share is None:
            flat = rng.integers(0, self.masks.size, count)
        else:
            in_foreground = round(count * foreground_share)
            flat = np.concatenate(
                [
                    self._foreground[rng.integers(0, len(self._foreground), in_foreground)],
                    self._rest[rng.integers(0, len(self._rest), count - in_foreground)],
                ]
            )
        indices = np.stack(np.unravel_index(flat, self.masks.shape), axis=1)
        return {
            "indices": indices,
            "spectral": gather_spectra(self.cubes, indices, self.scale),
            "mask": self.masks.reshape(-1)[flat, None],
        }
