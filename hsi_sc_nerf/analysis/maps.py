"""Maps of the surface: a number at each vertex, computed from its spectrum."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.indices.formula import SpectralIndex, index_values

_STEP = 1e-4
"""Step of a reflectance in numerical gradients: small beside reflectance, large beside rounding."""
_CAPTION_LETTERS = 40


@dataclass(frozen=True)
class SurfaceMap:
    """A number at each vertex.

    Attributes:
        name: name of the map.
        label: what it is, beside its picture: a formula, or a unit.
        values: NaN where none is known.
        of: computes the numbers of spectra at the surface's bands.
        error: standard deviation that all values share; 0 for none.
        definition: words that find the index again; empty for other maps.
        resampling_error: root mean square of what resampling the spectra changes.
        limited: of a calibration, whether it tells which spectra it was fitted on.
    """

    name: str
    label: str
    values: Float[np.ndarray, "v"]
    of: Callable[[Float[np.ndarray, "n bands"]], Float[np.ndarray, "n"]]
    error: float = 0.0
    definition: str = ""
    resampling_error: float = 0.0
    limited: bool = False

    @property
    def caption(self) -> str:
        """Name and label beside a picture, without a formula that is too long for it."""
        label = self.label.replace(" / (", " /\n(") if len(self.label) <= _CAPTION_LETTERS else ""
        return f"{self.name}\n{label}"

    @property
    def column(self) -> str:
        """Its column in a cloud."""
        return column_of("index" if self.definition else "calibration", self.name)


def column_of(kind: str, name: str) -> str:
    """Column of a cloud for a map: ``index_`` or ``calibration_``, and its name with ``_`` for all but letters."""
    return f"{kind}_{re.sub(r'[^A-Za-z0-9]+', '_', name)}"


def require_own_names(names: Sequence[str]) -> None:
    """Check the names of maps: tables have them without their signs.

    Raises:
        InputError: two are alike.
    """
    for one, other in itertools.combinations(names, 2):
        if re.sub(r"[\W_]+", "_", one) == re.sub(r"[\W_]+", "_", other):
            alike = "" if one == other else f" and {other}, which are alike but for signs"
            raise InputError(f"two indices or calibrations are named {one}{alike}; give each a name of its own.")


def numbered(columns: Sequence[str]) -> list[str]:
    """The columns, of which equal ones get numbers: names in scripts other than the Latin one are ``_`` alone.

    Example:
        >>> numbered(["calibration__", "calibration_sugar", "calibration__"])
        ['calibration__', 'calibration_sugar', 'calibration__2']
    """
    found: list[str] = []
    for column in columns:
        number, name = 1, column
        while name in found:
            number += 1
            name = f"{column}{'' if column.endswith('_') else '_'}{number}"
        found.append(name)
    return found


def index_maps(surface: SpectralMesh, indices: Sequence[SpectralIndex]) -> list[SurfaceMap]:
    """The indices of each vertex.

    Raises:
        InputError: a wavelength of an index has no band near it.

    Example:
        >>> (ndvi,) = index_maps(surface, find_indices(["NDVI"], surface.wavelengths_nm))
        >>> np.nanmedian(ndvi.values)
    """
    maps = []
    for index in indices:
        of = partial(index_values, index, wavelengths_nm=surface.wavelengths_nm)
        values = of(surface.spectra.astype(float))
        maps.append(SurfaceMap(index.name, index.expression, values, of, definition=index.definition))
    return maps


def propagated_std(
    of: Callable[[Float[np.ndarray, "n bands"]], Float[np.ndarray, "n"]],
    spectrum: Float[np.ndarray, "bands"],
    std: float | Float[np.ndarray, "bands"],
) -> float:
    """Standard deviation of a function of a spectrum whose bands err independently (linear propagation).

    Errors that bands share, such as of brightness, change ratios less than this.

    Args:
        of: the function, of many spectra at once.
        spectrum: where its gradient is taken.
        std: standard deviation of each band or of all.

    Example:
        >>> round(propagated_std(lambda spectra: spectra.sum(axis=1), np.full(4, 0.5), 0.01), 6)
        0.02
    """
    if not np.isfinite(std).all():
        return math.nan
    steps = _STEP * np.eye(len(spectrum))
    gradient = (of(spectrum + steps) - of(spectrum - steps)) / (2.0 * _STEP)
    return float(np.sqrt(np.sum((gradient * std) ** 2)))
