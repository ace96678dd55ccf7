import re
from pathlib import Path

import numpy as np
import pytest
import spyndex
import vegspec

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.indices.catalogue import CATALOGUE, USUAL, available_indices, find_indices
from hsi_sc_nerf.indices.formula import index_values

NM = np.linspace(397.32, 1003.58, 204)
FINE_NM = np.arange(400.0, 1300.0, 1.0)

# The wavelengths of ours that stand for the broad bands of spyndex (Montero et al. 2023, Scientific Data 10, 197).
# Not among them: its mND705 and mSR705, which differ from Sims and Gamon 2002.
SPYNDEX = {
    "NDVI": ("NDVI", {"N": 800, "R": 670}),
    "GNDVI": ("GNDVI", {"N": 800, "G": 550}),
    "NDVI705": ("ND705", {"RE2": 750, "RE1": 705}),
    "NDRE": ("NDREI", {"N": 790, "RE1": 720}),
    "CIre": ("CIRE", {"N": 780, "RE1": 710}),
    "CIgreen": ("CIG", {"N": 780, "G": 550}),
    "MCARI": ("MCARI", {"RE1": 700, "R": 670, "G": 550}),
    "MCARI2": ("MCARI2", {"N": 800, "R": 670, "G": 550}),
    "TCARI": ("TCARI", {"RE1": 700, "R": 670, "G": 550}),
    "OSAVI": ("OSAVI", {"N": 800, "R": 670}),
    "TCARI_OSAVI": ("TCARIOSAVI", {"N": 800, "RE1": 700, "R": 670, "G": 550}),
    "MTCI": ("MTCI", {"RE2": 754, "RE1": 709, "R": 681}),
    "SIPI": ("SIPI", {"N": 800, "A": 445, "R": 680}),
    "NPCI": ("NPCI", {"R": 680, "A": 430}),
    "PSRI": ("PSRI", {"R": 678, "B": 500, "RE2": 750}),
    "CRI1": ("CRI550", {"B": 510, "G": 550}),
    "CRI2": ("CRI700", {"B": 510, "RE1": 700}),
    "ARI1": ("ARI", {"G": 550, "RE1": 700}),
    "ARI2": ("ARI2", {"N": 800, "G": 550, "RE1": 700}),
    "PSSRa": ("SR", {"N": 800, "R": 680}),
    "NDWI": ("NDMI", {"N": 860, "S1": 1240}),
}

# Names of vegspec (Thorp, USDA-ARS), which has the wavelengths of the papers itself.
SAME_NAME = ("NDVI", "GNDVI", "MCARI", "MCARI2", "TCARI", "MTCI", "SIPI", "NPCI", "PSRI", "WI", "NDWI")
VEGSPEC = {name: name for name in SAME_NAME} | {
    "NDVI705": "NDVI3",
    "mND705": "SMNDVI",
    "mSR705": "MSR2",
    "VOG1": "VSR",
    "TCARI_OSAVI": "TOR",
    "PSSRa": "PSSRA",
    "PSSRb": "PSSRB",
    "PSSRc": "PSSRC",
    "CRI1": "CRI500",
    "CRI2": "CRI700",
    "ARI1": "ARI",
    "PRI": "PRI3",
    "WBI": "PSR",
}


@pytest.mark.parametrize("name", SPYNDEX)
def test_indices_are_those_of_a_published_implementation(name):
    spectra = np.random.default_rng(0).uniform(0.05, 0.9, (20, len(FINE_NM)))
    theirs, bands = SPYNDEX[name]
    at = {band: spectra[:, nm == FINE_NM][:, 0] for band, nm in bands.items()}
    expected = spyndex.computeIndex(theirs, at)
    np.testing.assert_allclose(index_values(CATALOGUE[name], spectra, FINE_NM), expected, rtol=1e-9)
    assert set(CATALOGUE[name].wavelengths_nm) == set(bands.values())


@pytest.mark.filterwarnings("ignore")  # of the indices that vegspec computes as well
def test_indices_and_their_wavelengths_are_those_of_another_published_implementation():
    spectra = np.random.default_rng(0).uniform(0.05, 0.9, (3, len(FINE_NM)))
    theirs = [vegspec.VegSpec(FINE_NM, spectrum).indices for spectrum in spectra]
    for ours, name in VEGSPEC.items():
        expected = [values[name] for values in theirs]
        found = index_values(CATALOGUE[ours], spectra, FINE_NM)
        np.testing.assert_allclose(found, expected, rtol=1e-9, err_msg=ours)
    # Neither has these at our wavelengths.
    assert set(CATALOGUE) - set(SPYNDEX) - set(VEGSPEC) == {"IAD", "mARI"}


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_ranges_hold_the_index_of_a_leaf(name):
    """A leaf by eye: green peak, chlorophyll's absorption, red edge at 715 nm, water at 970 and 1240 nm."""
    edge = 0.45 / (1.0 + np.exp(-(FINE_NM - 715.0) / 12.0))

    def bump(centre, width):
        return np.exp(-(((FINE_NM - centre) / width) ** 2))

    leaf = 0.05 + edge + 0.08 * bump(550, 30) - 0.03 * bump(970, 25) - 0.01 * bump(675, 15) - 0.06 * bump(1240, 60)
    value = index_values(CATALOGUE[name], leaf, FINE_NM)
    low, high = CATALOGUE[name].drawn_range
    assert low - 0.1 * (high - low) <= value <= high + 0.1 * (high - low)
    assert CATALOGUE[name].reference
    assert CATALOGUE[name].tells


def test_the_documentation_shows_the_catalogue():
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "indices.md").read_text(encoding="utf-8")
    shown = [
        [cell.strip(" `") for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")
    ]
    ends = {name: "{:g} to {:g}".format(*one.drawn_range) for name, one in CATALOGUE.items()}
    expected = [[n, one.expression, ends[n], one.tells, one.reference] for n, one in CATALOGUE.items()]
    assert shown[2:] == expected


def test_names_and_formulas_are_found():
    found = find_indices(["pri", "CRI = 1/R510 - 1/R550 [0, 15]", "CRI2"], NM)
    assert [one.name for one in found] == ["PRI", "CRI", "CRI2"]
    assert found[1].drawn_range == (0.0, 15.0)
    assert [find_indices([one.definition], NM) for one in found] == [[one] for one in found]
    assert not find_indices(["own = R510"], NM)[0].has_range


def test_without_a_name_the_usual_ones_that_the_bands_give():
    assert [one.name for one in find_indices([], NM)] == list(USUAL)
    assert [one.name for one in find_indices([], NM[NM < 880])] == ["NDVI", "NDVI705"]
    assert {one.name for one in available_indices(NM)} == set(CATALOGUE) - {"NDWI"}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["beauty"], "there is no index 'beauty'; choose from NDVI"),
        (["1x = R800"], "'1x = R800' is no NAME = FORMULA"),
        (["my CRI = R800"], "with a name of letters, digits and _ that begins with a letter"),
        (["x = R800 [1]"], "nor NAME = FORMULA [LOW, HIGH]"),
        (["x = R800 +"], "cannot be computed: it is no formula"),
        (["x = R800 [2, 1]"], "first end"),
        (["x = R800 [2, nan]"], "first end"),
        (["x = R800 [low, high]"], "could not convert"),
        (["x = R800", "x = R700"], "two indices are named x"),
        (["ndvi = R800"], "NDVI is another index"),
        (["NDWI"], "NDWI needs a band near 1240 nm"),
    ],
)
def test_what_cannot_be_computed_is_refused_in_a_sentence(words, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        find_indices(words, NM)
