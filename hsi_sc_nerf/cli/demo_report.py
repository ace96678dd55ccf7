"""Results of the demo: scores against the truth, images, tables and ``summary.json``."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.spatial import cKDTree

from hsi_sc_nerf import __version__, paper
from hsi_sc_nerf.benchmark.steps import StepCost
from hsi_sc_nerf.evaluation.spatial import precision_recall_f_score, sample_surface
from hsi_sc_nerf.export.ply import read_spectral_ply
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.packed.cube import unpack
from hsi_sc_nerf.packed.dataset import PackedDataset, open_packed
from hsi_sc_nerf.plotting.result_pictures import draw_cloud, draw_spectra, draw_views
from hsi_sc_nerf.simulate.processing_score import ProcessingScore, score_processing
from hsi_sc_nerf.simulate.truth import load_truth

SPECTRAL_METRICS = ("sam", "rmse", "ssim", "psnr")
REFERENCE_POINTS = 100_000
MARKED_POINTS = 4
FRONT_LAYER_M = 0.005
# The paper's results of the apple, its hardest object, for comparison.
PAPER_APPLE = {"sam": 0.0642, "rmse": 0.0438, "ssim": 0.742, "psnr": 24.49}


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
    quality = Table(
        *("metric", "mean ± SD", "paper's apple"),
        title="Held-out views, masked to the object; cloud against the true mesh",
    )
    units = {"sam": "SAM, rad", "rmse": "RMSE", "ssim": "SSIM", "psnr": "PSNR, dB", "f_score": "F-score at 2 mm, %"}
    for key, title in units.items():
        digits = 1 if key in ("psnr", "f_score") else 4
        published = f"{PAPER_APPLE[key]:.{digits}f}" if key in PAPER_APPLE else "-"
        spread = f" ± {metrics[f'{key}_std']:.{digits}f}" if f"{key}_std" in metrics else ""
        quality.add_row(title, f"{metrics[key]:.{digits}f}{spread}", published)
    errors_table = Table("error", "value", "target", title="Processing against the truth")
    for row in (
        ("rotation, degrees (largest)", f"{processing.rotation_deg:.3f}", "0.5"),
        ("position, mm (largest)", f"{1000 * processing.position_m:.2f}", "1"),
        ("focal length, %", f"{processing.focal_length_percent:.2f}", "-"),
        ("reflectance, RMSE", f"{processing.reflectance_rmse:.4f}", "0.02"),
        ("values flagged, %", f"{100 * processing.flagged_fraction:.2f}", "-"),
        ("mask, IoU (smallest)", f"{processing.mask_iou:.3f}", "-"),
    ):
        errors_table.add_row(*row)
    cost_table = Table("step", "seconds", "peak memory, MiB", title="Cost")
    for cost in costs:
        cost_table.add_row(cost.name, f"{cost.seconds:.1f}", f"{cost.peak_memory_mib:.0f}")
    cost_table.add_row("all", f"{sum(cost.seconds for cost in costs):.1f}", "")
    console.print(quality, errors_table, cost_table)
    console.print(f"Pictures, cloud and summary.json are in {escape(str(out))}.")


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
    image_points, depth = project(points, frame.camera_to_world, dataset.intrinsics)
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
