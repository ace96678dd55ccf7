"""What must hold for any numbers, in every precision and on every device: angles, losses, metrics, light along rays.

The reference of angles is computed with 50 digits.
"""

import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from ray_samples import samples_along

from hsi_sc_nerf.evaluation import spectral_metrics as metrics
from hsi_sc_nerf.models.compositing import BasisDecoder, SpectralRenderer
from hsi_sc_nerf.models.density_losses import separate_distortion
from hsi_sc_nerf.models.losses import angle_loss, angular_loss, hsi_loss
from hsi_sc_nerf.numerics import one_minus_cosine, safe_ratio, spectral_angle

DTYPES = [torch.float16, torch.bfloat16, torch.float32]
LOSSES = [hsi_loss, angular_loss, angle_loss]

in_precisions = pytest.mark.parametrize("dtype", DTYPES, ids=str)
any_number = st.floats(allow_nan=False, allow_infinity=False, width=32)
# Multiples of a packed count; scaled, they are still no subnormal numbers.
reflectances = st.lists(st.integers(0, 65_000).map(lambda count: count / 50_000), min_size=4, max_size=4)
some = settings(deadline=None, max_examples=40)


def angle_of_fifty_digits(a, b):
    with mpmath.workdps(50):
        a, b = (mpmath.matrix([mpmath.mpf(float(x)) for x in spectrum]) for spectrum in (a, b))
        lengths = mpmath.norm(a), mpmath.norm(b)
        if 0 in lengths:
            return math.pi / 2
        u, v = a / lengths[0], b / lengths[1]
        return float(2 * mpmath.atan2(mpmath.norm(u - v), mpmath.norm(u + v)))


def leaf(values, dtype, device):
    largest = torch.finfo(dtype).max
    return torch.tensor(values).double().clamp(-largest, largest).to(device, dtype).requires_grad_()


@in_precisions
@some
@given(a=st.lists(any_number, min_size=3, max_size=3), b=st.lists(any_number, min_size=3, max_size=3))
def test_angles_of_any_spectra_are_right_and_have_finite_gradients(device, dtype, a, b):
    x, y = leaf(a, dtype, device), leaf(b, dtype, device)
    angle = spectral_angle(x, y)
    truth = angle_of_fifty_digits(x.tolist(), y.tolist())
    # Half precision is computed in float32, in which opposite spectra keep 4e-4.
    assert angle.item() == pytest.approx(truth, rel=1e-2, abs=1e-6 if dtype != torch.float16 else 1e-3)
    # One by one: each is at most the largest number of its type, and their sum may be more.
    for value in (angle, one_minus_cosine(x, y), safe_ratio(x, y).sum()):
        for gradient in torch.autograd.grad(value, (x, y)):
            assert gradient.isfinite().all()


@some
@given(a=reflectances, b=reflectances, exponent=st.integers(-60, 60))
def test_angles_do_not_depend_on_brightness(device, a, b, exponent):
    x, y = (torch.tensor([spectrum], device=device) for spectrum in (a, b))
    scaled = spectral_angle(x * 2.0**exponent, y)
    torch.testing.assert_close(scaled, spectral_angle(x, y), rtol=1e-6, atol=1e-6)


@in_precisions
@pytest.mark.parametrize("loss", LOSSES)
@some
@given(values=st.lists(any_number, min_size=8, max_size=8), flags=st.lists(st.booleans(), min_size=8, max_size=8))
def test_losses_of_any_numbers_are_finite_and_flagged_ones_pull_at_nothing(device, dtype, loss, values, flags):
    predicted = leaf(values, dtype, device).detach().reshape(2, 4).requires_grad_()
    target = leaf(values[::-1], dtype, device).detach().reshape(2, 4)
    valid = torch.tensor(flags, device=device).reshape(2, 4)
    found = loss(predicted, torch.where(valid, target, torch.nan), valid)
    assert found.dtype == torch.float32
    assert found.isfinite()
    found.backward()
    assert predicted.grad.isfinite().all()
    assert not predicted.grad[~valid].any()


@some
@given(pixels=st.lists(reflectances, min_size=9, max_size=9), mask=st.lists(st.booleans(), min_size=9, max_size=9))
def test_metrics_stay_in_their_range_for_any_mask(device, pixels, mask):
    target = torch.tensor(pixels, device=device).reshape(3, 3, 4)
    chosen = torch.tensor(mask, device=device).reshape(3, 3)
    for predicted in (target, target.flip(0), torch.zeros_like(target), torch.ones_like(target)):
        found = metrics.spectral_metrics(predicted, target, chosen)
        if not any(mask):
            assert np.isnan(list(found.values())).all()
            continue
        assert 0.0 <= found["sam"] <= math.pi
        assert 0.0 <= found["rmse_pixel_mean"] <= found["rmse"] * (1 + 1e-6) <= 1.31
        assert min(found["ssim"], found["ssim_windowed"]) >= -1.000001
        assert max(found["ssim"], found["ssim_windowed"]) <= 1.000001
        assert -3.0 <= found["psnr"] <= 100.001


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 9, 3), (12, 2, 1), (30, 30, 1), (30, 30, 5)])
@pytest.mark.parametrize("level", [0.0, 1e-30, 0.5, 1.0])
@in_precisions
def test_constant_thin_and_one_band_pictures_have_scores(device, dtype, shape, level):
    picture = torch.full(shape, level, device=device, dtype=dtype)
    thin = torch.zeros(shape[:2], dtype=torch.bool, device=device)
    thin[0, :] = True
    for mask in (None, thin):
        same = metrics.spectral_metrics(picture, picture, mask)
        assert (same["ssim"], same["ssim_windowed"], same["rmse"]) == (1.0, 1.0, 0.0)
        assert same["psnr"] == pytest.approx(100.0)
        other = metrics.spectral_metrics(picture + 0.25, picture, mask)
        assert other["rmse"] == pytest.approx(0.25)
        assert other["psnr"] == pytest.approx(-20 * math.log10(0.25), rel=1e-5)
        without_score = [name for name, value in other.items() if not np.isfinite(value)]
        assert without_score == (["sam"] if shape[-1] == 1 else [])  # a single band has no angle


densities = st.lists(st.sampled_from([0.0, 1e-40, 1e-10, 1.0, 1e3, 1e10, 3e38]), min_size=6, max_size=6)
lengths = st.lists(st.sampled_from([0.0, 1e-10, 1e-3, 0.1]), min_size=6, max_size=6)


@some
@given(density=densities, length=lengths)
def test_light_along_any_ray_is_neither_made_nor_lost(device, density, length):
    ends = torch.cumsum(torch.tensor([length], device=device), -1)
    starts = torch.cat([torch.zeros(1, 1, device=device), ends[:, :-1]], -1)
    matter = torch.tensor([density], device=device, requires_grad=True)
    weights = samples_along(starts, ends).get_weights(matter[..., None])
    assert (weights >= 0.0).all()
    assert weights.sum() <= 1.0 + 1e-6
    coefficients = torch.rand(1, 6, 3, device=device, requires_grad=True)
    decoder = BasisDecoder(torch.eye(5, 3)).to(device)
    for behind in (False, True):
        spectrum = decoder(SpectralRenderer(behind)(coefficients, weights))
        assert (spectrum <= coefficients.max() + 1e-6).all()
        loss = spectrum.sum() + separate_distortion(weights[..., 0], starts, ends).sum()
        of_matter, of_coefficients = torch.autograd.grad(loss, (matter, coefficients), retain_graph=True)
        assert of_matter.isfinite().all()
        assert of_coefficients.isfinite().all()


def test_empty_and_solid_space(device):
    ends = torch.tensor([[0.1, 0.2, 0.3]], device=device)
    samples = samples_along(ends - 0.1, ends)
    empty, solid = torch.zeros(1, 3, 1, device=device), torch.full((1, 3, 1), 1e10, device=device)
    assert samples.get_weights(empty).tolist() == [[[0.0], [0.0], [0.0]]]
    assert samples.get_weights(solid).tolist() == [[[1.0], [0.0], [0.0]]]


@in_precisions
def test_renderer_in_low_precision_is_that_of_float64(device, dtype):
    generator = torch.Generator().manual_seed(0)
    colours = torch.rand(50, 24, 8, generator=generator).to(device, dtype)
    weights = torch.rand(50, 24, 1, generator=generator).softmax(-2).to(device, dtype)
    expected = (weights.double() * colours.double()).sum(-2)
    found = SpectralRenderer()(colours, weights).double()
    torch.testing.assert_close(found, expected, rtol=8 * torch.finfo(dtype).eps, atol=0)
