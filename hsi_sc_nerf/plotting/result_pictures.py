"""Pictures of a result: views beside their renderings, spectra, the cloud, training curves. One PNG a function.

Drawn without a display and without matplotlib's global state; written whole or not at all (full disk: InputError).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import colormaps, rc_context
from matplotlib.lines import Line2D

from hsi_sc_nerf.plotting.false_colour import ANGLE_COLOURS
from hsi_sc_nerf.plotting.figures import COLOURS, STYLE, new_figure, save_figure, show_image

_DASHED = (0.0, (3.0, 1.5))
_CLOUD_POINTS = 200_000


def _finite_mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else math.nan


@rc_context(STYLE)
def draw_views(
    path: Path,
    truth_rgb: Sequence[Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]],
    rendered_rgb: Sequence[Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]],
    names: Sequence[str],
    angle_maps_rad: Sequence[Float[np.ndarray, "h w"]] | None = None,
) -> None:
    """Pseudo-RGB of the measured views above their renderings and, below, maps of the spectral angle between them.

    Args:
        path: The PNG file.
        truth_rgb: Measured views, float in [0, 1] or 8 bit.
        rendered_rgb: Rendered views, likewise.
        names: A title for each view; the views stand side by side, so half a dozen is what a page takes.
        angle_maps_rad: Spectral angle of each pixel, radians; NaN (outside the mask, say) is drawn grey. The colour
            scale, common to all views, ends at their 99th percentile.
    """
    labels = ["Measured", "Rendered"] + (["Spectral angle"] if angle_maps_rad is not None else [])
    height, width = truth_rgb[0].shape[:2]
    cell_in = 1.7
    figure = new_figure(
        max(3.2, cell_in * len(names) + 0.4 + (0.7 if angle_maps_rad is not None else 0.0)),
        cell_in * height / width * len(labels) + 0.3 + (0.2 if angle_maps_rad is not None else 0.0),
    )
    grid = figure.subplots(len(labels), len(names), squeeze=False)
    for column, name in enumerate(names):
        grid[0, column].set_title(name)
        for row, images in enumerate((truth_rgb, rendered_rgb)):
            show_image(grid[row, column], images[column])
    for row, label in enumerate(labels):
        grid[row, 0].set_ylabel(label)
    if angle_maps_rad is not None:
        angles = np.concatenate([angle_map[np.isfinite(angle_map)] for angle_map in angle_maps_rad])
        top = float(np.percentile(angles, 99)) if len(angles) else 1.0
        colours = colormaps[ANGLE_COLOURS].with_extremes(bad="0.85")
        for column, angle_map in enumerate(angle_maps_rad):
            drawn = show_image(grid[2, column], angle_map, cmap=colours, vmin=0, vmax=top or 1.0)
            grid[2, column].set_xlabel(f"mean {_finite_mean(angle_map):.4f} rad")
        figure.colorbar(drawn, ax=grid[2].tolist(), label="rad", extend="max", fraction=0.05, aspect=15, pad=0.02)
    save_figure(figure, path)


@rc_context(STYLE)
def draw_spectra(
    path: Path,
    wavelengths_nm: Float[np.ndarray, "bands"],
    truth: Float[np.ndarray, "k bands"],
    reconstructed: Float[np.ndarray, "k bands"],
    labels: Sequence[str],
    image: Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"],
    pixels: Float[np.ndarray, "k 2"],
) -> None:
    """Measured and reconstructed spectra of marked points, their differences, and the picture that shows the points.

    Args:
        path: The PNG file.
        wavelengths_nm: Band centres.
        truth: Measured reflectance of each point (solid); NaN, where it was not measured, is a gap.
        reconstructed: Reflectance of each point in the reconstruction (dashed).
        labels: A name for each point.
        image: Pseudo-RGB, float in [0, 1] or 8 bit.
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
        spectra.plot(nm, truth[index][order], color=colour, linewidth=1.4, label=label)
        spectra.plot(nm, reconstructed[index][order], color=colour, linewidth=1.4, linestyle=_DASHED)
        difference.plot(nm, (reconstructed[index] - truth[index])[order], color=colour, linewidth=1.0)
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
def draw_cloud(
    path: Path,
    points_m: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    views: int = 3,
) -> None:
    """The cloud, in parallel projection and to one scale, from the camera's side, from the left and from above.

    Args:
        path: The PNG file.
        points_m: Positions in the object frame, metres. Above 200 000 points every k-th is drawn.
        colours: Pseudo-RGB.
        views: How many of the three sides to draw.
    """
    stride = max(1, math.ceil(len(points_m) / _CLOUD_POINTS))
    points, colours = points_m[::stride] * 1000.0, colours[::stride] / 255.0
    low, high = np.percentile(points, (0.1, 99.9), axis=0) if len(points) else (np.zeros(3), np.ones(3))
    margin = 0.05 * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    size = high - low
    outside = int(np.sum(((points < low) | (points > high)).any(1)))
    sides = _SIDES[:views]
    inch_per_mm = 3.2 / float(size.max())
    widths = [size[side[1][0]] for side in sides]
    heights = [size[side[2][0]] for side in sides]
    # One side shows about half of the points; a little over twice their spacing leaves hardly a gap.
    dot_mm = 2.2 * math.sqrt(2.0 * size[0] * size[2] / max(len(points), 1))
    figure = new_figure(sum(widths) * inch_per_mm + 0.75 * len(sides), max(heights) * inch_per_mm + 0.85)
    for axes, side in zip(figure.subplots(1, len(sides), width_ratios=widths, squeeze=False)[0], sides, strict=True):
        title, (across, across_sign), (up, up_sign), (near, near_sign) = side
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
