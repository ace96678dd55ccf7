"""Opacity that a model renders where the object covers half of a pixel, measured at the outlines of training frames.

A pixel on the outline shows the object in a part of its area, its coverage. The measured spectrum tells how large it
is: it lies between the chamber's spectrum beside the outline and the object's inside of it. A trained model may
render the same spectrum by more of a paler object, because nothing but the pixel's spectrum is taught there. So half
a coverage is not half an opacity in general, and the surface is looked for at the opacity that is measured.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.pixels import PixelSampler
from hsi_sc_nerf.processing.chamber import turntable_silhouette
from hsi_sc_nerf.surface.surface_depth import camera_rays

HALF = 0.5
"""Opacity at half a coverage where it cannot be measured: that of a model that renders the coverage itself."""
PLAUSIBLE_OPACITY = (0.3, 0.8)
MEASURED_COVERAGE = (0.4, 0.6)
FEWEST_PIXELS = 50
MOST_PIXELS = 10_000
LEAST_CONTRAST = 0.05
"""Root mean square over the bands between object and chamber, reflectance: less tells no coverage."""
OUTLINE_PX, BESIDE_PX = 1.5, 2.5
"""Pixels this near to the mask's edge may be covered in part. The pure spectra are taken this far from them."""
_SMOOTHING_PX = 1.0


@torch.no_grad()
def outline_opacity(run: TrainedRun, rays_per_batch: int) -> float:
    """The opacity of a run's rays through pixels that the object covers by half (`half_coverage_opacity`).

    Pixels before the turntable are left out, because their background is lit by the object and turns with it.

    Args:
        run: the trained run.
        rays_per_batch: rays rendered at a time.

    Example:
        >>> outline_opacity(open_run(Path("config.yml")), rays_per_batch=4096)
        0.6
    """
    model, cameras = run.model, run.manager.train_dataset.cameras
    poses = [frame.camera_to_world for frame in run.manager.train_dataset.frames]

    def opacity_of(pixels: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        parts = [np.zeros(0)]
        for start in range(0, len(pixels), rays_per_batch):
            frames, lines, samples = pixels[start : start + rays_per_batch].T
            rays = camera_rays(cameras, frames, np.stack([samples, lines], axis=1) + 0.5, model.device)
            parts.append(model.depth_and_opacity(rays)[1][:, 0].cpu().numpy())
        return np.concatenate(parts)

    return half_coverage_opacity(
        run.manager.train_pixel_sampler,
        lambda frame: ~turntable_silhouette(run.dataset, poses[frame]),
        opacity_of,
    )


def half_coverage_opacity(
    sampler: PixelSampler,
    before_chamber: Callable[[int], Bool[np.ndarray, "lines samples"]],
    opacity_of: Callable[[Int[np.ndarray, "n 3"]], Float[np.ndarray, "n"]],
) -> float:
    """Median opacity of the pixels that the object covers by `MEASURED_COVERAGE`; `HALF` if there are too few.

    Args:
        sampler: has the masks and reads the spectra.
        before_chamber: pixels of a frame, given by its index, that show the object or the chamber.
        opacity_of: the model's opacity at pixels (frame, line, sample).
    """
    pixels = outline_pixels(sampler.masks, before_chamber)
    every = max(1, -(-len(pixels[0]) // MOST_PIXELS))
    on, inside, outside = (part[::every] for part in pixels)
    coverage = pixel_coverage(sampler, on, inside, outside)
    low, high = MEASURED_COVERAGE
    half = on[(coverage > low) & (coverage < high)]
    if len(half) < FEWEST_PIXELS:
        return HALF
    return float(np.clip(np.median(opacity_of(half)), *PLAUSIBLE_OPACITY))


def outline_pixels(
    masks: Bool[np.ndarray, "frames lines samples"],
    before_chamber: Callable[[int], Bool[np.ndarray, "lines samples"]],
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]:
    """Pixels on the outlines, and for each one inside and one outside of it, across the outline.

    Args:
        masks: the object in each frame.
        before_chamber: pixels of a frame, given by its index, that show the object or the chamber.

    Returns:
        Pixels (frame, line, sample): on the outline, on the object beside it, and on the chamber beside it.
    """
    found: list[tuple[np.ndarray, ...]] = []
    for frame, mask in enumerate(masks):
        if not mask.any() or mask.all():
            continue
        # Distance from the mask's edge, positive inside; there is no pixel at 0.
        depth_px = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
        chamber = before_chamber(frame)
        on = np.argwhere((np.abs(depth_px) <= OUTLINE_PX) & chamber)
        inwards = np.stack(np.gradient(ndimage.gaussian_filter(depth_px, _SMOOTHING_PX)), axis=-1)[tuple(on.T)]
        inwards /= np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-9)
        inside, outside = (np.rint(on + sign * BESIDE_PX * inwards).astype(int) for sign in (1.0, -1.0))
        within = [((places >= 0) & (places < mask.shape)).all(axis=1) for places in (inside, outside)]
        on, inside, outside = (places[within[0] & within[1]] for places in (on, inside, outside))
        pure = (depth_px[tuple(inside.T)] >= OUTLINE_PX) & (depth_px[tuple(outside.T)] <= -OUTLINE_PX)
        pure &= chamber[tuple(outside.T)]
        found.append(tuple(np.insert(places[pure], 0, frame, axis=1) for places in (on, inside, outside)))
    if not found:
        empty = np.zeros((0, 3), int)
        return empty, empty, empty
    on, inside, outside = (np.concatenate(part) for part in zip(*found, strict=True))
    return on, inside, outside


def pixel_coverage(
    sampler: PixelSampler, on: Int[np.ndarray, "n 3"], inside: Int[np.ndarray, "n 3"], outside: Int[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Fraction of each pixel's area that the object covers, from two pure spectra beside it, by least squares.

    Args:
        sampler: reads the spectra.
        on: pixels (frame, line, sample) that are covered in part.
        inside: pixels of the object, one for each.
        outside: pixels of the background, likewise.

    Returns:
        About 0 to 1, with the noise of the spectra; NaN where the two spectra are too much alike.
    """
    batches = [sampler.at(places) for places in (on, inside, outside)]
    mixed, covered, bare = (batch["spectral"].astype(np.float64) for batch in batches)
    valid = np.logical_and.reduce([batch.get("valid", np.ones(mixed.shape, bool)) for batch in batches])
    contrast = np.where(valid, covered - bare, 0.0)
    energy = (contrast**2).sum(axis=1)
    tells = energy > LEAST_CONTRAST**2 * np.maximum(valid.sum(axis=1), 1)
    projected = ((mixed - bare) * contrast).sum(axis=1)
    return np.divide(projected, energy, out=np.full(len(on), np.nan), where=tells)
