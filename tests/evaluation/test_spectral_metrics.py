from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from hsi_sc_nerf.evaluation import spectral_metrics as metrics
from hsi_sc_nerf.evaluation.band_moments import windowed_scores

H, W, BANDS = 17, 23, 5


def pair() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    target = torch.rand(H, W, BANDS, generator=generator) * torch.linspace(0.2, 1.0, BANDS)
    return (target + 0.1 * torch.randn(H, W, BANDS, generator=generator)).clamp(0, 1), target


def blob() -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    return (rows - 3) ** 2 + (columns - 9) ** 2 < 40


IN_PRECISIONS = pytest.mark.parametrize(
    "dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64], ids=str
)
MASKS = pytest.mark.parametrize("mask", [None, blob()], ids=["full", "masked"])


def test_noise_turns_a_flat_spectrum_by_what_lies_across_it():
    angle = metrics.noise_angle(torch.full((2, 100), 0.5), torch.full((100,), 0.01))
    torch.testing.assert_close(angle, torch.full((2,), 0.01 * math.sqrt(99) / (0.5 * 10)))
    along = metrics.noise_angle(torch.tensor([0.4, 0.0]), torch.tensor([0.01, 0.0]))
    assert along == 0.0
    assert metrics.noise_angle(torch.zeros(3), torch.full((3,), 0.01)) == torch.inf


def some_valid() -> torch.Tensor:
    """A fifth flagged; band 4 wholly, pixel (3, 9) but for one band, pixel (3, 10) wholly."""
    valid = torch.rand(H, W, BANDS, generator=torch.Generator().manual_seed(5)) > 0.2
    valid[..., 4] = False
    valid[3, 9:11] = False
    valid[3, 9, 2] = True
    return valid


def on(device: str, *images: torch.Tensor | None) -> list[torch.Tensor | None]:
    return [None if image is None else image.to(device) for image in images]


def score_of_windows(
    x: np.ndarray, y: np.ndarray, valid: np.ndarray, centres: list[tuple[int, int]], reach: int
) -> float:
    """Mean SSIM of one band over Gaussian windows of the valid values around each centre."""
    scores = []
    for row, column in centres:
        rows, columns = np.meshgrid(np.arange(H), np.arange(W), indexing="ij")
        weights = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * 1.5**2))
        weights[(abs(rows - row) > reach) | (abs(columns - column) > reach)] = 0
        w, a, b = weights[valid], x[valid], y[valid]
        mean_a, mean_b = np.average(a, weights=w), np.average(b, weights=w)
        variances = np.average((a - mean_a) ** 2, weights=w) + np.average((b - mean_b) ** 2, weights=w)
        covariance = np.average((a - mean_a) * (b - mean_b), weights=w)
        luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
        scores.append(luminance * (2 * covariance + 9e-4) / (variances + 9e-4))
    return float(np.mean(scores))


def score_of_pixels(x: np.ndarray, y: np.ndarray) -> float:
    """SSIM of one band over all its valid values at once."""
    covariance = np.mean((x - x.mean()) * (y - y.mean()))
    luminance = (2 * x.mean() * y.mean() + 1e-4) / (x.mean() ** 2 + y.mean() ** 2 + 1e-4)
    return luminance * (2 * covariance + 9e-4) / (x.var() + y.var() + 9e-4)


@pytest.mark.parametrize("valid", [None, some_valid()], ids=["all valid", "some valid"])
@MASKS
def test_metrics_are_the_papers_formulas_over_valid_values(
    mask: torch.Tensor | None, valid: torch.Tensor | None, device: str
) -> None:
    predicted, target = pair()
    chosen = np.ones((H, W), bool) if mask is None else mask.numpy()
    judged = np.ones((H, W, BANDS), bool) if valid is None else valid.numpy()
    x, y = predicted.double().numpy(), target.double().numpy()
    angles, squares, roots = [], [], []
    for place in zip(*np.nonzero(chosen), strict=True):
        a, b = x[place][judged[place]], y[place][judged[place]]
        squares.extend((a - b) ** 2)
        if len(a) >= 1:
            roots.append(math.sqrt(np.mean((a - b) ** 2)))
        if len(a) >= 2:
            angles.append(math.acos(min(1.0, a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))))
    similarity, ratio, windowed = [], [], []
    for band in np.flatnonzero(judged.any((0, 1))):
        in_band = chosen & judged[..., band]
        a, b = x[in_band, band], y[in_band, band]
        similarity.append(score_of_pixels(a, b))
        ratio.append(-10 * math.log10(np.mean((a - b) ** 2) + 1e-10))
        centres = list(zip(*np.nonzero(in_band), strict=True))
        windowed.append(score_of_windows(x[..., band], y[..., band], judged[..., band], centres, reach=5))
    found = metrics.spectral_metrics(*on(device, predicted, target, mask, valid))
    assert found["sam"] == pytest.approx(np.mean(angles), rel=1e-5)
    assert found["rmse"] == pytest.approx(math.sqrt(np.mean(squares)), rel=1e-5)
    assert found["rmse_pixel_mean"] == pytest.approx(np.mean(roots), rel=1e-5)
    assert found["rmse_pixel_mean"] < found["rmse"]
    assert found["ssim"] == pytest.approx(np.mean(similarity), rel=1e-5)
    assert found["ssim_windowed"] == pytest.approx(np.mean(windowed), rel=1e-5)
    assert found["psnr"] == pytest.approx(np.mean(ratio), rel=1e-5)
    if valid is None:
        by_band = windowed_scores(*metrics.band_arrays(predicted, target, [mask], None))[0]
        np.testing.assert_allclose(by_band, windowed, rtol=1e-5)


def test_closed_forms() -> None:
    target = torch.full((H, W, BANDS), 0.5)
    found = metrics.spectral_metrics(target + 0.1, target)
    assert found["sam"] == pytest.approx(0, abs=1e-7)
    assert found["rmse"] == pytest.approx(0.1, rel=1e-6)
    assert found["rmse_pixel_mean"] == pytest.approx(0.1, rel=1e-6)
    assert found["psnr"] == pytest.approx(20, rel=1e-6)
    assert found["ssim"] == pytest.approx((2 * 0.6 * 0.5 + 1e-4) / (0.36 + 0.25 + 1e-4), rel=1e-6)
    assert found["ssim_windowed"] == pytest.approx(found["ssim"], rel=1e-6)


def test_known_angle_of_every_pixel() -> None:
    target = torch.zeros(H, W, 2)
    target[..., 0] = 0.7
    angle = 1e-6
    predicted = 0.3 * torch.stack([torch.full((H, W), math.cos(angle)), torch.full((H, W), math.sin(angle))], -1)
    assert metrics.spectral_angle_mapper(predicted, target).item() == pytest.approx(angle, rel=1e-3)
    assert metrics.spectral_angle_mapper(predicted, torch.zeros_like(target)).item() == pytest.approx(math.pi / 2)


def test_ssim_of_the_whole_mask_ignores_where_pixels_lie_and_the_windowed_one_does_not() -> None:
    predicted, target = pair()
    order = torch.randperm(H * W, generator=torch.Generator().manual_seed(0))
    shuffled = [image.reshape(-1, BANDS)[order].reshape(H, W, BANDS) for image in (predicted, target)]
    before, after = metrics.spectral_metrics(predicted, target), metrics.spectral_metrics(*shuffled)
    assert after["ssim"] == pytest.approx(before["ssim"], rel=1e-6)
    assert after["ssim_windowed"] != pytest.approx(before["ssim_windowed"], rel=1e-4)


@MASKS
@IN_PRECISIONS
def test_identical_images_score_full_marks(mask: torch.Tensor | None, dtype: torch.dtype, device: str) -> None:
    target, mask = on(device, pair()[1].to(dtype), mask)
    found = metrics.spectral_metrics(target, target, mask)
    assert found == pytest.approx(
        {"sam": 0, "rmse": 0, "rmse_pixel_mean": 0, "ssim": 1, "ssim_windowed": 1, "psnr": 100}, abs=1e-6
    )


@IN_PRECISIONS
def test_an_empty_mask_has_no_score(dtype: torch.dtype, device: str) -> None:
    predicted, target = (image.to(device, dtype) for image in pair())
    nothing = torch.zeros(H, W, dtype=torch.bool, device=device)
    found = metrics.metrics_of_regions(predicted, target, {"": nothing, "full_": None})
    assert {name for name, value in found.items() if math.isnan(value)} == {n for n in found if "full_" not in n}
    assert {n.removeprefix("full_") for n in found if "full_" in n} == {n for n in found if "full_" not in n}
    for function in (metrics.spectral_angle_mapper, metrics.spectral_rmse):
        assert function(predicted, target, nothing).isnan()


def test_variance_survives_a_large_offset_in_float32() -> None:
    generator = torch.Generator().manual_seed(0)
    detail = torch.randint(0, 4, (64, 64, 1), generator=generator) / 8192.0
    flat = (1000.0 + detail).double()
    contrast = metrics.spectral_metrics((1000.0 + detail).float(), (1000.0 - detail).float())["ssim"]
    variance = flat.var(unbiased=False).item()
    assert contrast == pytest.approx((9e-4 - 2 * variance) / (9e-4 + 2 * variance), rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32], ids=str)
@pytest.mark.parametrize("scale", [0.0, 1e-42, 1e-30, 3e38])
def test_metrics_are_finite(scale: float, dtype: torch.dtype, device: str) -> None:
    predicted, target, mask = on(device, *pair(), blob())
    predicted[..., 1] = 0
    target[..., 1] = 0
    predicted = (scale * predicted.double()).clamp(max=torch.finfo(dtype).max).to(dtype)
    for against in (target.to(dtype), predicted, torch.zeros_like(predicted)):
        assert np.isfinite(list(metrics.spectral_metrics(predicted, against, mask).values())).all()
        assert metrics.spectral_rmse(predicted, against, mask).dtype == torch.float32


@pytest.mark.parametrize("score", [metrics.spectral_metrics, metrics.spectral_angle_mapper, metrics.spectral_rmse])
def test_images_masks_and_validities_that_do_not_fit_are_refused(score) -> None:
    predicted, target = pair()
    with pytest.raises(ValueError, match="differ in shape"):
        score(predicted, target[..., :1])
    for mask in (blob()[1:], blob().float()):
        with pytest.raises(ValueError, match="mask"):
            score(predicted, target, mask)
    for valid in (blob(), some_valid().float(), some_valid()[..., :1]):
        with pytest.raises(ValueError, match="the validity of values of shape"):
            score(predicted, target, blob(), valid)


def test_pixels_outside_the_mask_may_be_anything() -> None:
    predicted, target = pair()
    expected = metrics.spectral_metrics(predicted, target, blob())
    predicted[~blob()] = float("nan")
    found = metrics.spectral_metrics(predicted, target, blob())
    assert all(found[name] == expected[name] for name in found if name != "ssim_windowed")


@pytest.mark.parametrize("anything", [-7.0, float("nan")])
def test_flagged_values_may_be_anything(anything: float) -> None:
    predicted, target = pair()
    valid = some_valid()
    expected = metrics.spectral_metrics(predicted, target, blob(), valid)
    target[~valid] = predicted[~valid] = anything
    assert metrics.spectral_metrics(predicted, target, blob(), valid) == expected


@MASKS
def test_where_nothing_is_valid_there_is_no_score(mask: torch.Tensor | None, device: str) -> None:
    predicted, target, mask = on(device, *pair(), mask)
    nothing = torch.zeros(H, W, BANDS, dtype=torch.bool, device=device)
    assert np.isnan(list(metrics.spectral_metrics(predicted, target, mask, nothing).values())).all()


def test_maps_are_nan_where_nothing_can_be_told() -> None:
    predicted, target = pair()
    valid = some_valid()
    angles = metrics.spectral_angle_map(predicted, target, valid)
    np.testing.assert_array_equal(angles.isnan(), valid.sum(-1) < 2)
    errors = metrics.squared_error_map(predicted, target, valid)
    np.testing.assert_array_equal(errors.isnan(), valid.sum(-1) < 1)


@pytest.mark.parametrize("valid", [None, torch.ones(H, W, 1, dtype=torch.bool)], ids=["all valid", "valid"])
def test_a_single_band_has_no_angle_and_all_other_scores(valid: torch.Tensor | None) -> None:
    found = metrics.spectral_metrics(*(image[..., :1] for image in pair()), blob(), valid)
    assert {name for name, value in found.items() if math.isnan(value)} == {"sam"}


def test_errors_of_valid_values_are_not_hidden() -> None:
    predicted, target = pair()
    valid = some_valid()
    row, column, band = ((valid & blob()[..., None]) & (valid.sum(-1, keepdim=True) > 2)).nonzero()[0]
    predicted[row, column, band] = float("nan")
    assert np.isnan(list(metrics.spectral_metrics(predicted, target, blob(), valid).values())).all()


def test_blocks_and_precision_change_nothing_but_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    images = pair()
    whole = metrics.spectral_metrics(*images, blob(), some_valid())
    assert metrics.spectral_metrics(*(i.double() for i in images), blob(), some_valid()) == pytest.approx(
        whole, rel=1e-6
    )
    monkeypatch.setattr(metrics, "BLOCK_VALUES", 2 * W * BANDS)
    assert metrics.spectral_metrics(*images, blob(), some_valid()) == pytest.approx(whole, rel=1e-6)


def test_regions_are_scored_as_if_alone() -> None:
    predicted, target = pair()
    found = metrics.metrics_of_regions(predicted, target, {"": blob(), "full_": None}, some_valid())
    assert found == pytest.approx(
        metrics.spectral_metrics(predicted, target, blob(), some_valid())
        | {f"full_{k}": v for k, v in metrics.spectral_metrics(predicted, target, None, some_valid()).items()}
    )


def test_threads_change_nothing_but_rounding() -> None:
    predicted, target = pair()
    threads = torch.get_num_threads()
    scores = []
    for count in (1, 3):
        torch.set_num_threads(count)
        scores.append(metrics.spectral_metrics(predicted, target, blob()))
    torch.set_num_threads(threads)
    assert scores[0] == pytest.approx(scores[1], rel=1e-9)
