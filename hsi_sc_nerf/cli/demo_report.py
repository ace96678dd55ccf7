"""Results of the demo: scores against the truth, images, tables and ``summary.json``."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib import rc_context
from matplotlib.lines import Line2D
from PIL import Image
from rich.console import Console
from rich.markup import escape
from scipy.spatial import cKDTree

from hsi_sc_nerf import __version__, paper
from hsi_sc_nerf.benchmark.steps import StepCost
from hsi_sc_nerf.evaluation.spatial import precision_recall_f_score, sample_surface
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset, open_packed
from hsi_sc_nerf.plotting import COLOURS, STYLE, new_figure, save_figure, show_image
from hsi_sc_nerf.simulate.scores import ProcessingScore, score_processing
from hsi_sc_nerf.simulate.truth import load_truth
from hsi_sc_nerf.terminal import screen_table

SPECTRAL_METRICS = ("sam", "rmse", "ssim", "psnr")
REFERENCE_POINTS = 100_000
MARKED_POINTS = 4
FRONT_LAYER_M = 0.005
# The paper's results of the apple, its hardest object, for comparison.
PAPER_APPLE = {"sam": 0.0642, "rmse": 0.0438, "ssim": 0.742, "psnr": 24.49}
_DASHED = (0.0, (3.0, 1.5))
_CLOUD_POINTS = 200_000


def score(out: Path) -> tuple[dict[str, float], ProcessingScore]:
    """Metrics of the result, and errors of the processed dataset.

    The metrics are those of ``ns-eval`` on held-out views, and precision, recall and F-score of the cloud against the
    true mesh without alignment.
    """
    results = json.loads((out / "eval.json").read_text(encoding="utf-8"))["results"]
    metrics = {f"{key}{end}": results[f"{key}{end}"] for key in SPECTRAL_METRICS for end in ("", "_std")}
    truth = load_truth(out / "session")
    mesh, cloud = truth.mesh(), read_spectral_ply(out / "point_cloud.ply")
    reference = sample_surface(mesh.vertices, mesh.triangles, REFERENCE_POINTS)
    spatial = precision_recall_f_score(cloud.points, reference, paper.F_SCORE_THRESHOLD_M)
    metrics |= asdict(spatial)
    return metrics, score_processing(open_packed(out / "data"), truth)


def write_summary(
    out: Path, metrics: dict[str, float], processing: ProcessingScore, costs: Sequence[StepCost]
) -> None:
    """Write ``summary.json``: metrics, errors of the processing, steps, version and machine."""
    write_json(
        out / "summary.json",
        {
            "metrics": metrics,
            "processing": asdict(processing),
            "steps": [asdict(cost) for cost in costs],
            "seconds": sum(cost.seconds for cost in costs),
            "f_score_threshold_m": paper.F_SCORE_THRESHOLD_M,
            "version": __version__,
            "machine": {"system": platform.platform(), "python": platform.python_version(), "cores": os.cpu_count()},
        },
    )


def show_table(
    console: Console, out: Path, metrics: dict[str, float], processing: ProcessingScore, costs: Sequence[StepCost]
) -> None:
    """Print metrics, errors and costs."""
    titles = {"sam": "SAM, rad", "rmse": "RMSE", "ssim": "SSIM", "psnr": "PSNR, dB", "f_score": "F-score at 2 mm, %"}
    quality = []
    for key, title in titles.items():
        digits = 1 if key in ("psnr", "f_score") else 4
        published = f"{PAPER_APPLE[key]:.{digits}f}" if key in PAPER_APPLE else "-"
        spread = f" ± {metrics[f'{key}_std']:.{digits}f}" if f"{key}_std" in metrics else ""
        quality.append([title, f"{metrics[key]:.{digits}f}{spread}", published])
    errors = [
        ["rotation, degrees (largest)", f"{processing.rotation_deg:.3f}", "0.5"],
        ["position, mm (largest)", f"{1000 * processing.position_m:.2f}", "1"],
        ["focal length, %", f"{processing.focal_length_percent:.2f}", "-"],
        ["reflectance, RMSE", f"{processing.reflectance_rmse:.4f}", "0.02"],
        ["values flagged, %", f"{100 * processing.flagged_fraction:.2f}", "-"],
        ["mask, IoU (smallest)", f"{processing.mask_iou:.3f}", "-"],
    ]
    steps = [[cost.name, f"{cost.seconds:.1f}", f"{cost.peak_memory_mib:.0f}"] for cost in costs]
    steps.append(["all", f"{sum(cost.seconds for cost in costs):.1f}", ""])
    judged = "Held-out views, masked to the object; cloud against the true mesh"
    console.print(
        screen_table(["metric", "mean ± SD", "paper's apple"], quality, judged),
        screen_table(["error", "value", "target"], errors, "Processing against the truth"),
        screen_table(["step", "seconds", "peak memory, MiB"], steps, "Cost"),
    )
    console.print(f"Pictures, cloud and summary.json are in {escape(str(out))}.", soft_wrap=True)


def draw_pictures(out: Path) -> None:
    """Draw ``views.png``, ``spectra.png`` and ``cloud.png``, and copy ``poses.png``."""
    dataset = open_packed(out / "data")
    cloud = read_spectral_ply(out / "point_cloud.ply")
    renders = sorted((out / "renders").glob("*_img_*.png"))
    halves = [np.split(np.asarray(Image.open(path).convert("RGB")), 2, axis=1) for path in renders]
    names = [f"held-out view {i + 1}" for i in range(len(halves))]
    draw_views(out / "views.png", [h[0] for h in halves], [h[1] for h in halves], names)
    draw_cloud(out / "cloud.png", cloud.points, cloud.colours)
    _draw_marked_spectra(out / "spectra.png", dataset, cloud.points, cloud.spectra)
    (out / "poses.png").write_bytes((out / "data" / "report" / "poses.png").read_bytes())


def _draw_marked_spectra(path: Path, dataset: PackedDataset, points: np.ndarray, spectra: np.ndarray) -> None:
    """Draw spectra of the cloud at some pixels of the first frame beside the measured ones."""
    frame = dataset.frames[0]
    pixels = _spread_pixels(frame.mask(), MARKED_POINTS)
    image_points, depth = project(points, frame.camera_to_world, dataset.intrinsics, dataset.distortion)
    tree = cKDTree(image_points)
    seen = []
    for pixel in pixels:
        behind = np.array(tree.query_ball_point(pixel, 0.5) or [tree.query(pixel)[1]])
        # Only the layer of points nearest to the camera is visible in the pixel.
        front = behind[depth[behind] < depth[behind].min() + FRONT_LAYER_M]
        seen.append(spectra[front].mean(axis=0))
    columns, lines = np.floor(pixels).astype(int).T
    measured, valid = unpack(frame.cube()[lines, columns])
    measured[~valid] = np.nan  # NaN leaves a gap in the curve
    labels = [chr(ord("A") + i) for i in range(len(pixels))]
    draw_spectra(path, dataset.wavelengths_nm, measured, np.array(seen), labels, frame.pseudo_rgb(), pixels)


def _spread_pixels(mask: np.ndarray, count: int) -> np.ndarray:
    """Centres (x, y) of ``count`` pixels inside the mask, spread from its top to its bottom."""
    inside = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    lines, columns = np.nonzero(inside if inside.any() else mask)
    heights = np.quantile(lines, (np.arange(count) + 0.5) / count).round().astype(int)
    pixels = []
    for i, line in enumerate(heights):
        row = np.sort(columns[lines == lines[np.abs(lines - line).argmin()]])
        # The pixels alternate between the sides of the object, whose spectra differ.
        pixels.append((row[int((0.25 if i % 2 else 0.75) * (len(row) - 1))] + 0.5, line + 0.5))
    return np.array(pixels)


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
        measured: reflectance of each point (solid); NaN, where it was not measured, is a gap.
        reconstructed: of each point (dashed).
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
        points_m: positions in the object frame, metres. Above 200 000 points every k-th is drawn.
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
