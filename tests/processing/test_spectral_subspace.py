from pathlib import Path

import numpy as np
import pytest
from capture_factory import packed_frame

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.packed.cube import FLAGGED, ReflectanceUncertainty, pack, write_packed_cube
from hsi_sc_nerf.processing.spectral_subspace import (
    SpectralSubspace,
    estimate_noise,
    find_subspace,
    pixel_noise,
    sample_training_spectra,
)

BANDS = 60
MAIZE = Path(__file__).parents[1] / "real_cubes" / "maize_kernel"


def noise_free(count: int, rank: int) -> np.ndarray:
    """Shaded mixtures of ``rank`` smooth spectra."""
    rng = np.random.default_rng(1)
    x = np.linspace(0.0, 1.0, BANDS)
    centres = np.linspace(0.1, 0.9, rank)[:, None]
    shapes = 0.1 + np.exp(-0.5 * ((x - centres) / 0.12) ** 2)
    return rng.dirichlet(np.ones(rank), count) * rng.uniform(0.2, 0.9, (count, 1)) @ shapes


def uneven_noise(spectra: np.ndarray) -> np.ndarray:
    """Photon noise, ten times larger in the outermost bands."""
    x = np.linspace(0.0, 1.0, BANDS)
    return 2e-3 * (1.0 + 9.0 * np.exp(-x / 0.05) + 9.0 * np.exp((x - 1.0) / 0.05)) * np.sqrt(0.05 + spectra)


def noisy(count: int, rank: int, times: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spectra without and with noise, and its standard deviation."""
    true = noise_free(count, rank)
    deviation = times * uneven_noise(true)
    return true, true + deviation * np.random.default_rng(2).standard_normal(true.shape), deviation


def projection_error(spectra: np.ndarray, subspace: SpectralSubspace) -> float:
    """Root mean square of what the projection takes off spectra."""
    return float(np.sqrt(np.mean((spectra - spectra @ subspace.basis @ subspace.basis.T) ** 2)))


@pytest.mark.parametrize("rank", [1, 3, 6])
@pytest.mark.parametrize("known", [True, False])
def test_the_rank_is_found_in_noise(rank, known):
    true, spectra, deviation = noisy(1500, rank)
    subspace = find_subspace(spectra, deviation if known else None)
    # The estimate is one a band, and bright spectra, noisier than dark ones, may seem to have a direction more.
    assert rank <= subspace.basis.shape[1] <= rank + (not known)
    assert projection_error(true, subspace) < 0.15 * np.sqrt(np.mean(deviation**2))


@pytest.mark.parametrize("rank", [1, 4, 9, BANDS])
def test_the_rank_can_be_given(rank):
    _, spectra, deviation = noisy(1500, 4)
    subspace = find_subspace(spectra, deviation, rank=rank)
    assert subspace.basis.shape == (BANDS, rank)
    np.testing.assert_allclose(subspace.basis.T @ subspace.basis, np.eye(rank), atol=1e-12)
    shared = find_subspace(spectra, deviation).basis[:, : min(rank, 4)]
    assert projection_error(shared.T, subspace) < 0.02  # the strongest directions come first


def test_a_rank_above_the_number_of_bands_is_refused():
    _, spectra, deviation = noisy(1500, 3)
    with pytest.raises(InputError, match="basis-size"):
        find_subspace(spectra, deviation, rank=BANDS + 1)


def test_noise_alone_has_no_rank():
    deviation = uneven_noise(np.full((400, BANDS), 0.3))
    noise = deviation * np.random.default_rng(3).standard_normal(deviation.shape)
    assert find_subspace(noise, deviation).basis.shape == (BANDS, 1)  # a basis has one column at least


def test_the_basis_is_orthonormal_and_keeps_squared_errors():
    _, spectra, deviation = noisy(1500, 4)
    subspace = find_subspace(spectra, deviation)
    np.testing.assert_allclose(subspace.basis.T @ subspace.basis, np.eye(4), atol=1e-12)
    coefficients = spectra @ np.linalg.pinv(subspace.scaled_basis).T
    coefficient_rms = np.sqrt(np.mean(coefficients**2, axis=0))
    projected = coefficients @ subspace.scaled_basis.T
    np.testing.assert_allclose((projected**2).mean(axis=1), (coefficients**2).sum(axis=1))
    np.testing.assert_allclose(coefficients.mean(axis=0), subspace.mean_coefficients, atol=1e-12)
    assert (subspace.mean_coefficients > 0).all()
    assert 0.1 < coefficient_rms[0] < 1.0
    assert (np.diff(coefficient_rms) < 0).all()


def test_the_rank_above_strong_noise_costs_hardly_any_accuracy():
    true, spectra, deviation = noisy(4000, 5, times=8.0)
    subspace = find_subspace(spectra, deviation)
    assert subspace.basis.shape[1] == 5
    assert projection_error(true, subspace) < 0.1 * np.sqrt(np.mean(deviation**2))
    assert find_subspace(spectra[:, :5]).basis.shape[1] <= 5


def test_noise_is_estimated_from_the_spectra():
    _, spectra, deviation = noisy(3000, 5)
    np.testing.assert_allclose(estimate_noise(spectra), np.sqrt(np.mean(deviation**2, axis=0)), rtol=0.1)


def test_flagged_values_take_their_spectra_out():
    _, spectra, deviation = noisy(1500, 3)
    valid = np.random.default_rng(4).random(spectra.shape) > 2e-3
    spoilt = np.where(valid, spectra, 0.0)
    whole = valid.all(axis=1)
    subspace = find_subspace(spoilt, deviation, valid)
    np.testing.assert_array_equal(subspace.basis, find_subspace(spectra[whole], deviation[whole]).basis)
    valid[50:, 0] = False
    with pytest.raises(InputError, match=r"free of flagged values.*--pipeline\.model\.head direct"):
        find_subspace(spoilt, deviation, valid)


def test_pixel_noise_excludes_the_white_reference():
    uncertainty = ReflectanceUncertainty(np.full(2, 1e-6), np.array([0.0, 3e-6]), np.full(2, 1.0))
    noise = pixel_noise(uncertainty, np.array([[1.0, 1.0], [-0.1, -0.1]]))
    np.testing.assert_allclose(noise, [[1e-3, 2e-3], [1e-3, 1e-3]], rtol=1e-3)


def test_spectra_of_a_packed_dataset_are_sampled(tmp_path):
    rng = np.random.default_rng(5)
    frames = []
    for i in range(2):
        mask = np.zeros((6, 5), np.uint8)
        mask[2:4, 1:3] = 255
        cube = rng.uniform(0.3, 0.4, (6, 5, 3)) + 0.5 * (mask[..., None] > 0)
        counts = pack(cube)
        counts[0, 0, 1] = FLAGGED
        frames.append(packed_frame(tmp_path, str(i)))
        write_packed_cube(frames[-1].cube_path, counts, np.arange(3.0) + 400.0)
        write_png(frames[-1].mask_path, mask)
    spectra, valid = sample_training_spectra(frames, 400)
    assert spectra.shape == valid.shape == (400, 3)
    assert (spectra[:, 0] > 0.75).sum() == 200
    assert 0 < (~valid).sum() == (spectra == 0).sum()
    np.testing.assert_array_equal(sample_training_spectra(frames, 400)[0], spectra)


@pytest.mark.slow
def test_noise_of_a_real_kernel_is_the_detectors_where_it_is_dark():
    kernel, dark, white = (
        open_cube(MAIZE / f"{name}.hdr").memmap().astype(float)
        for name in ("4-22-22_right_same_B73_top_00", "dark_reference_crop", "white_reference_crop")
    )
    level, read_noise = dark.mean(axis=(0, 1)), dark.std(axis=0, ddof=1).mean(axis=0)
    gain = 1.0 / (white.mean(axis=(0, 1)) - level)
    spectra = ((kernel - level) * gain).reshape(-1, kernel.shape[2])
    ratio = estimate_noise(spectra) / (read_noise * gain)
    np.testing.assert_allclose(ratio[:15], 1.0, atol=0.1)  # hardly any light there
    assert ratio[150:450].min() > 1.5  # where there is, it adds its own
    lit = spectra[:, 40:540]
    basis = find_subspace(lit).basis
    residual, noise = lit - lit @ basis @ basis.T, estimate_noise(lit)
    outside = 1.0 - np.square(basis).sum(axis=1)
    excess = (np.square(residual).sum(axis=1).mean() - noise**2 @ outside) / lit.shape[1]
    assert np.sqrt(max(excess, 0.0)) < 2e-3  # what the rank costs beyond the noise
