"""Contact sheet of the masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.morphology import draw_outline


def mask_picture(
    path: Path,
    images: Sequence[UInt8[np.ndarray, "h w 3"]],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    names: Sequence[str],
    *,
    columns: int = 6,
    tile_px: int = 240,
) -> None:
    """Draw a contact sheet: each frame's pseudo-RGB with its mask's outline and its name.

    Raises:
        InputError: the operating system refused to write.
    """
    tiles = []
    for image, mask, name in zip(images, masks, names, strict=True):
        scale = tile_px / image.shape[1]
        size = (tile_px, round(image.shape[0] * scale))
        interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
        small = cv2.resize(np.ascontiguousarray(image), size, interpolation=interpolation)
        tile = draw_outline(small, cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(tile, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
        tiles.append(tile)
    blank = np.full_like(tiles[0], 255)
    rows = [tiles[i : i + columns] for i in range(0, len(tiles), columns)]
    rows[-1] += [blank] * (len(rows[0]) - len(rows[-1]))
    write_png(path, np.concatenate([np.concatenate(row, axis=1) for row in rows]))
