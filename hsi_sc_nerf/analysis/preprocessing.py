"""What chemometrics does to spectra before a regression: absorbance, SNV, MSC, Savitzky-Golay derivatives."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import savgol_filter

Step = tuple[str, tuple[int, ...]]
"""Name and whole numbers of a step."""
_KNOWN = "absorbance, snv, msc or savgol WINDOW POLYNOMIAL DERIVATIVE, with spaces between the numbers"
_NUMBERS = {"absorbance": 0, "snv": 0, "msc": 0, "savgol": 3}


def preprocessed(
    spectra: Float[np.ndarray, "n bands"],
    steps: tuple[Step, ...],
    used: Bool[np.ndarray, "bands"],
    reference: Float[np.ndarray, "bands"],
) -> Float[np.ndarray, "n used"]:
    """The spectra after all steps, at the bands that a model uses; NaN where a step is not defined.

    - absorbance: ``log10(1 / R)``.
    - snv: standard normal variate, less the mean, by the standard deviation with n - 1 (Barnes et al. 1989).
    - msc: multiplicative scatter correction by the line through (reference, spectrum) (Geladi et al. 1985).
    - savgol WINDOW POLYNOMIAL DERIVATIVE: Savitzky-Golay, per band (Savitzky and Golay 1964). Bands that are not used
      leave after it; they fill its windows.

    Example:
        >>> every = np.ones(3, bool)
        >>> preprocessed(np.array([[0.2, 0.4, 0.9]]), read_steps("snv", every), every, np.zeros(3)).round(2)
        array([[-0.83, -0.28,  1.11]])
    """
    with np.errstate(all="ignore"):
        for name, numbers in steps:
            mean = spectra.mean(axis=1, keepdims=True)
            if name == "absorbance":
                spectra = -np.log10(spectra)
            elif name == "snv":
                spectra = (spectra - mean) / spectra.std(axis=1, ddof=1, keepdims=True)
            elif name == "msc":
                centred = reference - reference.mean()
                slope = spectra @ centred[:, None] / (centred @ centred)
                spectra = (spectra - mean) / slope + reference.mean()
            else:
                window, polynomial, derivative = numbers
                known = np.isfinite(spectra).all(axis=1, keepdims=True)
                filtered = savgol_filter(np.where(known, spectra, 0.0), window, polynomial, deriv=derivative)
                spectra = np.where(known, filtered, np.nan)[:, used]
                reference, used = reference[used], used[used]
    spectra = spectra[:, used]
    return np.where(np.isfinite(spectra), spectra, np.nan)


def read_steps(text: str, used: Bool[np.ndarray, "bands"]) -> tuple[Step, ...]:
    """The steps of a text such as ``absorbance, savgol 11 2 1, snv``.

    Raises:
        ValueError: a step is not known, or its numbers do not fit the bands.
    """
    steps: list[Step] = []
    bands = len(used)
    for words in (part.split() for part in text.split(",") if part.strip()):
        name, numbers = words[0].lower(), tuple(int(word) for word in words[1:])
        if _NUMBERS.get(name) != len(numbers):
            raise ValueError(f"'{' '.join(words)}' is not {_KNOWN}")
        if name == "savgol":
            window, polynomial, derivative = numbers
            if not (window % 2 and 0 <= derivative <= polynomial < window <= bands):
                raise ValueError(f"savgol needs an odd window of at most {bands} bands above the polynomial's degree")
            bands = int(used.sum())
        steps.append((name, numbers))
    return tuple(steps)
