"""The kernel from counts to packed reflectance, held against one expression in float64."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsi_sc_nerf.calibration.reflectance import FrameCalibration, PictureBands, PixelCounts, pack_counts
from hsi_sc_nerf.packed.cube import FLAGGED, LARGEST_REFLECTANCE, REFLECTANCE_SCALE, PixelFlag

LINES, SAMPLES, BANDS = 11, 6, 10
PICTURES = PictureBands(rgb=np.array([5, 3, 1]), gray=np.array([1, 2, 4]), bin_width=3)


def reference(counts, calibration):
    """Reflectance (unclipped, inf or nan where the counts are) and the reason for flagging each value."""
    bands = calibration.bands
    flat = 1.0 if calibration.flat is None else calibration.flat[..., None]
    stored = counts.astype(np.float64)
    reflectance = ((stored - calibration.dark) * calibration.gain / flat)[..., bands]
    why = np.zeros(counts.shape, np.uint8)
    if calibration.saturation_counts is not None:
        why[stored >= calibration.saturation_counts] = PixelFlag.SATURATED
    why[~np.isfinite(stored)] = PixelFlag.NO_DATA
    if calibration.ignore_value is not None:
        why[stored == calibration.ignore_value] = PixelFlag.NO_DATA
    if calibration.dead is not None:
        why[:, calibration.dead] = PixelFlag.DEAD
    return reflectance, why[..., bands]


def shown(reflectance, why, bounds):
    """What the pictures show: clipped, no data as the lower bound, dead elements replaced by a good neighbour."""
    values = np.clip(np.where(why == PixelFlag.NO_DATA, -np.inf, reflectance), *bounds)
    dead = (why == PixelFlag.DEAD).all(axis=0)
    for sample, band in np.argwhere(dead):
        good = np.flatnonzero(~dead[sample])
        if len(good):
            nearest = good[np.abs(good - band).argmin()]
            values[:, sample, band] = values[:, sample, nearest]
        else:
            values[:, sample, band] = bounds[0]
    return values


def check(counts, calibration, pictures=PICTURES):
    result = pack_counts(counts, calibration, pictures)
    with np.errstate(invalid="ignore"):
        reflectance, why = reference(counts, calibration)
    low, high = np.clip(calibration.bounds, 0.0, LARGEST_REFLECTANCE)
    expected = np.where(why == 0, np.rint(np.clip(reflectance, low, high) * REFLECTANCE_SCALE), FLAGGED)
    np.testing.assert_array_equal(result.packed == FLAGGED, why != 0)
    assert np.abs(result.packed.astype(np.int64) - expected).max() <= 1
    np.testing.assert_array_equal(result.flags, np.bitwise_or.reduce(why, axis=-1))

    rounded = np.rint(reflectance * REFLECTANCE_SCALE)
    expected_counts = {
        "clipped_low": (why == 0) & (rounded < np.rint(low * REFLECTANCE_SCALE)),
        "clipped_high": (why == 0) & (rounded > np.rint(high * REFLECTANCE_SCALE)),
        "saturated": why == PixelFlag.SATURATED,
        "dead": why == PixelFlag.DEAD,
        "no_data": why == PixelFlag.NO_DATA,
    }
    for name, marked in expected_counts.items():
        np.testing.assert_array_equal(getattr(result.pixel_counts, name), marked.sum(axis=(0, 1)), err_msg=name)
    assert result.pixel_counts.flagged.sum() == (result.packed == FLAGGED).sum()

    seen = shown(reflectance, why, (low, high))
    unit = 1.0 / REFLECTANCE_SCALE
    np.testing.assert_allclose(result.rgb, np.moveaxis(seen[..., pictures.rgb], -1, 0), atol=unit)
    np.testing.assert_allclose(result.gray, seen[..., pictures.gray].mean(axis=-1), atol=unit)
    starts = range(0, seen.shape[-1], pictures.bin_width)
    bins = [seen[..., i : i + pictures.bin_width].mean(axis=-1) for i in starts]
    np.testing.assert_allclose(result.binned, bins, atol=unit)
    return result


def make_counts(rng, dtype=np.uint16, low=0, high=4200, lines=LINES):
    return rng.integers(low, high, (lines, SAMPLES, BANDS)).astype(dtype)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


@pytest.fixture
def plain(rng) -> FrameCalibration:
    return FrameCalibration(
        dark=rng.uniform(90.0, 110.0, (1, BANDS)),
        gain=rng.uniform(0.9, 1.1, (1, BANDS)) / 3600,
        bands=np.arange(BANDS),
    )


def test_counts_equal_to_dark_are_not_clipped(plain):
    dark = np.rint(plain.dark)
    counts = np.broadcast_to(dark, (LINES, SAMPLES, BANDS)).astype(np.uint16)
    assert not check(counts, replace(plain, dark=dark)).pixel_counts.clipped_low.any()


@pytest.mark.parametrize("interleave", ["bip", "bil", "bsq"])
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_orders_and_turns(rng, plain, interleave, turns):
    order = {"bip": (0, 1, 2), "bil": (0, 2, 1), "bsq": (2, 0, 1)}[interleave]
    counts = np.ascontiguousarray(make_counts(rng).transpose(order)).transpose(np.argsort(order))
    result = check(counts, replace(plain, quarter_turns=turns))
    assert np.rot90(result.packed, turns).flags.c_contiguous


@pytest.mark.parametrize(
    "dtype", ["u1", "i2", ">i2", "u2", ">u2", "i4", ">i4", "u4", "i8", ">i8", "u8", "f4", ">f4", "f8", ">f8"]
)
@pytest.mark.parametrize("interleave", ["bip", "bil"])
def test_data_types(rng, plain, dtype, interleave):
    counts = make_counts(rng, dtype, high=250)
    if interleave == "bil":
        counts = np.ascontiguousarray(counts.transpose(0, 2, 1)).transpose(0, 2, 1)
    check(counts, replace(plain, gain=plain.gain * 24, saturation_counts=240.0, ignore_value=7.0))


@pytest.mark.parametrize("bands", [[2, 3, 4, 5, 6, 7], [0, 1, 3, 4, 8, 9], [0, 1, 2, 3, 4, 5]])
def test_bands_that_are_left_out_need_no_calibration(rng, plain, bands):
    left_out = np.setdiff1d(np.arange(BANDS), bands)
    gain = plain.gain.copy()
    gain[:, left_out] = np.nan
    calibration = replace(plain, gain=gain, bands=np.array(bands))
    for counts in (make_counts(rng), make_counts(rng).transpose(0, 2, 1).copy().transpose(0, 2, 1)):
        assert check(counts, calibration).packed.shape == (LINES, SAMPLES, len(bands))


def test_each_value_has_one_reason(rng, plain):
    counts = make_counts(rng)
    counts[2, 3] = 65_535  # no data, and above saturation
    counts[5, :4, 2] = 4095
    dead = np.zeros((SAMPLES, BANDS), bool)
    dead[3, [0, 4, 5]] = dead[4, :] = dead[0, 9] = True
    gain = np.broadcast_to(plain.gain, (SAMPLES, BANDS)).copy()
    gain[dead] = np.inf
    calibration = replace(plain, gain=gain, dead=dead, saturation_counts=4095.0, ignore_value=65_535.0)
    result = check(counts, calibration)
    assert result.flags[2, 3] == PixelFlag.NO_DATA | PixelFlag.DEAD
    assert result.flags[5, 0] & PixelFlag.SATURATED
    assert result.pixel_counts.dead[0] == LINES * 2


def test_floats_that_are_not_finite_are_no_data(rng, plain):
    counts = make_counts(rng, np.float32)
    counts[1, 2, 3], counts[1, 2, 4], counts[4, 1, 0] = np.nan, np.inf, -np.inf
    dead = np.zeros((SAMPLES, BANDS), bool)
    dead[2, 3] = True
    result = check(counts, replace(plain, dead=dead, saturation_counts=4095.0, bounds=(0.02, 0.9)))
    assert result.pixel_counts.no_data.sum() == 2


def test_calibration_that_is_not_finite(rng, plain):
    for wrong in (
        replace(plain, gain=np.full((1, BANDS), np.inf)),
        replace(plain, dark=np.full((1, BANDS), np.nan)),
        replace(plain, flat=np.zeros((LINES, SAMPLES))),
    ):
        with pytest.raises(ValueError, match=r"not finite|not positive"):
            pack_counts(make_counts(rng), wrong, PICTURES)


def test_total():
    of_frames = [PixelCounts(*(np.array([i, i + k]) for k in range(5))) for i in (1, 10)]
    total = PixelCounts.total(of_frames)
    assert [getattr(total, f.name).tolist() for f in fields(PixelCounts)] == [[11, 11 + 2 * k] for k in range(5)]


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_any_calibration(data):
    lines, samples, bands = (data.draw(st.integers(1, 12)) for _ in range(3))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    kept = np.flatnonzero(rng.random(bands) < 0.8)
    kept = kept if len(kept) else np.array([bands - 1])
    columns = data.draw(st.sampled_from([1, samples]))
    optional = data.draw(st.fixed_dictionaries({k: st.booleans() for k in ("flat", "sat", "dead", "ignore")}))
    calibration = FrameCalibration(
        dark=rng.uniform(50.0, 150.0, (columns, bands)),
        gain=rng.uniform(0.2, 1.5, (columns, bands)) / 900.0,
        bands=kept,
        bounds=data.draw(st.sampled_from([(0.0, 1.0), (0.1, 0.7), (-0.2, 5.0)])),
        flat=rng.uniform(0.5, 1.5, (lines, samples)) if optional["flat"] else None,
        saturation_counts=900.0 if optional["sat"] else None,
        dead=rng.random((samples, bands)) < 0.2 if optional["dead"] else None,
        ignore_value=0.0 if optional["ignore"] else None,
        quarter_turns=data.draw(st.integers(0, 3)),
    )
    counts = rng.integers(0, 1000, (lines, samples, bands)).astype(data.draw(st.sampled_from(["<u2", ">u2", "<f4"])))
    counts[rng.random((lines, samples)) < 0.2] = 0
    pictures = PictureBands(
        rgb=rng.integers(0, len(kept), 3),
        gray=np.unique(rng.integers(0, len(kept), 4)),
        bin_width=data.draw(st.integers(1, len(kept))),
    )
    check(counts, calibration, pictures)
