import pytest
import torch

from hsi_sc_nerf.models.compositing import ChamberSpectrum, SumBeforeLastSample, WeightedSum


@pytest.fixture
def samples():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, 5, generator=generator), 0.3 * torch.rand(2, 3, 1, generator=generator)


def test_the_sum_is_the_sum(samples):
    spectra, weights = samples
    expected = sum(weights[:, k] * spectra[:, k] for k in range(3))
    torch.testing.assert_close(WeightedSum()(rgb=spectra, weights=weights), expected)


def test_what_is_let_through_shows_the_last_sample(samples):
    spectra, weights = samples
    even = torch.full_like(spectra, 0.4)
    torch.testing.assert_close(SumBeforeLastSample()(rgb=even, weights=weights), even[:, 0])
    nothing = SumBeforeLastSample()(rgb=spectra, weights=torch.zeros_like(weights))
    torch.testing.assert_close(nothing, spectra[:, -1])


def test_the_chamber_is_behind_every_ray():
    spectrum = torch.tensor([0.7, 0.8])
    behind = ChamberSpectrum(spectrum)(torch.rand(4, 6, 3), None)
    assert behind.shape == (4, 6, 2)
    torch.testing.assert_close(behind[3, 5], spectrum)
