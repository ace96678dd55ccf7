import pytest
import torch

from hsi_sc_nerf.models.compositing import BasisDecoder, SpectralRenderer


@pytest.fixture
def samples():
    generator = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, 5, generator=generator), 0.3 * torch.rand(2, 3, 1, generator=generator)


def test_the_sum_is_the_sum(samples):
    spectra, weights = samples
    expected = sum(weights[:, k] * spectra[:, k] for k in range(3))
    torch.testing.assert_close(SpectralRenderer()(rgb=spectra, weights=weights), expected)


def test_what_is_let_through_shows_the_last_sample(samples):
    spectra, weights = samples
    even = torch.full_like(spectra, 0.4)
    torch.testing.assert_close(SpectralRenderer(last_sample_behind=True)(rgb=even, weights=weights), even[:, 0])
    nothing = SpectralRenderer(last_sample_behind=True)(rgb=spectra, weights=torch.zeros_like(weights))
    torch.testing.assert_close(nothing, spectra[:, -1])


def test_decoding_commutes_with_compositing(device):
    generator = torch.Generator().manual_seed(0)
    decoder = BasisDecoder(
        torch.randn(204, 8, generator=generator),
    ).to(device)
    coefficients = torch.randn(16, 24, 8, generator=generator).to(device)
    weights = torch.rand(16, 24, 1, generator=generator).softmax(1).to(device)
    once = decoder((weights * coefficients).sum(-2))
    torch.testing.assert_close(once, (weights * decoder(coefficients)).sum(-2), rtol=1e-5, atol=2e-6)
