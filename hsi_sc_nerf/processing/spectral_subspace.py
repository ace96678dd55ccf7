"""Low-rank basis of a session's spectra, from the singular values above the noise.

The field emits a few coefficients a sample instead of a value in every band. The mean is not subtracted, because a
ray mixes spectra with weights whose sum is below 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.cube import REFLECTANCE_SCALE, ReflectanceUncertainty
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame
from hsi_sc_nerf.packed.pixels import PixelReader, PixelSampler

MIN_SPECTRA = 64
"""Fewer spectra determine neither noise nor rank."""
MAX_RANK = 16
"""Largest number of directions above the noise that is taken."""
_NOISE_DRAWS = 3
# Bands on each side that predict a band where its noise is estimated from the spectra alone.
_NEIGHBOUR_BANDS = 12
# Standard deviation of the error of rounding a reflectance to a packed cube's numbers.
_ROUNDING_NOISE = 1.0 / (REFLECTANCE_SCALE * np.sqrt(12.0))


@dataclass(frozen=True, eq=False)
class SpectralSubspace:
    """An orthonormal basis of a session's spectra.

    Attributes:
        basis: orthonormal columns, in the order of the spectra's energy along them.
        mean_spectrum: mean of the spectra, projected.
    """

    basis: Float[np.ndarray, "bands rank"]
    mean_spectrum: Float[np.ndarray, "bands"]

    @property
    def scaled_basis(self) -> Float[np.ndarray, "bands rank"]:
        """The basis with columns of root mean square 1, whose coefficients the field emits.

        The mean squared error over the bands is then the sum of the coefficients' squared errors. Coefficients that
        are all scaled to 1 would give the shape of a spectrum far smaller gradients than its brightness.
        """
        return self.basis * np.sqrt(len(self.basis))

    @property
    def mean_coefficients(self) -> Float[np.ndarray, "rank"]:
        """Coefficients of the mean spectrum in ``scaled_basis``."""
        return self.mean_spectrum @ self.basis / np.sqrt(len(self.basis))


def training_subspace(
    dataset: PackedDataset, frames: Sequence[PackedFrame], rank: int | None = None
) -> SpectralSubspace:
    """The subspace of training pixels, half of which lie on the object.

    Args:
        dataset: its uncertainty is the noise; where it has none, the noise is estimated from the spectra.
        rank: size of the basis; None for as many directions as stand out of the noise.

    Raises:
        InputError: too few pixels are free of flagged values, or there are fewer bands than ``rank``.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> training_subspace(dataset, dataset.frames[:-1]).basis.shape
        (204, 9)
    """
    spectra, valid = sample_training_spectra(frames)
    noise = None if dataset.uncertainty is None else pixel_noise(dataset.uncertainty, spectra)
    return find_subspace(spectra, noise, valid, rank)


def find_subspace(
    spectra: Float[np.ndarray, "n bands"],
    noise: Float[np.ndarray, "*n bands"] | None = None,
    valid: Bool[np.ndarray, "n bands"] | None = None,
    rank: int | None = None,
) -> SpectralSubspace:
    """The subspace of spectra above their noise.

    Spectra are divided by the noise of their bands and of their rows. A direction counts if its singular value
    exceeds the largest one of simulated noise with the same standard deviations (parallel analysis, Horn 1965).

    Args:
        noise: standard deviation of each value or of each band, above 0; None to estimate it (`estimate_noise`).
        valid: which values are measurements; spectra with any other are left out. All if not given.
        rank: number of directions, from the strongest on; None for those that count, at most `MAX_RANK`.

    Raises:
        InputError: too few spectra have all bands, or there are fewer bands than ``rank``.
        ValueError: the noise is not above 0.
    """
    complete = np.ones(len(spectra), bool) if valid is None else valid.all(axis=1)
    if complete.sum() < MIN_SPECTRA:
        raise InputError(
            f"only {complete.sum()} of {len(spectra)} sampled spectra are free of flagged values, and a spectral "
            f"basis needs {MIN_SPECTRA}; calibration.json in the dataset counts the flags of each band: list the "
            "worst bands as bad (bbl) in the headers and process again, or train with --pipeline.model.head direct."
        )
    sample = spectra[complete].astype(np.float64)
    deviation = estimate_noise(sample) if noise is None else np.broadcast_to(noise, spectra.shape)[complete]
    deviation = np.broadcast_to(deviation, sample.shape).astype(np.float64)
    if not (deviation > 0.0).all():
        raise ValueError("the standard deviation of the noise is not above 0 everywhere")

    band_noise = np.sqrt(np.mean(deviation**2, axis=0))
    noise_scale = band_noise * np.sqrt(np.mean((deviation / band_noise) ** 2, axis=1, keepdims=True))
    # The triangle of a QR decomposition has the singular values and directions of the whole.
    _, singular, directions = np.linalg.svd(np.linalg.qr(sample / noise_scale, mode="r"))
    if rank is None:
        above_noise = int((singular > _largest_noise_value(deviation / noise_scale)).sum())
        rank = max(1, min(above_noise, MAX_RANK))
    elif rank > len(singular):
        raise InputError(
            f"the dataset has {len(singular)} bands, too few for a basis of {rank} spectra; take a smaller "
            "--pipeline.model.basis-size."
        )

    span, _ = np.linalg.qr((directions[:rank] * band_noise).T)
    _, _, rotation = np.linalg.svd(sample @ span, full_matrices=False)
    basis = span @ rotation.T
    basis *= np.where((sample @ basis).sum(axis=0) < 0.0, -1.0, 1.0)
    return SpectralSubspace(basis, mean_spectrum=basis @ (basis.T @ sample.mean(axis=0)))


def _largest_noise_value(deviation: Float[np.ndarray, "n bands"]) -> float:
    """Largest singular value of simulated noise with these standard deviations."""
    rng = np.random.default_rng(0)
    draws = [deviation * rng.standard_normal(deviation.shape) for _ in range(_NOISE_DRAWS)]
    return float(max(np.sqrt(np.linalg.eigvalsh(draw.T @ draw)[-1]) for draw in draws))


def estimate_noise(spectra: Float[np.ndarray, "n bands"]) -> Float[np.ndarray, "bands"]:
    """Standard deviation of each band's noise, estimated from the spectra alone.

    Each band is predicted from its neighbours by linear regression (Roger and Arnold 1996). The residual's variance
    is the band's own noise plus the neighbours' noise weighted by the squared coefficients: a linear system for the
    variances. Noise that neighbouring bands share is missed, and signal in a single band is taken for noise.
    """
    count, bands = spectra.shape
    reach = max(1, min(_NEIGHBOUR_BANDS, count // 8, (bands - 1) // 2))
    mixing = np.eye(bands)
    residual_variance = np.empty(bands)
    for band in range(bands):
        start = min(max(band - reach, 0), max(bands - 2 * reach - 1, 0))
        others = np.setdiff1d(np.arange(start, min(start + 2 * reach + 1, bands)), [band])
        weights, _, _, _ = np.linalg.lstsq(spectra[:, others], spectra[:, band], rcond=None)
        residual = spectra[:, band] - spectra[:, others] @ weights
        residual_variance[band] = residual @ residual / (count - len(others))
        mixing[band, others] = weights**2
    variance = np.linalg.solve(mixing, residual_variance)
    # Where neighbours are much noisier, the solution may be far too small, or negative.
    return np.sqrt(np.clip(variance, 0.01 * residual_variance, residual_variance) + _ROUNDING_NOISE**2)


def pixel_noise(
    uncertainty: ReflectanceUncertainty, spectra: Float[np.ndarray, "n bands"]
) -> Float[np.ndarray, "n bands"]:
    """Standard deviation of the reflectance of pixels of the same material.

    The white reference's noise is left out, because all pixels have it in common; rounding in packed cubes is added.
    """
    return np.sqrt(uncertainty.constant + uncertainty.linear * np.maximum(spectra, 0.0) + _ROUNDING_NOISE**2)


def sample_training_spectra(
    frames: Sequence[PackedFrame], count: int = 4096
) -> tuple[Float[np.ndarray, "count bands"], Bool[np.ndarray, "count bands"]]:
    """Reflectance at random pixels, half of them on the object, and which values are measurements (others are 0)."""
    masks = np.stack([frame.mask() for frame in frames])
    # Closed at once: the data manager opens a file for each of these frames as well.
    with closing(PixelReader(frame.cube() for frame in frames)) as reader:
        batch = PixelSampler(reader, masks, count, seed=0, has_flagged=True).sample(0, 0.5)
    return batch["spectral"], batch["valid"]
