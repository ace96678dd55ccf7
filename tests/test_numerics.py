import math

import pytest
import torch

from hsi_sc_nerf.numerics import (
    masked_mean,
    mean_square,
    one_minus_cosine,
    safe_log10,
    safe_ratio,
    safe_sqrt,
    select_pixels,
    spectral_angle,
)

BANDS = 204


def spectra(seed: int = 0, pixels: int = 16, bands: int = BANDS) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(pixels, bands, generator=generator, dtype=torch.float64) + 0.1


def turned(a: torch.Tensor, angle: float) -> torch.Tensor:
    """Each spectrum turned by ``angle`` rad towards a random direction, in float64."""
    away = torch.randn(a.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    away -= a * (away * a).sum(-1, keepdim=True) / a.square().sum(-1, keepdim=True)
    away *= a.norm(dim=-1, keepdim=True) / away.norm(dim=-1, keepdim=True)
    return a * math.cos(angle) + away * math.sin(angle)


def orthogonal_pair() -> tuple[torch.Tensor, torch.Tensor]:
    a, b = spectra(), spectra(1)
    a[:, ::2], b[:, 1::2] = 0, 0
    return a, b


def dead_bands(a: torch.Tensor) -> torch.Tensor:
    a = a.clone()
    a[:, :20] = 0
    return a


# name: (a, b, expected angle or None)
CASES = {
    "identical": (spectra(), spectra(), 0.0),
    "scaled": (spectra(), 3 * spectra(), 0.0),
    "opposite": (spectra(), -spectra(), math.pi),
    "orthogonal": (*orthogonal_pair(), math.pi / 2),
    "different": (spectra(), spectra(1), None),
    "zero": (torch.zeros(16, BANDS), spectra(), math.pi / 2),
    "both zero": (torch.zeros(16, BANDS), torch.zeros(16, BANDS), math.pi / 2),
    "tiny": (1e-30 * spectra(), spectra(1), None),
    "subnormal": (1e-42 * spectra(), spectra(), None),
    "both tiny": (1e-30 * spectra(), 1e-30 * spectra(1), None),
    "huge": (1e30 * spectra(), spectra(1), None),
    "both huge": (3e38 * (spectra() - 0.1), 3e38 * (spectra(1) - 0.1), None),
    "tiny and huge": (1e-30 * spectra(), 1e30 * spectra(1), None),
    "half's smallest": (6e-8 * (spectra() > 0.3), 6e-8 * (spectra(1) > 0.3), None),
    "half's largest": (65504.0 * (spectra() > 0.3), 65504.0 * (spectra(1) > 0.3), None),
    "dead bands": (dead_bands(spectra()), dead_bands(spectra(1)), None),
    "no pixels": (torch.zeros(0, BANDS), torch.zeros(0, BANDS), None),
}
DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]


def as_leaf(values: torch.Tensor, dtype: torch.dtype, device: str) -> torch.Tensor:
    largest = torch.finfo(dtype).max
    return values.double().clamp(-largest, largest).to(device, dtype).requires_grad_()


def assert_finite(value: torch.Tensor, *leaves: torch.Tensor) -> None:
    assert torch.isfinite(value).all()
    value.sum().backward()
    for leaf in leaves:
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
        assert leaf.grad.dtype == leaf.dtype


@pytest.mark.slow
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(
    "function",
    [
        spectral_angle,
        one_minus_cosine,
        lambda a, b: one_minus_cosine(a, b, norm_floor=1e-3),
        safe_ratio,
        lambda a, b: masked_mean((a - b).double().square()),
        lambda a, b: safe_sqrt(a) + safe_sqrt(b),
        lambda a, b: safe_log10(a) + safe_log10(b),
    ],
    ids=["angle", "cosine", "cosine floored", "ratio", "mean", "sqrt", "log10"],
)
def test_values_and_gradients_are_finite(function, case: str, dtype: torch.dtype, device: str) -> None:
    a, b = (as_leaf(values, dtype, device) for values in CASES[case][:2])
    assert_finite(function(a, b), a, b)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("case", [name for name, case in CASES.items() if case[2] is not None])
def test_closed_form_angles(case: str, dtype: torch.dtype, device: str) -> None:
    a, b = (as_leaf(values, dtype, device) for values in CASES[case][:2])
    # Tripling rounds in half precision, which turns the spectrum by about the rounding unit.
    tolerance = {"rel": 1e-6, "abs": 2 * torch.finfo(dtype).eps if case == "scaled" else 0.0}
    assert spectral_angle(a, b).numpy(force=True) == pytest.approx(CASES[case][2], **tolerance)
    assert one_minus_cosine(a, b).numpy(force=True) == pytest.approx(1 - math.cos(CASES[case][2]), abs=1e-4, rel=1e-6)


@pytest.mark.parametrize("bands", [3, 204])
@pytest.mark.parametrize("scale", [1.0, 0.37, 1e-30, 1e30])
@pytest.mark.parametrize("angle", [1e-6, 1e-4, 1e-2, 1.0, 3.1, math.pi - 1e-4])
def test_angle_is_accurate_in_float32(angle: float, scale: float, bands: int, device: str) -> None:
    exact = spectra(bands=bands, pixels=200).float().double()
    a, b = exact.float().to(device), (scale * turned(exact, angle)).float().to(device)
    # Rounding b to float32 turns it by up to 1e-7 rad: the truth is the angle of what is stored.
    u, v = (x.double() / x.double().norm(dim=-1, keepdim=True) for x in (a, b))
    truth = 2 * torch.atan2((u - v).norm(dim=-1), (u + v).norm(dim=-1))
    torch.testing.assert_close(spectral_angle(a, b).double(), truth, rtol=1e-5, atol=0)
    if bands == BANDS:
        assert spectral_angle(a, b).mean().item() == pytest.approx(angle, rel=0.01)
    torch.testing.assert_close(one_minus_cosine(a, b).double(), 2 * (truth / 2).sin().square(), rtol=1e-5, atol=0)


@pytest.mark.parametrize(
    "function",
    [spectral_angle, one_minus_cosine, lambda a, b: one_minus_cosine(a, b, norm_floor=30.0), safe_ratio, mean_square],
)
def test_gradients_match_finite_differences(function, device: str) -> None:
    a, b = (spectra(seed, pixels=3, bands=7).to(device).requires_grad_() for seed in (0, 1))
    assert torch.autograd.gradcheck(function, (a, b))


@pytest.mark.parametrize("function", [safe_sqrt, safe_log10, masked_mean])
def test_gradients_of_one_argument_match_finite_differences(function, device: str) -> None:
    assert torch.autograd.gradcheck(function, (spectra(pixels=3, bands=7).to(device).requires_grad_(),))


@pytest.mark.parametrize("function", [spectral_angle, one_minus_cosine])
def test_float32_gradient_near_identical_spectra(function, device: str) -> None:
    a, b = spectra().float().to(device), turned(spectra(), 1e-4).float().to(device)
    leaf, exact = a.clone().requires_grad_(), a.double().requires_grad_()
    function(leaf, b).sum().backward()
    function(exact, b.double()).sum().backward()
    torch.testing.assert_close(leaf.grad, exact.grad.float(), rtol=1e-4, atol=1e-7 * exact.grad.abs().max().item())


def test_zero_spectrum_has_no_gradient(device: str) -> None:
    for function in (spectral_angle, one_minus_cosine, lambda a, b: one_minus_cosine(a, b, norm_floor=1e-3)):
        a = torch.zeros(2, BANDS, device=device, requires_grad=True)
        b = spectra(pixels=2).float().to(device).requires_grad_()
        function(a, b).sum().backward()
        assert not a.grad.any()
        assert b.grad.abs().max() < 1e-15


def test_norm_floor_fades_the_cosine_and_bounds_the_gradient() -> None:
    a = torch.tensor([[0.25, 0.0]], requires_grad=True)
    value = one_minus_cosine(a, torch.tensor([[5.0, 0.0]]), norm_floor=1.0)
    value.sum().backward()
    assert value.item() == pytest.approx(0.75)
    torch.testing.assert_close(a.grad, torch.tensor([[-1.0, 0.0]]))


def test_ratio_of_dead_bands_is_zero() -> None:
    numerator = torch.tensor([1.0, 2.0, 3.0, 4.0], requires_grad=True)
    denominator = torch.tensor([0.0, 4.0, 1e-9, -2.0], requires_grad=True)
    ratio = safe_ratio(numerator, denominator, minimum=1e-6)
    torch.testing.assert_close(ratio.detach(), torch.tensor([0.0, 0.5, 0.0, -2.0]))
    ratio.sum().backward()
    torch.testing.assert_close(numerator.grad, torch.tensor([0.0, 0.25, 0.0, -0.5]))
    torch.testing.assert_close(denominator.grad, torch.tensor([0.0, -0.125, 0.0, -1.0]))


def test_roots_and_logarithms_at_the_edges() -> None:
    values = torch.tensor([-1e-9, 0.0, 4.0], requires_grad=True)
    safe_sqrt(values).sum().backward()
    torch.testing.assert_close(safe_sqrt(values).detach(), torch.tensor([0.0, 0.0, 2.0]))
    torch.testing.assert_close(values.grad, torch.tensor([0.0, 0.0, 0.25]))
    torch.testing.assert_close(safe_log10(torch.tensor([-1.0, 0.0, 100.0]), 1e-5), torch.tensor([-5.0, -5.0, 2.0]))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_input_is_not_hidden(bad: float, device: str) -> None:
    a, b = torch.full((1, 4), bad, device=device), torch.ones(1, 4, device=device)
    values = (spectral_angle(a, b), one_minus_cosine(a, b), safe_sqrt(a), safe_log10(a), masked_mean(a))
    for value in (*values, safe_ratio(a, b), mean_square(a, b)):
        assert not torch.isfinite(value).any()


def test_masked_mean_of_half_precision_accumulates_in_float32(device: str) -> None:
    values = torch.full((300, 300), 0.1, dtype=torch.float16, device=device)
    assert masked_mean(values).item() == pytest.approx(values[0, 0].item(), rel=1e-6)
    assert masked_mean(torch.full((9,), 6e4, dtype=torch.float16)).item() == pytest.approx(6e4, rel=1e-3)


def test_masked_mean_of_nothing_is_zero() -> None:
    values = torch.ones(4, 4, requires_grad=True)
    mean = masked_mean(values, torch.zeros(4, 4, dtype=torch.bool))
    mean.backward()
    assert mean.item() == 0
    assert not values.grad.any()


def test_left_out_pixels_touch_nothing() -> None:
    values = torch.tensor([[1.0, float("nan")], [3.0, float("inf")]], requires_grad=True)
    mask = torch.tensor([[True, False], [True, False]])
    masked_mean(values, mask).backward()
    torch.testing.assert_close(values.grad, torch.tensor([[0.5, 0.0], [0.5, 0.0]]))


@pytest.mark.parametrize("mask", [torch.ones(2, 3), torch.ones(3, 2, dtype=torch.bool)])
def test_a_mask_of_the_wrong_kind_is_refused(mask: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="mask"):
        select_pixels(torch.ones(2, 3, 5), mask)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e15])
def test_the_compiled_mean_square_and_its_gradients_equal_those_in_float64(scale):
    a, b = scale * spectra().float(), scale * spectra(1).float()
    found = []
    for dtype in (torch.float32, torch.float64):
        pair = [values.to(dtype).requires_grad_() for values in (a, b)]
        mean = mean_square(*pair)
        found.append([mean, *torch.autograd.grad(0.7 * mean, pair)])
    for compiled, exact in zip(*found, strict=True):
        torch.testing.assert_close(compiled, exact.float(), rtol=1e-5, atol=0.0)


def test_the_mean_square_of_the_largest_numbers_and_of_none_is_finite():
    largest = torch.finfo(torch.float32).max
    a, b = torch.full((2,), largest, requires_grad=True), torch.full((2,), -largest, requires_grad=True)
    mean = mean_square(a, b)
    mean.backward()
    assert mean.item() == largest
    torch.testing.assert_close(torch.stack([a.grad, b.grad]), torch.tensor([[largest] * 2, [-largest] * 2]))
    assert mean_square(a[:0], b[:0]).item() == 0.0


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_the_compiled_angle_and_its_gradients_equal_those_in_float64(scale):
    torch.manual_seed(0)
    a, b = scale * torch.rand(50, 204), torch.rand(50, 204)
    b[:25] = a[:25] / scale + 1e-3 * torch.rand(25, 204)
    upstream = torch.rand(50) * min(scale, 1.0)
    found = []
    for dtype in (torch.float32, torch.float64):
        pair = [spectra.to(dtype).requires_grad_() for spectra in (a, b)]
        angle = spectral_angle(*pair)
        found.append([angle, *torch.autograd.grad((angle * upstream).sum(), pair)])
    for compiled, exact in zip(*found, strict=True):
        torch.testing.assert_close(compiled.double(), exact, rtol=1e-4, atol=1e-5 * exact.abs().max().item())
