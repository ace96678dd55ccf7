"""Export the spectral cloud of a trained run, for `ns-export pointcloud` and `hsi-sc-nerf export`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from operator import and_
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import (
    CHUNK_POINTS,
    INCIDENCE,
    CloudStream,
    SpectralCloud,
    estimate_normals,
    statistical_inliers,
)
from hsi_sc_nerf.export.formats import require_format, write_cloud
from hsi_sc_nerf.export.options import CloudOptions, select_bands
from hsi_sc_nerf.files import require_writable
from hsi_sc_nerf.models.trained_run import TrainedRun
from hsi_sc_nerf.spectra import to_8_bit
from hsi_sc_nerf.surface.depth_renders import DepthRenders, render_depth_maps
from hsi_sc_nerf.surface.outline_opacity import outline_opacity
from hsi_sc_nerf.surface.regions import (
    EVERYWHERE,
    Region,
    box_region,
    oriented_box_region,
    painted_region,
    read_roi_masks,
    visual_hull_region,
)
from hsi_sc_nerf.surface.surface_depth import camera_rays, render_object
from hsi_sc_nerf.surface.surface_points import SurfacePoints, sample_surface_points
from hsi_sc_nerf.surface.view_statistics import STATISTICS, view_statistics
from hsi_sc_nerf.terminal import progress_bar

EXTRA = ("opacity", INCIDENCE, *STATISTICS)


def export_cloud(run: TrainedRun, output_dir: Path, options: CloudOptions, name: str = "") -> Path:
    """Write the cloud of a run to ``OUTPUT_DIR/point_cloud.*`` (metres, object frame) and return its path.

    Spectra are rendered and written in chunks, so that memory does not grow with the number of points. The file
    states the run's ``name``.

    Raises:
        InputError: the model holds no object, the options contradict the run, or the file cannot be written.

    Example:
        >>> run = open_trained_run(Path("outputs/pear/hsi-sc-nerf/2026-11-22_101500/config.yml"))
        >>> export_cloud(run, Path("export"), CloudOptions(num_points=100_000))
        PosixPath('export/point_cloud.ply')
    """
    target = Path(output_dir) / "point_cloud"
    require_writable(target.parent)
    bands = select_bands(run.model.wavelengths_nm, options.bands)
    require_format(target, options.format, len(bands), len(EXTRA))
    cloud = render_cloud(run, options, name)
    path = write_cloud(target, cloud, options.format)
    unit = "metres" if run.dataset.metric else "distances of the camera (nothing gave the scale)"
    summary = f"{cloud.count:,} points with {len(bands)} bands, in {unit}: {escape(str(path))}"
    CONSOLE.print(f"[bold green]{summary}", soft_wrap=True)
    return path


def render_cloud(run: TrainedRun, options: CloudOptions, name: str = "") -> CloudStream:
    """The cloud of a run: the points on its surface, whose spectra are rendered when the chunks are iterated over.

    Raises:
        InputError: the model holds no object, or the options contradict the run.
    """
    bands = select_bands(run.model.wavelengths_nm, options.bands)
    sampler, dataset = run.manager.train_pixel_sampler, run.manager.train_dataset
    painted_masks = None
    if options.roi_masks is not None:
        painted_masks = read_roi_masks(options.roi_masks, dataset.frames, sampler.masks[0].shape)
    masks = np.ones_like(sampler.masks) if options.keep_turntable else sampler.masks
    batch = min(options.num_rays_per_batch, run.model.config.eval_num_rays_per_chunk)
    renders = render_depth_maps(run.model, dataset.cameras, masks, batch)
    box_m = run.dataset.scene_box_m if options.keep_turntable else run.dataset.object_box_m
    region = _region(run, renders, options, painted_masks)
    at_outline = outline_opacity(run, batch)
    surface = sample_surface_points(
        run.model, renders, options.num_points, batch, run.to_scene(box_m), region, at_outline
    )
    if len(surface) < options.num_points:
        CONSOLE.print(f"[yellow]Only {len(surface):,} points were found: the region holds hardly any surface.")
    if options.remove_outliers:
        surface = surface.select(statistical_inliers(surface.points, options.std_ratio))
        if not len(surface):
            raise InputError("every point counts as an outlier; give a larger --std-ratio.")
    normals = surface.mesh_normals
    if options.normal_method == "open3d":
        normals = estimate_normals(surface.points, normals)
    chunks = _render_chunks(run, renders, surface, normals.astype(np.float32), bands, batch)
    return CloudStream(len(surface), run.model.wavelengths_nm[bands], EXTRA, chunks, name, run.dataset.metric)


def _region(
    run: TrainedRun,
    renders: DepthRenders,
    options: CloudOptions,
    painted_masks: dict[int, Bool[np.ndarray, "lines samples"]] | None,
) -> Region:
    """The intersection of all regions that the options name."""
    regions = [EVERYWHERE]
    if not options.keep_turntable:
        regions.append(visual_hull_region(renders))
    if options.obb_center is not None and options.obb_rotation is not None and options.obb_scale is not None:
        regions.append(oriented_box_region(options.obb_center, options.obb_rotation, options.obb_scale))
    if options.roi_box is not None:
        regions.append(box_region(run.to_scene(np.reshape(options.roi_box, (2, 3)))))
    if painted_masks is not None:
        regions.append(painted_region(painted_masks, renders))
    return reduce(and_, regions)


def _render_chunks(
    run: TrainedRun,
    renders: DepthRenders,
    surface: SurfacePoints,
    normals: Float[np.ndarray, "n 3"],
    bands: Int[np.ndarray, "selected"],
    batch: int,
) -> Iterator[SpectralCloud]:
    """The cloud's chunks, each rendered when it is written."""
    frames, reader = run.manager.train_dataset.frames, run.manager.train_pixel_sampler.reader
    flags = np.stack([frame.flags() for frame in frames]) if run.dataset.flagged_values else None
    with progress_bar("rendering spectra", "points", len(surface)) as update:
        for start in range(0, len(surface), CHUNK_POINTS):
            chunk = surface.select(slice(start, start + CHUNK_POINTS))
            parts = [_render_points(run, chunk.select(slice(i, i + batch))) for i in range(0, len(chunk), batch)]
            spectra, opacity = (np.concatenate(column) for column in zip(*parts, strict=True))
            points, outward = (
                torch.from_numpy(array).float().to(run.model.device) for array in (chunk.points, chunk.mesh_normals)
            )
            statistics = view_statistics(points, outward, spectra[:, bands], bands, renders, reader, flags)
            yield SpectralCloud(
                run.to_metres(chunk.points).astype(np.float32),
                normals[start : start + CHUNK_POINTS],
                to_8_bit(spectra[:, run.model.rgb_bands]),
                spectra[:, bands],
                run.model.wavelengths_nm[bands],
                {"opacity": opacity, INCIDENCE: chunk.incidence_deg.astype(np.float32), **statistics},
            )
            update(min(start + CHUNK_POINTS, len(surface)))


@torch.no_grad()
def _render_points(
    run: TrainedRun, surface: SurfacePoints
) -> tuple[Float[np.ndarray, "n bands"], Float[np.ndarray, "n"]]:
    """The object's reflectance along the ray of each point, and the ray's opacity."""
    rays = camera_rays(run.manager.train_dataset.cameras, surface.frames, surface.xy_px, run.model.device)
    outputs, spectra = render_object(run.model, rays)
    return spectra.cpu().numpy(), outputs["accumulation"][:, 0].cpu().numpy()
