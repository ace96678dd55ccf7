"""Opacity that a model renders where the object covers half of a pixel, measured at the outlines of training frames.

The object covers only a part of a pixel on its outline. This coverage follows from the measured spectrum, which lies
between the spectrum of the chamber outside the outline and that of the object inside it. A trained model may render
the same spectrum with more of a paler object, because it is trained on the pixel's spectrum alone. So half a coverage
is in general not an opacity of one half, and the surface is placed at the measured opacity.

The coverage cannot be measured if the rim of the object has another brightness than its inside. Gloss makes the rim
resemble the chamber, which it mirrors, and a lamp in front leaves it darker. Both also change the rim's pixels that
the object covers completely, which are therefore compared with pixels further inside.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.packed.pixels import PixelSampler
from hsi_sc_nerf.processing.chamber import turntable_silhouette
from hsi_sc_nerf.surface.surface_depth import camera_rays

HALF = 0.5
"""Opacity at half coverage if it cannot be measured: that of a model that renders the coverage itself."""
PLAUSIBLE_OPACITY = (0.3, 0.8)
MEASURED_COVERAGE = (0.4, 0.6)
FEWEST_PIXELS = 50
MOST_PIXELS, MOST_FRAMES = 10_000, 24
LEAST_CONTRAST = 0.05
"""Least difference between object and chamber, reflectance (RMS over the bands), with which coverage is measured."""
OUTLINE_PX = (-1.5, 1.5)
"""Depths inside the mask at which the object may cover a part of a pixel."""
RIM_PX = (1.5, 2.5)
"""Depths of the outermost pixels that the object covers completely."""
PURE_PX, DEEP_PX = 2.5, 5.0
"""Distances from the outline at which the pure spectra of object and chamber are taken, and those that the rim is
compared with."""
RIM_CHANGE = 0.025
"""Largest change of the rim's median brightness relative to deep pixels with which the coverage is measured
(docs/validation/surface.md)."""
_SMOOTHING_PX = 1.0


@torch.no_grad()
def outline_opacity(run: TrainedRun, rays_per_batch: int) -> float:
    """The opacity of a run's rays through pixels that the object covers by half (`half_coverage_opacity`).

    Pixels in front of the turntable are left out: their background receives light from the object and turns with it.

    Args:
        rays_per_batch: rays rendered at a time.

    Example:
        >>> outline_opacity(open_trained_run(Path("config.yml")), rays_per_batch=4096)
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
    """Median opacity of the pixels that the object covers by `MEASURED_COVERAGE`.

    `HALF` if there are too few such pixels, or if the rim has another brightness than the object's inside.

    Args:
        sampler: has the masks and reads the spectra.
        before_chamber: pixels of a frame, given by its index, that show the object or the chamber.
        opacity_of: the model's opacity at pixels (frame, line, sample).
    """
    pixels = _some(outline_pixels(sampler.masks, before_chamber, OUTLINE_PX, PURE_PX))
    coverage = pixel_coverage(sampler, *pixels)
    low, high = MEASURED_COVERAGE
    half = pixels[0][(coverage > low) & (coverage < high)]
    if len(half) < FEWEST_PIXELS:
        return HALF
    rim, deep, _ = _some(outline_pixels(sampler.masks, before_chamber, RIM_PX, DEEP_PX))
    if len(rim) < FEWEST_PIXELS or abs(rim_brightness(sampler, rim, deep) - 1.0) > RIM_CHANGE:
        return HALF
    return float(np.clip(np.median(opacity_of(half)), *PLAUSIBLE_OPACITY))


def _some(pixels: tuple[Int[np.ndarray, "n 3"], ...]) -> list[Int[np.ndarray, "m 3"]]:
    """At most `MOST_PIXELS` of the pixels, evenly chosen."""
    return [part[:: max(1, -(-len(part) // MOST_PIXELS))] for part in pixels]


def rim_brightness(sampler: PixelSampler, rim: Int[np.ndarray, "n 3"], deep: Int[np.ndarray, "n 3"]) -> float:
    """Median brightness of pixels of the rim relative to pixels further inside, one for each."""
    batches = [sampler.at(pixels) for pixels in (rim, deep)]
    spectra = [batch["spectral"] for batch in batches]
    both = np.logical_and.reduce([batch.get("valid", np.ones(spectra[0].shape, bool)) for batch in batches])
    at_rim, inside = ((part * both).sum(axis=1) for part in spectra)
    return float(np.median(at_rim / np.maximum(inside, 1e-6)))


def outline_pixels(
    masks: Bool[np.ndarray, "frames lines samples"],
    before_chamber: Callable[[int], Bool[np.ndarray, "lines samples"]],
    depths_px: tuple[float, float],
    inside_px: float,
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"], Int[np.ndarray, "n 3"]]:
    """Pixels near the outlines of some frames, and for each one inside and one outside of it, across the outline.

    Args:
        masks: the object in each frame.
        before_chamber: pixels of a frame, given by its index, that show the object or the chamber.
        depths_px: least and largest depth of the pixels inside the mask; negative outside of it.
        inside_px: depth of the pixels inside. Those outside are `PURE_PX` beside the mask.

    Returns:
        Pixels (frame, line, sample) near the outline, on the object inside it, and on the chamber outside it.
    """
    found = [(np.zeros((0, 3), int),) * 3]
    for frame in range(0, len(masks), -(-len(masks) // MOST_FRAMES)):
        mask = masks[frame]
        if not mask.any() or mask.all():
            continue
        # There is no pixel at depth 0.
        depth_px = ndimage.distance_transform_edt(mask) - ndimage.distance_transform_edt(~mask)
        chamber = before_chamber(frame)
        on = np.argwhere((depth_px >= depths_px[0]) & (depth_px <= depths_px[1]) & chamber)
        gradient = np.stack(np.gradient(ndimage.gaussian_filter(depth_px, _SMOOTHING_PX)), axis=-1)
        inwards = unit_vectors(gradient[tuple(on.T)])
        of_on = depth_px[tuple(on.T)][:, None]
        inside, outside = (np.rint(on + (to_px - of_on) * inwards).astype(int) for to_px in (inside_px, -PURE_PX))
        within = [((pixels >= 0) & (pixels < mask.shape)).all(axis=1) for pixels in (inside, outside)]
        on, inside, outside = (pixels[within[0] & within[1]] for pixels in (on, inside, outside))
        pure = (depth_px[tuple(inside.T)] >= inside_px - 1.0) & (depth_px[tuple(outside.T)] <= 1.0 - PURE_PX)
        pure &= chamber[tuple(outside.T)]
        found.append(tuple(np.insert(pixels[pure], 0, frame, axis=1) for pixels in (on, inside, outside)))
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
        About 0 to 1, with the noise of the spectra; NaN where the two spectra are too similar.
    """
    batches = [sampler.at(pixels) for pixels in (on, inside, outside)]
    mixed, covered, bare = (batch["spectral"].astype(np.float64) for batch in batches)
    valid = np.logical_and.reduce([batch.get("valid", np.ones(mixed.shape, bool)) for batch in batches])
    contrast = np.where(valid, covered - bare, 0.0)
    energy = (contrast**2).sum(axis=1)
    differs = energy > LEAST_CONTRAST**2 * np.maximum(valid.sum(axis=1), 1)
    projected = ((mixed - bare) * contrast).sum(axis=1)
    return np.divide(projected, energy, out=np.full(len(on), np.nan), where=differs)
