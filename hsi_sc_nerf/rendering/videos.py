"""Show rendered spectra in false colours, and write videos of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.plotting.figures import INDEX_COLOURS, coloured
from hsi_sc_nerf.rendering.views import RenderedView
from hsi_sc_nerf.spectra.bands import COMPOSITES, composite, require_bands
from hsi_sc_nerf.spectra.indices import INDICES, index_values

_CONSTANT_RATE_FACTOR = "18"
"""Quality of x264: visually lossless."""


@dataclass(frozen=True)
class FalseColour:
    """A composite or an index as a picture.

    Attributes:
        name: of the composite or the index.
        legend: what the colours mean.
        colours: turns a view into a picture, colours in [0, 1].
    """

    name: str
    legend: str
    colours: Callable[[RenderedView], Float[Tensor, "h w 3"]]


def find_false_colour(name: str, wavelengths_nm: Float[np.ndarray, "bands"]) -> FalseColour:
    """The composite or index of a name, in upper or lower case.

    Raises:
        InputError: there is no such composite or index, or no band is near a wavelength that it needs.

    Example:
        >>> ndvi = find_false_colour("NDVI", run.dataset.wavelengths_nm)
        >>> picture = ndvi.colours(render_view(run.model, run.manager.eval_dataset.cameras[:1]))
    """
    names = {known.casefold(): known for known in (*COMPOSITES, *INDICES)}
    found = names.get(name.casefold())
    if found is None:
        raise InputError(f"there is no composite or index '{name}'; choose from {', '.join(names.values())}.")
    if found in COMPOSITES:
        rgb_nm = COMPOSITES[found].wavelengths_nm
        require_bands(wavelengths_nm, rgb_nm, found)
        return FalseColour(
            found,
            f"{', '.join(f'{nm:g}' for nm in rgb_nm)} nm as red, green, blue",
            lambda view: composite(view.spectral, wavelengths_nm, rgb_nm).clamp(0.0, 1.0),
        )
    index = INDICES[found]
    require_bands(wavelengths_nm, index.wavelengths_nm, found)
    low, high = index.drawn_range

    def colours(view: RenderedView) -> Float[Tensor, "h w 3"]:
        values = index_values(index, view.spectral, wavelengths_nm)
        return coloured(values.masked_fill(~view.valid, torch.nan), index.drawn_range, INDEX_COLOURS)

    legend = f"{index.expression}, {low:g} to {high:g} in {INDEX_COLOURS}, grey outside the object"
    return FalseColour(found, legend, colours)


@contextmanager
def open_video(path: Path, frames_per_second: int) -> Iterator[Callable[[UInt8[np.ndarray, "h w 3"]], None]]:
    """Write a video that browsers play (H.264 in MP4); the context gives a function that adds a frame (RGB).

    All frames have the size of the first one. An odd last line or column, which the format does not allow, is left
    out. The file is complete when the context ends, and is not held in memory.

    Example:
        >>> with open_video(Path("orbit.mp4"), frames_per_second=15) as add_frame:
        ...     add_frame(np.zeros((480, 640, 3), np.uint8))
    """
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=frames_per_second, options={"crf": _CONSTANT_RATE_FACTOR})
        stream.pix_fmt = "yuv420p"

        def add_frame(image: np.ndarray) -> None:
            even = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
            if not stream.codec_context.is_open:
                stream.height, stream.width = even.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        yield add_frame
        container.mux(stream.encode())
