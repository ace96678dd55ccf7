import numpy as np
import pytest
import torch

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.indices.catalogue import CATALOGUE
from hsi_sc_nerf.indices.formula import index_values
from hsi_sc_nerf.spectra import COMPOSITES, composite, covered, require_bands, same_bands

WAVELENGTHS_NM = np.linspace(397.32, 1003.58, 204)


def a_line(shape=(5, 4)):
    """Reflectance that grows linearly with the wavelength, a slope for each pixel: R = slope * nm."""
    slopes = np.linspace(1e-4, 9e-4, int(np.prod(shape))).reshape(shape)
    return slopes, slopes[..., None] * WAVELENGTHS_NM


def nearest(target):
    return WAVELENGTHS_NM[np.argmin([abs(centre - target) for centre in WAVELENGTHS_NM])]


RGB_NM = {
    "pseudo-RGB": (598, 548, 449),
    "apple": (801, 708, 551),
    "maize visible": (650, 540, 470),
    "maize": (850, 580, 490),
    "pear": (980, 710, 550),
    "CIR": (800, 670, 550),
}


@pytest.mark.parametrize("kind", ["array", "tensor"])
def test_composites_of_a_line_are_proportional_to_their_wavelengths(kind, device):
    slopes, spectra = a_line()
    given = spectra if kind == "array" else torch.from_numpy(spectra).to(device)
    assert set(RGB_NM) == set(COMPOSITES)
    for name, one in COMPOSITES.items():
        image = torch.as_tensor(composite(given, WAVELENGTHS_NM, one.wavelengths_nm)).cpu().numpy()
        np.testing.assert_allclose(image, slopes[..., None] * [nearest(nm) for nm in RGB_NM[name]])


def test_wavelengths_without_a_band_near_them_are_refused():
    visible = np.arange(400.0, 701.0, 5.0)
    assert covered(visible, (400.0, 551.0, 710.0)).all()
    assert covered(visible, (400.0, 551.0, 710.5)).tolist() == [True, True, False]
    with pytest.raises(InputError, match=r"NDVI needs .* 800 nm, .* 61 bands .* 400 to 700 nm"):
        index_values(CATALOGUE["NDVI"], np.ones((1, 61)), visible)
    with pytest.raises(InputError, match="near 980 and another near 850 nm"):
        require_bands(visible, (980.0, 850.0, 550.0), "a picture")


def test_a_gap_is_no_band_but_coarse_bands_are():
    with_gap = np.concatenate([np.arange(400.0, 880.0, 3.0), np.arange(990.0, 1003.0, 3.0)])
    assert covered(with_gap, (900.0, 970.0, 995.0)).tolist() == [False, False, True]
    coarse = np.linspace(397.32, 1003.58, 12)
    assert all(covered(coarse, (nm,)).all() for nm in np.arange(371.0, 1030.0))
    assert not covered(coarse, (365.0, 1035.0)).any()
    assert covered(coarse, (450.0, 450.0)).all()


@pytest.mark.parametrize(
    ("centres_nm", "index", "missing"),
    [
        # Too far away, however far apart the bands are.
        ([550.0, 670.0, 800.0], "NDVI705", "750 and another near 705 nm, and the 3 bands"),
        ([449.0, 598.0, 980.0], "WI", "900 nm, and the 3 bands"),
        # Near both: the index would be 0 whatever the surface.
        ([620.0, 727.0, 800.0], "NDVI705", "750 and another near 705 nm, and the 3 bands"),
    ],
)
def test_a_band_stands_for_one_wavelength_near_it(centres_nm, index, missing):
    with pytest.raises(InputError, match=f"{index} needs a band near {missing}"):
        index_values(CATALOGUE[index], np.ones((1, 3)), np.array(centres_nm))


def test_the_same_bands_are_found_and_near_ones_are_not_the_same():
    np.testing.assert_array_equal(same_bands(WAVELENGTHS_NM, WAVELENGTHS_NM[[7, 3]] + 0.004), [7, 3])
    assert same_bands(WAVELENGTHS_NM, WAVELENGTHS_NM[[7, 3]] + np.array([0.0, 0.5])) is None
