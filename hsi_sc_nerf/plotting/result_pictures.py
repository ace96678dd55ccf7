"""Pictures of a result: views above their renderings, spectra, the cloud. One PNG a function, written by
`save_figure`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import rc_context
from matplotlib.lines import Line2D

from hsi_sc_nerf.plotting.figures import COLOURS, STYLE, new_figure, save_figure, show_image

_DASHED = (0.0, (3.0, 1.5))
_CLOUD_POINTS = 200_000


@rc_context(STYLE)
def draw_views(
    path: Path,
    measured_rgb: Sequence[Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]],
    rendered_rgb: Sequence[Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]],
    names: Sequence[str],
) -> None:
    """Pseudo-RGB (float in [0, 1] or 8 bit) of the measured views above their renderings, half a dozen at most."""
    height, width = measured_rgb[0].shape[:2]
    cell_in = 1.7
    figure = new_figure(max(3.2, cell_in * len(names) + 0.4), 2.0 * cell_in * height / width + 0.3)
    grid = figure.subplots(2, len(names), squeeze=False)
    for line, label, images in zip(grid, ("Measured", "Rendered"), (measured_rgb, rendered_rgb), strict=True):
        line[0].set_ylabel(label)
        for axes, image in zip(line, images, strict=True):
            show_image(axes, image)
    for axes, name in zip(grid[0], names, strict=True):
        axes.set_title(name)
    save_figure(figure, path)


@rc_context(STYLE)
def draw_spectra(
    path: Path,
    wavelengths_nm: Float[np.ndarray, "bands"],
    measured: Float[np.ndarray, "k bands"],
    reconstructed: Float[np.ndarray, "k bands"],
    labels: Sequence[str],
    image: Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"],
    pixels: Float[np.ndarray, "k 2"],
) -> None:
    """Measured and reconstructed spectra of marked points, their differences, and the picture that shows the points.

    Args:
        path: the PNG file.
        wavelengths_nm: band centres.
        measured: reflectance of each point (solid); NaN, where it was not measured, is a gap.
        reconstructed: of each point (dashed).
        labels: a name for each point.
        image: pseudo-RGB, float in [0, 1] or 8 bit.
        pixels: (x, y) of each point in the image, from its upper left corner.
    """
    figure = new_figure(9.0, 3.8)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1, 1.7))[0]
    picture = left.subplots()
    show_image(picture, image)
    spectra, difference = right.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    order = np.argsort(wavelengths_nm)
    nm = np.asarray(wavelengths_nm)[order]
    for index, label in enumerate(labels):
        colour = COLOURS[index % len(COLOURS)]
        x, y = pixels[index]
        picture.plot(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor="white", markeredgewidth=3.5)
        picture.plot(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=2)
        spectra.plot(nm, measured[index][order], color=colour, linewidth=1.4, label=label)
        spectra.plot(nm, reconstructed[index][order], color=colour, linewidth=1.4, linestyle=_DASHED)
        difference.plot(nm, (reconstructed[index] - measured[index])[order], color=colour, linewidth=1.0)
    points = spectra.legend(loc="upper left", handlelength=1.2)
    spectra.add_artist(points)
    lines = [Line2D([], [], color="0.3"), Line2D([], [], color="0.3", linestyle=_DASHED)]
    spectra.legend(lines, ["measured", "reconstructed"], loc="lower right", handlelength=2.2)
    spectra.set(ylabel="reflectance", ylim=(0, None))
    difference.axhline(0, color="0.4", linewidth=0.8)
    difference.set(xlabel="wavelength (nm)", ylabel="reconstructed\n− measured", xlim=(nm[0], nm[-1]))
    right.align_ylabels()
    save_figure(figure, path)


# Title, horizontal axis, vertical axis, axis towards the viewer; each axis with its sign, in the object frame.
_SIDES = (
    ("From the camera's side", (1, 1), (2, 1), (0, 1)),
    ("From the left", (0, 1), (2, 1), (1, -1)),
    ("From above", (1, 1), (0, -1), (2, 1)),
)


@rc_context(STYLE)
def draw_cloud(path: Path, points_m: Float[np.ndarray, "n 3"], colours: UInt8[np.ndarray, "n 3"]) -> None:
    """The cloud, in parallel projection and to one scale, from the camera's side, from the left and from above.

    Args:
        path: the PNG file.
        points_m: positions in the object frame, metres. Above 200 000 points every k-th is drawn.
        colours: pseudo-RGB.
    """
    stride = max(1, math.ceil(len(points_m) / _CLOUD_POINTS))
    points, colours = points_m[::stride] * 1000.0, colours[::stride] / 255.0
    low, high = np.percentile(points, (0.1, 99.9), axis=0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    size = high - low
    outside = int(np.sum(((points < low) | (points > high)).any(1)))
    inch_per_mm = 3.2 / float(size.max())
    widths = [size[side[1][0]] for side in _SIDES]
    heights = [size[side[2][0]] for side in _SIDES]
    # One side shows about half of the points; a little over twice their spacing leaves hardly a gap.
    dot_mm = 2.2 * math.sqrt(2.0 * size[0] * size[2] / len(points))
    figure = new_figure(sum(widths) * inch_per_mm + 0.75 * len(_SIDES), max(heights) * inch_per_mm + 0.85)
    panels = figure.subplots(1, len(_SIDES), width_ratios=widths)
    for axes, (title, (across, across_sign), (up, up_sign), (near, near_sign)) in zip(panels, _SIDES, strict=True):
        order = np.argsort(near_sign * points[:, near])
        axes.scatter(
            points[order, across],
            points[order, up],
            s=max(0.5, dot_mm * inch_per_mm * 72.0) ** 2,
            c=colours[order],
            linewidths=0,
            rasterized=True,
        )
        axes.set(
            title=title,
            xlabel=f"{'xyz'[across]} (mm)",
            ylabel=f"{'xyz'[up]} (mm)",
            xlim=(low[across], high[across])[::across_sign],
            ylim=(low[up], high[up])[::up_sign],
            aspect="equal",
            anchor="N",
        )
    if outside:
        figure.supxlabel(f"{outside / len(points):.2%} of the points lie outside the frame", fontsize=8, color="0.4")
    save_figure(figure, path)
