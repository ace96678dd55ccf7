"""Videos that every browser plays: H.264 in MP4, by the encoder that nerfstudio's dependency PyAV brings along."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

_QUALITY = "18"  # x264's constant rate factor: by eye no different from the pictures


@contextmanager
def open_video(path: Path, frames_per_second: int) -> Iterator[Callable[[UInt8[np.ndarray, "h w 3"]], None]]:
    """Begin a video; the function that this gives adds a frame (RGB). All frames have the first one's size.

    An odd last line or column, which the format does not take, is left out. The file is complete when the context
    ends; what is written on the way is not held.
    """
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=frames_per_second, options={"crf": _QUALITY})
        stream.pix_fmt = "yuv420p"

        def add(image: np.ndarray) -> None:
            even = np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
            if not stream.codec_context.is_open:
                stream.height, stream.width = even.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        yield add
        container.mux(stream.encode())
