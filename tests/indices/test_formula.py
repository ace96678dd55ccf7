import re

import numpy as np
import pytest
import torch

from hsi_sc_nerf.indices.formula import MAX_LETTERS, SpectralIndex, index_values

NM = np.array([500.0, 600.0, 700.0])
R = np.random.default_rng(0).uniform(0.05, 0.9, (5, 3))
A, B, C = R.T


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("R500 + R600 * R700", A + B * C),
        ("(R500 + R600) * -R700", -(A + B) * C),
        ("R500 - R600 - R700", A - B - C),
        ("2*R500^2 / +R600 ** 3", 2 * A**2 / B**3),
        ("R500 \N{MINUS SIGN} R600 \N{EN DASH} 2\N{MULTIPLICATION SIGN}R700", A - B - 2 * C),
        ("sqrt(R500) - log10(R600 / R700) + 1.5e-1", np.sqrt(A) - np.log10(B / C) + 0.15),
    ],
)
def test_formulas_are_those_of_arithmetic_for_arrays_and_tensors(expression, expected):
    index = SpectralIndex("own", expression)
    np.testing.assert_allclose(index_values(index, R, NM), expected, rtol=1e-12)
    of_tensor = index_values(index, torch.from_numpy(R), NM)
    np.testing.assert_allclose(of_tensor.numpy(), expected, rtol=1e-12)
    assert index_values(index, R.astype(np.float32), NM).dtype == np.float32


@pytest.mark.parametrize("expression", ["1 / (R500 - R600)", "sqrt(R500 - 1)", "log10(0 * R500)", "R500 + 1/0"])
def test_what_is_not_defined_is_nan(expression):
    same = np.full((1, 3), 0.5)
    for spectra in (same, torch.from_numpy(same)):
        assert np.isnan(float(index_values(SpectralIndex("own", expression), spectra, NM)[0]))


def test_a_negative_reflectance_that_the_formula_names_has_no_index():
    spectra = np.array([[-0.01, 0.5, 0.5], [0.5, 0.5, -0.01]])
    values = index_values(SpectralIndex("own", "R600 / R500"), spectra, NM)
    assert np.isnan(values[0])
    assert values[1] == 1.0


@pytest.mark.parametrize(
    ("expression", "why"),
    [
        ("__import__('os').getcwd() + R500", "'__import__"),
        ("R500.real", "'R500.real'"),
        ("sqrt(R500, R600)", "sqrt"),
        ("exp(R500)", "exp"),
        ("R500 if R600 else 1", "if"),
        ("True + R500", "True"),
        ("R500 + 1j", "1j"),
        ("R500 % 2", "%"),
        ("'a' * R500", "'a'"),
        ("R5 + 1", "'R5'"),
        ("R500 +", "no formula"),
        ("(" * 190 + "R500", "no formula"),
        ("1 + 2", "names no reflectance"),
        ("R500" + " + R500" * (MAX_LETTERS // 6), "longer than"),
    ],
)
def test_what_is_no_formula_is_refused(expression, why):
    with pytest.raises(ValueError, match=re.escape(why)):
        SpectralIndex("own", expression)


def test_an_index_names_its_wavelengths_once():
    assert SpectralIndex("own", "R700 / R500 - R700").wavelengths_nm == (700.0, 500.0)
