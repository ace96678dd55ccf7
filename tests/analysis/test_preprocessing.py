import numpy as np
import pytest
from scipy.signal import savgol_coeffs

from hsi_sc_nerf.analysis.preprocessing import preprocessed, read_steps

SPECTRA = np.random.default_rng(0).uniform(0.1, 0.9, (4, 15))
EVERY = np.ones(15, bool)
REFERENCE = SPECTRA.mean(axis=0)


def by(text, spectra=SPECTRA, used=EVERY):
    return preprocessed(spectra, read_steps(text, used), used, REFERENCE)


def test_steps_are_those_of_their_definitions():
    np.testing.assert_array_equal(by(""), SPECTRA)
    np.testing.assert_allclose(10.0 ** -by("absorbance"), SPECTRA)
    snv = by("SNV")
    np.testing.assert_allclose(snv.mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(snv.std(axis=1, ddof=1), 1.0)
    for row, corrected in zip(SPECTRA, by("msc"), strict=True):
        slope, offset = np.polyfit(REFERENCE, row, 1)
        np.testing.assert_allclose(corrected, (row - offset) / slope)


def test_a_derivative_is_the_sum_of_its_window():
    weights = savgol_coeffs(5, 2, deriv=1, use="dot")
    expected = [[row[k - 2 : k + 3] @ weights for k in range(2, 13)] for row in SPECTRA]
    np.testing.assert_allclose(by("savgol 5 2 1")[:, 2:-2], expected)
    line = np.arange(15.0)[None]
    np.testing.assert_allclose(by("savgol 7 2 1", line), 1.0)


def test_bands_without_a_coefficient_fill_windows_and_leave_before_what_follows():
    used = np.isin(np.arange(15), range(2, 13))
    derivative = by("savgol 5 2 1")[:, 2:-2]
    np.testing.assert_allclose(by("savgol 5 2 1", used=used), derivative)
    mean, sd = (f(derivative, axis=1, keepdims=True) for f in (np.mean, lambda x, **k: np.std(x, ddof=1, **k)))
    np.testing.assert_allclose(by("savgol 5 2 1, snv", used=used), (derivative - mean) / sd)
    np.testing.assert_allclose(by("", used=used), SPECTRA[:, 2:13])


def test_what_is_not_defined_is_nan_and_stays_in_its_row():
    spectra = SPECTRA.copy()
    spectra[1] = 0.5
    spectra[2, 3] = -0.1
    assert np.isnan(by("snv", spectra)[1]).all()
    found = by("absorbance, savgol 5 2 1", spectra)
    assert np.isnan(found[2]).all()
    np.testing.assert_allclose(found[[0, 3]], by("absorbance, savgol 5 2 1")[[0, 3]])


@pytest.mark.parametrize("text", ["smooth", "snv 3", "savgol 4 2 1", "savgol 17 2 1", "savgol 5 5 1", "savgol 5 2 3"])
def test_unknown_steps_are_refused(text):
    with pytest.raises(ValueError, match=r"absorbance, snv, msc|savgol needs an odd window"):
        read_steps(text, EVERY)
