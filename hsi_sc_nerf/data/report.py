"""Pictures by which a user checks the calibration and the masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hsi_sc_nerf.data.atomic import atomic_write, write_png
from hsi_sc_nerf.data.calibration.white_reference import WhiteReference
from hsi_sc_nerf.data.envi import Cube
from hsi_sc_nerf.data.pseudo_rgb import nearest_bands, to_8_bit

_OUTLINE_RGB = (255, 0, 200)


def white_reference_picture(path: Path, cube: Cube, white: WhiteReference, rgb_nm: Sequence[float]) -> None:
    """Draw the tarp, its deviation map, the kept region and the white spectrum before and after smoothing.

    Raises:
        InputError: the operating system refused to write.
    """
    x0, y0, x1, y1 = white.roi
    raw = cube.memmap()[..., nearest_bands(cube.wavelengths_nm, rgb_nm)].astype(float)
    image = to_8_bit(raw / np.maximum(np.percentile(raw, 99.5, axis=(0, 1)), 1e-9))
    kept = np.zeros(cube.shape[:2], dtype=bool)
    kept[y0:y1, x0:x1] = white.mask

    figure = Figure(figsize=(14, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([["tarp", "deviation", "mask"], ["spectrum"] * 3])
    tarp, deviation, mask, spectrum = (axes[name] for name in ("tarp", "deviation", "mask", "spectrum"))
    tarp.imshow(image)
    tarp.add_patch(Rectangle((x0 - 0.5, y0 - 0.5), x1 - x0, y1 - y0, fill=False, edgecolor="tab:red", linewidth=2))
    tarp.set_title("White tarp and its coarse region")
    shown = deviation.imshow(white.deviation, cmap="viridis", extent=(x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5))
    figure.colorbar(shown, ax=deviation)
    deviation.set_title("Deviation D from the mean spectrum")
    mask.imshow(outlined(image, kept))
    mask.set_title(f"Region kept: {int(white.mask.sum())} pixels")

    spectrum.plot(cube.wavelengths_nm, white.measured, color="tab:gray", label="measured")
    spectrum.plot(cube.wavelengths_nm, white.spectrum, color="tab:blue", label="smoothed")
    spectrum.set(xlabel="wavelength (nm)", ylabel="counts above dark", title="White spectrum")
    spectrum.legend()
    with atomic_write(path) as (temporary,):
        figure.savefig(temporary, dpi=100)


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
        tile = outlined(small, cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(tile, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
        tiles.append(tile)
    blank = np.full_like(tiles[0], 255)
    rows = [tiles[i : i + columns] for i in range(0, len(tiles), columns)]
    rows[-1] += [blank] * (len(rows[0]) - len(rows[-1]))
    write_png(path, np.concatenate([np.concatenate(row, axis=1) for row in rows]))


def outlined(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], colour: tuple[int, int, int] = _OUTLINE_RGB
) -> UInt8[np.ndarray, "h w 3"]:
    """A copy of the image with the mask's outline drawn over it."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(image).copy(), contours, -1, colour, 1)
