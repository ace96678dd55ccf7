"""The index that the viewer shows: a name of the catalogue, or a formula that is typed in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.indices.catalogue import CATALOGUE, find_indices
from hsi_sc_nerf.indices.formula import SpectralIndex, index_values
from hsi_sc_nerf.plotting import INDEX_COLOURS, coloured, usual_range
from hsi_sc_nerf.viewer.drawings import colour_bar, inline_image


class IndexChoice:
    """What two controls say together: a list of names, and a box for a formula, which counts if it is not empty.

    A formula that does not say the ends of its colours gets those of the first picture that it is drawn in, which
    keeps the colours of a place while the camera moves.

    Args:
        wavelengths_nm: band centres.
    """

    def __init__(self, wavelengths_nm: Float[np.ndarray, "bands"]) -> None:
        self._wavelengths_nm = wavelengths_nm
        self._found_ends: dict[str, tuple[float, float]] = {}

    def find(self, name: str | None, typed: str) -> tuple[SpectralIndex | None, str]:
        """The chosen index, and what is wrong with the typed text, in a sentence.

        Args:
            name: of the catalogue, which counts where the text is empty or wrong; None without one.
            typed: a name of the catalogue, or NAME = FORMULA [LOW, HIGH].
        """
        index, wrong = None if name is None else CATALOGUE[name], ""
        if typed.strip():
            try:
                (index,) = find_indices([typed], self._wavelengths_nm)
            except InputError as error:
                wrong = str(error)
        if index is not None and not index.has_range and index.definition in self._found_ends:
            index = replace(index, drawn_range=self._found_ends[index.definition])
        return index, wrong

    def picture(
        self, index: SpectralIndex | None, spectral: Float[Tensor, "h w bands"], shown: Bool[Tensor, "h w"]
    ) -> tuple[Float[Tensor, "h w 3"], bool]:
        """The index in colours, and whether this picture has given it the ends of them.

        Args:
            index: of `find`; None leaves the picture blank.
            spectral: rendered spectra.
            shown: pixels of the object, from which the ends of the colours are found.
        """
        if index is None:
            return coloured(spectral.new_full(spectral.shape[:2], np.nan), (0.0, 1.0), INDEX_COLOURS), False
        values = index_values(index, spectral, self._wavelengths_nm)
        ends, new = index.drawn_range, False
        if not index.has_range:
            known = values[shown].cpu().numpy()
            ends, new = usual_range(known), bool(np.isfinite(known).any())
            if new:
                self._found_ends[index.definition] = ends
        return coloured(values, ends, INDEX_COLOURS), new


def index_legend(index: SpectralIndex | None, wrong: str) -> list[str]:
    """Parts of the panel's text: what the colours mean, after what is wrong with what was typed.

    Formulas and sentences stand as code, in which the browser reads no markup.
    """
    parts = [f"**{_code(wrong)}**"] if wrong else []
    if index is None:
        return parts
    parts.append(f"**index** {_code(f'{index.name} = {index.expression}')}: {index.tells}")
    if index.has_range:
        bar = colour_bar(index.drawn_range, INDEX_COLOURS, index.name)
        parts.append(inline_image(bar, "colours {:g} to {:g}".format(*index.drawn_range)))
    return parts


def _code(text: str) -> str:
    return f"`{text.replace('`', ' ')}`"
