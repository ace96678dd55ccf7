"""What ``ns-export pointcloud`` does for a run of hsi-sc-nerf."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.scripts.exporter import ExportPointCloud
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.utils.rich_utils import CONSOLE

from hsi_sc_nerf.data.datamanager import SpectralDataManager
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.clean import estimate_normals, statistical_inliers
from hsi_sc_nerf.export.ply import write_spectral_ply
from hsi_sc_nerf.export.point_cloud import SurfacePoints, sample_surface_points
from hsi_sc_nerf.models.spectral_model import SpectralModel


def export_spectral_point_cloud(options: ExportPointCloud) -> None:
    """Write ``point_cloud.ply`` in metres and the object frame, with a property for each band.

    Raises:
        SystemExit: with one sentence, where the model holds no object or the file cannot be written.
    """
    _, pipeline, _, _ = eval_setup(options.load_config)
    manager = cast(SpectralDataManager, pipeline.datamanager)
    model = cast(SpectralModel, pipeline.model)
    scene = manager.train_dataparser_outputs
    try:
        cloud = sample_surface_points(
            model,
            manager.train_dataset.cameras,
            manager.train_pixel_sampler.masks,
            options.num_points,
            options.num_rays_per_batch,
            box=scene.metadata["object_box"],
        )
        cloud = _finish(cloud, options)
        centre = -scene.dataparser_transform[:, 3].numpy()
        points_m = np.asarray(cloud.points / scene.dataparser_scale + centre, np.float32)
        path = Path(options.output_dir) / "point_cloud.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        wavelengths_nm = model.wavelengths_nm
        write_spectral_ply(path, points_m, cloud.normals, cloud.colours, cloud.spectra, wavelengths_nm)
    except InputError as error:
        raise SystemExit(f"hsi-sc-nerf: {error}") from error
    CONSOLE.print(f"[bold green]{len(points_m):,} points with {len(wavelengths_nm)} bands, in metres: {path}")


def _finish(cloud: SurfacePoints, options: ExportPointCloud) -> SurfacePoints:
    """Crop, clean and give normals as nerfstudio's options say."""
    if options.obb_center is not None and options.obb_rotation is not None and options.obb_scale is not None:
        crop = OrientedBox.from_params(options.obb_center, options.obb_rotation, options.obb_scale)
        cloud = cloud.select(crop.within(torch.from_numpy(cloud.points)).numpy())
        if len(cloud.points) == 0:
            raise InputError("the oriented box holds no point of the object; check --obb-center and --obb-scale.")
    if options.remove_outliers:
        cloud = cloud.select(statistical_inliers(cloud.points, options.std_ratio))
    if options.normal_method == "open3d":
        cloud = replace(cloud, normals=estimate_normals(cloud.points, facing=cloud.normals))
    return cloud
