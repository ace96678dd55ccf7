"""The usual narrow-band indices by name, and those that a user asks for by name or by formula."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.indices.formula import SpectralIndex
from hsi_sc_nerf.spectra import covered, require_bands

# Name, formula, ends of the colour map for plant tissue, what it follows, source.
_TABLE = (
    ("NDVI", "(R800 - R670) / (R800 + R670)", (0, 1), "green tissue", "Rouse et al. 1974"),
    ("GNDVI", "(R800 - R550) / (R800 + R550)", (0, 1), "chlorophyll", "Gitelson et al. 1996"),
    ("NDVI705", "(R750 - R705) / (R750 + R705)", (0, 0.8), "chlorophyll, where NDVI saturates; ripening and "
     "senescence", "Gitelson and Merzlyak 1994"),
    ("NDRE", "(R790 - R720) / (R790 + R720)", (0, 0.6), "chlorophyll, nitrogen", "Barnes et al. 2000"),
    ("mND705", "(R750 - R705) / (R750 + R705 - 2*R445)", (0, 1), "chlorophyll, less the gloss of the surface",
     "Sims and Gamon 2002"),
    ("mSR705", "(R750 - R445) / (R705 - R445)", (1, 6), "chlorophyll, less the gloss of the surface",
     "Sims and Gamon 2002"),
    ("VOG1", "R740 / R720", (1, 2), "chlorophyll, the place of the red edge", "Vogelmann et al. 1993"),
    ("CIre", "R780 / R710 - 1", (0, 4), "chlorophyll content, about linear", "Gitelson et al. 2003"),
    ("CIgreen", "R780 / R550 - 1", (0, 10), "chlorophyll content, about linear", "Gitelson et al. 2003"),
    ("MCARI", "((R700 - R670) - 0.2*(R700 - R550)) * (R700 / R670)", (0, 0.5), "depth of chlorophyll's absorption",
     "Daughtry et al. 2000"),
    ("MCARI2", "1.5*(2.5*(R800 - R670) - 1.3*(R800 - R550)) / sqrt((2*R800 + 1)**2 - (6*R800 - 5*sqrt(R670)) - 0.5)",
     (0, 1), "green area, little influenced by chlorophyll", "Haboudane et al. 2004"),
    ("TCARI", "3*((R700 - R670) - 0.2*(R700 - R550) * (R700 / R670))", (0, 0.6),
     "depth of chlorophyll's absorption", "Haboudane et al. 2002"),
    ("OSAVI", "(R800 - R670) / (R800 + R670 + 0.16)", (0, 0.9), "green tissue before soil", "Rondeaux et al. 1996"),
    ("TCARI_OSAVI", "3*((R700 - R670) - 0.2*(R700 - R550) * (R700 / R670)) / "
     "(1.16*(R800 - R670) / (R800 + R670 + 0.16))", (0, 1), "chlorophyll before soil", "Haboudane et al. 2002"),
    ("MTCI", "(R754 - R709) / (R709 - R681)", (0, 6), "chlorophyll content", "Dash and Curran 2004"),
    ("IAD", "log10(R720 / R670)", (0, 1.5), "ripeness of fruit, by the chlorophyll of its skin", "Ziosi et al. 2008"),
    ("PSSRa", "R800 / R680", (1, 20), "chlorophyll a", "Blackburn 1998"),
    ("PSSRb", "R800 / R635", (1, 10), "chlorophyll b", "Blackburn 1998"),
    ("PSSRc", "R800 / R470", (1, 20), "carotenoids", "Blackburn 1998"),
    ("SIPI", "(R800 - R445) / (R800 - R680)", (0.8, 1.8), "carotenoids to chlorophyll a",
     "Peñuelas, Baret and Filella 1995"),
    ("NPCI", "(R680 - R430) / (R680 + R430)", (-0.5, 0.8), "all pigments to chlorophyll", "Peñuelas et al. 1994"),
    ("CRI1", "1/R510 - 1/R550", (0, 15), "carotenoids", "Gitelson et al. 2002"),
    ("CRI2", "1/R510 - 1/R700", (0, 15), "carotenoids, where there are anthocyanins", "Gitelson et al. 2002"),
    ("ARI1", "1/R550 - 1/R700", (0, 10), "anthocyanins", "Gitelson et al. 2001"),
    ("ARI2", "R800 * (1/R550 - 1/R700)", (0, 5), "anthocyanins, in thick leaves", "Gitelson et al. 2001"),
    ("mARI", "R780 * (1/R550 - 1/R700)", (0, 5), "anthocyanins", "Gitelson et al. 2006"),
    ("PRI", "(R531 - R570) / (R531 + R570)", (-0.2, 0.2), "xanthophylls, the use of light",
     "Peñuelas, Filella and Gamon 1995"),
    ("PSRI", "(R678 - R500) / R750", (-0.1, 0.4), "senescence, ripening of fruit", "Merzlyak et al. 1999"),
    ("WI", "R900 / R970", (0.9, 1.3), "water in the tissue", "Peñuelas et al. 1997"),
    ("WBI", "R970 / R900", (0.75, 1.1), "water in the tissue", "Peñuelas et al. 1993"),
    ("NDWI", "(R860 - R1240) / (R860 + R1240)", (-0.2, 0.4), "water in the tissue", "Gao 1996"),
)  # fmt: skip
CATALOGUE = {row[0]: SpectralIndex(*row) for row in _TABLE}
"""The indices by name."""
USUAL = ("NDVI", "NDVI705", "WI")
"""Indices that are shown if the user names none."""
_OWN = re.compile(r"\s*([A-Za-z]\w{0,29})\s*=([^=\[\]]+)(?:\[([^,\[\]]+),([^,\[\]]+)\]\s*)?", re.ASCII)


def find_indices(words: Sequence[str], wavelengths_nm: Float[np.ndarray, "bands"]) -> list[SpectralIndex]:
    """The indices that a user names; of the `USUAL` ones those that the bands can give, where the user names none.

    Args:
        words: names of the catalogue, in upper or lower case, or NAME = FORMULA, with [LOW, HIGH] behind it for the
            ends of the colour map.
        wavelengths_nm: band centres.

    Raises:
        InputError: something is neither, two have one name, or a wavelength has no band near it.

    Example:
        >>> [found.expression for found in find_indices(["wi", "own = R970 / R900 [0, 2]"], np.array([900.0, 970.0]))]
        ['R900 / R970', 'R970 / R900']
    """
    if not words:
        return [one for one in available_indices(wavelengths_nm) if one.name in USUAL]
    found: dict[str, SpectralIndex] = {}
    for word in words:
        index = find_index(word)
        if found.setdefault(index.name, index) != index:
            raise InputError(f"two indices are named {index.name}; give each formula a name of its own.")
        require_bands(wavelengths_nm, index.wavelengths_nm, index.name)
    return list(found.values())


def find_index(word: str) -> SpectralIndex:
    """An index by its name in the catalogue, or by NAME = FORMULA (`find_indices`).

    Raises:
        InputError: it is neither.
    """
    names = {name.casefold(): name for name in CATALOGUE}
    if known := names.get(word.strip().casefold()):
        return CATALOGUE[known]
    match = _OWN.fullmatch(word)
    if match is None and "=" in word:
        raise InputError(
            f"the index '{word}' is no NAME = FORMULA, nor NAME = FORMULA [LOW, HIGH]; write it like 'CRI = 1/R510 - "
            "1/R550 [0, 15]', with a name of letters, digits and _ that begins with a letter."
        )
    if match is None:
        raise InputError(
            f"there is no index '{word}'; choose from {', '.join(CATALOGUE)}, or give NAME = FORMULA, such as "
            "'CRI = 1/R510 - 1/R550' or, with the ends of its colours, 'CRI = 1/R510 - 1/R550 [0, 15]'."
        )
    name, expression, *ends = match.groups()
    try:
        index = SpectralIndex(name, expression.strip())
        if ends[0] is not None:
            low, high = map(float, ends)
            if not -np.inf < low < high < np.inf:
                raise ValueError("the first end of its colours must be below the second")
            index = replace(index, drawn_range=(low, high))
    except ValueError as error:
        raise InputError(f"the index '{word}' cannot be computed: {error}; correct it.") from error
    if known := names.get(name.casefold()):
        if index.expression != CATALOGUE[known].expression:
            raise InputError(f"{known} is another index of the catalogue; give '{word}' another name.")
        return replace(CATALOGUE[known], drawn_range=index.drawn_range) if index.has_range else CATALOGUE[known]
    return index


def available_indices(wavelengths_nm: Float[np.ndarray, "bands"]) -> list[SpectralIndex]:
    """The indices of the catalogue that these band centres can give."""
    return [one for one in CATALOGUE.values() if covered(wavelengths_nm, one.wavelengths_nm).all()]
