"""Export the spectral cloud of a trained run, for `ns-export pointcloud` and `hsi-sc-nerf export`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import and_
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor
from torch.nn import functional

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
from hsi_sc_nerf.models.spectral_model import SpectralModel
from hsi_sc_nerf.models.trained_run import TrainedRun, open_run
from hsi_sc_nerf.progress import progress_bar
from hsi_sc_nerf.spectra.pseudo_rgb import to_8_bit
from hsi_sc_nerf.surface.depth_renders import DepthRenders, render_depth_maps
from hsi_sc_nerf.surface.regions import (
    EVERYWHERE,
    Region,
    box_region,
    cylinder_region,
    oriented_box_region,
    painted_region,
    read_roi_masks,
    visual_hull_region,
)
from hsi_sc_nerf.surface.surface_depth import camera_rays, model_output, render_object
from hsi_sc_nerf.surface.surface_points import SurfacePoints, sample_surface_points
from hsi_sc_nerf.surface.view_statistics import COLUMNS, view_statistics

if TYPE_CHECKING:
    from nerfstudio.scripts.exporter import ExportPointCloud

NAME = "point_cloud"
EXTRA = ("opacity", INCIDENCE, *COLUMNS)


def export_cloud(run: TrainedRun, output_dir: Path, options: CloudOptions) -> Path:
    """Write the cloud of a run to ``OUTPUT_DIR/point_cloud.*`` (metres, object frame) and return its path.

    Columns beside spectra, normals and colours: ``opacity`` of the point's ray, ``incidence_deg`` between the ray and
    the normal, and those of `view_statistics`.

    Raises:
        InputError: the model holds no object, an option cannot be met, or the file cannot be written.

    Example:
        >>> run = open_run(Path("outputs/pear/hsi-sc-nerf/2026-11-22_120000/config.yml"))
        >>> export_cloud(run, Path("export"), CloudOptions(num_points=100_000))
        PosixPath('export/point_cloud.ply')
    """
    target = Path(output_dir) / NAME
    bands = select_bands(run.model.wavelengths_nm, options.bands)
    require_format(target, options.format, len(bands), len(EXTRA))
    sampler, dataset = run.manager.train_pixel_sampler, run.manager.train_dataset
    painted_masks = None
    if options.roi_masks is not None:
        painted_masks = read_roi_masks(options.roi_masks, dataset.frames, sampler.masks[0].shape)
    masks = np.ones_like(sampler.masks) if options.keep_turntable else sampler.masks
    batch = min(options.num_rays_per_batch, run.model.config.eval_num_rays_per_chunk)
    renders = render_depth_maps(run.model, dataset.cameras, masks, batch, options.depth_output_name)
    box_m = run.dataset.scene_box_m if options.keep_turntable else run.dataset.object_box_m
    region = _region(run, renders, options, painted_masks)
    surface = sample_surface_points(run.model, renders, options.num_points, batch, run.to_scene(box_m), region)
    if len(surface) < options.num_points:
        CONSOLE.print(f"[yellow]Only {len(surface):,} points were found: the region holds hardly any surface.")
    if options.remove_outliers:
        surface = surface.select(statistical_inliers(surface.points, options.std_ratio))
        if not len(surface):
            raise InputError("every point counts as an outlier; give a larger --std-ratio.")
    normals = None
    if options.normal_method == "open3d":
        normals = estimate_normals(surface.points, surface.mesh_normals if options.reorient_normals else None)
    flags = np.stack([frame.flags() for frame in dataset.frames]) if run.dataset.flagged_values else None
    chunks = _RenderedChunks(run, renders, flags, surface, normals, bands, options, batch)
    cloud = CloudStream(len(surface), run.model.wavelengths_nm[bands], EXTRA, chunks)
    path = write_cloud(target, cloud, options.format)
    summary = f"{cloud.count:,} points with {len(bands)} bands, in metres: {escape(str(path))}"
    CONSOLE.print(f"[bold green]{summary}", soft_wrap=True)
    return path


def export_spectral_point_cloud(options: ExportPointCloud) -> None:
    """`ns-export pointcloud` for a run of hsi-sc-nerf: write ``point_cloud.ply`` (metres, object frame).

    Raises:
        SystemExit: with one sentence, if the model holds no object or the file cannot be written.
    """
    try:
        export_cloud(open_run(options.load_config), options.output_dir, CloudOptions.from_nerfstudio(options))
    except InputError as error:
        raise SystemExit(f"hsi-sc-nerf: {error}") from error


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
    if options.roi_cylinder is not None:
        x, y, radius, low, high = options.roi_cylinder
        box_m = np.array([[x - radius, y - radius, low], [x + radius, y + radius, high]])
        regions.append(cylinder_region(run.to_scene(box_m)))
    if painted_masks is not None:
        regions.append(painted_region(painted_masks, renders))
    return reduce(and_, regions)


@dataclass(frozen=True, eq=False)
class _RenderedChunks:
    """The cloud's chunks, each rendered when it is written."""

    run: TrainedRun
    renders: DepthRenders
    flags: UInt8[np.ndarray, "frames lines samples"] | None
    surface: SurfacePoints
    normals: Float[np.ndarray, "n 3"] | None
    bands: Int[np.ndarray, "bands"]
    options: CloudOptions
    batch: int

    def __iter__(self) -> Iterator[SpectralCloud]:
        with progress_bar("rendering spectra", "points", len(self.surface)) as update:
            for start in range(0, len(self.surface), CHUNK_POINTS):
                rows = slice(start, start + CHUNK_POINTS)
                yield self._rendered(self.surface.select(rows), None if self.normals is None else self.normals[rows])
                update(min(rows.stop, len(self.surface)))

    def _rendered(self, surface: SurfacePoints, normals: np.ndarray | None) -> SpectralCloud:
        model, manager = self.run.model, self.run.manager
        bands = torch.from_numpy(self.bands).to(model.device)
        parts = []
        for start in range(0, len(surface), self.batch):
            part = surface.select(slice(start, start + self.batch))
            rendered, *columns = render_points(model, manager.train_dataset.cameras, part, self.options)
            parts.append([column.cpu().numpy() for column in (rendered[:, bands], *columns)])
        spectra, opacity, colours, model_normals = (np.concatenate(column) for column in zip(*parts, strict=True))
        points, outward = (
            torch.from_numpy(array).float().to(model.device) for array in (surface.points, surface.mesh_normals)
        )
        reader = manager.train_pixel_sampler.reader
        statistics = view_statistics(points, outward, spectra, self.bands, self.renders, reader, self.flags)
        return SpectralCloud(
            self.run.to_metres(surface.points).astype(np.float32),
            model_normals if normals is None else normals.astype(np.float32),
            to_8_bit(colours),
            spectra,
            model.wavelengths_nm[self.bands],
            {"opacity": opacity, INCIDENCE: surface.incidence_deg.astype(np.float32), **statistics},
        )


@torch.no_grad()
def render_points(
    model: SpectralModel, cameras: Cameras, surface: SurfacePoints, options: CloudOptions
) -> tuple[Float[Tensor, "n bands"], Float[Tensor, "n"], Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Render the ray of each point.

    Args:
        model: trained model, in evaluation mode.
        cameras: the training cameras.
        surface: points of the surface.
        options: name the outputs that give colours and normals.

    Returns:
        The object's reflectance, without the background's part; the ray's opacity; colours, red, green, blue in
        [0, 1]; unit normals.

    Raises:
        InputError: the model has no such output, or the colours do not have three channels.
    """
    rays = camera_rays(cameras, surface.frames, surface.xy_px, model.device)
    outputs, spectra = render_object(model, rays)
    if options.rgb_output_name == "rgb":
        colours = spectra[:, model.rgb_bands]
    else:
        colours = model_output(outputs, options.rgb_output_name, "rgb")
        if colours.shape[1:] != (3,):
            raise InputError(
                f"--rgb-output-name {options.rgb_output_name}: is no picture of red, green and blue; take rgb."
            )
    if options.normal_output_name == "normals":
        points = torch.from_numpy(surface.points).float().to(model.device)
        normals = -functional.normalize(model.field.density_gradient(points), dim=-1)
    else:
        # The model's outputs show -1 to 1 as 0 to 1.
        encoded = model_output(outputs, options.normal_output_name, "normal")
        normals = functional.normalize(2.0 * encoded - 1.0, dim=-1)
    if options.reorient_normals:
        away = (normals * rays.directions).sum(dim=-1, keepdim=True) > 0.0
        normals = torch.where(away, -normals, normals)
    return spectra, outputs["accumulation"][:, 0], colours.clamp(0.0, 1.0), normals
