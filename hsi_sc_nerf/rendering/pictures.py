"""What rendered spectra look like: a composite or an index, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.plotting.false_colour import INDEX_COLOURS, coloured
from hsi_sc_nerf.rendering.cubes import RenderedView
from hsi_sc_nerf.spectra.bands import require_bands
from hsi_sc_nerf.spectra.composites import COMPOSITES, composite
from hsi_sc_nerf.spectra.indices import INDICES, index_values


@dataclass(frozen=True)
class Look:
    """A way to show spectra.

    Attributes:
        name: of the composite or the index.
        legend: what its colours mean.
        paint: makes a picture of a view, colours in [0, 1].
    """

    name: str
    legend: str
    paint: Callable[[RenderedView], Float[Tensor, "h w 3"]]


def find_look(name: str, wavelengths_nm: Float[np.ndarray, "bands"]) -> Look:
    """The composite or index of a name, in whatever letters it is written.

    Raises:
        InputError: there is none, or it needs a wavelength that no band is near.
    """
    known = {known.casefold(): known for known in (*COMPOSITES, *INDICES)}
    found = known.get(name.casefold())
    if found is None:
        raise InputError(f"there is no composite or index '{name}'; choose from {', '.join(known.values())}.")
    if found in COMPOSITES:
        chosen = COMPOSITES[found]
        require_bands(wavelengths_nm, chosen.wavelengths_nm, found)
        shown = ", ".join(f"{nm:g}" for nm in chosen.wavelengths_nm)
        return Look(
            found,
            f"{shown} nm as red, green, blue",
            lambda view: composite(view.spectral, wavelengths_nm, chosen.wavelengths_nm).clamp(0.0, 1.0),
        )
    index = INDICES[found]
    require_bands(wavelengths_nm, index.wavelengths_nm, found)

    def paint(view: RenderedView) -> Float[Tensor, "h w 3"]:
        values = index_values(index, view.spectral, wavelengths_nm)
        return coloured(values.masked_fill(~view.valid, torch.nan), index.drawn_range, INDEX_COLOURS)

    low, high = index.drawn_range
    return Look(found, f"{index.expression}, {low:g} to {high:g} in {INDEX_COLOURS}, grey where nothing is", paint)
