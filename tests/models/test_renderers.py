import pytest
import torch

from hsi_sc_nerf.models.renderers import BasisDecoder, SpectralRenderer, composite_band_groups

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


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
    torch.testing.assert_close(SpectralRenderer("last-sample")(rgb=even, weights=weights), even[:, 0])
    nothing = SpectralRenderer("last-sample")(rgb=spectra, weights=torch.zeros_like(weights))
    torch.testing.assert_close(nothing, spectra[:, -1])


@pytest.mark.parametrize("device", DEVICES)
def test_decoding_commutes_with_compositing(device):
    generator = torch.Generator().manual_seed(0)
    decoder = BasisDecoder(
        torch.randn(204, 8, generator=generator),
    ).to(device)
    coefficients = torch.randn(16, 24, 8, generator=generator).to(device)
    weights = torch.rand(16, 24, 1, generator=generator).softmax(1).to(device)
    once = decoder((weights * coefficients).sum(-2))
    torch.testing.assert_close(once, (weights * decoder(coefficients)).sum(-2), rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_two_densities_give_the_slab_its_two_transmittances(device):
    # A slab of reflectance r in front of nothing sends r (1 - exp(-sigma d)), however it is sampled.
    density, reflectance, thickness, samples = torch.tensor([0.7, 9.0]), torch.tensor([0.2, 0.6, 0.9]), 0.5, 40
    lengths = torch.rand(4, samples, 1, generator=torch.Generator().manual_seed(0))
    lengths *= thickness / lengths.sum(1, keepdim=True)
    channels = torch.cat([reflectance.expand(4, samples, 3), lengths * density], -1).to(device)
    spectra, opacity = composite_band_groups(channels, (1, 2))
    stopped = (1 - torch.exp(-density * thickness))[[0, 1, 1]]
    torch.testing.assert_close(opacity.cpu(), stopped.expand(4, 3), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(spectra.cpu(), (reflectance * stopped).expand(4, 3), rtol=1e-5, atol=1e-6)
