"""The spectral cloud of a trained run, written piece by piece: what `ns-export pointcloud` and our command do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import and_
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import CHUNK_POINTS, INCIDENCE, CloudStream, SpectralCloud
from hsi_sc_nerf.export.formats import require_format, write_cloud
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.models.trained_run import TrainedRun, open_run
from hsi_sc_nerf.progress import progress_bar
from hsi_sc_nerf.spectra.pseudo_rgb import to_8_bit
from hsi_sc_nerf.surface.depth_renders import SeenSurface, look_from_cameras
from hsi_sc_nerf.surface.outliers import estimate_normals, statistical_inliers
from hsi_sc_nerf.surface.point_cloud import SurfacePoints, render_points, spread_points
from hsi_sc_nerf.surface.regions import EVERYWHERE, Region, around_cylinder, chosen_bands, in_box, in_cylinder
from hsi_sc_nerf.surface.roi_masks import in_roi_masks, read_roi_masks
from hsi_sc_nerf.surface.silhouettes import silhouettes, within_silhouettes
from hsi_sc_nerf.surface.view_spread import COLUMNS, MeasuredFrames, spread_over_views

if TYPE_CHECKING:
    from nerfstudio.scripts.exporter import ExportPointCloud

NAME = "point_cloud"
EXTRA = ("opacity", INCIDENCE, *COLUMNS)


def export_spectral_point_cloud(options: ExportPointCloud) -> None:
    """What `ns-export pointcloud` does for a run of hsi-sc-nerf: ``point_cloud.ply``, metres, object frame.

    Raises:
        SystemExit: with one sentence, where the model holds no object or the file cannot be written.
    """
    try:
        export_cloud(open_run(options.load_config), options.output_dir, CloudOptions.from_nerfstudio(options))
    except InputError as error:
        raise SystemExit(f"hsi-sc-nerf: {error}") from error


def export_cloud(run: TrainedRun, output_dir: Path, options: CloudOptions) -> Path:
    """Write the cloud of a run to ``OUTPUT_DIR/point_cloud.*`` (metres, object frame) and return its path.

    Columns beside spectra, normals and colours: ``opacity`` of the point's ray, ``incidence_deg`` at which that meets
    the surface, and `view_spread.COLUMNS`.

    Raises:
        InputError: the model holds no object, an option cannot be met, or the file cannot be written.
    """
    target = Path(output_dir) / NAME
    bands = chosen_bands(run.model.wavelengths_nm, options.bands)
    require_format(target, options.format, len(bands), len(EXTRA))
    sampler = run.manager.train_pixel_sampler
    painted = None
    if options.roi_masks is not None:
        painted = read_roi_masks(options.roi_masks, run.manager.train_dataset.frames, sampler.masks[0].shape)
    masks = np.ones_like(sampler.masks) if options.keep_turntable else sampler.masks
    batch = min(options.num_rays_per_batch, run.model.config.eval_num_rays_per_chunk)
    cameras = run.manager.train_dataset.cameras
    seen = look_from_cameras(run.model, cameras, masks, batch, options.depth_output_name)
    box_m = run.dataset.scene_box_m if options.keep_turntable else run.dataset.object_box_m
    region = _region(run, seen, options, painted)
    surface = spread_points(run.model, seen, options.num_points, batch, run.to_scene(box_m), region)
    if len(surface) < options.num_points:
        CONSOLE.print(
            f"[yellow]Only {len(surface):,} points were found: hardly any of the surface lies in the region."
        )
    if options.remove_outliers:
        surface = surface.select(statistical_inliers(surface.points, options.std_ratio))
        if not len(surface):
            raise InputError("every point counts as an outlier; give a larger --std-ratio.")
    normals = None
    if options.normal_method == "open3d":
        facing = surface.facing if options.reorient_normals else np.zeros_like(surface.facing)
        normals = estimate_normals(surface.points, facing)
    flags = None
    if run.dataset.flagged_values:
        flags = np.stack([frame.flags() for frame in run.manager.train_dataset.frames])
    pieces = _Pieces(run, seen, MeasuredFrames(sampler.reader, flags), surface, normals, bands, options, batch)
    wavelengths_nm = run.model.wavelengths_nm[bands]
    cloud = CloudStream(len(surface), wavelengths_nm, EXTRA, pieces)
    path = write_cloud(target, cloud, options.format)
    summary = f"{cloud.count:,} points with {len(bands)} bands, in metres: {escape(str(path))}"
    CONSOLE.print(f"[bold green]{summary}", soft_wrap=True)
    return path


def _region(
    run: TrainedRun,
    seen: SeenSurface,
    options: CloudOptions,
    painted: Mapping[int, Bool[np.ndarray, "lines samples"]] | None,
) -> Region:
    """Which points the options and the painted masks, by frame, keep."""
    regions: list[Region] = []
    device = run.model.device
    if not options.keep_turntable:
        outlines = silhouettes(seen.maps.masks)

        def on_object(points: np.ndarray, _: np.ndarray) -> np.ndarray:
            where = torch.from_numpy(points).float().to(device)
            return within_silhouettes(seen.maps, outlines, where).cpu().numpy()

        regions.append(Region(on_object))
    if options.obb_center is not None and options.obb_rotation is not None and options.obb_scale is not None:
        crop = OrientedBox.from_params(options.obb_center, options.obb_rotation, options.obb_scale)
        reach = np.abs(crop.R.numpy()) @ np.divide(options.obb_scale, 2.0)
        bounds = np.array(options.obb_center) + np.stack([-reach, reach])
        regions.append(Region(lambda points, _: crop.within(torch.from_numpy(points).float()).numpy(), bounds))
    if options.roi_box is not None:
        box_m = np.reshape(options.roi_box, (2, 3))
        regions.append(Region(lambda points, _: in_box(run.to_metres(points), box_m), run.to_scene(box_m)))
    if options.roi_cylinder is not None:
        x, y, radius_m, low_m, high_m = options.roi_cylinder
        cylinder = ((x, y), radius_m, (low_m, high_m))
        bounds = run.to_scene(around_cylinder(*cylinder))
        regions.append(Region(lambda points, _: in_cylinder(run.to_metres(points), *cylinder), bounds))
    if painted is not None:
        masks = {frame: torch.from_numpy(mask).to(device) for frame, mask in painted.items()}

        def in_painted(points: np.ndarray, facing: np.ndarray) -> np.ndarray:
            where, outwards = (torch.from_numpy(array).float().to(device) for array in (points, facing))
            return in_roi_masks(masks, seen.maps, where, outwards).cpu().numpy()

        regions.append(Region(in_painted))
    return reduce(and_, regions, EVERYWHERE)


@dataclass(frozen=True, eq=False)
class _Pieces:
    """The cloud's pieces, rendered when they are asked for."""

    run: TrainedRun
    seen: SeenSurface
    measured: MeasuredFrames
    surface: SurfacePoints
    normals: Float[np.ndarray, "n 3"] | None
    bands: Int[np.ndarray, "bands"]
    options: CloudOptions
    batch: int

    def __iter__(self) -> Iterator[SpectralCloud]:
        with progress_bar("rendering spectra", "points", len(self.surface)) as done:
            for start in range(0, len(self.surface), CHUNK_POINTS):
                rows = slice(start, start + CHUNK_POINTS)
                piece = self.surface.select(rows)
                yield self._rendered(piece, None if self.normals is None else self.normals[rows])
                done(start + len(piece))

    def _rendered(self, piece: SurfacePoints, normals: np.ndarray | None) -> SpectralCloud:
        model, options = self.run.model, self.options
        rendered = SpectralCloud(
            np.asarray(self.run.to_metres(piece.points), np.float32),
            np.empty((len(piece), 3), np.float32),
            np.empty((len(piece), 3), np.uint8),
            np.empty((len(piece), len(self.bands)), np.float32),
            model.wavelengths_nm[self.bands],
            {"opacity": np.empty(len(piece), np.float32), INCIDENCE: piece.incidence_deg.astype(np.float32)},
        )
        bands = torch.from_numpy(self.bands).to(model.device)
        for start in range(0, len(piece), self.batch):
            rows = slice(start, start + self.batch)
            rays = render_points(
                model,
                self.run.manager.train_dataset.cameras,
                piece.select(rows),
                options.rgb_output_name,
                options.normal_output_name,
                options.reorient_normals,
            )
            rendered.spectra[rows] = rays.spectra[:, bands].cpu().numpy()
            rendered.extra["opacity"][rows] = rays.opacity.cpu().numpy()
            rendered.colours[rows] = to_8_bit(rays.colours.cpu().numpy())
            rendered.normals[rows] = rays.normals.cpu().numpy()
        if normals is not None:
            rendered.normals[:] = normals
        points, facing = (torch.from_numpy(a).float().to(model.device) for a in (piece.points, piece.facing))
        rendered.extra.update(
            spread_over_views(points, facing, rendered.spectra, self.bands, self.seen.maps, self.measured)
        )
        return rendered
